# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The registrar: vertical scans become points in the map frame (paper, section 2.2, first setup)."""

from __future__ import annotations

import heapq
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.config import RegistrationConfig
from g2_recon.geometry import se3
from g2_recon.geometry.cloud import Cloud
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import PoseBuffer

Float = NDArray[np.float64]


# Poses are kept this long for scans that come late, as messages of two lasers overtake each other.
_POSES_KEPT_S = 2.0


@dataclass(frozen=True, slots=True)
class RegisteredScan:
    """The points of one vertical scan in the map frame, each with the place of the laser when it was measured."""

    stamp: float
    cloud: Cloud


class Registrar:
    """Places each beam of each vertical scan by the pose of the robot at the beam's own time.

    Scans and poses may come in any order. A scan waits until poses cover its last beam; `take` hands out what is done.
    """

    def __init__(self, config: RegistrationConfig, T_base_laser: ArrayLike) -> None:
        """`T_base_laser`: (4, 4) mounting pose of the vertical laser."""
        self._config = config
        self._T_base_laser = np.asarray(T_base_laser, float)
        self.reset()

    def reset(self) -> None:
        """Forget poses, waiting scans and counts."""
        self._poses = PoseBuffer()
        # A heap by the time of the last beam; the count keeps scans of equal time in the order in which they came.
        self._waiting: list[tuple[float, int, Scan]] = []
        self._count = 0
        self._newest_scan = -np.inf
        self._done: list[RegisteredScan] = []
        self._drops: Counter[str] = Counter()

    def configure(self, config: RegistrationConfig) -> None:
        """Take other settings for the scans that are not placed yet."""
        self._config = config

    @property
    def drops(self) -> dict[str, int]:
        """How many scans were given up, by reason."""
        return dict(self._drops)

    @property
    def waiting(self) -> int:
        """How many scans wait for a pose."""
        return len(self._waiting)

    def add_pose(self, stamp: float, T_map_base: ArrayLike) -> None:
        """Take note of the pose (4, 4) of the robot at a time in seconds; places the scans that waited for it."""
        self._poses.add(stamp, T_map_base)
        self._place_waiting()

    def add_scan(self, scan: Scan) -> None:
        """Place a scan, now or when its poses have come."""
        heapq.heappush(self._waiting, (scan.last_stamp, self._count, scan))
        self._count += 1
        self._newest_scan = max(self._newest_scan, scan.stamp)
        self._place_waiting()

    def take(self) -> list[RegisteredScan]:
        """The scans that were placed since the last call, in the order in which they were placed."""
        done, self._done = self._done, []
        return done

    def finish(self) -> list[RegisteredScan]:
        """What `take` returns, after giving up on scans that still wait: no more poses will come."""
        for _, _, scan in self._waiting:
            self._drops["after the last pose" if scan.stamp > self._poses.last_stamp else "before the first pose"] += 1
        self._waiting = []
        return self.take()

    def _place_waiting(self) -> None:
        while self._waiting and self._waiting[0][0] <= self._poses.last_stamp:
            self._place(heapq.heappop(self._waiting)[2])
        while self._waiting and self._newest_scan - self._waiting[0][2].stamp > self._config.max_wait:
            heapq.heappop(self._waiting)
            self._drops[f"no pose came for {self._config.max_wait:g} s"] += 1
        oldest = self._waiting[0][2].stamp if self._waiting else np.inf
        self._poses.drop_before(min(oldest, self._poses.last_stamp - _POSES_KEPT_S))

    def _place(self, scan: Scan) -> None:
        """Place one scan, or count why it cannot be placed."""
        in_laser, beams = scan.points(range_min=self._config.min_range, range_max=self._config.max_range)
        T_map_base, known = self._poses.interpolate(
            scan.stamp + scan.time_increment * beams, max_gap=self._config.max_gap
        )
        if not len(beams):
            self._drops["no beam in range"] += 1
        elif scan.stamp < self._poses.first_stamp:
            self._drops["before the first pose"] += 1
        elif not known.all():
            self._drops[f"no pose within {self._config.max_gap:g} s"] += 1
        else:
            T_map_laser = T_map_base @ self._T_base_laser
            points = se3.transform_points(T_map_laser, np.column_stack([in_laser, np.zeros(len(in_laser))]))
            self._done.append(RegisteredScan(scan.stamp, Cloud(points, T_map_laser[:, :3, 3].copy())))
