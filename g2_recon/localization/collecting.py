# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Scans of a robot that does not know its place, tracked from one to the next, to be looked for at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g2_recon.config import LocalizationConfig
from g2_recon.geometry.se2_kernels import compose, relative
from g2_recon.localization.beams import SURFACE, Beams
from g2_recon.localization.keyframes import Keyframes
from g2_recon.localization.tracking import FEWEST_SURFACES, Tracker

Float = NDArray[np.float64]
Int = NDArray[np.int64]

# What is kept of a long search, so that memory does not grow; after so many scans in a row that do not match, those
# before belong to another place.
_MOST_KEYFRAMES, _KEPT_KEYFRAMES = 96, 32
_PATIENCE = 5
# So many keyframes are looked for together, spread over so much of the latest way.
_GROUP, _GROUP_SPAN = 12, 32


class Collector:
    """Keyframes of the latest way, in a frame of their own."""

    def __init__(self, config: LocalizationConfig) -> None:
        self._config = config
        self.keyframes = Keyframes()
        self.clear()

    def clear(self) -> None:
        """Forget all scans."""
        self._empty()
        self._unmatched = 0
        self.pose: Float = np.zeros(3)
        """Of the latest scan, (3,)."""

    def _empty(self) -> None:
        empty = Keyframes()
        self.keyframes.fill(empty.poses, empty.arrays)
        self._tracker = Tracker(self.keyframes)

    def add(self, beams: Beams, step: Float | None) -> bool:
        """Track a scan from the one before, whose step (3,) to it the odometry tells or not; whether it is kept."""
        if not len(self.keyframes):
            self.pose = self.pose if step is None else compose(self.pose, step)
            return self._keep(beams)
        placement = self._tracker.track(beams, self.pose, step)
        self.pose = placement.pose
        self._unmatched = 0 if placement.matched else self._unmatched + 1
        if self._unmatched >= _PATIENCE:
            self._empty()
            return self._keep(beams)
        moved = np.abs(relative(self.keyframes.poses[-1], self.pose))
        is_new = (
            np.hypot(moved[0], moved[1]) >= self._config.keyframe_distance or moved[2] >= self._config.keyframe_angle
        )
        return bool(placement.matched and is_new and self._keep(beams))

    def _keep(self, beams: Beams) -> bool:
        if np.count_nonzero(beams.kinds == SURFACE) < FEWEST_SURFACES:
            return False
        if len(self.keyframes) >= _MOST_KEYFRAMES:
            first = len(self.keyframes) - _KEPT_KEYFRAMES
            self.keyframes.fill(self.keyframes.poses[first:], self.keyframes.since(first))
        self.keyframes.add(beams, self.pose)
        self._unmatched = 0
        self._tracker.moved()
        return True


def latest(count: int, first: int = 0) -> Int:
    """Of keyframes from `first` to before `count`, those that are looked for together, the newest last."""
    rows = np.arange(max(first, count - _GROUP_SPAN), count)
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _GROUP)).round().astype(np.int64))]
