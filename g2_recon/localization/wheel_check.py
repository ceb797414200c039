# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Whether scans and wheels tell of the same way; they do not where a laser or its odometry is not what it should be."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.geometry import se2

# Ways of so many metres are compared, by the wheels; they contradict where they differ by more than this share.
_WAY_M, _SHARE = 0.3, 0.5
# The last so many tell, and at least so many have to.
_MOST_WAYS, _FEWEST_WAYS = 30, 10


class WheelCheck:
    """Compares the last few metres of the way as scans tell it and as wheels do."""

    def __init__(self) -> None:
        self._contradict: deque[bool] = deque(maxlen=_MOST_WAYS)
        self._begin: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    def add(self, pose: ArrayLike, odometry: ArrayLike | None) -> None:
        """`pose` (3,) of the robot in the map by the scans, and in the odometry frame by the wheels; None: unknown."""
        if odometry is None:
            self._begin = None
            return
        now = np.array(pose, float), np.array(odometry, float)
        if self._begin is None:
            self._begin = now
            return
        by_scans, by_wheels = (se2.relative(before, after) for before, after in zip(self._begin, now, strict=True))
        way = math.hypot(by_wheels[0], by_wheels[1])
        if way >= _WAY_M:
            apart = math.hypot(by_scans[0] - by_wheels[0], by_scans[1] - by_wheels[1])
            self._contradict.append(apart > _SHARE * way)
            self._begin = now

    @property
    def contradiction(self) -> float:
        """The share of the last ways that differ; 0 before there are enough of them."""
        ways = self._contradict
        return sum(ways) / len(ways) if len(ways) >= _FEWEST_WAYS else 0.0
