# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The occupancy grid of the keyframes, which keeps up with them as they are added and moved."""

from __future__ import annotations

from array import array

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.config import LocalizationConfig
from g2_recon.errors import InputError
from g2_recon.geometry import se2
from g2_recon.geometry.occupancy_grid import OccupancyGrid
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.se2_kernels import compose
from g2_recon.geometry.session import Session
from g2_recon.localization.occupancy import GridBuilder

Float = NDArray[np.float64]

# What lies this near is free where a beam has no return.
_FREE_RANGE_M = 5.0
# A keyframe has moved where what it sees this far away has moved by more than a cell.
_ARM_M = 5.0


class KeyframeGrid:
    """Scans of keyframes, and the grid that counts them at the poses that they have now.

    A new keyframe is added to the counts. One that was moved, as by a loop closure, cannot be taken out of them, so all
    are counted anew. Ranges are kept in half precision, to 1 cm at 30 m and 2 mm at 8 m, as there may be very many.
    """

    def __init__(self, config: LocalizationConfig, T_base_laser: ArrayLike) -> None:
        """`T_base_laser`: (4, 4) mounting pose; a laser mounted upside down is one with a roll of pi."""
        mount = np.asarray(T_base_laser, float)
        self._config = config
        self._T_base_laser = se2.from_se3(mount)
        self._turn = -1.0 if mount[2, 2] < 0 else 1.0
        self.clear()

    def clear(self) -> None:
        """Forget all keyframes."""
        # Of keyframes: angle and increment of the beams and the longest range; the ranges, and where they end.
        self._geometry = array("d")
        self._ranges = bytearray()
        self._ends = array("q", [0])
        self._start_over()

    def _start_over(self) -> None:
        reach = self._config.max_range
        self._builder = GridBuilder(
            resolution=self._config.grid_resolution, max_range=reach, free_range=min(_FREE_RANGE_M, reach)
        )
        # Of the keyframes in the counts, where they were then: x, y, yaw of each.
        self._counted = array("d")
        self._caught_up = False
        self.left_out = 0
        self.why_left_out = ""

    def __len__(self) -> int:
        """How many keyframes there are."""
        return len(self._ends) - 1

    @property
    def counted(self) -> int:
        """How many keyframes are in the counts so far."""
        return len(self._counted) // 3

    def add(self, scan: Scan) -> None:
        """Keep the scan of a new keyframe; it is counted in `update`."""
        says = scan.valid() | np.isposinf(scan.ranges)
        with np.errstate(over="ignore"):
            ranges = np.where(says, scan.ranges, np.nan).astype(np.float16)
            farthest = float(np.float16(scan.range_max))
        self._geometry.extend((scan.angle_min, scan.angle_increment, farthest))
        self._ranges += ranges.tobytes()
        self._ends.append(len(self._ranges))

    def add_session(self, session: Session) -> None:
        """Keep the scans of the keyframes of a session."""
        for scan in session.scans(upside_down=self._turn < 0):
            self.add(scan)

    def is_current(self, poses: ArrayLike) -> bool:
        """Whether every keyframe is counted, at T_map_base (K, 3), where it is now."""
        return self.counted == len(self) and not self._have_moved(np.reshape(poses, (-1, 3)))

    def update(self, poses: ArrayLike, *, most: int | None = None) -> bool:
        """Count keyframes, of which T_map_base is (K, 3) now; whether all are counted.

        Those that moved are counted anew. With `most` so many are counted in one call, and a new count is not begun
        before the last one is complete: so there is a grid now and then, however often keyframes move. A keyframe that
        the grid refuses is left out: `left_out` of them, for the last reason in `why_left_out`.
        """
        places = np.reshape(poses, (-1, 3))
        if (most is None or self._caught_up) and self._have_moved(places):
            self._start_over()
        begin = self.counted
        end = len(self) if most is None else min(len(self), begin + most)
        for index in range(begin, end):
            self._count(places[index], index)
        self._caught_up = end == len(self)
        return self._caught_up

    def _count(self, place: Float, index: int) -> None:
        self._counted.extend(place)
        ranges = np.frombuffer(self._ranges[self._ends[index] : self._ends[index + 1]], np.float16)
        first, increment, farthest = self._geometry[3 * index : 3 * index + 3]
        try:
            self._builder.add(
                compose(place, self._T_base_laser),
                self._turn * (first + increment * np.arange(len(ranges))),
                ranges,
                range_min=self._config.min_range,
                range_max=farthest,
            )
        except InputError as error:
            self.left_out += 1
            self.why_left_out = str(error)

    def _have_moved(self, places: Float) -> bool:
        counted = np.reshape(self._counted, (-1, 3))
        moved = se2.relative(counted, places[: len(counted)])
        far = np.hypot(moved[:, 0], moved[:, 1]) + _ARM_M * np.abs(moved[:, 2])
        return bool((far > self._config.grid_resolution).any())

    def grid(self) -> OccupancyGrid:
        """The grid of the keyframes that are counted."""
        return self._builder.grid()
