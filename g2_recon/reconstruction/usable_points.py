# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Which points of a cloud may be surface, and whether these are enough for one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.chunks import in_chunks
from g2_recon.geometry.cloud import Cloud

Float = NDArray[np.float64]

FEWEST_POINTS = 10
# Among so many points of a real cloud enough are distinct; only where they are not, all are looked at.
_ENOUGH_TO_SEE = 1000
# No robot drives so far; what is wider has stray points or is not in metres.
_LARGEST_M = 1e6


def usable_points(cloud: Cloud, *, min_sensor_distance: float = 0.0, workers: int = 1) -> tuple[Cloud, dict[str, int]]:
    """The cloud without what cannot be surface, and how many points were left out, by reason.

    min_sensor_distance: m, what is nearer to the sensor is the robot itself.
    Raises InputError where fewer than ten distinct points, or none off a line, remain.
    """
    finite = cloud.finite()
    left_out = {"not finite": len(cloud) - len(finite)}
    near = near_sensor(finite, min_sensor_distance, workers)
    good = finite.select(~near) if near.any() else finite
    left_out["nearer to the sensor than min_sensor_distance"] = len(finite) - len(good)
    check_enough(good, len(cloud))
    return good, {reason: count for reason, count in left_out.items() if count}


def check_enough(good: Cloud, count: int) -> None:
    """Raises InputError where the good ones among `count` points are too few for a surface, on one line or too wide."""
    distinct = distinct_points(good.points)
    if distinct < FEWEST_POINTS:
        raise InputError(
            f"the cloud has {distinct} distinct usable points of {count}",
            advice=f"a surface needs at least {FEWEST_POINTS}",
        )
    size = max(float(np.ptp(column)) for column in good.points.T)
    if size > _LARGEST_M:
        raise InputError(
            f"the cloud is {size:.3g} m wide",
            advice="give coordinates in metres, and leave out points that are far off",
        )
    # Where a part of the points is not on one line, neither are all.
    if _on_one_line(good.points[:_ENOUGH_TO_SEE]) and _on_one_line(good.points):
        raise InputError("all points of the cloud lie on one line", advice="a surface needs points beside it")


def distinct_points(points: Float) -> int:
    """How many of points (N, 3) differ; where the first few are enough for a surface, only of those."""
    count = len(np.unique(points[:_ENOUGH_TO_SEE], axis=0))
    if count < FEWEST_POINTS and len(points) > _ENOUGH_TO_SEE:
        count = len(np.unique(points, axis=0))
    return count


def near_sensor(cloud: Cloud, distance: float, workers: int) -> NDArray[np.bool_]:
    """Mask (N,) of the points nearer to their sensor than `distance` (m); none where sensors are not known."""
    near = np.zeros(len(cloud), bool)
    points, sensor = cloud.points, cloud.sensor
    if sensor is None or distance <= 0:
        return near

    def look(begin: int, end: int) -> None:
        away = points[begin:end] - sensor[begin:end]
        near[begin:end] = np.einsum("ni,ni->n", away, away) < distance**2

    in_chunks(look, len(cloud), workers)
    return near


def _on_one_line(points: Float) -> bool:
    extent = np.linalg.svd(np.cov((points - points.mean(axis=0)).T), compute_uv=False)
    return bool(extent[1] <= 1e-12 * extent[0])
