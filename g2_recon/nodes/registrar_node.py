# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""registrar_node: vertical scans, and the poses of the robot, to clouds in the map frame."""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Iterator, Sequence

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Path
from numpy.typing import NDArray
from sensor_msgs.msg import LaserScan
from std_msgs.msg import UInt32

from g2_recon.geometry.scan import Scan
from g2_recon.nodes import conversions
from g2_recon.nodes.journals import MessageJournal
from g2_recon.nodes.parameters import RegistrarParameters
from g2_recon.nodes.piece_publisher import PiecePublisher
from g2_recon.nodes.ros import LATCHED, Transforms, reliable_qos, run, sensor_qos
from g2_recon.nodes.stage_node import JumpDetector, LaserMount, StageNode
from g2_recon.registration.registrar import Registrar

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
        self._registered = 0
        # Scans of lives before, until the pose of the laser is known.
        self._early_scans: list[Scan] = []
        depth = self.settings.queue_depth
        self._cloud = PiecePublisher(self, self.settings.map_frame, depth)
        self.offer_trigger("~/reset", self._reset)
        self.compile_beside("registration")
        takers = {
            "source": (UInt32, lambda message: self._cloud.former_sources.append(message.data)),
            "pose": (PoseStamped, self._add_pose),
            "scan": (LaserScan, self._take_up_scan),
        }
        self._journal = MessageJournal(self, self.settings.session_dir, "scans.journal", takers)
        self._journal.take_up()
        self._journal.keep("source", UInt32(data=self._cloud.source))
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
            values["scans not needed, as the robot had not moved on"] = self._registrar.too_near
            values["scans not needed, as what they saw was known"] = self._registrar.nothing_new
            values["pieces placed anew"] = self._cloud.renewed
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
        self._cloud.follow(self._registrar)
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
            self._cloud.renew_if_needed()
        else:
            self.get_logger().warning("the trajectory is of another map: forgetting poses and scans")
            self._reset()

    def _publish_registered(self) -> None:
        assert self._registrar is not None
        for registered in self._registrar.take():
            self._cloud.publish(registered)
            self._registered += 1
        self._cloud.renew_if_needed()

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
        self._cloud.take_back()
        self._early_scans.clear()
        self._journal.clear()
        self._journal.keep("source", UInt32(data=self._cloud.source))
        return "forgot all poses, scans and points"

    def _registrar_drops(self) -> dict[str, int]:
        assert self._registrar is not None
        drops = self._registrar.drops.items()
        return {f"dropped: {reason if reason.startswith('pose') else f'scan, {reason}'}": n for reason, n in drops}


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; the exit code."""
    return run(RegistrarNode, args)


if __name__ == "__main__":
    sys.exit(main())
