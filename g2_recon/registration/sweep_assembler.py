# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The sweep assembler: scans of a laser that tilts while the robot stands become sweeps (paper, section 2.2)."""

from __future__ import annotations

import logging
from bisect import bisect_left, bisect_right
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from g2_recon.config import SweepConfig
from g2_recon.geometry import se3
from g2_recon.geometry.cloud import Cloud
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import PoseBuffer

Float = NDArray[np.float64]

_log = logging.getLogger(__name__)

# Less than this from scan to scan is a tilt that stands still.
_STILL_RAD = 1e-4
# Angles and poses are kept this long for scans that come late.
_KEPT_S = 5.0


@dataclass(frozen=True, slots=True)
class AssembledSweep:
    """A sweep: stamp in seconds of its first beam; cloud in the frame of the mount, with the laser at its origin.

    T_odom_mount: (4, 4) where the mount was by odometry, None where that is not known.
    """

    stamp: float
    cloud: Cloud
    T_odom_mount: Float | None


class SweepAssembler:
    """Collects scans from where the tilt starts to move until it turns round, stands still or scans stay away.

    Scans, angles and poses may come in any order as long as scans are in order of time; a scan waits for its angles.
    """

    def __init__(self, config: SweepConfig, T_base_mount: ArrayLike) -> None:
        """`T_base_mount`: (4, 4) mounting pose of the laser at angle 0; a positive angle turns its x axis down."""
        self._config = config
        self._T_base_mount = np.asarray(T_base_mount, float)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._angle_stamps: list[float] = []
        self._angles: list[float] = []
        self._odometry = PoseBuffer()
        self._waiting: list[Scan] = []
        self._scans: list[Scan] = []
        self._last: tuple[float, float] | None = None
        self._direction = 0.0
        self._done: list[AssembledSweep] = []
        self._drops: Counter[str] = Counter()

    @property
    def drops(self) -> dict[str, int]:
        """How many scans and sweeps were given up, by reason."""
        return dict(self._drops)

    def add_angle(self, stamp: float, angle: float) -> None:
        """Take note of the tilt in radians at a time in seconds."""
        if not np.isfinite((stamp, angle)).all():
            self._drops["tilt angles that are not finite"] += 1
            return
        at = bisect_right(self._angle_stamps, stamp)
        self._angle_stamps.insert(at, stamp)
        self._angles.insert(at, angle)
        self._take_scans()

    def add_odometry(self, stamp: float, T_odom_base: ArrayLike) -> None:
        """Take note of where the robot was, a transform (4, 4), at a time in seconds."""
        self._odometry.add(stamp, T_odom_base)

    def add_scan(self, scan: Scan) -> None:
        """Take a scan, now or when its angles have come."""
        newest = self._waiting[-1].stamp if self._waiting else self._last[0] if self._last else -np.inf
        if scan.stamp <= newest:
            self._drops["scans older than the one before"] += 1
            return
        self._waiting.append(scan)
        self._take_scans()

    def take(self) -> list[AssembledSweep]:
        """The sweeps that were completed since the last call."""
        done, self._done = self._done, []
        return done

    def finish(self) -> list[AssembledSweep]:
        """What `take` returns, with the sweep that was still going on: no more scans will come."""
        if self._waiting:
            self._drops["scans without a tilt angle"] += len(self._waiting)
            self._waiting = []
        self._complete()
        return self.take()

    def _take_scans(self) -> None:
        while self._waiting and self._angle_stamps and self._waiting[0].last_stamp <= self._angle_stamps[-1]:
            scan = self._waiting.pop(0)
            if scan.stamp < self._angle_stamps[0]:
                self._drops["scans without a tilt angle"] += 1
            else:
                self._follow(scan)

    def _follow(self, scan: Scan) -> None:
        """Add a scan to the sweep that is going on, or end that one and start another."""
        angle = float(self._tilt(np.array([scan.stamp]))[0])
        before, self._last = self._last, (scan.stamp, angle)
        if before is None or scan.stamp - before[0] > self._config.max_gap:
            self._complete()
            self._scans = [scan]
            return
        step = angle - before[1]
        if abs(step) < _STILL_RAD:
            self._complete()
            self._scans = [scan]
            return
        if self._direction and np.sign(step) != self._direction:
            self._complete()
        self._direction = float(np.sign(step))
        self._scans.append(scan)

    def _complete(self) -> None:
        """Make a sweep of the scans so far, or say why they are none."""
        scans, self._scans, self._direction = self._scans, [], 0.0
        if len(scans) < 2:
            return
        stamps = np.concatenate([scan.beam_stamps() for scan in scans])
        first, last = float(stamps.min()), float(stamps.max())
        span = abs(float(np.diff(self._tilt(np.array([first, last])))[0]))
        jump = self._largest_jump(first, last)
        if jump > self._config.max_tilt_step:
            self._refuse("the tilt jumped", first, f"its angle jumps by {np.degrees(jump):.1f} deg")
        elif span < self._config.min_tilt:
            self._refuse("the tilt covered too little", first, f"its tilt covers {np.degrees(span):.0f} deg only")
        elif (moved := self._motion(first, last)) is not None and not self._stood(*moved):
            why = f"the robot moved {moved[0]:.3f} m and turned {np.degrees(moved[1]):.2f} deg"
            self._refuse("the robot moved", first, why)
        else:
            T_odom_base, known = self._odometry.interpolate([first], max_gap=self._config.max_gap)
            T_odom_mount = T_odom_base[0] @ self._T_base_mount if known[0] else None
            self._done.append(AssembledSweep(first, self._placed(scans), T_odom_mount))
        keep = max(bisect_left(self._angle_stamps, last - _KEPT_S) - 1, 0)
        del self._angle_stamps[:keep], self._angles[:keep]
        self._odometry.drop_before(last - _KEPT_S)

    def _refuse(self, reason: str, stamp: float, why: str) -> None:
        self._drops[f"sweeps in which {reason}"] += 1
        _log.warning("the sweep at %.3f s is refused: %s", stamp, why)

    def _tilt(self, stamps: ArrayLike) -> Float:
        return np.asarray(np.interp(np.asarray(stamps, float), self._angle_stamps, self._angles))

    def _largest_jump(self, first: float, last: float) -> float:
        """Largest change in radians from one tilt angle to the next."""
        angles = self._angles[
            max(bisect_left(self._angle_stamps, first) - 1, 0) : bisect_right(self._angle_stamps, last) + 1
        ]
        return float(np.abs(np.diff(angles)).max(initial=0.0))

    def _motion(self, first: float, last: float) -> tuple[float, float] | None:
        """How far the robot got, in metres and radians, from where it stood first; None where odometry does not say."""
        times = np.linspace(first, last, 2 + int((last - first) * 20))
        poses, known = self._odometry.interpolate(times, max_gap=self._config.max_gap)
        if not known.any():
            return None
        apart = se3.inverse(poses[known][0]) @ poses[known]
        turned = Rotation.from_matrix(apart[:, :3, :3]).magnitude()
        return float(np.linalg.norm(apart[:, :3, 3], axis=1).max()), float(turned.max())

    def _stood(self, metres: float, radians: float) -> bool:
        return metres <= self._config.max_motion and radians <= self._config.max_turn

    def _placed(self, scans: list[Scan]) -> Cloud:
        """The points of scans in the frame of the mount, each beam by the tilt at its own time."""
        places = []
        for scan in scans:
            in_laser, beams = scan.points(range_min=self._config.min_range, range_max=self._config.max_range)
            tilt = self._tilt(scan.stamp + scan.time_increment * beams)
            places.append(
                np.column_stack([in_laser[:, 0] * np.cos(tilt), in_laser[:, 1], -in_laser[:, 0] * np.sin(tilt)])
            )
        points = np.concatenate(places)
        return Cloud(points, np.zeros_like(points))
