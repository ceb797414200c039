# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The whole map of robots made ready for matching as a sweep is: with what all lasers looked through."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from g2_recon.config import SweepConfig
from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud
from g2_recon.kernels import kernel
from g2_recon.registration.prepared_sweep import PreparedSweep, prepare

Float = NDArray[np.float64]

# Edge of a cube of space, m; it is free if so many beams went through it that ended so far behind it, m.
_CUBE_M, _BEAMS, _BEHIND_M = 0.2, 2, 0.3
_MOST_CUBES = 100_000_000


@dataclass(frozen=True, slots=True)
class PreparedMap(PreparedSweep):
    """A map in the frame of its world, and how many beams went through each cube of its space.

    beams: (X, Y, Z), at most 255. corner: (3,) m, where the first cube begins. `nearest` says nothing: lasers were in
    many places.
    """

    beams: NDArray[np.uint8]
    corner: Float

    def seen_through(self, places: Float, margin: float) -> NDArray[np.bool_]:
        """Mask (K,) of the places (K, 3) that lasers looked through; cubes are coarser than any margin."""
        with np.errstate(invalid="ignore"):
            cubes = np.floor((places - self.corner) / _CUBE_M).astype(np.int64)
        inside = ((cubes >= 0) & (cubes < self.beams.shape)).all(axis=1)
        result = np.zeros(len(places), np.bool_)
        result[inside] = self.beams[tuple(cubes[inside].T)] >= _BEAMS
        return result


def prepare_map(cloud: Cloud, config: SweepConfig) -> PreparedMap:
    """Make a map, points with where each was seen from, ready to have sweeps laid on it.

    Raises InputError where it has too few points, does not tell where they were seen from, or is too large.
    """
    if cloud.sensor is None:
        raise InputError("a cloud does not tell where its points were seen from", advice="leave it out")
    ranges = np.linalg.norm(cloud.points - cloud.sensor, axis=1)
    cloud = cloud.select((ranges >= config.min_range) & (ranges <= config.max_range))
    # Those limits are of the ranges of beams, not of how far from its origin a map reaches.
    whole = prepare(cloud.points, config.model_copy(update={"min_range": 0.0, "max_range": np.inf, "scale": 1.0}))
    assert cloud.sensor is not None
    both = np.concatenate([cloud.points, cloud.sensor])
    corner = both.min(axis=0)
    size = np.floor((both.max(axis=0) - corner) / _CUBE_M).astype(np.int64) + 1
    if np.prod(size.astype(float)) > _MOST_CUBES:
        raise InputError(f"a map of {np.ptp(both, axis=0)} m is too large to look for sweeps in", advice="map in parts")
    beams = np.zeros(size, np.uint8)
    count_beams(beams, cloud.sensor, cloud.points, corner, _CUBE_M, _BEHIND_M)
    parts = {field.name: getattr(whole, field.name) for field in fields(whole) if field.name != "nearest"}
    return PreparedMap(**parts, nearest=np.full_like(whole.nearest, np.nan), beams=beams, corner=corner)


@kernel
def count_beams(beams, sensors, points, corner, edge, behind):  # type: ignore[no-untyped-def]
    """Add to the cubes (X, Y, Z) the beams (N,) from sensors to points (N, 3) that end `behind` m after them."""
    for row in range(len(points)):
        x, y, z = sensors[row, 0] - corner[0], sensors[row, 1] - corner[1], sensors[row, 2] - corner[2]
        dx, dy, dz = (
            points[row, 0] - sensors[row, 0],
            points[row, 1] - sensors[row, 1],
            points[row, 2] - sensors[row, 2],
        )
        length = (dx * dx + dy * dy + dz * dz) ** 0.5
        steps = int((length - behind) / edge)
        for step in range(steps):
            share = (step + 0.5) * edge / length
            u, v, w = int((x + share * dx) / edge), int((y + share * dy) / edge), int((z + share * dz) / edge)
            if beams[u, v, w] < 255:
                beams[u, v, w] += 1
