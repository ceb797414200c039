# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The paper's localizer: ICP of each scan against a global point map that grows as the robot goes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.config import LocalizationConfig
from g2_recon.geometry import se2
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.localization.localized_scan import LocalizedScan
from g2_recon.localization.odometry import OdometrySteps
from g2_recon.localization.paper_matching import MatchResult, match
from g2_recon.localization.point_map import PointMap
from g2_recon.progress import Progress, silent

Float = NDArray[np.float64]

# Fewer beams than this say nothing about a pose in the plane that odometry would not say better.
_FEWEST_POINTS = 10
# How far off the first guess may be, with odometry and without: a floor (m, m, rad), and a share of the way and of the
# turn since the last scan. Where a scan does not match, the pose is as much less certain.
_DRIFT_FLOOR = np.array([0.02, 0.02, 0.1])
_DRIFT_FLOOR_WITHOUT_ODOMETRY = np.array([0.1, 0.1, 0.2])
_DRIFT_SHARE = np.array([0.1, 0.1, 0.2])


class PaperLocalizer:
    """Scan matching by ICP, combined with a global point map that is built on the way (paper, section 2.2)."""

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
        self._odometry = OdometrySteps(np.zeros(3), use=self._config.use_odometry)
        self._covariance: Float = np.zeros((3, 3))
        self.unmatched = 0

    def process(self, scan: Scan, odometry: ArrayLike | None = None) -> LocalizedScan:
        """Localize one scan and, where the robot has moved on, add it to the map.

        odometry: (3,) x, y, yaw of T_odom_base when the scan was taken; None or NaN where unknown.
        """
        points = self._points_in_base(scan)
        guess, drift = self._first_guess(scan.stamp, odometry)
        result = self._match(points, guess)
        matched = result is not None and result.inliers >= self._config.min_inliers
        if result is not None and matched:
            pose, inliers = result.pose, result.inliers
            self._covariance = np.asarray(np.linalg.inv(result.information), float)
        else:
            pose, inliers = guess, 0.0 if result is None else result.inliers
            self._covariance = self._covariance + np.diag(drift**2)
            # The first scan has no map to match.
            self.unmatched += bool(self._poses)
        if self._poses:
            self._last_step = se2.relative(self._poses[-1], pose)
        self._stamps.append(scan.stamp)
        self._poses.append(pose)
        keyframe = self._grow_map(points, pose, matched=matched)
        return LocalizedScan(scan.stamp, pose, self._covariance, inliers, matched, keyframe)

    @property
    def odometry_jumps(self) -> int:
        """Between how many scans odometry was not believed."""
        return self._odometry.jumps

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

    def later_point_map(self) -> Callable[[], Float]:
        """The point map of now, for whoever wants it later, in another thread."""
        points = self.point_map()
        return lambda: points

    def _points_in_base(self, scan: Scan) -> Float:
        """Points (M, 2) of the scan in the robot frame, projected to the floor."""
        planar, _ = scan.points(range_min=self._config.min_range, range_max=self._config.max_range)
        return planar @ self._T_base_laser[:2, :2].T + self._T_base_laser[:2, 3]

    def _first_guess(self, stamp: float, odometry: ArrayLike | None) -> tuple[Float, Float]:
        """The pose (3,) that odometry predicts, or constant velocity where there is none, and its drift (3,)."""
        step = self._odometry.step(stamp, odometry)
        if not self._poses:
            return self._start, np.zeros(3)
        floor = _DRIFT_FLOOR_WITHOUT_ODOMETRY if step is None else _DRIFT_FLOOR
        step = self._last_step if step is None else step
        way = np.hypot(step[0], step[1])
        return se2.compose(self._poses[-1], step), floor + _DRIFT_SHARE * (way, way, abs(step[2]))

    def _match(self, points: Float, guess: Float) -> MatchResult | None:
        if len(points) < _FEWEST_POINTS or not len(self._map):
            return None
        return match(
            points,
            self._map,
            guess,
            max_correspondence=self._config.max_correspondence,
            min_correspondence=self._config.min_correspondence,
            max_iterations=self._config.max_iterations,
        )

    def _grow_map(self, points: Float, pose: Float, *, matched: bool) -> bool:
        """Add the scan if the robot has moved on since the last keyframe; a rejected match would blur the map."""
        first = not len(self._map)
        if not (matched or first) or len(points) < _FEWEST_POINTS:
            return False
        if not first:
            moved = se2.relative(self._poses[self._keyframes[-1]], pose)
            near = np.hypot(moved[0], moved[1]) < self._config.keyframe_distance
            if near and abs(moved[2]) < self._config.keyframe_angle:
                return False
        self._map.add(se2.transform_points(pose, points))
        self._map.focus(pose[:2])
        self._keyframes.append(len(self._poses) - 1)
        return True
