# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""registrar_node: vertical scans, and the poses of the robot, to clouds in the map frame."""

from __future__ import annotations

import math
import sys
from array import array
from collections import deque
from collections.abc import Iterator, Sequence
from secrets import randbits
from time import monotonic

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Path
from numpy.typing import NDArray
from sensor_msgs.msg import LaserScan, PointCloud2
from std_msgs.msg import UInt32, UInt32MultiArray

from g2_recon.geometry.cloud import Piece
from g2_recon.geometry.scan import Scan
from g2_recon.nodes import conversions
from g2_recon.nodes.journals import MessageJournal
from g2_recon.nodes.parameters import RegistrarParameters
from g2_recon.nodes.ros import LATCHED, Transforms, reliable_qos, run, sensor_qos
from g2_recon.nodes.stage_node import JumpDetector, LaserMount, StageNode
from g2_recon.registration.registrar import RegisteredCloud, Registrar

# Pieces are placed anew for so long at a time, and scans and poses have their turn in between, s.
_RENEW_S, _RENEW_PERIOD_S = 0.005, 0.015
# How often it is looked whether somebody subscribes who lacks what was before, s.
_WATCH_PERIOD_S = 0.5

# A pose that is so much older than the scans is missing.
_LATE_POSE_S = 1.0
_LEVEL = math.radians(45)


class RegistrarNode(StageNode[RegistrarParameters]):
    """Publishes one cloud a vertical scan, with the stamp of the scan, as soon as poses cover it.

    Where the localizer moves the way, and where somebody comes late, the pieces of the cloud are published anew.
    """

    def __init__(self) -> None:
        """Raises ConfigError where a parameter is wrong."""
        super().__init__("registrar_node", RegistrarParameters)
        self._mount = LaserMount(self, self.settings.laser_pose, self.settings.base_frame, Transforms(self))
        self._registrar: Registrar | None = None
        # Poses that come before the pose of the laser is known.
        self._early_poses: deque[tuple[float, NDArray]] = deque()
        self._jumps = self._new_jumps()
        self._registered = self._renewed = 0
        self._newest_stamp, self._subscribers = Time(), 0
        self._begin_source()
        # Of lives before this one, whose points are now those of this one.
        self._former_sources: list[int] = []
        # Scans of lives before, until the pose of the laser is known.
        self._early_scans: list[Scan] = []
        depth = self.settings.queue_depth
        self._cloud_publisher = self.create_publisher(PointCloud2, "cloud", reliable_qos(depth))
        self.offer_trigger("~/reset", self._reset)
        self._renew_timer = self.create_timer(_RENEW_PERIOD_S, self._renew, clock=self.steady_clock)
        self._renew_timer.cancel()
        takers = {
            "source": (UInt32, lambda message: self._former_sources.append(message.data)),
            "pose": (PoseStamped, self._add_pose),
            "scan": (LaserScan, self._take_up_scan),
        }
        self._journal = MessageJournal(self, self.settings.session_dir, "scans.journal", takers)
        self._journal.take_up()
        self._journal.keep("source", UInt32(data=self._source))
        self.create_timer(_WATCH_PERIOD_S, self._watch_subscribers, clock=self.steady_clock)
        self.listen(UInt32MultiArray, "cloud_wanted", self._on_wanted, reliable_qos(depth))
        self.listen(Path, "trajectory", self._on_trajectory, LATCHED, raw=True)
        self.listen(PoseWithCovarianceStamped, "pose", self._on_pose, reliable_qos(depth))
        self.listen(LaserScan, "scan_vertical", self._on_scan, sensor_qos(depth))

    def waiting_for(self) -> str:
        """See StageNode."""
        lack = self.not_received("scan_vertical") or self._mount.waiting_for or self.not_received("pose")
        return lack or self._late_pose() or self.stopped("scan_vertical")

    def _late_pose(self) -> str:
        scan, pose = self.inputs["scan_vertical"].newest_stamp, self.inputs["pose"].newest_stamp
        if scan - pose < _LATE_POSE_S:
            return ""
        return f"no pose yet at {scan:.1f} s, the newest is of {pose:.1f} s: is the localizer paused, busy or gone?"

    def doubts(self) -> Iterator[str]:
        """See StageNode."""
        if self._mount.tilt is not None and self._mount.tilt < _LEVEL:
            yield (
                f"the laser of `scan_vertical` lies level, tilted by {math.degrees(self._mount.tilt):.0f} deg only: "
                "exchange it with that of `scan`, or correct its pose in `laser_pose` or TF"
            )

    def settings_changed(self) -> None:
        """See StageNode."""
        if self._registrar is not None:
            self._registrar.configure(self.settings)

    def figures(self) -> dict[str, object]:
        """See StageNode."""
        values: dict[str, object] = {"registered scans": self._registered}
        if self._registrar is not None:
            values["scans that wait for a pose"] = self._registrar.waiting
            values["scans kept to be placed anew"] = self._registrar.kept
            values["scans too old to be placed anew"] = self._registrar.released
            values["pieces placed anew"] = self._renewed
            values["pieces to be placed anew"] = self._registrar.to_renew
            values |= self._registrar_drops()
        return values

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        if self._in_map_frame(message.header.frame_id, "pose"):
            self._add_pose(PoseStamped(header=message.header, pose=message.pose.pose))

    def _add_pose(self, message: PoseStamped) -> None:
        T_map_base = self.usable(conversions.pose_matrix, message.pose, "pose")
        if T_map_base is None:
            return
        stamp = conversions.stamp_seconds(message.header.stamp)
        self._reset_if_jumped("pose", stamp)
        self._journal.keep("pose", message)
        if self._registrar is None:
            self._early_poses.append((stamp, T_map_base))
            if len(self._early_poses) > self.settings.queue_depth and not self._early_scans:
                self._early_poses.popleft()
            return
        self._registrar.add_pose(stamp, T_map_base)
        self._publish_registered()

    def _on_scan(self, message: LaserScan) -> None:
        scan = self.usable(conversions.scan_from_message, message, "scan")
        if scan is None:
            return
        self._reset_if_jumped("scan_vertical", scan.stamp)
        T_base_laser = self._mount.find(scan.frame_id)
        if T_base_laser is None:
            self.drops["scan of a laser with unknown pose"] += 1
            return
        self._journal.keep("scan", message)
        self._start_registrar(T_base_laser)
        self._add_scan(scan)

    def _take_up_scan(self, message: LaserScan) -> None:
        """A scan of a life before: where the pose of the laser comes from TF, it is not known yet."""
        scan = self.usable(conversions.scan_from_message, message, "scan")
        if scan is None:
            return
        T_base_laser = self._mount.find(scan.frame_id)
        if T_base_laser is None:
            self._early_scans.append(scan)
            return
        self._start_registrar(T_base_laser)
        self._add_scan(scan)

    def _start_registrar(self, T_base_laser: NDArray) -> None:
        if self._registrar is not None:
            return
        self._registrar = Registrar(self.settings, T_base_laser, keep_scans=True)
        for stamp, T_map_base in self._early_poses:
            self._registrar.add_pose(stamp, T_map_base)
        self._early_poses.clear()
        for scan in self._early_scans:
            self._registrar.add_scan(scan)
        self._early_scans.clear()

    def _add_scan(self, scan: Scan) -> None:
        assert self._registrar is not None
        self._registrar.add_scan(scan)
        self._publish_registered()

    def _on_trajectory(self, data: bytes) -> None:
        """An empty trajectory says that the localizer started a new map, so that the old poses no longer hold."""
        told = self.usable(conversions.trajectory_from_serialized_path, data, "trajectory")
        if told is None:
            return
        frame, keyframes = told
        if not len(keyframes):
            self._reset()
            return
        if self._registrar is None or not self._in_map_frame(frame, "trajectory"):
            return
        if self._registrar.follow(keyframes):
            self._renew_if_needed()
        else:
            self.get_logger().warning("the trajectory is of another map: forgetting poses and scans")
            self._reset()

    def _publish_registered(self) -> None:
        assert self._registrar is not None
        for registered in self._registrar.take():
            if not self._registered:
                self._subscribers = self._cloud_publisher.get_subscription_count()
            self._publish(registered)
            self._registered += 1
        self._renew_if_needed()

    def _publish(self, registered: RegisteredCloud) -> None:
        self._newest_stamp = conversions.stamp_message(registered.stamp)
        head = conversions.header(self._newest_stamp, self.settings.map_frame)
        piece = Piece(self._source, registered.piece, registered.revision)
        self._cloud_publisher.publish(conversions.cloud_to_message(head, registered.cloud, piece, len(self._sent)))
        self._sent.append(registered.piece)

    def _begin_source(self) -> None:
        """Of each message of the source, by its sequence number, which piece it was of."""
        self._source, self._sent = randbits(32), array("I")

    def _on_wanted(self, message: UInt32MultiArray) -> None:
        """Somebody lacks the messages from one sequence number to before another of a source."""
        if len(message.data) != 3:
            self.drop("unusable request", "cloud_wanted needs source, first and end of the sequence numbers")
            return
        source, begin, end = message.data
        if self._registrar is not None and source == self._source:
            self._registrar.renew_pieces(self._sent[begin:end])
            self._renew_if_needed()

    def _renew_if_needed(self) -> None:
        assert self._registrar is not None
        if self._registrar.to_renew and self._renew_timer.is_canceled():
            self._renew_timer.reset()

    def _renew(self) -> None:
        """Publish pieces that have moved, as many as there is time for."""
        end = monotonic() + _RENEW_S
        while self._registrar is not None and (renewed := self._registrar.renew()):
            self._publish(renewed)
            self._renewed += 1
            if monotonic() > end:
                return
        self._renew_timer.cancel()

    def _watch_subscribers(self) -> None:
        """Whoever comes late gets all that was before."""
        before, self._subscribers = self._subscribers, self._cloud_publisher.get_subscription_count()
        if self._subscribers > before and self._registrar is not None:
            # Points of scans that are kept no more would not come again.
            if not self._registrar.released:
                for source in self._former_sources:
                    self._take_back(source)
            self._registrar.renew_all()
            self._renew_if_needed()

    def _in_map_frame(self, frame: str, what: str) -> bool:
        if frame == self.settings.map_frame:
            return True
        self.drop(f"{what} in another frame", f"it is in '{frame}', not '{self.settings.map_frame}'")
        return False

    def _reset_if_jumped(self, topic: str, stamp: float) -> None:
        if self._jumps[topic].jumped_back(stamp):
            self.get_logger().warning(f"time on `{topic}` jumped back to {stamp:.3f} s: forgetting poses and scans")
            self._reset()
            self._jumps = self._new_jumps()

    def _new_jumps(self) -> dict[str, JumpDetector]:
        return {topic: JumpDetector(self.settings.max_wait) for topic in ("pose", "scan_vertical")}

    def _reset(self) -> str:
        """Start anew; what was published is taken back."""
        self._early_poses.clear()
        if self._registrar is not None:
            self.drops.update({key.removeprefix("dropped: "): count for key, count in self._registrar_drops().items()})
            if self._registrar.waiting:
                self.drops["scan that waited at a reset"] += self._registrar.waiting
            self._registrar.reset()
            for source in (*self._former_sources, self._source):
                self._take_back(source)
            self._begin_source()
        self._former_sources.clear()
        self._early_scans.clear()
        self._journal.clear()
        self._journal.keep("source", UInt32(data=self._source))
        return "forgot all poses, scans and points"

    def _take_back(self, source: int) -> None:
        head = conversions.header(self._newest_stamp, self.settings.map_frame)
        self._cloud_publisher.publish(conversions.no_pieces_message(head, source))

    def _registrar_drops(self) -> dict[str, int]:
        assert self._registrar is not None
        drops = self._registrar.drops.items()
        return {f"dropped: {reason if reason.startswith('pose') else f'scan, {reason}'}": n for reason, n in drops}


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; the exit code."""
    return run(RegistrarNode, args)


if __name__ == "__main__":
    sys.exit(main())
