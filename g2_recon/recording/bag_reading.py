# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A recording from a bag: which topics, which messages are usable, where the lasers are mounted."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection

from g2_recon.config import RecordingConfig
from g2_recon.errors import InputError
from g2_recon.geometry import se2, se3, sick_lms
from g2_recon.geometry.recording import Recording
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.progress import Progress, silent
from g2_recon.recording.bag_access import OpenBag, open_bag
from g2_recon.recording.trajectories import sound_poses

_log = logging.getLogger(__name__)

_DEFAULTS = RecordingConfig()
_MAX_BEAMS = 100_000
_SCAN, _ODOMETRY = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
_JOINTS = "sensor_msgs/msg/JointState"
_TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_PROGRESS_STEP = 1000
_MAX_HOLD_S = 1.5
"""How far a scan may be stamped from the odometry beside it; clocks that step backwards do so by up to a second."""

_Mounts = dict[str, tuple[str, NDArray[np.float64]]]
"""Parent frame and T_parent_child by child frame."""


class _UnusableError(Exception):
    """A message is left out; the text says why, as it is counted."""


@dataclass
class _Topics:
    """Which connections of the bag hold what."""

    scan: list[Connection]
    scan_vertical: list[Connection]
    scan_tilt: list[Connection]
    odometry: list[Connection]
    joints: list[Connection]


@dataclass
class _Found:
    """What the messages held so far."""

    scans: dict[str, list[Scan]] = field(default_factory=lambda: {"scan": [], "scan_vertical": [], "scan_tilt": []})
    odometry_before: list[int] = field(default_factory=list)
    """How many odometry messages came before each horizontal scan."""
    odometry: list[tuple[float, ...]] = field(default_factory=list)
    tilt: list[tuple[float, float]] = field(default_factory=list)


def read_bag(path: str | Path, config: RecordingConfig = _DEFAULTS, *, progress: Progress = silent) -> Recording:
    """Read a rosbag2 directory, a single .mcap or .db3 file, or a ROS 1 .bag file.

    Stamps are those of the message headers. Messages come in the order in which they were received, those of a ROS 1
    bag in file order; where stamps of the horizontal scans or the odometry step backwards, `scan_odometry` pairs them
    by this order. Ranges above `range_max` become +inf (REP-117); NaN, -inf and 0 stay. Mounting poses are those
    of /tf_static, or else the first ones of /tf, along the chain from `config.base_frame` to the frame of the first
    scan; that of the sweeping laser only of /tf_static, since /tf moves it.

    Messages that cannot be used are left out and counted in `drops`, as is the end of a damaged bag. Raises InputError
    if the bag cannot be opened or holds no usable LaserScan.
    """
    with open_bag(path) as bag:
        bag.use_file_order()
        topics = _choose_topics(bag, config)
        drops: Counter[str] = Counter()
        found = _read_messages(bag, topics, drops, progress)
        if not any(found.scans.values()):
            reasons = ", ".join(f"{count} {reason}" for reason, count in drops.items()) or "the topics are empty"
            raise InputError(
                f"holds no usable scan: {reasons}; {bag.describe()}",
                where=path,
                advice="record it again",
            )
        mounts = _mounting_poses(bag, found, config.base_frame.lstrip("/"), drops)
        drops.update(bag.complaints)
    recording = _assemble(found, mounts, drops)
    for reason, count in recording.drops.items():
        _log.warning("%s: %d %s", path, count, reason)
    return recording


def _choose_topics(bag: OpenBag, config: RecordingConfig) -> _Topics:
    """The connections that the config names, or, for the scan and the odometry, the only ones there are."""
    vertical = _named(bag, config.scan_vertical_topic, _SCAN)
    tilt = _named(bag, config.scan_tilt_topic, _SCAN)
    others = {connection.topic for connection in vertical + tilt}
    scan = _named_or_only(bag, config.scan_topic, _SCAN, others)
    if not scan + vertical + tilt:
        has_some = any(connection.msgtype == _SCAN for connection in bag.connections)
        raise InputError(
            f"holds {'several LaserScan topics, none' if has_some else 'no LaserScan'} named {config.scan_topic!r}"
            f"; {bag.describe()}",
            where=bag.path,
            advice="set scan_topic, or record a LaserScan",
        )
    return _Topics(
        scan=scan,
        scan_vertical=vertical,
        scan_tilt=tilt,
        odometry=_named_or_only(bag, config.odom_topic, _ODOMETRY, set()),
        joints=_named(bag, config.joint_topic, _JOINTS),
    )


def _named(bag: OpenBag, topic: str, *msgtypes: str) -> list[Connection]:
    return [
        connection
        for connection in bag.connections
        if connection.topic.lstrip("/") == topic.lstrip("/") and connection.msgtype in msgtypes
    ]


def _named_or_only(bag: OpenBag, topic: str, msgtype: str, others: set[str]) -> list[Connection]:
    named = _named(bag, topic, msgtype)
    if named:
        return named
    left = [item for item in bag.connections if item.msgtype == msgtype and item.topic not in others]
    candidates = sorted({connection.topic for connection in left})
    if len(candidates) == 1:
        _log.info("%s: no %s; taking %s, the only %s", bag.path, topic, candidates[0], msgtype)
        return left
    if candidates:
        _log.warning("%s: no %s, and several %s: %s", bag.path, topic, msgtype, ", ".join(candidates))
    return []


def _read_messages(bag: OpenBag, topics: _Topics, drops: Counter[str], progress: Progress) -> _Found:
    found = _Found()
    takers: dict[tuple[str, str], Callable[[Any], None]] = {}
    for name, scans in found.scans.items():
        for connection in getattr(topics, name):
            takers[connection.topic, _SCAN] = _ScanTaker(found, scans, connection.topic)
    for connection in topics.odometry:
        takers[connection.topic, _ODOMETRY] = lambda message: found.odometry.append(_odometry_row(message))
    for connection in topics.joints:
        takers[connection.topic, _JOINTS] = lambda message: found.tilt.append(_tilt_row(message))
    connections = [item for item in bag.connections if (item.topic, item.msgtype) in takers]
    total = sum(connection.msgcount for connection in connections)
    for done, (connection, _, raw) in enumerate(bag.messages(connections)):
        if done % _PROGRESS_STEP == 0:
            progress("read bag", done, total)
        try:
            message = bag.decode(raw, connection.msgtype)
            if message is None:
                raise _UnusableError(f"{connection.msgtype.rpartition('/')[2]} messages that cannot be decoded")
            takers[connection.topic, connection.msgtype](message)
        except _UnusableError as reason:
            drops[str(reason)] += 1
    progress("read bag", total, total)
    return found


@dataclass
class _ScanTaker:
    """Adds the LaserScan messages of one topic to its scans, and says once if their beam spacing was put right."""

    found: _Found
    scans: list[Scan]
    topic: str
    is_told: bool = False

    def __call__(self, message: Any) -> None:
        scan = _to_scan(message)
        if scan.angle_increment != float(message.angle_increment) and not self.is_told:
            self.is_told = True
            _log.warning(
                "%s states a beam spacing of %.4f deg for %d beams; they are %.4f deg apart",
                self.topic,
                np.degrees(message.angle_increment),
                len(scan.ranges),
                np.degrees(scan.angle_increment),
            )
        self.scans.append(scan)
        if self.scans is self.found.scans["scan"]:
            self.found.odometry_before.append(len(self.found.odometry))


def _to_scan(message: Any) -> Scan:
    """A Scan from a LaserScan message of either ROS."""
    ranges = np.array(message.ranges, np.float32)
    if not 0 < len(ranges) <= _MAX_BEAMS:
        raise _UnusableError(f"scans without a beam or with more than {_MAX_BEAMS:,}")
    range_min, range_max = float(message.range_min), float(message.range_max)
    if not range_min < range_max:
        raise _UnusableError("scans whose range_max is not above their range_min")
    ranges[ranges > range_max] = np.inf
    try:
        return Scan(
            stamp=_seconds(message.header.stamp),
            ranges=ranges,
            angle_min=float(message.angle_min),
            angle_increment=sick_lms.beam_spacing(len(ranges), float(message.angle_increment)),
            range_min=range_min,
            range_max=range_max,
            time_increment=float(message.time_increment),
            frame_id=message.header.frame_id.lstrip("/"),
        )
    except InputError:
        raise _UnusableError("scans whose angles or times are not finite, or whose beams do not spread") from None


def _odometry_row(message: Any) -> tuple[float, ...]:
    """Stamp, x, y, z and quaternion x, y, z, w of an Odometry message."""
    position, rotation = message.pose.pose.position, message.pose.pose.orientation
    return (
        _seconds(message.header.stamp),
        *(position.x, position.y, position.z),
        *(rotation.x, rotation.y, rotation.z, rotation.w),
    )


def _tilt_row(message: Any) -> tuple[float, float]:
    """Stamp and angle of the joint that tilts the laser: the only joint, or the only one with "tilt" in its name."""
    positions = message.position
    joints = [index for index, name in enumerate(message.name) if len(message.name) == 1 or "tilt" in name.lower()]
    if len(joints) != 1 or len(positions) != len(message.name):
        raise _UnusableError("joint states without exactly one joint whose name has 'tilt' in it")
    angle = float(positions[joints[0]])
    if not np.isfinite(angle):
        raise _UnusableError("joint states with an angle that is not finite")
    return _seconds(message.header.stamp), angle


def _seconds(stamp: Any) -> float:
    """A message stamp as the float64 nearest to it."""
    return float((stamp.sec * 10**9 + stamp.nanosec) / 10**9)


def _mounting_poses(
    bag: OpenBag, found: _Found, base: str, drops: Counter[str]
) -> dict[str, NDArray[np.float64] | None]:
    """T_base_laser by laser, None where the bag does not say."""
    frames = {name: scans[0].frame_id for name, scans in found.scans.items() if scans}
    static: _Mounts = {}
    for message in _transform_messages(bag, "tf_static"):
        _add_mounts(static, message, drops)
    poses = {name: _follow_chain(static, base, frame) for name, frame in frames.items()}
    wanted = [name for name in ("scan", "scan_vertical") if name in frames and poses[name] is None]
    moving = dict(static)
    for message in _transform_messages(bag, "tf") if wanted else ():
        if _add_mounts(moving, message, drops):
            poses.update({name: _follow_chain(moving, base, frames[name]) for name in wanted})
        if all(poses[name] is not None for name in wanted):
            break
    return poses


def _transform_messages(bag: OpenBag, topic: str) -> Iterator[Any]:
    for connection, _, raw in bag.messages(_named(bag, topic, *_TRANSFORMS)):
        message = bag.decode(raw, connection.msgtype)
        if message is not None:
            yield message


def _add_mounts(mounts: _Mounts, message: Any, drops: Counter[str]) -> bool:
    """Add the transforms of frames that are new; true if there was one."""
    before = len(mounts)
    for stamped in message.transforms:
        child, shift, turn = (
            stamped.child_frame_id.lstrip("/"),
            stamped.transform.translation,
            stamped.transform.rotation,
        )
        if child not in mounts:
            try:
                T_parent_child = se3.from_quaternion([shift.x, shift.y, shift.z], [turn.x, turn.y, turn.z, turn.w])
            except InputError:
                drops["transforms that are not finite or no rotation"] += 1
                continue
            mounts[child] = (stamped.header.frame_id.lstrip("/"), T_parent_child)
    return len(mounts) > before


def _follow_chain(mounts: _Mounts, base: str, frame: str) -> NDArray[np.float64] | None:
    """T_base_frame along the parents of `frame`; None if they do not lead to `base`."""
    T_parent_frame = np.eye(4)
    seen: set[str] = set()
    while frame != base:
        if frame in seen or frame not in mounts:
            return None
        seen.add(frame)
        frame, T_parent_child = mounts[frame]
        T_parent_frame = T_parent_child @ T_parent_frame
    return T_parent_frame


def _assemble(found: _Found, mounts: dict[str, NDArray[np.float64] | None], drops: Counter[str]) -> Recording:
    odometry, is_sound = _to_trajectory(found.odometry, drops)
    odometry_before = np.append(0, is_sound.cumsum())[np.array(found.odometry_before, int)]
    tilt = np.array(found.tilt, float).reshape(-1, 2)
    stamps = {name: np.array([scan.stamp for scan in scans]) for name, scans in found.scans.items()}
    stamps |= {"odometry": odometry.stamps, "joint state": tilt[:, 0]}
    for name, of_series in stamps.items():
        backwards = int((np.diff(of_series) < 0).sum())
        if backwards:
            drops[f"{name} messages stamped earlier than the one before (kept, in their order)"] = backwards
    steps_back = any((np.diff(stamps[name]) < 0).any() for name in ("scan", "odometry"))
    return Recording(
        scans=found.scans["scan"],
        scans_vertical=found.scans["scan_vertical"],
        odometry=odometry,
        scan_odometry=_pair_by_arrival(odometry, stamps["scan"], odometry_before) if steps_back else None,
        scans_tilt=found.scans["scan_tilt"],
        tilt_stamps=tilt[:, 0].copy(),
        tilt_angles=tilt[:, 1].copy(),
        T_base_laser=mounts.get("scan"),
        T_base_laser_vertical=mounts.get("scan_vertical"),
        T_base_tilt=mounts.get("scan_tilt"),
        drops=dict(drops),
    )


def _pair_by_arrival(
    odometry: Trajectory, stamps: NDArray[np.float64], odometry_before: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Odometry (N, 3) x, y, yaw at scans (N,) between the messages that arrived just before and just after each.

    For stamps that step backwards: sorted by time, messages of different moments would stand side by side. A scan
    that is not stamped between the two has the nearer of them, or NaN if both are too far away.
    """
    if len(odometry) == 0:
        return np.full((len(stamps), 3), np.nan)
    poses = odometry.planar()
    before, after = np.maximum(odometry_before - 1, 0), np.minimum(odometry_before, len(odometry) - 1)
    since, until = stamps - odometry.stamps[before], odometry.stamps[after] - stamps
    span = since + until
    share = np.clip(np.divide(since, span, out=np.zeros_like(span), where=span > 0), 0, 1)
    step = poses[after] - poses[before]
    step[:, 2] = se2.wrap_angle(step[:, 2])
    result = poses[before] + share[:, None] * step
    result[:, 2] = se2.wrap_angle(result[:, 2])
    is_between = (since >= 0) & (until >= 0)
    result[~is_between & (np.minimum(abs(since), abs(until)) > _MAX_HOLD_S)] = np.nan
    return result


def _to_trajectory(rows: list[tuple[float, ...]], drops: Counter[str]) -> tuple[Trajectory, NDArray[np.bool_]]:
    """The poses of sound odometry messages, and which of the messages those are."""
    table: NDArray[np.float64] = np.array(rows, float).reshape(-1, 8)
    good = sound_poses(table[:, 1:4], table[:, 4:])
    if not good.all():
        drops["odometry messages whose pose is not finite or no rotation"] += int((~good).sum())
    table = table[good]
    lengths = np.linalg.norm(table[:, 4:], axis=1, keepdims=True)
    return Trajectory(table[:, 0].copy(), table[:, 1:4].copy(), table[:, 4:] / lengths), good
