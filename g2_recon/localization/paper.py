# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The paper's localizer: ICP of each scan against a global point map that grows as the robot goes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.config import LocalizationConfig
from g2_recon.geometry import se2
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.localization.localized_scan import LocalizedScan
from g2_recon.localization.paper_matching import MatchResult, beam_normals, match
from g2_recon.localization.point_map import PointMap
from g2_recon.progress import Progress, silent

Float = NDArray[np.float64]

# Fewer beams than this say nothing about a pose in the plane that odometry would not say better.
_FEWEST_POINTS = 10
# How uncertain a first guess is: a floor (m, m, rad) and a share of the way and of the turn since the last scan.
_GUESS_FLOOR = np.array([0.02, 0.02, 0.1])
_GUESS_SHARE = np.array([0.1, 0.1, 0.2])
# Without odometry the guess is that nothing has changed since the step before, which a robot that starts, stops or
# turns refutes.
_GUESS_FLOOR_WITHOUT_ODOMETRY = np.array([0.1, 0.1, 0.2])
# The first gate of the match lets through what an uncertain guess moves a point by; a turn does so at 3 m, where the
# walls of rooms and corridors are.
_GATE = np.array([3.0, 3.0, 3.0])

# Odometry that claims more than this between two scans has jumped: no robot indoors is that fast.
_JUMP_M = 0.5
_FASTEST_M_S = 5.0


class PaperLocalizer:
    """Scan-to-map ICP (paper, section 2.2): scan matching combined with a global point map built on the way."""

    def __init__(self, config: LocalizationConfig, T_base_laser: ArrayLike) -> None:
        """`T_base_laser`: (4, 4) mounting pose; a laser mounted upside down is one with a roll of pi."""
        self._config = config
        self._T_base_laser = np.asarray(T_base_laser, float)
        self.reset()

    def reset(self, pose: ArrayLike = se2.IDENTITY) -> None:
        """Forget everything and start a new map with the robot at `pose` (3,) in it."""
        self._map = PointMap(spacing=self._config.map_spacing, reach=self._config.max_range + 2.0)
        self._stamps: list[float] = []
        self._poses: list[Float] = []
        self._keyframes: list[int] = []
        self._start = np.array(pose, float)
        self._last_step: Float = np.zeros(3)
        self._odometry: Float | None = None
        self._covariance: Float = np.zeros((3, 3))
        self.unmatched = 0
        self.odometry_jumps = 0

    def process(self, scan: Scan, odometry: ArrayLike | None = None) -> LocalizedScan:
        """Localize one scan and, where the robot has moved on, add it to the map.

        odometry: (3,) x, y, yaw of T_odom_base when the scan was taken; None or NaN where unknown.
        """
        points, normals = self._points_in_base(scan)
        guess, sigma = self._first_guess(scan.stamp, odometry)
        result = self._match(points, normals, guess, sigma)
        matched = result is not None and result.inliers >= self._config.min_inliers
        if result is not None and matched:
            pose, inliers = result.pose, result.inliers
            self._covariance = np.asarray(np.linalg.inv(result.information), float)
        else:
            pose, inliers = guess, 0.0 if result is None else result.inliers
            self._covariance = self._covariance + np.diag(sigma**2)
            # The first scan has no map to match.
            self.unmatched += bool(self._poses)
        if self._poses:
            self._last_step = se2.relative(self._poses[-1], pose)
        self._stamps.append(scan.stamp)
        self._poses.append(pose)
        keyframe = self._grow_map(points, normals, pose, matched=matched)
        return LocalizedScan(scan.stamp, pose, self._covariance, inliers, matched, keyframe)

    @property
    def loops(self) -> int:
        """None: the paper's localizer closes no loops."""
        return 0

    def finish(self, progress: Progress = silent) -> None:
        """Nothing: the paper's localizer does not look back."""

    def causal_trajectory(self) -> Trajectory:
        """The same as `trajectory`."""
        return self.trajectory()

    def trajectory(self) -> Trajectory:
        """T_map_base of every scan, in the order in which they came."""
        return Trajectory.from_se2(self._stamps, np.reshape(self._poses, (-1, 3)))

    def keyframes(self) -> Trajectory:
        """T_map_base of the scans that were added to the map."""
        poses = np.reshape([self._poses[index] for index in self._keyframes], (-1, 3))
        return Trajectory.from_se2([self._stamps[index] for index in self._keyframes], poses)

    def point_map(self) -> Float:
        """The points (N, 2) of the map."""
        return self._map.points.copy()

    def _points_in_base(self, scan: Scan) -> tuple[Float, Float]:
        """Points (M, 2) of the scan and their normals (M, 2) in the robot frame, projected to the floor.

        Points without a normal lie on no surface: mixed pixels, legs, leaves. They are left out.
        """
        planar, beams = scan.points(range_min=self._config.min_range, range_max=self._config.max_range)
        normals = beam_normals(planar, beams)
        known = normals.any(axis=1)
        turn = self._T_base_laser[:2, :2].T
        return planar[known] @ turn + self._T_base_laser[:2, 3], normals[known] @ turn

    def _first_guess(self, stamp: float, odometry: ArrayLike | None) -> tuple[Float, Float]:
        """The pose (3,) that odometry predicts, or constant velocity where there is none, and its sigma (3,)."""
        measured = None if odometry is None or not self._config.use_odometry else np.asarray(odometry, float)
        if measured is not None and not np.isfinite(measured).all():
            measured = None
        last, self._odometry = self._odometry, measured
        if not self._poses:
            return self._start, np.zeros(3)
        if measured is None or last is None:
            return self._moved_on(self._last_step, _GUESS_FLOOR_WITHOUT_ODOMETRY)
        step = se2.relative(last, measured)
        if np.hypot(step[0], step[1]) > _JUMP_M + _FASTEST_M_S * abs(stamp - self._stamps[-1]):
            self.odometry_jumps += 1
            return self._moved_on(self._last_step, _GUESS_FLOOR_WITHOUT_ODOMETRY)
        return self._moved_on(step, _GUESS_FLOOR)

    def _moved_on(self, step: Float, floor: Float) -> tuple[Float, Float]:
        way = np.hypot(step[0], step[1])
        return se2.compose(self._poses[-1], step), floor + _GUESS_SHARE * (way, way, abs(step[2]))

    def _match(self, points: Float, normals: Float, guess: Float, sigma: Float) -> MatchResult | None:
        if len(points) < _FEWEST_POINTS or not len(self._map):
            return None
        return match(
            points,
            normals,
            self._map,
            guess,
            max_correspondence=max(self._config.max_correspondence, *(_GATE * sigma)),
            min_correspondence=self._config.min_correspondence,
            max_iterations=self._config.max_iterations,
            guess_sigma=sigma,
        )

    def _grow_map(self, points: Float, normals: Float, pose: Float, *, matched: bool) -> bool:
        """Add the scan if the robot has moved on since the last keyframe; a rejected match would blur the map."""
        first = not len(self._map)
        if not (matched or first) or len(points) < _FEWEST_POINTS:
            return False
        if not first:
            moved = se2.relative(self._poses[self._keyframes[-1]], pose)
            near = np.hypot(moved[0], moved[1]) < self._config.keyframe_distance
            if near and abs(moved[2]) < self._config.keyframe_angle:
                return False
        self._map.add(se2.transform_points(pose, points), se2.transform_points((0.0, 0.0, pose[2]), normals))
        self._map.focus(pose[:2])
        self._keyframes.append(len(self._poses) - 1)
        return True
