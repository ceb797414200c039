# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Compile kernels, so that no first use has to wait for it: python -m g2_recon.warm_up [PART...].

Parts are tracking (of localization, in a new map), smoothing (the half of it that another process compiles meanwhile),
localization, registration, reconstruction (of clouds with sensors, mode solid) and submaps (the half of that which
another process compiles meanwhile); without any, all kernels there are.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

import numpy as np

from g2_recon.config import ReconstructionConfig, RegistrationConfig, SweepConfig
from g2_recon.evaluation.surface import score_surface
from g2_recon.geometry.cloud import Cloud
from g2_recon.geometry.mesh import TrueSurface
from g2_recon.geometry.scan import Scan
from g2_recon.localization.warm_up import (
    warm_up_localization,
    warm_up_mapping,
    warm_up_matching,
    warm_up_smoothing,
    warm_up_tracking,
)
from g2_recon.reconstruction.reconstructor import reconstruct
from g2_recon.reconstruction.warm_up import (
    corner_of_a_room,
    warm_up_joining,
    warm_up_reconstruction,
    warm_up_submaps,
)
from g2_recon.registration.prepared_map import prepare_map
from g2_recon.registration.prepared_sweep import prepare
from g2_recon.registration.registrar import Registrar


def warm_up() -> None:
    """Run every kernel once on a few points; Numba keeps what it compiles on disk."""
    warm_up_localization()
    warm_up_registration()
    warm_up_reconstruction()
    cloud = corner_of_a_room(with_sensor=False)
    reconstruct(cloud, ReconstructionConfig())
    triangles = np.eye(3), np.array([[0, 1, 2], [2, 1, 0]])
    score_surface(TrueSurface(*triangles), *triangles, samples=10)
    published = ReconstructionConfig(mode="paper", clusters=4, passes=50)
    for other in ({}, {"training": "batch"}, {"clustering": "neural_gas", "presentations": 100, "passes": 1}):
        reconstruct(cloud, published.model_copy(update=other))


def warm_up_registration() -> None:
    """The same for the kernels of registration only."""
    registrar = Registrar(RegistrationConfig(), np.eye(4), keep_scans=True)
    registrar.add_pose(0.0, np.eye(4))
    registrar.add_scan(Scan(0.0, np.ones(2, np.float32), 0.0, 1.0))
    points = np.random.default_rng(0).uniform(-2.0, 2.0, (1000, 3))
    sweep = prepare(points, SweepConfig())
    sweep.seen_through(sweep.points, 0.1)
    prepare_map(Cloud(points, np.zeros_like(points)), SweepConfig())


def _in_two(one: Callable[[], None], other: str, all_of_it: Callable[[], None]) -> None:
    """One half here, the other part in another process, as somebody waits for it; then all, which loads them."""
    beside = subprocess.Popen([sys.executable, "-m", "g2_recon.warm_up", other])
    one()
    beside.wait()
    all_of_it()


PARTS: dict[str, Callable[[], None]] = {
    "tracking": lambda: _in_two(warm_up_matching, "smoothing", warm_up_tracking),
    "smoothing": warm_up_smoothing,
    "localization": warm_up_mapping,
    "registration": warm_up_registration,
    "reconstruction": lambda: _in_two(warm_up_joining, "submaps", warm_up_reconstruction),
    "submaps": warm_up_submaps,
}


if __name__ == "__main__":
    for action in [PARTS[part] for part in sys.argv[1:]] or [warm_up]:
        action()
