# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What a localizer says of one scan."""

from __future__ import annotations

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
