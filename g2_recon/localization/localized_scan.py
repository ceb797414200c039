# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What a localizer says of one scan."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class LocalizedScan:
    """Where the robot was when a scan was taken.

    stamp: s. pose: (3,) x, y, yaw of T_map_base. covariance: (3, 3) of x, y, yaw in the map frame. inliers: share of
    the beams that fit the map. matched: false where the match was rejected and the pose follows the first guess.
    keyframe: whether the scan was added to the map.
    """

    stamp: float
    pose: NDArray[np.float64]
    covariance: NDArray[np.float64]
    inliers: float
    matched: bool
    keyframe: bool

    @property
    def weak_axis(self) -> tuple[float, float, float]:
        """How the position is known least: direction in the map, rad in [-pi/2, pi/2), sigma along and across it, m.

        Along a bare corridor, that is its direction.
        """
        values, vectors = np.linalg.eigh(self.covariance[:2, :2])
        across, along = np.sqrt(np.maximum(values, 0.0))
        direction = math.atan2(vectors[1, 1], vectors[0, 1])
        return (direction + math.pi / 2) % math.pi - math.pi / 2, float(along), float(across)
