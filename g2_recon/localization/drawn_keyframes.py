# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The latest keyframes, drawn into a likelihood grid for scans that are looked for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g2_recon.localization import likelihood
from g2_recon.localization.keyframes import Keyframes

# So many are drawn.
_DRAWN = 40


class DrawnKeyframes:
    """Likelihoods around the last keyframe.

    grid: (C, C) cells. wide: each cell the largest of those at most `reach` cells away; with a reach of 0 there is
    none. corner: (2,) m, of the first cell. resolution: m.
    """

    def __init__(self, keyframes: Keyframes, *, cells: int, resolution: float, sigma: float, reach: int = 0) -> None:
        """sigma: m, by which points are blurred."""
        self._keyframes = keyframes
        self.resolution = resolution
        self.grid = np.zeros((cells, cells), np.uint8)
        self.wide = np.zeros((cells, cells) if reach else (0, 0), np.uint8)
        self.corner: NDArray[np.float64] = np.zeros(2)
        self._bell = likelihood.bell(resolution, sigma)
        self._reach = reach
        self._box = np.zeros(4, np.int64)
        self._is_current = False

    def moved(self) -> None:
        """To be called when keyframes were added or improved."""
        self._is_current = False

    def update(self, segment: int) -> None:
        """Draw what has changed; `segment`: the first keyframe that counts."""
        if self._is_current:
            return
        self._is_current = True
        count, poses = len(self._keyframes), self._keyframes.poses
        points, kinds = self._keyframes.points, self._keyframes.kinds
        drawn = slice(max(segment, count - _DRAWN), count)
        self.corner = poses[-1, :2] - 0.5 * len(self.grid) * self.resolution
        likelihood.clear(self.grid, self._box, 0)
        likelihood.clear(self.wide, self._box, self._reach)
        self._box = likelihood.splat(
            self.grid,
            points[drawn],
            kinds[drawn],
            poses[drawn],
            self.corner[0],
            self.corner[1],
            self.resolution,
            self._bell,
        )
        if self._reach:
            likelihood.widen(self.grid, self._box, self._reach, self.wide)
