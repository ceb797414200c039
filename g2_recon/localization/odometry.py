# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Wheel odometry from scan to scan, as far as it can be believed."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.geometry.se2_kernels import compose, relative

Float = NDArray[np.float64]

# Odometry that claims more than this between two scans has jumped: no robot indoors is that fast.
# Where stamps do not tell how long it took, as in logs without time, it may be a long way.
_JUMP_M, _JUMP_WITHOUT_TIME_M = 0.5, 3.0
_FASTEST_M_S = 5.0


class OdometrySteps:
    """Steps (3,) of the laser between scans."""

    def __init__(self, T_base_laser: Float, *, use: bool) -> None:
        """T_base_laser: (3,); without `use` there is no odometry."""
        self._T_base_laser = T_base_laser
        self._use = use
        self._last: Float | None = None
        self._stamp = np.nan
        self.jumps = 0

    @property
    def last(self) -> Float:
        """T_odom_base (3,) at the last scan, NaN where unknown."""
        return np.full(3, np.nan) if self._last is None else self._last

    def go_on(self, stamp: float, odometry: Float) -> None:
        """Go on from the scan at `stamp` s as if it had been the last one."""
        self._last, self._stamp = (None if np.isnan(odometry).any() else odometry.copy()), stamp

    def step(self, stamp: float, odometry: ArrayLike | None) -> Float | None:
        """The step to the scan at `stamp` s, where T_odom_base is `odometry` (3,); None where it is not known."""
        measured = None if odometry is None or not self._use else np.asarray(odometry, float)
        if measured is not None and not all(map(math.isfinite, measured)):
            measured = None
        last, elapsed = self._last, abs(stamp - self._stamp)
        self._last, self._stamp = measured, stamp
        if measured is None or last is None:
            return None
        step = relative(compose(last, self._T_base_laser), compose(measured, self._T_base_laser))
        farthest = _JUMP_M + _FASTEST_M_S * elapsed if elapsed else _JUMP_WITHOUT_TIME_M
        if math.dist(measured[:2], last[:2]) > farthest:
            self.jumps += 1
            return None
        return np.asarray(step)
