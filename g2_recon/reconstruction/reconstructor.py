# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Reconstruction of a surface by clusters and self-organizing maps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from g2_recon.config import ReconstructionConfig
from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud, Piece
from g2_recon.progress import Progress, silent
from g2_recon.reconstruction.collected_cloud import CollectedCloud
from g2_recon.reconstruction.paper import reconstruct_as_published
from g2_recon.reconstruction.result import Reconstruction
from g2_recon.reconstruction.solid import reconstruct_solid

FEWEST_POINTS = 10
# Among so many points of a real cloud enough are distinct; only where they are not, all are looked at.
_ENOUGH_TO_SEE = 1000
# No robot drives so far; what is wider has stray points or is not in metres.
_LARGEST_M = 1e6


def reconstruct(cloud: Cloud, config: ReconstructionConfig, *, progress: Progress = silent) -> Reconstruction:
    """Reconstruct the surface that a cloud was measured on.

    Raises InputError where the cloud has too few distinct points for a surface.
    """
    usable, left_out = usable_points(cloud, config)
    way = reconstruct_solid if config.mode == "solid" else reconstruct_as_published
    result = way(usable, config, progress=progress)
    return replace(result, left_out=left_out | result.left_out)


def usable_points(cloud: Cloud, config: ReconstructionConfig) -> tuple[Cloud, dict[str, int]]:
    """The cloud without what cannot be surface, and how many points were left out, by reason.

    Raises InputError where fewer than ten distinct points, or none off a line, remain.
    """
    finite = cloud.finite()
    left_out = {"not finite": len(cloud) - len(finite)}
    good = finite
    if finite.sensor is not None and config.min_sensor_distance > 0:
        distance = np.linalg.norm(finite.points - finite.sensor, axis=1)
        near = distance < config.min_sensor_distance
        good = finite.select(~near) if near.any() else finite
    left_out["nearer to the sensor than min_sensor_distance"] = len(finite) - len(good)
    distinct = len(np.unique(good.points[:_ENOUGH_TO_SEE], axis=0))
    if distinct < FEWEST_POINTS and len(good) > _ENOUGH_TO_SEE:
        distinct = len(np.unique(good.points, axis=0))
    if distinct < FEWEST_POINTS:
        raise InputError(
            f"the cloud has {distinct} distinct usable points of {len(cloud)}",
            advice=f"a surface needs at least {FEWEST_POINTS}",
        )
    size = float(np.ptp(good.points, axis=0).max())
    if size > _LARGEST_M:
        raise InputError(
            f"the cloud is {size:.3g} m wide",
            advice="give coordinates in metres, and leave out points that are far off",
        )
    # Where a part of the points is not on one line, neither are all.
    if _on_one_line(good.points[:_ENOUGH_TO_SEE]) and _on_one_line(good.points):
        raise InputError("all points of the cloud lie on one line", advice="a surface needs points beside it")
    return good, {reason: count for reason, count in left_out.items() if count}


def _on_one_line(points: NDArray[np.float64]) -> bool:
    extent = np.linalg.svd(np.cov((points - points.mean(axis=0)).T), compute_uv=False)
    return bool(extent[1] <= 1e-12 * extent[0])


class Reconstructor:
    """Collects clouds as they come and reconstructs what there is on request."""

    def __init__(self, config: ReconstructionConfig) -> None:
        self._config = config
        self._collected = CollectedCloud()

    def __len__(self) -> int:
        return len(self._collected)

    def add_cloud(self, cloud: Cloud, piece: Piece | None = None, *, topic: str = "", leave_out: bool = False) -> str:
        """Add points in the map frame, or replace them; see CollectedCloud.add."""
        return self._collected.add(cloud, piece, topic=topic, leave_out=leave_out)

    def cloud(self) -> Cloud:
        """All points so far."""
        return self._collected.cloud()

    def reconstruct(self, *, progress: Progress = silent) -> Reconstruction:
        """Reconstruct from all points so far; see the function of the same name."""
        return reconstruct(self.cloud(), self._config, progress=progress)

    def reset(self) -> None:
        """Forget all points."""
        self._collected.clear()
