# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The messages that a recording becomes in a bag, of ROS 2 or ROS 1."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.config import RecordingConfig
from g2_recon.errors import InputError
from g2_recon.geometry import se3
from g2_recon.geometry.recording import Recording
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory

_log = logging.getLogger(__name__)

TILT_JOINT = "laser_tilt_joint"
"""Name of the joint whose angle the JointState messages carry."""

TF_STATIC, TRANSFORMS = "/tf_static", "tf2_msgs/msg/TFMessage"
_NAMES = RecordingConfig()
_ODOM_FRAME = "odom"
_SCAN, _ODOMETRY = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
_JOINTS = "sensor_msgs/msg/JointState"
_END_OF_TIME = 2**31
"""Seconds; ROS 2 keeps them in 32 bits with a sign."""


@dataclass(frozen=True)
class Series:
    """The messages of one topic, and when each counts as received (N,), nanoseconds, increasing."""

    topic: str
    msgtype: str
    received: NDArray[np.int64]
    messages: Sequence[Any]


def all_series(recording: Recording, store: Any, *, where: object) -> list[Series]:
    """What there is of a recording as messages of a rosbags typestore, a series a topic, /tf_static first.

    A message counts as received at its stamp, but always after the one in front of it: readers sort by this time, so
    the order of a recording whose stamps step backwards is kept. Odometry that belongs to the scans is written at
    their stamps, each before its scan, so that they are paired again whatever the stamps do. Negative stamps, which
    ROS does not have, shift all stamps by whole seconds.

    Raises InputError, naming `where`, if there is nothing, a stamp cannot be a ROS time, or two lasers with different
    mounting poses have the same frame.
    """
    odometry = _odometry_to_write(recording)
    make = _Factory(store, where, _shift_of_stamps(recording, odometry, where))
    stamps = [make.nanoseconds(stamp) for stamp in odometry.stamps.tolist()]
    rows = zip(stamps, odometry.positions.tolist(), odometry.quaternions.tolist(), strict=True)
    series = [_series(_NAMES.odom_topic, _ODOMETRY, stamps, [make.odometry(*row) for row in rows])]
    series += [
        _series(topic, _SCAN, [make.nanoseconds(scan.stamp) for scan in scans], [make.scan(scan) for scan in scans])
        for topic, scans in (
            (_NAMES.scan_topic, recording.scans),
            (_NAMES.scan_vertical_topic, recording.scans_vertical),
            (_NAMES.scan_tilt_topic, recording.scans_tilt),
        )
    ]
    stamps = [make.nanoseconds(stamp) for stamp in recording.tilt_stamps.tolist()]
    angles = recording.tilt_angles.tolist()
    states = [make.joint_state(stamp, angle) for stamp, angle in zip(stamps, angles, strict=True)]
    series.append(_series(_NAMES.joint_topic, _JOINTS, stamps, states))
    series = [item for item in series if item.messages]
    if not series:
        raise InputError("the recording is empty, a bag of it would be too", where=where, advice="record something")
    mounts = _mounts(recording, where)
    if mounts:
        start = min(int(item.received[0]) for item in series)
        series.insert(0, _series(TF_STATIC[1:], TRANSFORMS, [start], [make.transforms(start, mounts)]))
    return series


def _series(topic: str, msgtype: str, stamps: list[int], messages: list[Any]) -> Series:
    place = np.arange(len(stamps))
    received = np.maximum.accumulate(np.array(stamps, np.int64) - place) + place
    return Series(f"/{topic}", msgtype, received, messages)


def _odometry_to_write(recording: Recording) -> Trajectory:
    """That of the scans where the recording has it, else that of the wheels."""
    if recording.scan_odometry is None:
        return recording.odometry
    known = np.isfinite(recording.scan_odometry).all(axis=1)
    if not known.any():
        return recording.odometry
    stamps = np.array([scan.stamp for scan in recording.scans])
    return Trajectory.from_se2(stamps[known], recording.scan_odometry[known])


def _shift_of_stamps(recording: Recording, odometry: Trajectory, where: object) -> int:
    """Whole seconds that make all stamps 0 or later; said in the log unless 0."""
    scans = recording.scans + recording.scans_vertical + recording.scans_tilt
    stamps = np.concatenate([[scan.stamp for scan in scans], recording.tilt_stamps, odometry.stamps])
    shift = math.ceil(-stamps[np.isfinite(stamps)].min(initial=0.0))
    if shift:
        _log.warning("%s: ROS has no stamps below 0: all stamps are shifted by %d s", where, shift)
    return shift


def _mounts(recording: Recording, where: object) -> dict[str, NDArray[np.float64]]:
    """T_base_laser by the frame of the laser, of the lasers that have scans and a known mounting pose."""
    mounts: dict[str, NDArray[np.float64]] = {_NAMES.base_frame: np.eye(4)}
    for scans, T_base_laser in (
        (recording.scans, recording.T_base_laser),
        (recording.scans_vertical, recording.T_base_laser_vertical),
        (recording.scans_tilt, recording.T_base_tilt),
    ):
        if not scans or T_base_laser is None:
            continue
        frame = scans[0].frame_id
        if not np.array_equal(mounts.setdefault(frame, T_base_laser), T_base_laser):
            raise InputError(
                f"the frame {frame!r} would have two different mounting poses",
                where=where,
                advice="give each laser a frame_id of its own",
            )
    del mounts[_NAMES.base_frame]
    return mounts


class _Factory:
    """Makes messages of one typestore; those of ROS 1 have a sequence number in their header."""

    def __init__(self, store: Any, where: object, shift_s: int) -> None:
        self._shift_s = shift_s
        self._types = store.types
        self._where = where
        header_fields = [name for name, _ in store.fielddefs["std_msgs/msg/Header"][1]]
        self._header_extra = {"seq": 0} if "seq" in header_fields else {}

    def nanoseconds(self, stamp: float) -> int:
        """A stamp in whole nanoseconds, shifted."""
        if not 0 <= stamp + self._shift_s < _END_OF_TIME:
            raise InputError(
                f"the stamp {stamp!r} s cannot be a ROS time",
                where=self._where,
                advice="ROS keeps seconds up to 2**31: correct the stamps of the recording",
            )
        seconds = math.floor(stamp)
        return (seconds + self._shift_s) * 10**9 + round((stamp - seconds) * 1e9)

    def scan(self, scan: Scan) -> Any:
        """A LaserScan."""
        return self._types[_SCAN](
            header=self._header(self.nanoseconds(scan.stamp), scan.frame_id),
            angle_min=scan.angle_min,
            angle_max=scan.angle_min + scan.angle_increment * (len(scan.ranges) - 1),
            angle_increment=scan.angle_increment,
            time_increment=scan.time_increment,
            scan_time=0.0,
            range_min=scan.range_min,
            range_max=scan.range_max,
            ranges=np.asarray(scan.ranges, np.float32),
            intensities=np.empty(0, np.float32),
        )

    def odometry(self, stamp: int, position: Sequence[float], quaternion: Sequence[float]) -> Any:
        """An Odometry without covariances and speeds."""
        covariance = np.zeros(36)
        pose = self._new(
            "Pose", position=self._new("Point", *position), orientation=self._new("Quaternion", *quaternion)
        )
        still = self._new("Vector3", 0.0, 0.0, 0.0)
        twist = self._new("Twist", linear=still, angular=still)
        return self._types[_ODOMETRY](
            header=self._header(stamp, _ODOM_FRAME),
            child_frame_id=_NAMES.base_frame,
            pose=self._new("PoseWithCovariance", pose=pose, covariance=covariance),
            twist=self._new("TwistWithCovariance", twist=twist, covariance=covariance),
        )

    def joint_state(self, stamp: int, angle: float) -> Any:
        """A JointState of the joint that tilts the laser."""
        none = np.empty(0)
        return self._types[_JOINTS](
            header=self._header(stamp, ""),
            name=[TILT_JOINT],
            position=np.array([angle]),
            velocity=none,
            effort=none,
        )

    def transforms(self, stamp: int, mounts: dict[str, NDArray[np.float64]]) -> Any:
        """A TFMessage from the base to each frame."""
        return self._types[TRANSFORMS](
            transforms=[
                self._new(
                    "TransformStamped",
                    header=self._header(stamp, _NAMES.base_frame),
                    child_frame_id=frame,
                    transform=self._transform(T_base_frame),
                )
                for frame, T_base_frame in mounts.items()
            ]
        )

    def _transform(self, T_base_frame: ArrayLike) -> Any:
        matrix = np.asarray(T_base_frame, float)
        return self._new(
            "Transform",
            translation=self._new("Vector3", *matrix[:3, 3].tolist()),
            rotation=self._new("Quaternion", *se3.to_quaternion(matrix).tolist()),
        )

    def _header(self, stamp: int, frame_id: str) -> Any:
        seconds, nanoseconds = divmod(stamp, 10**9)
        time = self._types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
        return self._types["std_msgs/msg/Header"](**self._header_extra, stamp=time, frame_id=frame_id)

    def _new(self, name: str, *values: Any, **fields: Any) -> Any:
        return self._types[f"geometry_msgs/msg/{name}"](*values, **fields)
