# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A frame that a cloud has of itself: what is made of it does not depend on where it lies and how it is turned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g2_recon.geometry.chunks import in_chunks
from g2_recon.geometry.cloud import Cloud

Float = NDArray[np.float64]

# Walls are mostly along the principal axes. Turned off these, no wall lies along the sides of voxels, where noise would
# spread it over two layers of them.
_ASIDE = Rotation.from_euler("xyz", (0.41, 0.67, 0.53)).as_matrix()


@dataclass(frozen=True, slots=True)
class OwnFrame:
    """origin: (3,) m. axes: (3, 3) right-handed, unit rows; both in the frame of the cloud."""

    origin: Float
    axes: Float

    def of(self, cloud: Cloud, *, workers: int = 1) -> Cloud:
        """The cloud in this frame."""
        sensor = None if cloud.sensor is None else self._of(cloud.sensor, workers)
        return Cloud(self._of(cloud.points, workers), sensor)

    def _of(self, points: Float, workers: int) -> Float:
        result = np.empty(points.shape)

        def turn(begin: int, end: int) -> None:
            np.matmul(points[begin:end] - self.origin, self.axes.T, out=result[begin:end])

        in_chunks(turn, len(points), workers)
        return result

    def back(self, points: Float) -> Float:
        """Points (N, 3) of this frame in the frame of the cloud."""
        return np.asarray(points @ self.axes + self.origin)


def own_frame(points: Float) -> OwnFrame:
    """The principal axes of points (N, 3), turned to the side of the longer tail, and then aside by fixed angles."""
    origin = points.mean(axis=0)
    relative = points - origin
    axes = np.linalg.eigh(relative.T @ relative)[1].T[::-1]
    along = relative @ axes[:2].T
    tail = np.einsum("nk,nk,nk->k", along, along, along)
    first, second = axes[:2] * np.where(tail < 0, -1.0, 1.0)[:, None]
    return OwnFrame(origin, _ASIDE @ np.stack([first, second, np.cross(first, second)]))
