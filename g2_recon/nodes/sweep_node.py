# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""sweep_node: stop-and-go sweeps, or the scans of a tilting laser, to clouds in the map frame."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from sensor_msgs.msg import JointState, LaserScan, PointCloud2

from g2_recon.errors import InputError
from g2_recon.geometry import se3
from g2_recon.geometry.cloud import Cloud
from g2_recon.geometry.trajectory import PoseBuffer, Trajectory
from g2_recon.nodes import conversions
from g2_recon.nodes.parameters import SweepParameters
from g2_recon.nodes.piece_publisher import PiecePublisher
from g2_recon.nodes.ros import Transforms, reliable_qos, run, sensor_qos
from g2_recon.nodes.stage_node import JumpDetector, LaserMount, StageNode, session_folder
from g2_recon.recording.clouds import write_cloud
from g2_recon.recording.trajectories import write_tum
from g2_recon.registration.sweep_assembler import SweepAssembler
from g2_recon.registration.sweep_merger import SweepMerger

Float = NDArray[np.float64]


class SweepNode(StageNode[SweepParameters]):
    """Publishes the points of each sweep at its place, and anew where later ones move it or somebody comes late."""

    def __init__(self) -> None:
        """Raises ConfigError where a parameter is wrong."""
        super().__init__("sweep_node", SweepParameters)
        self._mount = LaserMount(self, self.settings.laser_pose, self.settings.base_frame, Transforms(self))
        self._merger = SweepMerger(self.settings)
        self._assembler: SweepAssembler | None = None
        self._T_base_mount: Float | None = None
        self._jumps = {"sweep": JumpDetector(), "scan_tilt": JumpDetector()}
        self._odometry = PoseBuffer()
        # Sweeps that came before the odometry at their time did.
        self._waiting: deque[tuple[float, Cloud, Float]] = deque(maxlen=self.settings.queue_depth)
        self._stamps: list[float] = []
        self._placed: dict[str, int] = {}
        depth = self.settings.queue_depth
        self._cloud = PiecePublisher(self, self.settings.map_frame, depth)
        self._cloud.follow(self._merger)
        self._pose_publisher = self.create_publisher(PoseWithCovarianceStamped, "sweep_pose", reliable_qos(depth))
        self.offer_trigger("~/reset", self._reset)
        self.offer_trigger("~/save", self._save)
        if self.settings.laser_pose:
            self._start_assembler("")
        self.listen(Odometry, "odom", self._on_odometry, sensor_qos(depth))
        self.listen(PointCloud2, "sweep", self._on_sweep, sensor_qos(depth))
        self.listen(JointState, "joint_states", self._on_joints, sensor_qos(depth))
        self.listen(LaserScan, "scan_tilt", self._on_scan, sensor_qos(depth))

    def waiting_for(self) -> str:
        """See StageNode."""
        if not self.received["sweep"] and not self.received["scan_tilt"]:
            return f"{self.not_received('sweep')}, or for `{self.resolve_topic_name('scan_tilt')}`"
        if self.received["scan_tilt"] and self.not_received("joint_states"):
            return self.not_received("joint_states")
        return self._mount.waiting_for

    def figures(self) -> dict[str, object]:
        """See StageNode."""
        values: dict[str, object] = {"sweeps in the cloud": len(self._merger), "loops closed": self._merger.loops}
        values |= {"sweeps published anew": self._cloud.renewed, "sweeps to be published": self._merger.to_renew}
        values |= {f"sweeps placed: {quality}": count for quality, count in self._placed.items()}
        if self._waiting:
            values["sweeps that wait for odometry"] = len(self._waiting)
        if self._assembler is not None:
            values |= {f"dropped: {reason}": count for reason, count in self._assembler.drops.items()}
        return values

    def _on_odometry(self, message: Odometry) -> None:
        odometry = self.usable(conversions.odometry_from_message, message, "odometry")
        if odometry is None:
            return
        stamp, T_odom_base = odometry
        self._odometry.add(stamp, T_odom_base)
        self._odometry.drop_before(self._odometry.last_stamp - self.settings.odometry_kept)
        if self._assembler is not None:
            self._assembler.add_odometry(stamp, T_odom_base)
        self._place_waiting()

    def _on_sweep(self, message: PointCloud2) -> None:
        cloud = self.usable(conversions.cloud_from_message, message, "sweep")
        if cloud is None:
            return
        T_base_laser = self._mount.find(message.header.frame_id)
        if T_base_laser is None:
            self.drops["sweep of a laser with unknown pose"] += 1
            return
        stamp = conversions.stamp_seconds(message.header.stamp)
        self._reset_if_jumped("sweep", stamp)
        self._waiting.append((stamp, cloud, T_base_laser))
        self._place_waiting()

    def _on_joints(self, message: JointState) -> None:
        names = list(message.name)
        joint = self.settings.tilt_joint or (names[0] if names else "")
        if joint not in names or names.index(joint) >= len(message.position):
            # Other joints of the robot come on the same topic.
            return
        if self._assembler is not None:
            stamp = conversions.stamp_seconds(message.header.stamp)
            self._assembler.add_angle(stamp, float(message.position[names.index(joint)]))
            self._place_assembled()

    def _on_scan(self, message: LaserScan) -> None:
        scan = self.usable(conversions.scan_from_message, message, "scan")
        if scan is None:
            return
        self._reset_if_jumped("scan_tilt", scan.stamp)
        if self._assembler is None and not self._start_assembler(scan.frame_id):
            self.drops["scan of a laser with unknown pose"] += 1
            return
        assert self._assembler is not None
        self._assembler.add_scan(scan)
        self._place_assembled()

    def _start_assembler(self, laser_frame: str) -> bool:
        """Whether the pose of the mount is known, so that scans can be taken."""
        self._T_base_mount = self._mount.find(laser_frame)
        if self._T_base_mount is not None:
            self._assembler = SweepAssembler(self.settings, self._T_base_mount)
        return self._assembler is not None

    def _place_assembled(self) -> None:
        assert self._assembler is not None and self._T_base_mount is not None
        for sweep in self._assembler.take():
            self._place(sweep.stamp, sweep.cloud, sweep.T_odom_mount, self._T_base_mount)

    def _place_waiting(self) -> None:
        """Place the sweeps whose odometry has come; all of them where there is no odometry."""
        while self._waiting and (not len(self._odometry) or self._waiting[0][0] <= self._odometry.last_stamp):
            stamp, cloud, T_base_laser = self._waiting.popleft()
            T_odom_base, known = self._odometry.interpolate([stamp], max_gap=self.settings.max_gap)
            self._place(stamp, cloud, T_odom_base[0] @ T_base_laser if known[0] else None, T_base_laser)

    def _place(self, stamp: float, cloud: Cloud, T_odom_laser: Float | None, T_base_laser: Float) -> None:
        try:
            placed = self._merger.add(cloud, T_odom_laser, stamp=stamp)
        except InputError as error:
            self.drop("unusable sweep", str(error))
            return
        self._placed[placed.quality] = self._placed.get(placed.quality, 0) + 1
        if placed.quality not in ("first", "good"):
            self.get_logger().warning(f"sweep at {stamp:.3f} s: {placed.quality}: {placed.reason}")
        if not placed.kept:
            self.drops[f"sweep, {placed.quality}"] += 1
            return
        self._stamps.append(stamp)
        head = conversions.header(conversions.stamp_message(stamp), self.settings.map_frame)
        new = self._merger.renew()
        assert new is not None
        self._cloud.publish(new)
        self._cloud.renew_if_needed()
        T_map_laser = self._merger.poses()[-1]
        T_map_base = T_map_laser @ se3.inverse(T_base_laser)
        covariance = conversions.moved_covariance(
            self._merger.covariance(len(self._merger) - 1), T_map_base[:3, 3] - T_map_laser[:3, 3]
        )
        self._pose_publisher.publish(conversions.pose_with_covariance_message(head, T_map_base, covariance))

    def _save(self) -> str:
        folder = session_folder(self.settings.session_dir)
        if not len(self._merger):
            raise InputError("there is no sweep to save")
        write_cloud(folder / "cloud.ply", self._merger.cloud())
        write_tum(folder / "poses.tum", Trajectory.from_matrices(self._stamps, self._merger.poses()))
        return f"wrote {folder / 'cloud.ply'} and {folder / 'poses.tum'}"

    def _reset_if_jumped(self, topic: str, stamp: float) -> None:
        if self._jumps[topic].jumped_back(stamp):
            self.get_logger().warning(f"time on `{topic}` jumped back to {stamp:.3f} s: forgetting all sweeps")
            self._reset()

    def _reset(self) -> str:
        """Start anew; what was published is taken back."""
        self._merger.reset()
        self._cloud.take_back()
        self._waiting.clear()
        self._stamps.clear()
        self._placed.clear()
        self._odometry.clear()
        if self._assembler is not None:
            self._assembler.reset()
        return "forgot all sweeps"


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; the exit code."""
    return run(SweepNode, args)


if __name__ == "__main__":
    sys.exit(main())
