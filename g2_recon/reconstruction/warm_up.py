# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The kernels of a live reconstruction, run once: so that they are compiled or, where they are already, loaded."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g2_recon.config import ReconstructionConfig
from g2_recon.geometry.cloud import Cloud
from g2_recon.geometry.point_tree import are_near
from g2_recon.reconstruction.collected_cloud import Part
from g2_recon.reconstruction.flat_submaps import FlatSubmaps, train_submaps
from g2_recon.reconstruction.growing import GrowingReconstruction
from g2_recon.reconstruction.mesh_of_submaps import mesh_of_submaps
from g2_recon.reconstruction.normals import SECTORS
from g2_recon.reconstruction.solid import find_clusters, find_surface
from g2_recon.reconstruction.surface_points import SurfacePoints

_CONFIG = ReconstructionConfig(workers=1)
# Neurons along a side of the floor that is joined.
_ALONG = 15


def warm_up_reconstruction() -> None:
    """All of them."""
    growing, cloud = GrowingReconstruction(_CONFIG), corner_of_a_room(with_sensor=True)
    for end in (len(cloud) - 10, len(cloud)):
        growing.update({0: Part(0, cloud.select(np.arange(end)))})


def warm_up_submaps() -> None:
    """Those of phases 0 to 2: up to submaps that are trained."""
    surface = find_surface(corner_of_a_room(with_sensor=True), _CONFIG, 1)
    find_clusters(surface, _CONFIG, 1)
    are_near(surface.points, surface.points[:1], _CONFIG.spacing, 1)
    points = _floor(0.1)
    train_submaps(
        points,
        np.ones(len(points)),
        np.zeros(len(points), np.int64),
        points[:1],
        np.array([[0.0, 0.0, 1.0]]),
        np.zeros(1),
        spacing=_CONFIG.spacing,
        noise=0.01,
        epochs=2,
        workers=1,
    )


def warm_up_joining() -> None:
    """Those of phases 3 and 4, and none of the others."""
    surface = _surface_without_neighbors(corner_of_a_room(with_sensor=False).points)
    neurons = _floor(_CONFIG.spacing)
    row = np.arange(len(neurons) - _ALONG)[np.arange(len(neurons) - _ALONG) % _ALONG < _ALONG - 1]
    # Two halves with a strip between them that is to be joined.
    row = row[row // _ALONG != _ALONG // 2]
    corners = row, row + _ALONG, row + _ALONG + 1, row + 1
    submaps = FlatSubmaps(
        vertices=neurons,
        normals=np.tile([0.0, 0.0, 1.0], (len(neurons), 1)),
        center=neurons.copy(),
        submap=(np.arange(len(neurons)) // _ALONG > _ALONG // 2).astype(np.int64),
        faces=np.concatenate([np.stack(corners[:3], axis=1), np.stack((corners[0], *corners[2:]), axis=1)]),
        hits=np.ones(len(neurons), np.int64),
        covered=np.ones(len(neurons), bool),
        bent=np.array([True, False]),
        bmu=np.zeros(len(surface), np.int64),
    )
    nearest = np.linalg.norm(surface.points[:, None] - neurons, axis=2).argmin(axis=1)
    mesh_of_submaps(surface, submaps, nearest, _CONFIG, 1)


def _surface_without_neighbors(points: NDArray[np.float64]) -> SurfacePoints:
    count = len(points)
    return SurfacePoints(
        points=points,
        normals=np.tile([0.0, 0.0, 1.0], (count, 1)),
        weights=np.ones(count),
        noise=0.01,
        neighbors=np.repeat(np.arange(count, dtype=np.int32), SECTORS).reshape(-1, SECTORS),
        cells=np.arange(count, dtype=np.uint64),
        voxel=0.1,
        kept=np.arange(count),
        rejected={},
    )


def corner_of_a_room(*, with_sensor: bool) -> Cloud:
    """Three sides of a room of 3 m, a point each 10 cm."""
    floor = _floor(0.1)
    points = np.concatenate([np.roll(floor, shift, axis=1) for shift in range(3)])
    return Cloud(points, np.full_like(points, 1.5) if with_sensor else None)


def _floor(step: float) -> NDArray[np.float64]:
    """Points (N, 3) on a floor of 3 m, so many metres apart, row by row."""
    u, v = (grid.ravel() for grid in np.meshgrid(np.arange(0, 3, step), np.arange(0, 3, step), indexing="ij"))
    return np.column_stack([u, v, 0 * u])
