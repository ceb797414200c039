# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The localizer: one horizontal scan after the other becomes a pose in a map that closes its loops."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from g2_recon.config import LocalizationConfig
from g2_recon.errors import InputError
from g2_recon.geometry import se2
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.se2_kernels import compose, inverse_3x3, is_within, relative
from g2_recon.geometry.session import LastScan, ScanPoses, Session, SessionGrowth
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.kernels import kernel
from g2_recon.localization import refinement
from g2_recon.localization.beams import SURFACE, Beams, beams
from g2_recon.localization.keyframes import Keyframes
from g2_recon.localization.localized_scan import LocalizedScan
from g2_recon.localization.loop_closure import LoopCloser
from g2_recon.localization.odometry import OdometrySteps
from g2_recon.localization.point_map import map_of_keyframes
from g2_recon.localization.smoothing import Smoother
from g2_recon.localization.tracking import FEWEST_SURFACES, Placement, Tracker
from g2_recon.localization.uncertainty import WAY_PER_RAD, Uncertainty
from g2_recon.progress import Progress, silent

Float = NDArray[np.float64]

# The way of the robot is cut into local maps so long.
_LOCAL_MAP_M = 5.0
_FEWEST_KEYFRAMES = 2
# After so many scans in a row that do not match, the map goes on in a new segment, as unsure of its place as after so
# long a way.
_PATIENCE = 5
_BREAK_WAY_M = 300.0
# Beams are moved to the stamp of their scan by the velocity since the last one, if that was not longer ago; no robot
# indoors is faster, m/s, m/s, rad/s.
_LONGEST_STEP_S = 1.0
_FASTEST = np.array([5.0, 5.0, 5.0])
# So much may it change from scan to scan, m/s, m/s, rad/s.
_MOST_SUDDEN = np.array([1.0, 1.0, 1.0])
_UNKNOWN = np.full(3, np.nan)
# A robot that has moved less than this stands: the localizer is surer of its place than that.
_STANDING_M, _STANDING_RAD = 0.02, 0.01
# A direction in which nothing is known has this information.
_NEARLY_NOTHING = 1e-4 * np.eye(3)
# Along a direction in which corners tell where a scan is, there is at least so much more of it, 1 / m^2.
_LEAST_BY_CORNERS = 1000.0
# So many scans are matched at once at the end: enough for all cores, and little memory.
_MATCHED_AT_ONCE = 1024

# Loops are closed beside the tracking and count so many keyframes later, however long that takes: the result is the
# same on any machine, and no scan waits unless it takes longer.
_CLOSED_AFTER = 5
_BACKGROUND = ThreadPoolExecutor(1, "loop closure")


class _Closing(NamedTuple):
    """Loops that are being closed: at how many keyframes they count, and what LoopCloser.handle will answer."""

    due: int
    moved: Future[tuple[Float, Float] | None]


class Localizer:
    """Tracking, fixed-lag smoothing, loop closures as they come, and refinement at the end."""

    def __init__(self, config: LocalizationConfig, T_base_laser: ArrayLike, *, keep_scans: bool = False) -> None:
        """`T_base_laser`: (4, 4) mounting pose; a laser mounted upside down is one with a roll of pi.

        keep_scans: keep what `finish` needs to improve every scan; memory then grows with time, not with the map.
        """
        self._config = config
        mount = np.asarray(T_base_laser, float)
        self._T_base_laser = se2.from_se3(mount)
        self._T_laser_base = se2.inverse(self._T_base_laser)
        self._upside_down = bool(mount[2, 2] < 0)
        self._keep_scans = keep_scans
        self.reset()

    def reset(self, pose: ArrayLike = se2.IDENTITY) -> None:
        """Forget everything and start a new map with the robot at `pose` (3,) in it."""
        self._keyframes = Keyframes()
        self._tracker = Tracker(self._keyframes)
        self._smoother = Smoother(self._keyframes)
        self._loops = LoopCloser()
        self._closing: _Closing | None = None
        self._refined: Future[Float] | None = None
        self._odometry = OdometrySteps(self._T_base_laser, use=self._config.use_odometry)
        self._start = se2.compose(np.array(pose, float), self._T_base_laser)
        # Of keyframes: stamp, step (3) of the wheels from the one before, way driven until there, track lost
        # on the way there.
        self._keyframe_stamps = array("d")
        self._wheel_steps = array("d")
        self._ways = array("d")
        self._broken = array("B")
        self._map_begins = 0
        self._wheels_since: Float = np.zeros(3)
        # Of scans: keyframe that it hangs on, pose (3) seen from there; beams, where they are kept.
        self._stamps = array("d")
        self._owners = array("i")
        self._offsets = array("d")
        self._causal: list[Float] = []
        self._scans: list[Beams | None] = []
        self._last: Float = self._start
        self._stamp = -math.inf
        self._twist: Float = np.zeros(3)
        self._lost = 0
        self._uncertainty = Uncertainty(self._keyframes)
        self.unmatched = 0

    @property
    def odometry_jumps(self) -> int:
        """Between how many scans odometry was not believed."""
        return self._odometry.jumps

    @property
    def loops(self) -> int:
        """How many loops were closed."""
        return len(self._loops.loops)

    @property
    def _segment_is_empty(self) -> bool:
        """Whether there is no keyframe yet that a scan can be laid on."""
        return len(self._keyframes) == self._tracker.segment

    def process(self, scan: Scan, odometry: ArrayLike | None = None) -> LocalizedScan:
        """Localize one scan and, where the robot has moved on, add it to the map.

        odometry: (3,) x, y, yaw of T_odom_base when the scan was taken; None or NaN where unknown.
        """
        step = self._odometry.step(scan.stamp, odometry)
        elapsed = scan.stamp - self._stamp
        seen = beams(
            scan,
            range_min=self._config.min_range,
            range_max=self._config.max_range,
            upside_down=self._upside_down,
            twist=self._twist_of(step, elapsed),
        )
        placement = self._place(seen, step)
        self._twist = _velocity(relative(self._last, placement.pose), elapsed)
        self._stamp = scan.stamp
        self._wheels_since = compose(self._wheels_since, _UNKNOWN if step is None or placement.wheels_err else step)
        self._last = placement.pose
        keyframe = self._grow_map(seen, placement, step)
        self._remember(scan.stamp, seen, placement.pose, keyframe=keyframe)
        # A loop that was closed moves the present pose, too.
        if keyframe and self._close_loops():
            self._last = self._keyframes.poses[-1].copy()
        covariance = self._covariance(placement)
        pose = compose(self._last, self._T_laser_base)
        if self._keep_scans:
            self._causal.append(pose)
        return LocalizedScan(scan.stamp, pose, covariance, placement.inliers, placement.matched, keyframe)

    def _twist_of(self, step: Float | None, elapsed: float) -> Float:
        """The velocity (3,) at which beams are moved: that of the wheels, unless it differs too much from the last.

        Wheels that come late would tear a scan apart.
        """
        if step is None:
            return self._twist
        wheels = _velocity(step, elapsed)
        return wheels if is_within(wheels - self._twist, _MOST_SUDDEN) else self._twist

    def _place(self, seen: Beams, step: Float | None) -> Placement:
        if self._segment_is_empty:
            matched = np.count_nonzero(seen.kinds == SURFACE) >= FEWEST_SURFACES
            pose = self._last if step is None else compose(self._last, step)
            return Placement(pose, 1e6 * np.eye(3), 1.0, 1.0, matched)
        placement = self._tracker.track(seen, self._last, step)
        self._lost = 0 if placement.matched else self._lost + 1
        self.unmatched += not placement.matched
        return placement

    def _grow_map(self, seen: Beams, placement: Placement, step: Float | None) -> bool:
        """Add the scan if the robot has moved on since the last keyframe; a rejected match would blur the map."""
        if self._segment_is_empty:
            if placement.matched:
                way = _BREAK_WAY_M if len(self._keyframes) else 0.0
                self._add_keyframe(seen, placement.pose, way, broken=way > 0)
            return placement.matched
        moved = relative(self._keyframes.poses[-1], placement.pose)
        way, turn = math.hypot(moved[0], moved[1]), abs(moved[2])
        if self._lost >= _PATIENCE and np.count_nonzero(seen.kinds == SURFACE) >= FEWEST_SURFACES:
            # Even a lone keyframe: no local map may reach over the break.
            self._finish_local_map(1)
            self._tracker.segment = len(self._keyframes)
            self._add_keyframe(seen, compose(self._keyframes.poses[-1], moved), _BREAK_WAY_M, broken=True)
            self._lost = 0
            return True
        if not placement.matched or (way < self._config.keyframe_distance and turn < self._config.keyframe_angle):
            return False
        corners = self._told_by_corners(placement) if step is None else None
        self._add_keyframe(seen, placement.pose, way + WAY_PER_RAD * turn, broken=False, corners=corners)
        return True

    def _told_by_corners(self, placement: Placement) -> Float | None:
        """The direction (2,) along which a match without wheels was slid to where corners fit best, if it was.

        Beyond what its surfaces say, all that is known of it otherwise is a guess that is as good along as across.
        """
        beyond = (placement.information - placement.hessian / self._tracker.pair_sigma**2)[:2, :2]
        values, vectors = np.linalg.eigh(beyond)
        return np.asarray(vectors[:, 1]) if values[1] - values[0] > _LEAST_BY_CORNERS else None

    def _add_keyframe(
        self, seen: Beams, pose: Float, way: float, *, broken: bool, corners: Float | None = None
    ) -> None:
        self._keyframes.add(seen, pose)
        self._keyframe_stamps.append(self._stamp)
        wheels, self._wheels_since = self._wheels_since, np.zeros(3)
        self._wheel_steps.extend(wheels)
        self._ways.append(way + (self._ways[-1] if self._ways else 0.0))
        self._broken.append(broken)
        self._smoother.add(wheels, self._tracker.segment)
        self._uncertainty.add(self._smoother.latest(), wheels=wheels, broken=broken, corners=corners)
        self._tracker.pair_sigma = self._uncertainty.pair_sigma
        self._tracker.moved()
        self._last = self._keyframes.poses[-1].copy()

    def _covariance(self, placement: Placement) -> Float:
        """Covariance (3, 3) of the present pose in the map frame: of the match, and of the keyframe it hangs on."""
        information = placement.information + _NEARLY_NOTHING
        if self._segment_is_empty:
            return np.asarray(inverse_3x3(information))
        return self._uncertainty.of_match(self._last, information)

    def _remember(self, stamp: float, seen: Beams, pose: Float, *, keyframe: bool) -> None:
        if self._segment_is_empty:
            owner, offset = -1, pose
        else:
            owner = len(self._keyframes) - 1
            offset = np.zeros(3) if keyframe else relative(self._keyframes.poses[owner], pose)
        # The trajectory of a live robot does not grow while it stands.
        if not self._keep_scans and self._owners and owner == self._owners[-1] and not keyframe:
            x, y, yaw = self._offsets[-3:]
            if max(abs(offset[0] - x), abs(offset[1] - y)) < _STANDING_M and abs(offset[2] - yaw) < _STANDING_RAD:
                return
        self._stamps.append(stamp)
        self._owners.append(owner)
        self._offsets.extend(offset)
        if self._keep_scans:
            self._scans.append(None if keyframe else seen)

    def _close_loops(self) -> bool:
        """Where a local map is complete, have it looked for among the earlier ones; whether the map has moved."""
        if self._refined is not None:
            return False
        count = len(self._keyframes)
        moved = self._closing is not None and count >= self._closing.due and self._take_loops()
        first, last = self._map_begins, count - 1
        if self._ways[last] - self._ways[first] < _LOCAL_MAP_M or last - first < _FEWEST_KEYFRAMES:
            return moved
        moved |= self._take_loops()
        self._map_begins = last
        arguments = self._keyframes.snapshot(), first, last, self._ways[(first + last) // 2], self._drift(first, last)
        if self._config.loop_closure:
            answer = _BACKGROUND.submit(self._loops.handle, *arguments, self._uncertainty.pair_sigma)
            self._closing = _Closing(count + _CLOSED_AFTER, answer)
        else:
            self._loops.add(*arguments)
        return moved

    def _drift(self, first: int, last: int) -> Float | None:
        """Covariance (3, 3) of a new local map of keyframes from `first` to before `last`, as seen from the latest."""
        if not self._loops.maps:
            return None
        return self._uncertainty.between(self._loops.maps[-1].reference, (first + last) // 2)

    def _take_loops(self) -> bool:
        """Wait for the loops that are being closed and move the map as they say; whether that has moved it."""
        self.take_refinement()
        closing, self._closing = self._closing, None
        answer = None if closing is None else closing.moved.result()
        if answer is None:
            return False
        before, covariance = answer
        self._follow(before)
        self._uncertainty.drift_scale = self._loops.drift_scale
        self._uncertainty.take_back(self._loops.maps[-1].reference, covariance)
        return True

    def _finish_local_map(self, fewest: int = _FEWEST_KEYFRAMES) -> int | None:
        """End the present local map with the latest keyframe; its index, or None where it has too few."""
        self._take_loops()
        first, last = self._map_begins, len(self._keyframes)
        if last - first < fewest:
            return None
        self._map_begins = last
        arguments = first, last, self._ways[(first + last) // 2], self._drift(first, last)
        return self._loops.add(self._keyframes.snapshot(), *arguments)

    def _follow(self, before: Float) -> None:
        """Move the keyframes as the local maps were moved from their poses (C, 3) before."""
        poses = self._keyframes.poses
        poses[:] = self._loops.carried_along(poses, before, np.array(self._broken, bool))
        self._tracker.moved()

    def session(self) -> Session:
        """All that it takes to go on in this map another time. Raises InputError where there is no keyframe."""
        if not len(self._keyframes):
            raise InputError("there is no map to save", advice="send scans first")
        self._settle_loops()
        points, normals, kinds, firsts, increments = self._keyframes.arrays
        local_maps, loops, information = self._graph()
        return Session(
            stamps=np.array(self._keyframe_stamps),
            poses=self._keyframes.poses.copy(),
            points=points.copy(),
            normals=normals.copy(),
            kinds=kinds.copy(),
            firsts=firsts.copy(),
            increments=increments.copy(),
            ways=np.array(self._ways),
            wheel_steps=np.array(self._wheel_steps).reshape(-1, 3),
            broken=np.array(self._broken, bool),
            local_maps=local_maps,
            loops=loops,
            loop_information=information,
        )

    def _settle_loops(self) -> None:
        """Wait for the loops that are being closed, where the present pose is not one of a new keyframe."""
        self.take_refinement()
        before = self._keyframes.poses[-1].copy()
        if self._take_loops():
            self._last = compose(self._keyframes.poses[-1], relative(before, self._last))

    def _graph(self) -> tuple[NDArray[np.int64], NDArray[np.int64], Float]:
        """Begins of the local maps (C,), loops (L, 2) and their information (L, 3, 3), while none is being closed."""
        count = len(self._keyframes)
        begins = [local.first for local in self._loops.maps] + ([self._map_begins] if self._map_begins < count else [])
        return np.array(begins, np.int64), *self._loops.credible()

    def growth(self, keyframes: int, scans: int, *, most: int | None = None) -> SessionGrowth:
        """What has come since there were so many keyframes and scans; nothing waits for it and nothing is moved.

        most: keyframes, of those that have come.
        """
        points, normals, kinds, firsts, increments = self._keyframes.since(keyframes, most)
        end = keyframes + len(points)
        return SessionGrowth(
            first=keyframes,
            poses=self._keyframes.poses.copy(),
            stamps=np.array(self._keyframe_stamps[keyframes:end]),
            points=points.copy(),
            normals=normals.copy(),
            kinds=kinds.copy(),
            firsts=firsts.copy(),
            increments=increments.copy(),
            ways=np.array(self._ways[keyframes:end]),
            wheel_steps=np.reshape(self._wheel_steps[3 * keyframes : 3 * end], (-1, 3)),
            broken=np.array(self._broken[keyframes:end], bool),
            graph=self._graph() if len(points) and not self._map_is_changing else None,
            scans=ScanPoses(
                np.array(self._stamps[scans:]),
                np.array(self._owners[scans:], np.int64),
                np.reshape(self._offsets[3 * scans :], (-1, 3)),
            ),
            last=LastScan(self._stamp, self._last.copy(), self._odometry.last),
        )

    def go_on(self, session: Session, scans: ScanPoses, last: LastScan) -> None:
        """Go on in a session as if nothing had happened since its last scan; after a crash, nothing has.

        Raises InputError as `remember` does.
        """
        self.resume(session)
        self.remember(scans)
        # The wheels since the last keyframe are not known any more.
        self._wheels_since = _UNKNOWN
        self._last, self._stamp = last.pose.copy(), last.stamp
        self._odometry.go_on(last.stamp, last.odometry)
        self._tracker.segment = int(np.flatnonzero(session.broken).max(initial=0))
        self._smoother.refill(session.wheel_steps, self._tracker.segment)

    def remember(self, scans: ScanPoses) -> None:
        """Take scans of an earlier session into the trajectory; they hang on the keyframes that there are now.

        Raises InputError where there are not so many keyframes.
        """
        if len(scans) and scans.owners.max() >= len(self._keyframes):
            raise InputError("scans of a session hang on keyframes that are not there")
        self._stamps = array("d", scans.stamps) + self._stamps
        self._owners = array("i", scans.owners) + self._owners
        self._offsets = array("d", scans.offsets.ravel()) + self._offsets

    def resume(self, session: Session, pose: ArrayLike = se2.IDENTITY) -> None:
        """Forget everything and go on in the map of a session, in a new segment with the robot at `pose` (3,)."""
        Localizer.reset(self, pose)
        self._take_keyframes(session)
        self._wheel_steps = array("d", session.wheel_steps.ravel())
        self._ways = array("d", session.ways)
        self._broken = array("B", session.broken.tobytes())
        graph = session.local_maps, session.ways, session.loops, session.loop_information
        self._loops.resume(self._keyframes.snapshot(), *graph)
        self._map_begins = len(session)

    def _take_keyframes(self, session: Session) -> None:
        """In place of those that there are; a new segment begins after them."""
        self._keyframes.fill(session.poses, session.beams)
        self._uncertainty.fill(len(session))
        self._keyframe_stamps = array("d", session.stamps)
        self._tracker.segment = len(session)

    def finish(self, progress: Progress = silent) -> None:
        """Close the loops that are left and refine all poses, as one does after the end of a recording."""
        if len(self._keyframes) < _FEWEST_KEYFRAMES:
            return
        self._keyframes.poses[:] = self._refinement()(progress)
        if self._keep_scans:
            self._refine_scans()
            progress("matching all scans", 1, 1)
        self._tracker.moved()

    def begin_refinement(self) -> None:
        """Do what `finish` does with the keyframes beside the tracking: `take_refinement` then moves the map.

        Scans may come meanwhile; loops are closed again once the refinement is taken.
        """
        if self._refined is None and len(self._keyframes) >= _FEWEST_KEYFRAMES:
            self._settle_loops()
            self._refined = _BACKGROUND.submit(self._refinement())

    @property
    def refining(self) -> bool:
        """Whether a refinement was begun that is not ready to be taken yet."""
        return self._refined is not None and not self._refined.done()

    def take_refinement(self) -> bool:
        """Wait for the refinement that was begun and move the map as it says; whether there was one."""
        refined, self._refined = self._refined, None
        if refined is None:
            return False
        known, poses = self._keyframes.poses, refined.result()
        # What came meanwhile hangs on the last keyframe that was refined.
        step = se2.compose(poses[-1], se2.inverse(known[len(poses) - 1]))
        known[len(poses) :] = se2.compose(step, known[len(poses) :])
        known[: len(poses)] = poses
        self._last = compose(step, self._last)
        self._loops.settle(self._keyframes.snapshot())
        self._tracker.moved()
        return True

    @property
    def _map_is_changing(self) -> bool:
        return self._closing is not None or self._refined is not None

    def _refinement(self) -> Callable[..., Float]:
        """What gives the refined poses (N, 3) of the keyframes there are now, wherever it runs; the loops are its own.

        It takes a Progress.
        """
        loops, new = self._loops, None
        if self._config.loop_closure:
            new = self._finish_local_map()
        keyframes = self._keyframes.snapshot()
        ways, broken = np.array(self._ways), np.array(self._broken, bool)
        wheel_steps = np.array(self._wheel_steps).reshape(-1, 3)

        def refined(progress: Progress = silent) -> Float:
            if self._config.loop_closure:
                loops.take_poses(keyframes)
                before = loops.poses.copy()
                _close_more_loops(loops, new, progress)
                keyframes.poses[:] = loops.carried_along(keyframes.poses, before, broken)
            return refinement.refine(keyframes, ways, wheel_steps, broken, progress=progress)

        return refined

    def move_keyframes(self, poses: ArrayLike) -> None:
        """Take T_map_laser (N, 3) of all keyframes from a map that knows more, as of several robots; scans follow."""
        self._take_loops()
        self._keyframes.poses[:] = poses
        if self._keep_scans:
            self._refine_scans()
        self._tracker.moved()

    def _refine_scans(self) -> None:
        """Match every scan that is no keyframe to the keyframes around it."""
        poses, arrays = self._keyframes.poses, self._keyframes.arrays
        guesses = self._scan_poses()
        owners = np.array(self._owners)
        rows = np.array([i for i, scan in enumerate(self._scans) if scan is not None and owners[i] >= 0], int)
        if not len(rows):
            return
        near = cKDTree(poses[:, :2]).query(guesses[rows, :2], np.arange(1, min(24, len(poses)) + 1))[1]
        for first in range(0, len(rows), _MATCHED_AT_ONCE):
            some = slice(first, first + _MATCHED_AT_ONCE)
            scans = Keyframes()
            for row in rows[some]:
                kept = self._scans[row]
                assert kept is not None
                scans.add(kept, guesses[row])
            seen = scans.arrays[:3]
            at, owner = guesses[rows[some]], owners[rows[some]]
            placed = refinement.place(at, owner, near[some], *seen, poses, *arrays)
            for row, offset in zip(rows[some], se2.relative(poses[owner], placed), strict=True):
                self._offsets[3 * row : 3 * row + 3] = array("d", offset)

    def _scan_poses(self) -> Float:
        """T_map_laser (N, 3) of the scans."""
        offsets = np.array(self._offsets).reshape(-1, 3)
        owners = np.array(self._owners)
        poses = offsets.copy()
        hung = owners >= 0
        poses[hung] = se2.compose(self._keyframes.poses[owners[hung]], offsets[hung])
        return poses

    def trajectory(self) -> Trajectory:
        """T_map_base of every scan, in the order in which they came, as it is known now."""
        return Trajectory.from_se2(np.array(self._stamps), se2.compose(self._scan_poses(), self._T_laser_base))

    def causal_trajectory(self) -> Trajectory:
        """T_map_base of every scan as it was known when the scan came; empty if scans are not kept."""
        return Trajectory.from_se2(self._stamps[: len(self._causal)], np.reshape(self._causal, (-1, 3)))

    @property
    def keyframe_count(self) -> int:
        """How many scans were added to the map."""
        return len(self._keyframes)

    @property
    def latest_stamp(self) -> float:
        """Of the latest scan, or of the latest keyframe of a session that no scan has come to yet, s."""
        return max([self._stamp, *self._keyframe_stamps[-1:]])

    def keyframes(self) -> Trajectory:
        """T_map_base of the scans that were added to the map."""
        poses = se2.compose(self._keyframes.poses, self._T_laser_base)
        return Trajectory.from_se2(np.array(self._keyframe_stamps), poses)

    def point_map(self) -> Float:
        """The points (N, 2) of the map, thinned to `map_spacing`."""
        return self.later_point_map()()

    def later_point_map(self) -> Callable[[], Float]:
        """The point map of now, for whoever wants to make it later, in another thread."""
        keyframes = self._keyframes.snapshot()
        return partial(map_of_keyframes, keyframes.poses, keyframes.points, keyframes.kinds, self._config.map_spacing)


def _close_more_loops(loops: LoopCloser, new: int | None, progress: Progress) -> None:
    """Once all is in place, more places turn out to be the same ones; new: a local map that was never looked for."""
    if new is not None:
        loops.close(new)
    for c in range(len(loops.maps)):
        loops.close(c, wide=False)
        progress("loop closure", c + 1, len(loops.maps))
    loops.optimize()


@kernel
def _velocity(step, elapsed):  # type: ignore[no-untyped-def]
    """A step (3,) a second, m/s and rad/s; 0 where the time is no help: equal, backward or far apart stamps."""
    velocity = np.zeros(3)
    if 0 < elapsed < _LONGEST_STEP_S:
        for u in range(3):
            velocity[u] = min(max(step[u] / elapsed, -_FASTEST[u]), _FASTEST[u])
    return velocity
