# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Between ROS messages and the types of the stages; whole arrays at a time, and nothing in a message is trusted."""

from __future__ import annotations

import array
import math
import struct
import sys

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseStamped,
    PoseWithCovarianceStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Vector3,
)
from nav_msgs.msg import MapMetaData, Odometry, Path
from nav_msgs.msg import OccupancyGrid as GridMessage
from numpy.typing import ArrayLike, NDArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import LaserScan, PointCloud2, PointField
from std_msgs.msg import Header

from g2_recon.errors import InputError
from g2_recon.geometry import se3
from g2_recon.geometry.cloud import ALL_PIECES, Cloud, Piece
from g2_recon.geometry.occupancy_grid import OccupancyGrid
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory

Float = NDArray[np.float64]

POINT_FIELDS = ("x", "y", "z")
SENSOR_FIELDS = ("vx", "vy", "vz")
"""Where each point was seen from, as in the PLY files."""
PIECE_FIELDS = ("source", "piece", "revision")
"""Of a cloud that comes in pieces: uint32, the same for all points of a message; see geometry.cloud.Piece."""

SEQUENCE_FIELD = "sequence"
"""Of the same: uint32, which message of its source it is, so that whoever lacks some can ask for them."""

FARTHEST_M = 1e6
"""No robot is farther than this from the origin of its map; what says so is broken, and float32 would lose it."""

_FIELD_TYPES = {
    PointField.INT8: "i1",
    PointField.UINT8: "u1",
    PointField.INT16: "i2",
    PointField.UINT16: "u2",
    PointField.INT32: "i4",
    PointField.UINT32: "u4",
    PointField.FLOAT32: "f4",
    PointField.FLOAT64: "f8",
}


def stamp_seconds(stamp: Time) -> float:
    """Seconds of a stamp."""
    return float(stamp.sec) + float(stamp.nanosec) * 1e-9


def stamp_message(seconds: float) -> Time:
    """The stamp of a time in seconds, to the nearest nanosecond that a float can tell."""
    whole = math.floor(seconds)
    nanoseconds = round((seconds - whole) * 1e9)
    return Time(sec=whole + nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def header(stamp: Time, frame_id: str) -> Header:
    """A header."""
    return Header(stamp=stamp, frame_id=frame_id)


def scan_from_message(message: LaserScan) -> Scan:
    """A scan. Raises InputError where the numbers that give the beams their place and meaning are unusable."""
    if not message.range_min < message.range_max:
        raise InputError(
            f"the scan states ranges from {message.range_min} to {message.range_max} m",
            where=f"frame {message.header.frame_id}",
            advice="range_min must be smaller than range_max",
        )
    return Scan(
        stamp=stamp_seconds(message.header.stamp),
        ranges=np.array(message.ranges, np.float32),
        angle_min=message.angle_min,
        angle_increment=message.angle_increment,
        range_min=message.range_min,
        range_max=message.range_max,
        time_increment=message.time_increment,
        # Of the many scans that are kept all have the same, which each message brings once more.
        frame_id=sys.intern(message.header.frame_id),
    )


def scan_to_message(scan: Scan) -> LaserScan:
    """The message of a scan."""
    count = len(scan.ranges)
    return LaserScan(
        header=header(stamp_message(scan.stamp), scan.frame_id),
        angle_min=scan.angle_min,
        angle_max=scan.angle_min + scan.angle_increment * max(count - 1, 0),
        angle_increment=scan.angle_increment,
        time_increment=scan.time_increment,
        scan_time=scan.time_increment * count,
        range_min=scan.range_min,
        range_max=scan.range_max,
        ranges=_array("f", scan.ranges.astype(np.float32)),
    )


def pose_matrix(pose: Pose) -> Float:
    """The transform (4, 4) of a pose.

    Raises InputError where it is not finite, its quaternion is no rotation or it is absurdly far away.
    """
    position, rotation = pose.position, pose.orientation
    return _matrix((position.x, position.y, position.z), (rotation.x, rotation.y, rotation.z, rotation.w))


def transform_matrix(transform: Transform) -> Float:
    """The transform (4, 4) of a message. Raises InputError as `pose_matrix` does."""
    move, rotation = transform.translation, transform.rotation
    return _matrix((move.x, move.y, move.z), (rotation.x, rotation.y, rotation.z, rotation.w))


def pose_message(matrix: ArrayLike) -> Pose:
    """The pose of a transform (4, 4)."""
    T = np.asarray(matrix, float)
    return _pose(T[:3, 3].tolist(), se3.to_quaternion(T).tolist())


def transform_message(stamp: Time, parent: str, child: str, T_parent_child: ArrayLike) -> TransformStamped:
    """The message of a transform (4, 4) between two frames."""
    T = np.asarray(T_parent_child, float)
    x, y, z = T[:3, 3].tolist()
    qx, qy, qz, qw = se3.to_quaternion(T).tolist()
    return TransformStamped(
        header=header(stamp, parent),
        child_frame_id=child,
        transform=Transform(translation=Vector3(x=x, y=y, z=z), rotation=Quaternion(x=qx, y=qy, z=qz, w=qw)),
    )


def odometry_from_message(message: Odometry) -> tuple[float, Float]:
    """Stamp in seconds and T_odom_base (4, 4). Raises InputError as `pose_matrix` does."""
    return stamp_seconds(message.header.stamp), pose_matrix(message.pose.pose)


def planar_pose_message(head: Header, pose: ArrayLike, covariance: ArrayLike) -> PoseWithCovarianceStamped:
    """The message of a planar pose (3,) and its covariance (3, 3) of x, y, yaw; the other entries are zero."""
    full = np.zeros((6, 6))
    full[np.ix_((0, 1, 5), (0, 1, 5))] = covariance
    message = PoseWithCovarianceStamped(header=head)
    message.pose.pose = pose_message(se3.from_se2(pose))
    message.pose.covariance = full.ravel()
    return message


def pose_with_covariance_message(head: Header, matrix: ArrayLike, covariance: ArrayLike) -> PoseWithCovarianceStamped:
    """The message of a transform (4, 4) and its covariance (6, 6) of x y z in metres, then angles about them in rad."""
    message = PoseWithCovarianceStamped(header=head)
    message.pose.pose = pose_message(matrix)
    message.pose.covariance = np.asarray(covariance, float).ravel()
    return message


def moved_covariance(covariance: ArrayLike, lever: ArrayLike) -> Float:
    """The covariance (6, 6) of a pose that hangs on another one: `lever` (3,) metres from there, in the fixed frame."""
    x, y, z = np.asarray(lever, float)
    J = np.eye(6)
    # A turn moves what is at the end of the lever by turn x lever.
    J[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return np.asarray(J @ np.asarray(covariance, float) @ J.T)


def path_message(head: Header, trajectory: Trajectory) -> Path:
    """The message of a trajectory; each pose has its own stamp."""
    rows = zip(trajectory.stamps.tolist(), trajectory.positions.tolist(), trajectory.quaternions.tolist(), strict=True)
    return Path(
        header=head,
        poses=[
            PoseStamped(header=header(stamp_message(stamp), head.frame_id), pose=_pose(position, quaternion))
            for stamp, position, quaternion in rows
        ],
    )


def serialized_path(head: Header, trajectory: Trajectory) -> bytes:
    """The bytes of `path_message`, made of arrays, as making objects of thousands of poses takes too long.

    How they are laid out: see `_rows_of_path`.
    """
    frame = head.frame_id.encode() + b"\0"
    size = 12 + len(frame)
    pose = size + -size % 8
    step = pose + 56
    records = np.zeros(
        len(trajectory),
        np.dtype(
            {
                "names": ["sec", "nanosec", "length", "frame", "pose"],
                "formats": ["<i4", "<u4", "<u4", f"S{len(frame)}", "7<f8"],
                "offsets": [0, 4, 8, 12, pose],
                "itemsize": step,
            }
        ),
    )
    whole = np.floor(trajectory.stamps)
    nanoseconds = np.rint((trajectory.stamps - whole) * 1e9).astype(np.int64)
    records["sec"], records["nanosec"] = whole.astype(np.int64) + nanoseconds // 10**9, nanoseconds % 10**9
    records["length"], records["frame"] = len(frame), frame
    records["pose"][:, :3], records["pose"][:, 3:] = trajectory.positions, trajectory.quaternions
    # Not copied before the message is put together: there may be thousands of poses.
    poses = records.view(np.uint8).data
    start = struct.pack("<iII", head.stamp.sec, head.stamp.nanosec, len(frame)) + frame
    start += bytes(-len(start) % 4) + struct.pack("<I", len(trajectory))
    # Where the poses begin, the doubles of the first are aligned otherwise than those of the others.
    start += poses[:size]
    start += bytes(-len(start) % 8 if len(poses) else 0) + poses[pose:step]
    return b"".join([b"\0\1\0\0", start, poses[step:]])


def trajectory_from_path(message: Path) -> Trajectory:
    """The trajectory of a message, each pose with its own stamp. Raises InputError as `pose_matrix` does."""
    rows = np.array(
        [
            (stamp.sec + 1e-9 * stamp.nanosec, at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)
            for stamp, at, turn in ((p.header.stamp, p.pose.position, p.pose.orientation) for p in message.poses)
        ]
    ).reshape(-1, 8)
    return _checked_path(rows)


def trajectory_from_serialized_path(data: bytes) -> tuple[str, Trajectory]:
    """The frame and the trajectory of the bytes of a path message: making objects of thousands of poses takes too long.

    Raises InputError as `pose_matrix` does.

    Where the bytes are laid out otherwise than by a publisher that gives all poses one frame, the message is made.
    """
    rows = _rows_of_path(data)
    if rows is None:
        message = deserialize_message(data, Path)
        return message.header.frame_id, trajectory_from_path(message)
    length = int.from_bytes(data[12:16], "little")
    return data[16 : 16 + length - 1].decode(errors="replace"), _checked_path(rows)


def _rows_of_path(data: bytes) -> Float | None:
    """Stamp, position and quaternion (N, 8) of the poses of a path in CDR (OMG, DDS-XTypes 1.3, section 7.4).

    After four bytes that tell the byte order all is aligned to its size: the stamp, the length and the characters of
    the frame, the number of poses, and for each a stamp, a frame and seven doubles. None where it is not just so.
    """
    body = data[4:]
    if len(body) < 16 or data[:2] != b"\x00\x01":
        return None
    begin = 12 + int.from_bytes(body[8:12], "little")
    begin += -begin % 4 + 4
    count = int.from_bytes(body[begin - 4 : begin], "little")
    length = int.from_bytes(body[begin + 8 : begin + 12], "little")
    # The poses follow each other in the same way once the first of them ends where doubles do.
    first = begin + 12 + length
    first += -first % 8
    step = 12 + length
    step += -step % 8 + 56
    if count == 0 or length > len(body) or len(body) < first + 56 + (count - 1) * step:
        return None
    heads: NDArray = np.ndarray(
        (count - 1,), [("sec", "<i4"), ("nanosec", "<u4"), ("length", "<u4")], body, first + 56, (step,)
    )
    if not (heads["length"] == length).all():
        return None
    rows = np.empty((count, 8))
    sec, nanosec = np.frombuffer(body, "<i4", 1, begin)[0], np.frombuffer(body, "<u4", 1, begin + 4)[0]
    rows[0, 0] = float(sec) + 1e-9 * float(nanosec)
    rows[1:, 0] = heads["sec"] + 1e-9 * heads["nanosec"]
    rows[:, 1:] = np.ndarray((count, 7), "<f8", body, first, (step, 8))
    return rows


def _checked_path(rows: Float) -> Trajectory:
    """The trajectory of stamps, positions and quaternions (N, 8). Raises InputError where a pose is unusable."""
    if not (np.abs(rows[:, 1:4]) <= FARTHEST_M).all():
        raise InputError(f"a pose of the path is not finite or farther than {FARTHEST_M:g} m from the origin")
    trajectory = Trajectory(rows[:, 0].copy(), rows[:, 1:4].copy(), rows[:, 4:].copy())
    trajectory.matrices()
    return trajectory


def cloud_from_message(message: PointCloud2) -> Cloud:
    """A cloud with its sensor positions if the message has fields vx, vy, vz.

    Fields may have any order, type, padding and byte order; points that are not finite are kept as they are.
    Raises InputError where x, y or z is missing or the layout does not fit the data.
    """
    fields = _fields(message, POINT_FIELDS + SENSOR_FIELDS)
    if missing := [name for name in POINT_FIELDS if name not in fields]:
        raise InputError(f"the cloud has no field {' '.join(missing)}", where=f"frame {message.header.frame_id}")
    rows = _rows(message, fields)
    seen_from = all(name in fields for name in SENSOR_FIELDS)
    return Cloud(_columns(rows, POINT_FIELDS), _columns(rows, SENSOR_FIELDS) if seen_from else None)


def piece_from_message(message: PointCloud2) -> Piece | None:
    """Which piece the points of a cloud message belong to, None if it does not say so.

    Raises InputError as `cloud_from_message` does, and where the points belong to several.
    """
    kinds = {field.name: field.datatype for field in message.fields}
    if any(kinds.get(name) != PointField.UINT32 for name in PIECE_FIELDS) or message.width * message.height == 0:
        return None
    rows = _rows(message, _fields(message, PIECE_FIELDS))
    if not all((rows[name] == rows[name].flat[0]).all() for name in PIECE_FIELDS):
        raise InputError("the cloud has points of several pieces", where=f"frame {message.header.frame_id}")
    return Piece(*(int(rows[name].flat[0]) for name in PIECE_FIELDS))


def cloud_and_piece_from_message(message: PointCloud2) -> tuple[Cloud, Piece | None]:
    """A cloud, and which piece it is of, None where it does not say. Raises InputError where either is unusable."""
    return cloud_from_message(message), piece_from_message(message)


def usable_points(cloud: Cloud) -> Cloud:
    """The cloud without points, or points seen from places, that are not finite or absurdly far away."""
    columns = cloud.points if cloud.sensor is None else np.hstack([cloud.points, cloud.sensor])
    return cloud.select(np.asarray((np.abs(columns) <= FARTHEST_M).all(axis=1)))


def sequence_from_message(message: PointCloud2) -> int | None:
    """Which message of its source a cloud that is a piece is, None if it does not say so. Raises InputError."""
    if not any(f.name == SEQUENCE_FIELD and f.datatype == PointField.UINT32 for f in message.fields):
        return None
    rows = _rows(message, _fields(message, (SEQUENCE_FIELD,)))
    return int(rows[SEQUENCE_FIELD].flat[0]) if rows.size else None


def cloud_to_message(
    head: Header, cloud: Cloud, piece: Piece | None = None, sequence: int | None = None
) -> PointCloud2:
    """The message of a cloud: float32 x y z and, where known, vx vy vz, without padding; then uint32 of the piece.

    sequence: which message of the source of the piece it is.
    """
    columns = cloud.points if cloud.sensor is None else np.hstack([cloud.points, cloud.sensor])
    names: tuple[str, ...] = POINT_FIELDS if cloud.sensor is None else POINT_FIELDS + SENSOR_FIELDS
    kinds = [PointField.FLOAT32] * len(names)
    values = columns.astype("<f4")
    if piece is not None:
        told = [piece.source, piece.number, piece.revision, *([] if sequence is None else [sequence])]
        names, kinds = names + (*PIECE_FIELDS, SEQUENCE_FIELD)[: len(told)], kinds + [PointField.UINT32] * len(told)
        numbers = np.array(told, "<u4").view("<f4")
        values = np.hstack([values, np.broadcast_to(numbers, (len(cloud), len(numbers)))])
    step = 4 * len(names)
    return PointCloud2(
        header=head,
        height=1,
        width=len(cloud),
        fields=[
            PointField(name=name, offset=4 * index, datatype=kind, count=1)
            for index, (name, kind) in enumerate(zip(names, kinds, strict=True))
        ],
        is_bigendian=False,
        point_step=step,
        row_step=step * len(cloud),
        data=_array("B", values),
        is_dense=bool(np.isfinite(columns).all()),
    )


def no_pieces_message(head: Header, source: int) -> PointCloud2:
    """What removes all points of a source; its one point is none, as a message without points could not say whose."""
    return cloud_to_message(head, Cloud(np.full((1, 3), np.nan)), Piece(source, ALL_PIECES))


def grid_message(head: Header, grid: OccupancyGrid) -> GridMessage:
    """The message of an occupancy grid, as made when its header says."""
    height, width = grid.cells.shape
    return GridMessage(
        header=head,
        info=MapMetaData(
            map_load_time=head.stamp,
            resolution=float(grid.resolution),
            width=width,
            height=height,
            origin=pose_message(se3.from_se2(grid.origin)),
        ),
        data=_array("b", grid.cells),
    )


def _array(typecode: str, values: NDArray) -> array.array:
    """An array that the message keeps as it is; a list or bytes would be checked element by element."""
    result = array.array(typecode)
    result.frombytes(values.tobytes())
    return result


def _matrix(position: tuple[float, float, float], quaternion: tuple[float, float, float, float]) -> Float:
    T = se3.from_quaternion(position, quaternion)
    if np.abs(T[:3, 3]).max() > FARTHEST_M:
        raise InputError(f"a pose is at {position} m, farther than {FARTHEST_M:g} m from the origin")
    return T


def _pose(position: list[float], quaternion: list[float]) -> Pose:
    x, y, z = position
    qx, qy, qz, qw = quaternion
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def _fields(message: PointCloud2, names: tuple[str, ...]) -> dict[str, PointField]:
    """Fields by name, of those that are there. Raises InputError where one is double or unreadable."""
    where = f"frame {message.header.frame_id}"
    known = [field for field in message.fields if field.name in names]
    fields = {field.name: field for field in known}
    if len(fields) < len(known):
        raise InputError("the cloud has two fields of one name", where=where)
    for field in known:
        size = np.dtype(_FIELD_TYPES[field.datatype]).itemsize if field.datatype in _FIELD_TYPES else math.inf
        if field.offset + size > message.point_step:
            raise InputError(
                f"the field {field.name} of type {field.datatype} at byte {field.offset} does not fit "
                f"a point of {message.point_step} bytes",
                where=where,
            )
    return fields


def _rows(message: PointCloud2, fields: dict[str, PointField]) -> NDArray:
    """The points of a cloud message as records. Raises InputError where the layout does not fit the data."""
    height, width, step = message.height, message.width, message.point_step
    formats = [(">" if message.is_bigendian else "<") + _FIELD_TYPES[field.datatype] for field in fields.values()]
    if width * height == 0:
        return np.empty((0, 1), np.dtype({"names": list(fields), "formats": formats}))
    # A single row needs no row step, and some drivers leave it at zero.
    row_step = message.row_step if height > 1 else width * step
    if row_step < width * step or (height - 1) * row_step + width * step > len(message.data):
        raise InputError(
            f"a cloud of {height} x {width} points of {step} bytes, {row_step} bytes a row, "
            f"does not fit its {len(message.data)} bytes of data",
            where=f"frame {message.header.frame_id}",
        )
    offsets = [field.offset for field in fields.values()]
    dtype = np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": step})
    return np.ndarray((height, width), dtype, buffer=message.data, strides=(row_step, step))


def _columns(rows: NDArray, names: tuple[str, ...]) -> Float:
    result = np.empty((rows.size, len(names)))
    for index, name in enumerate(names):
        result[:, index] = rows[name].reshape(-1)
    return result
