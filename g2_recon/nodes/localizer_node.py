# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""localizer_node: horizontal scans, and wheel odometry where there is some, to poses in the map."""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path as FilePath
from time import monotonic
from typing import NamedTuple, TypeGuard

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future
from sensor_msgs.msg import LaserScan

from g2_recon.errors import InputError
from g2_recon.geometry import se2, se3
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import PoseBuffer, Trajectory
from g2_recon.localization.localized_scan import LocalizedScan
from g2_recon.localization.localizer import Localizer
from g2_recon.localization.map_localizer import MapLocalizer
from g2_recon.localization.methods import AnyLocalizer, make_localizer
from g2_recon.localization.paper import PaperLocalizer
from g2_recon.localization.resumed import ResumedLocalizer
from g2_recon.localization.warm_up import warm_up_tracking
from g2_recon.localization.wheel_check import WheelCheck
from g2_recon.nodes import conversions
from g2_recon.nodes.keyframes import KeyframeSender
from g2_recon.nodes.localizer_journal import LocalizerJournal
from g2_recon.nodes.map_publisher import MapPublisher, flat_cloud
from g2_recon.nodes.parameters import LocalizerParameters
from g2_recon.nodes.ros import Transforms, reliable_qos, run, sensor_qos
from g2_recon.nodes.stage_node import JumpDetector, LaserMount, StageNode, session_folder
from g2_recon.recording.clouds import write_cloud
from g2_recon.recording.occupancy_maps import write_map
from g2_recon.recording.sessions import read_session, write_session
from g2_recon.recording.trajectories import write_tum

# Odometry with a longer gap says nothing about a time inside it.
_MAX_ODOMETRY_GAP_S = 1.0
# So long odometry is thought to go on as before, rather than to wait for the next: at 1 m/s^2 it errs by 5 mm then.
_LONGEST_LEAD_S = 0.1
# Wall time that queued odometry gets to come in before a scan goes on without it, and the same where no newer scan
# tells how much time has passed: at the end of a recording.
_GRACE_S, _LONGEST_GRACE_S = 0.05, 1.0
# So many of the last scans tell how well they match; what is wrong if fewer than this share do, or if more than this
# share of the way contradicts the wheels.
_LAST_SCANS, _FEWEST_SCANS = 200, 50
_LEAST_MATCHED, _MOST_CONTRADICTION = 0.5, 0.5
# A session whose last scan is not older than this was left by a crash: the robot has not been carried away since.
_SOON_S = 60.0
# Odometry that is so much older than the scans has stopped.
_LATE_ODOMETRY_S = 2.0
_UPRIGHT = math.radians(45)


class _WaitingScan(NamedTuple):
    scan: Scan
    stamp: Time
    received_at: float


class LocalizerNode(StageNode[LocalizerParameters]):
    """Localizes each scan; publishes poses at once, trajectory and maps at new keyframes, at most once a second."""

    def __init__(self) -> None:
        """Raises ConfigError where a parameter is wrong, InputError where the map cannot be used."""
        super().__init__("localizer_node", LocalizerParameters)
        self._transforms = Transforms(self)
        self._mount = LaserMount(self, self.settings.laser_pose, self.settings.base_frame, self._transforms)
        self._localizer: AnyLocalizer | None = None
        self._maps = MapPublisher(self)
        self._start: NDArray[np.float64] | None = None
        self._loaded = read_session(FilePath(self.settings.map).expanduser()) if self.settings.map else None
        self._session = self._loaded
        self._odometry = PoseBuffer()
        # Whether the first scan after a crash is still to come.
        self._bridging = False
        self._waiting: deque[_WaitingScan] = deque()
        self._jumps = JumpDetector()
        self._newest_scan = -np.inf
        self._last_stamp = Time()
        self._localized = 0
        self._latest: LocalizedScan | None = None
        self._matched: deque[bool] = deque(maxlen=_LAST_SCANS)
        self._wheel_check = WheelCheck()
        # Who waits for a refinement that is to be begun, and for the one that goes on.
        self._refinement_wanted: list[Future] = []
        self._refinement_awaited: list[Future] = []
        self._journal = self._open_journal()
        if self.settings.method == "graph":
            self.compile_beside(*(() if self.settings.map else ("tracking",)), "localization", load=_load)
        self._connect()

    def _open_journal(self) -> LocalizerJournal:
        """With what a node that was killed has left in it."""
        folder = self.settings.session_dir
        if self.settings.method == "paper" and folder:
            self.get_logger().warning("method paper keeps no journal: after a crash it starts anew")
            folder = ""
        journal = LocalizerJournal(self, folder, "localizer.journal")
        if journal.last is not None:
            # A recording that is replayed once more starts anew, as one that loops does.
            self._jumps.jumped_back(journal.last.stamp)
            if self.settings.use_odometry and np.isfinite(journal.last.odometry).all():
                # What the wheels have told since then leads over the time in between.
                self._odometry.add(journal.last.stamp, se3.from_se2(journal.last.odometry))
                self._bridging = True
        return journal

    def _start_localizer(self, T_base_laser: NDArray[np.float64], stamp: float) -> None:
        """With the first scan, at `stamp` s; where a session was left a moment ago, go on as if nothing had been."""
        left, last = self._journal.session, self._journal.last
        soon = False
        if left is not None and last is not None and self.settings.mode == "mapping":
            self._session = left
            soon = self._start is None and stamp - last.stamp < _SOON_S
            self.get_logger().info(f"going on in the map of the last time: {len(left)} keyframes")
        self._localizer = make_localizer(self.settings, T_base_laser, session=None if soon else self._session)
        if self._start is not None:
            self._localizer.reset(self._start)
        if isinstance(self._localizer, Localizer):
            self._take_up(self._localizer)
        self._maps.begin(T_base_laser, self._session)

    def _take_up(self, localizer: Localizer) -> None:
        try:
            self._journal.take_up(localizer, near=self._start is None)
        except InputError as error:
            self.drop("unusable journal", str(error))
            self._journal.clear()

    def _connect(self) -> None:
        depth = self.settings.queue_depth
        self._pose_publisher = self.create_publisher(PoseWithCovarianceStamped, "pose", reliable_qos(depth))
        self._keyframe_sender = KeyframeSender(self)
        self.offer_trigger("~/reset", self._reset_on_request)
        self.offer_trigger("~/save", self._save)
        self.offer_trigger("~/refine", self._refine, group=ReentrantCallbackGroup())
        self.offer_pause()
        self.create_timer(1.0, self._publish_maps, clock=self.steady_clock)
        # They run while there is something to do: each time one fires, all entities are waited for anew.
        self._waiting_timer = self.create_timer(
            _GRACE_S, self._process_waiting, clock=self.steady_clock, autostart=False
        )
        self._refinement_timer = self.create_timer(
            _GRACE_S, self._tend_refinement, clock=self.steady_clock, autostart=False
        )
        self.listen(PoseWithCovarianceStamped, "initialpose", self._on_initial_pose, reliable_qos(1))
        if self.settings.use_odometry:
            self.listen(Odometry, "odom", self._on_odometry, sensor_qos(depth))
        self.listen(LaserScan, "scan", self._on_scan, sensor_qos(depth))

    def end(self) -> None:
        """End the thread beside first: it works with what the node has."""
        self._maps.close()
        super().end()

    def waiting_for(self) -> str:
        """See StageNode."""
        return self.not_received("scan") or self._mount.waiting_for or self.stopped("scan") or self._waiting_for_place()

    def doubts(self) -> Iterator[str]:
        """See StageNode."""
        if self._mount.tilt is not None and self._mount.tilt > _UPRIGHT:
            yield (
                f"the laser of `scan` stands upright, {math.degrees(self._mount.tilt):.0f} deg from level: exchange it "
                "with that of `scan_vertical`, or correct its pose in `laser_pose` or TF"
            )
        if self.settings.use_odometry:
            yield self._lack_of_odometry()
        if self._wheel_check.contradiction > _MOST_CONTRADICTION:
            yield (
                f"scans and wheels contradict each other on {self._wheel_check.contradiction:.0%} of the last metres: "
                "perhaps both lasers are swapped (`scan` has to be the horizontal one, `scan_vertical` the vertical "
                "one), `laser_pose` is wrong, or `odom` is not of this robot"
            )
        elif len(self._matched) >= _FEWEST_SCANS and self._share_matched() < _LEAST_MATCHED:
            yield (
                f"only {self._share_matched():.0%} of the last scans match the map: perhaps `scan` is not that of the "
                "horizontal laser, or `laser_pose`, `min_range` or `max_range` is wrong"
            )

    def _lack_of_odometry(self) -> str:
        odom, scan = self.inputs["odom"], self.inputs["scan"]
        if not odom.count:
            return (
                f"no odometry: {odom.lack()}; scans are matched without it; if there is none, set use_odometry to false"
            )
        if scan.newest_stamp - odom.newest_stamp > _LATE_ODOMETRY_S:
            return f"no odometry since {odom.newest_stamp:.1f} s: `{odom.topic}` has stopped or comes late"
        return ""

    def _share_matched(self) -> float:
        return sum(self._matched) / max(len(self._matched), 1)

    def _waiting_for_place(self) -> str:
        lost = isinstance(self._localizer, (MapLocalizer, ResumedLocalizer)) and not self._localizer.is_placed
        return "looking for the place of the robot in the loaded map: drive, or give an initialpose" if lost else ""

    def _makes_map(self, localizer: AnyLocalizer) -> TypeGuard[Localizer]:
        """Whether others are told of its keyframes: not in a map that stays as it is, nor before its place is known."""
        maps = isinstance(localizer, Localizer) and not isinstance(localizer, MapLocalizer)
        return maps and not self._waiting_for_place()

    def figures(self) -> dict[str, object]:
        """See StageNode."""
        localizer, latest = self._localizer, self._latest
        return {
            "localized scans": self._localized,
            "scans that did not match the map": 0 if localizer is None else localizer.unmatched,
            "scans that wait for odometry": len(self._waiting),
            "beams that fit the map": "" if latest is None else f"{latest.inliers:.0%}",
            "of the last scans match": f"{self._share_matched():.0%}" if self._matched else "",
            "of the last metres contradict the wheels": f"{self._wheel_check.contradiction:.0%}",
            "position is known least": "" if latest is None else _weak_axis(latest),
            "loops closed": 0 if localizer is None else localizer.loops,
        }

    def _on_odometry(self, message: Odometry) -> None:
        odometry = self.usable(conversions.odometry_from_message, message, "odometry")
        if odometry is None:
            return
        stamp, T_odom_base = odometry
        if stamp < self._odometry.last_stamp - _MAX_ODOMETRY_GAP_S:
            self._odometry.clear()
        self._odometry.add(stamp, T_odom_base)
        self._process_waiting()

    def _on_scan(self, message: LaserScan) -> None:
        if self.paused:
            self.drops["scan while paused"] += 1
            return
        scan = self.usable(conversions.scan_from_message, message, "scan")
        if scan is None:
            return
        if self._jumps.jumped_back(scan.stamp):
            self.get_logger().warning(f"time jumped back to {scan.stamp:.3f} s: starting a new map")
            self._reset(None)
        T_base_laser = self._mount.find(scan.frame_id)
        if T_base_laser is None:
            self.drops["scan of a laser with unknown pose"] += 1
            return
        if self._localizer is None:
            self._start_localizer(T_base_laser, scan.stamp)
        self._newest_scan = max(self._newest_scan, scan.stamp)
        self._waiting.append(_WaitingScan(scan, message.header.stamp, monotonic()))
        self._process_waiting()

    def _process_waiting(self) -> None:
        """Localize the scans that have their odometry, or for which none will come."""
        while self._waiting and not self._odometry_may_come(self._waiting[0]):
            waiting = self._waiting.popleft()
            self._localize(waiting.scan, waiting.stamp)
        if not self._waiting:
            self._waiting_timer.cancel()
        elif self._waiting_timer.is_canceled():
            self._waiting_timer.reset()

    def _odometry_may_come(self, waiting: _WaitingScan) -> bool:
        if not len(self._odometry) or waiting.scan.stamp <= self._odometry.last_stamp:
            return False
        if not self._bridging and self._odometry.leads_to(waiting.scan.stamp, _LONGEST_LEAD_S):
            return False
        overdue = self._newest_scan - self._odometry.last_stamp > self.settings.odometry_wait
        brief = overdue and not self._bridging
        return monotonic() - waiting.received_at < (_GRACE_S if brief else _LONGEST_GRACE_S)

    def _localize(self, scan: Scan, stamp: Time) -> None:
        assert self._localizer is not None
        T_odom_base = self._look_up_odometry(scan.stamp)
        odometry = None if T_odom_base is None else se2.from_se3(T_odom_base)
        result = self._localizer.process(scan, odometry)
        self._localized += 1
        self._latest = result
        self._matched.append(result.matched)
        self._wheel_check.add(result.pose, odometry)
        if result.keyframe:
            self._maps.add(scan)
        if isinstance(self._localizer, Localizer):
            self._journal.write(self._localizer)
        self._last_stamp = stamp
        self._publish_pose(result, stamp, T_odom_base)

    def _look_up_odometry(self, stamp: float) -> NDArray[np.float64] | None:
        """T_odom_base (4, 4) at the time of a scan, None where unknown.

        Where the last odometry before the scan leads on to it, that the next one has come, too, makes no difference:
        what becomes of a scan must not hang on how long messages take.
        """
        T_odom_base = None if self._bridging else self._odometry.ahead(stamp, _LONGEST_LEAD_S)
        if T_odom_base is None:
            max_gap = _SOON_S if self._bridging else _MAX_ODOMETRY_GAP_S
            poses, known = self._odometry.interpolate([stamp], max_gap=max_gap)
            T_odom_base = poses[0] if known[0] else None
        self._bridging = False
        # Scans of some recordings step back by less than a second.
        self._odometry.drop_before(stamp - _MAX_ODOMETRY_GAP_S)
        return T_odom_base

    def _publish_pose(self, result: LocalizedScan, stamp: Time, T_odom_base: NDArray[np.float64] | None) -> None:
        head = conversions.header(stamp, self.settings.map_frame)
        self._pose_publisher.publish(conversions.planar_pose_message(head, result.pose, result.covariance))
        if self.settings.publish_tf and T_odom_base is not None and not self._waiting_for_place():
            T_map_odom = se3.from_se2(result.pose) @ se3.inverse(T_odom_base)
            self._transforms.send(stamp, self.settings.map_frame, self.settings.odom_frame, T_map_odom)

    def _publish_maps(self) -> None:
        """Tell of new keyframes, and have the maps drawn that changed with them."""
        if self._localizer is None:
            return
        self._maps.publish(self._localizer, self._last_stamp)
        if self._makes_map(self._localizer):
            self._keyframe_sender.tell(self._localizer, self.settings.map_frame)

    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        frame = message.header.frame_id
        if frame not in ("", self.settings.map_frame):
            self.drop("initialpose in another frame", f"it is in {frame}, not {self.settings.map_frame}")
            return
        try:
            pose = se2.from_se3(conversions.pose_matrix(message.pose.pose))
        except InputError as error:
            self.drop("unusable initialpose", str(error))
            return
        near = f"x {pose[0]:.2f} m, y {pose[1]:.2f} m, yaw {pose[2]:.2f} rad"
        if isinstance(self._localizer, (MapLocalizer, ResumedLocalizer)):
            self.get_logger().info(f"looking for the place of the robot near {near}")
            self._localizer.set_pose(pose)
        elif self._localizer is None and self._loaded is not None:
            self._start = pose
        else:
            self.get_logger().info(f"starting a new map at {near}")
            self._reset(pose)

    def _reset_on_request(self) -> str:
        self._reset(None)
        return "starting a new map" if self._session is None else "starting again with the loaded map"

    def _reset(self, start: NDArray[np.float64] | None) -> None:
        """Start anew. The empty trajectory tells whoever builds on the poses that they start anew."""
        self._start = start
        if self._waiting:
            self.drops["scan that waited at a reset"] += len(self._waiting)
        self._waiting.clear()
        self._newest_scan = -np.inf
        self._matched.clear()
        self._wheel_check = WheelCheck()
        self._journal.clear()
        self._keyframe_sender.begin_anew()
        if self._session is not self._loaded:
            # What was taken up from the journal is forgotten, too.
            self._session, self._localizer = self._loaded, None
            self._maps.forget()
        if self._localizer is not None:
            self._localizer.reset(*([] if start is None else [start]))
        self._maps.restart(self._session)
        self._maps.clear(self._last_stamp)

    async def _refine(self) -> str:
        """Wait until the timer has done it, between scans."""
        localizer = self._localizer
        if isinstance(localizer, (MapLocalizer, PaperLocalizer)):
            raise InputError("this map is not refined", advice="use method graph and mode mapping")
        if localizer is None or self._waiting_for_place():
            raise InputError("there is nothing to refine", advice=self.waiting_for() or "send scans first")
        answer = Future()
        self._refinement_wanted.append(answer)
        self._refinement_timer.reset()
        return str(await answer)

    def _tend_refinement(self) -> None:
        """Begin the refinement that somebody waits for, or take the one that is ready."""
        localizer = self._localizer
        if self._refinement_awaited and not (isinstance(localizer, Localizer) and localizer.refining):
            awaited, self._refinement_awaited = self._refinement_awaited, []
            try:
                told = self._take_refinement(localizer)
            except Exception as error:
                # For whoever asked; it must not end the node.
                for answer in awaited:
                    answer.set_exception(error)
            else:
                for answer in awaited:
                    answer.set_result(told)
        elif self._refinement_wanted and not self._refinement_awaited and isinstance(localizer, Localizer):
            localizer.begin_refinement()
            self._refinement_awaited, self._refinement_wanted = self._refinement_wanted, []
        # In this order: in another thread somebody may just come to want one.
        self._refinement_timer.cancel()
        if self._refinement_wanted or self._refinement_awaited:
            self._refinement_timer.reset()

    def _take_refinement(self, localizer: AnyLocalizer | None) -> str:
        if not isinstance(localizer, Localizer) or not localizer.take_refinement():
            raise InputError("there was nothing to refine, or it was forgotten meanwhile", advice="send scans first")
        self._journal.write(localizer)
        self._maps.moved()
        self._publish_maps()
        return f"refined {localizer.keyframe_count} keyframes, with {localizer.loops} closed loops"

    def _save(self) -> str:
        folder = session_folder(self.settings.session_dir)
        if self._localizer is None:
            raise InputError("there is nothing to save", advice=self.waiting_for() or "send scans first")
        trajectory = self._localizer.trajectory()
        write_tum(folder / "trajectory.tum", trajectory)
        cloud = flat_cloud(self._localizer.point_map())
        write_cloud(folder / "point_map.ply", cloud)
        wrote = f"trajectory.tum ({len(trajectory)} poses), point_map.ply ({len(cloud)} points)"
        grid = self._maps.grid(self._localizer.keyframes())
        if grid is not None and grid.cells.size:
            write_map(folder / "map.yaml", grid)
            wrote += f", map.yaml, map.pgm ({grid.cells.shape[1]} x {grid.cells.shape[0]} cells)"
        if isinstance(self._localizer, Localizer) and self._localizer.keyframe_count:
            session = self._localizer.session()
            write_session(folder / "session.npz", session)
            wrote += f", session.npz ({len(session)} keyframes)"
        return f"wrote {wrote} to {folder}"


def _load() -> None:
    """Run once what the first scans need: some tenths of a second, for which they would wait."""
    warm_up_tracking()
    Trajectory.from_se2(np.arange(2.0), np.zeros((2, 3))).interpolate([0.5])


def _weak_axis(scan: LocalizedScan) -> str:
    direction, along, across = scan.weak_axis
    return f"along {math.degrees(direction):.0f} deg in the map: sigma {along:.3f} m, across it {across:.3f} m"


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; the exit code."""
    return run(LocalizerNode, args)


if __name__ == "__main__":
    sys.exit(main())
