# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Compile all kernels, so that no first use has to wait for it: python -m g2_recon.warm_up."""

from __future__ import annotations

import numpy as np

from g2_recon.config import LocalizationConfig, ReconstructionConfig
from g2_recon.evaluation.surface import score_surface
from g2_recon.geometry.cloud import Cloud
from g2_recon.geometry.mesh import TrueSurface
from g2_recon.geometry.scan import Scan
from g2_recon.localization.localizer import Localizer
from g2_recon.reconstruction.reconstructor import reconstruct


def warm_up() -> None:
    """Run every kernel once on a few points; Numba keeps what it compiles on disk."""
    localizer = Localizer(LocalizationConfig(), np.eye(4))
    for _ in range(2):
        localizer.process(Scan(0.0, np.full(181, 2.0, np.float32), -np.pi / 2, np.pi / 180))
    for with_sensor in (True, False):
        cloud = _corner_of_a_room(with_sensor=with_sensor)
        reconstruct(cloud, ReconstructionConfig())
    triangles = np.eye(3), np.array([[0, 1, 2], [2, 1, 0]])
    score_surface(TrueSurface(*triangles), *triangles, samples=10)
    for training in ("iterative", "batch"):
        reconstruct(cloud, ReconstructionConfig(mode="paper", training=training, clusters=4, passes=50))


def _corner_of_a_room(*, with_sensor: bool) -> Cloud:
    """Three sides of a room of 3 m, a point each 10 cm."""
    u, v = (grid.ravel() for grid in np.meshgrid(np.arange(0, 3, 0.1), np.arange(0, 3, 0.1)))
    sides = [np.column_stack(columns) for columns in ((u, v, 0 * u), (u, 0 * u, v), (0 * u, u, v))]
    points = np.concatenate(sides)
    return Cloud(points, np.full_like(points, 1.5) if with_sensor else None)


if __name__ == "__main__":
    warm_up()
