# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import array
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose
from nav_msgs.msg import Odometry, Path
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import LaserScan, PointCloud2, PointField
from std_msgs.msg import Header

from g2_recon.errors import InputError
from g2_recon.geometry import se3
from g2_recon.geometry.cloud import ALL_PIECES, Cloud, Piece
from g2_recon.geometry.occupancy_grid import OccupancyGrid
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.nodes import conversions

HEAD = Header(frame_id="map")
FLOAT32, FLOAT64 = PointField.FLOAT32, PointField.FLOAT64
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def through_the_wire(message):
    return deserialize_message(serialize_message(message), type(message))


def make_scan(**changes) -> Scan:
    values = {
        "stamp": 1234.5,
        "ranges": np.array([1.0, np.inf, -np.inf, np.nan, 0.0, 2.5], np.float32),
        "angle_min": -1.0,
        "angle_increment": 0.25,
        "range_min": 0.125,
        "range_max": 8.0,
        "time_increment": 0.0078125,
        "frame_id": "laser",
    }
    return Scan(**(values | changes))


def layout_message(points, fields, *, padding=0, big=False, row_padding=0, height=1) -> PointCloud2:
    """A cloud message with the given fields (name, datatype), each followed by `padding` bytes."""
    order = ">" if big else "<"
    offsets = np.cumsum([0] + [np.dtype(TYPES[kind]).itemsize + padding for _, kind in fields])
    dtype = np.dtype(
        {
            "names": [name for name, _ in fields],
            "formats": [order + TYPES[kind] for _, kind in fields],
            "offsets": offsets[:-1].tolist(),
            "itemsize": int(offsets[-1]),
        }
    )
    width = len(points) // height
    rows = np.zeros(len(points), dtype)
    for column, (name, _) in enumerate(fields):
        rows[name] = points[:, column]
    packed = b"".join(rows[row * width : (row + 1) * width].tobytes() + bytes(row_padding) for row in range(height))
    return PointCloud2(
        header=HEAD,
        height=height,
        width=width,
        fields=[
            PointField(name=name, offset=int(offset), datatype=kind, count=1)
            for (name, kind), offset in zip(fields, offsets, strict=False)
        ],
        is_bigendian=big,
        point_step=dtype.itemsize,
        row_step=width * dtype.itemsize + row_padding,
        data=array.array("B", packed),
    )


def test_a_scan_survives_its_message():
    scan = make_scan()
    back = conversions.scan_from_message(through_the_wire(conversions.scan_to_message(scan)))
    np.testing.assert_array_equal(back.ranges, scan.ranges)
    for name in ("stamp", "angle_min", "angle_increment", "range_min", "range_max", "time_increment", "frame_id"):
        assert getattr(back, name) == getattr(scan, name)


def test_codes_of_rep_117_are_no_measurements():
    scan = conversions.scan_from_message(conversions.scan_to_message(make_scan()))
    np.testing.assert_array_equal(np.flatnonzero(scan.valid()), [0, 5])


@pytest.mark.parametrize(
    "changes",
    [
        {"angle_increment": 0.0},
        {"angle_increment": math.nan},
        {"angle_min": math.inf},
        {"time_increment": math.nan},
        {"range_min": math.nan},
        {"range_max": 0.0},
    ],
)
def test_a_scan_whose_numbers_make_no_sense_is_refused(changes):
    message = conversions.scan_to_message(make_scan())
    for name, value in changes.items():
        setattr(message, name, value)
    with pytest.raises(InputError):
        conversions.scan_from_message(message)


@given(
    ranges=st.lists(st.floats(width=32), max_size=20),
    numbers=st.lists(st.floats(width=32), min_size=6, max_size=6),
    sec=st.integers(-(2**31), 2**31 - 1),
    nanosec=st.integers(0, 2**32 - 1),
)
def test_any_scan_message_gives_finite_points_or_is_refused(ranges, numbers, sec, nanosec):
    names = ("angle_min", "angle_max", "angle_increment", "time_increment", "range_min", "range_max")
    message = LaserScan(ranges=ranges, **dict(zip(names, numbers, strict=True)))
    message.header.stamp = Time(sec=sec, nanosec=nanosec)
    try:
        scan = conversions.scan_from_message(message)
    except InputError:
        return
    points, _ = scan.points()
    assert np.isfinite(points).all()


@given(st.floats(-(2**31), 2**31 - 1))
def test_a_stamp_survives_its_message_to_the_nanosecond(seconds):
    back = conversions.stamp_seconds(conversions.stamp_message(seconds))
    assert back == pytest.approx(seconds, rel=1e-15, abs=1e-9)


def test_odometry_gives_the_pose_of_the_robot():
    T = se3.from_xyz_rpy((1, 2, 3, 0.1, -0.2, 0.3))
    message = Odometry()
    message.header.stamp = Time(sec=5, nanosec=250_000_000)
    message.pose.pose = conversions.pose_message(T)
    stamp, back = conversions.odometry_from_message(through_the_wire(message))
    assert stamp == 5.25
    np.testing.assert_allclose(back, T, atol=1e-12)


@given(st.lists(st.floats(), min_size=7, max_size=7))
def test_any_pose_message_gives_a_rigid_transform_or_is_refused(numbers):
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = numbers[:3]
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = numbers[3:]
    try:
        T = conversions.pose_matrix(pose)
    except InputError:
        return
    assert np.isfinite(T).all()
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)


def test_a_quaternion_of_zeros_is_refused():
    pose = Pose()
    pose.orientation.w = 0.0
    with pytest.raises(InputError, match="quaternion"):
        conversions.pose_matrix(pose)


def test_a_pose_that_is_absurdly_far_away_is_refused():
    pose = Pose()
    pose.position.x = 1e30
    with pytest.raises(InputError, match="farther"):
        conversions.pose_matrix(pose)


def test_a_planar_covariance_goes_to_x_y_and_yaw():
    covariance = np.arange(1.0, 10.0).reshape(3, 3)
    full = conversions.planar_pose_message(HEAD, (1, 2, 3), covariance).pose.covariance.reshape(6, 6)
    np.testing.assert_array_equal(full[np.ix_((0, 1, 5), (0, 1, 5))], covariance)
    assert np.count_nonzero(full) == 9


def test_a_path_keeps_stamps_and_poses():
    trajectory = Trajectory.from_se2([1.5, 2.25], [(1, 2, 0.5), (3, 4, -0.5)])
    path = through_the_wire(conversions.path_message(HEAD, trajectory))
    assert [conversions.stamp_seconds(pose.header.stamp) for pose in path.poses] == [1.5, 2.25]
    poses = [conversions.pose_matrix(pose.pose) for pose in path.poses]
    np.testing.assert_allclose(poses, trajectory.matrices(), atol=1e-12)


@pytest.mark.parametrize("seen_from", [True, False])
def test_a_cloud_survives_its_message_as_float32(seen_from):
    numbers = np.random.default_rng(0).normal(size=(2, 100, 3))
    cloud = Cloud(numbers[0], numbers[1] if seen_from else None)
    back = conversions.cloud_from_message(through_the_wire(conversions.cloud_to_message(HEAD, cloud)))
    np.testing.assert_array_equal(back.points, cloud.points.astype(np.float32))
    if seen_from:
        np.testing.assert_array_equal(back.sensor, cloud.sensor.astype(np.float32))
    else:
        assert back.sensor is None


@pytest.mark.parametrize("seen_from", [True, False])
def test_the_piece_of_a_cloud_survives_its_message_beside_the_points(seen_from):
    points = np.random.default_rng(0).normal(0, 10, (5, 3))
    cloud, piece = Cloud(points, -points if seen_from else None), Piece(2**32 - 1, 2**31, 7)
    message = through_the_wire(conversions.cloud_to_message(HEAD, cloud, piece))
    assert conversions.piece_from_message(message) == piece
    np.testing.assert_array_equal(conversions.cloud_from_message(message).points, points.astype(np.float32))


def test_a_cloud_that_names_no_piece_is_of_none():
    cloud = Cloud(np.ones((2, 3)))
    assert conversions.piece_from_message(conversions.cloud_to_message(HEAD, cloud)) is None
    message = conversions.cloud_to_message(HEAD, cloud, Piece(1, 2, 3))
    # Somebody else's fields of that name.
    message.fields[3].datatype = PointField.FLOAT32
    assert conversions.piece_from_message(message) is None


def test_a_cloud_of_several_pieces_is_refused():
    one, other = (conversions.cloud_to_message(HEAD, Cloud(np.ones((1, 3))), Piece(1, k)) for k in (2, 3))
    one.width, one.row_step = 2, 2 * one.row_step
    one.data = one.data + other.data
    with pytest.raises(InputError, match="several pieces"):
        conversions.piece_from_message(one)


def test_what_takes_points_back_survives_its_message():
    message = through_the_wire(conversions.no_pieces_message(HEAD, 5))
    assert conversions.piece_from_message(message) == Piece(5, ALL_PIECES)
    assert len(conversions.usable_points(conversions.cloud_from_message(message))) == 0


def test_a_path_survives_its_message():
    trajectory = Trajectory.from_se2([1.5, 2.25, 1.7e9], [(0, 1, 2), (3, 4, -1), (5, 6, 0)])
    back = conversions.trajectory_from_path(through_the_wire(conversions.path_message(HEAD, trajectory)))
    np.testing.assert_array_equal(back.stamps, trajectory.stamps)
    np.testing.assert_array_equal(back.positions, trajectory.positions)
    np.testing.assert_allclose(back.quaternions, trajectory.quaternions, atol=1e-15)


@pytest.mark.parametrize("count", [0, 1, 2, 50])
@pytest.mark.parametrize("frame", ["", "map", "robot1/map", "a_map"])
def test_the_bytes_of_a_path_are_read_as_the_message(count, frame):
    planar = np.random.default_rng(0).normal(0, 5, (count, 3))
    message = conversions.path_message(Header(frame_id=frame), Trajectory.from_se2(1.7e9 + np.arange(count), planar))
    data = serialize_message(message)
    read_frame, read = conversions.trajectory_from_serialized_path(data)
    expected = conversions.trajectory_from_path(message)
    assert read_frame == frame
    np.testing.assert_array_equal(read.stamps, expected.stamps)
    np.testing.assert_array_equal(read.positions, expected.positions)
    np.testing.assert_array_equal(read.quaternions, expected.quaternions)
    assert (conversions._rows_of_path(data) is None) == (count == 0)


@pytest.mark.parametrize("count", [0, 1, 2, 50])
@pytest.mark.parametrize("frame", ["", "map", "robot1/map", "a_map"])
def test_the_bytes_that_are_written_of_a_path_are_read_as_its_message(count, frame):
    rng = np.random.default_rng(0)
    head = Header(frame_id=frame, stamp=Time(sec=-3, nanosec=7))
    trajectory = Trajectory.from_se2(rng.uniform(-2e9, 2e9, count), rng.normal(0, 5, (count, 3)))
    data, message = conversions.serialized_path(head, trajectory), conversions.path_message(head, trajectory)
    # What fills up to the next multiple of eight bytes is left as it is by rclpy.
    assert len(data) == len(serialize_message(message))
    assert deserialize_message(data, Path) == message


def test_a_path_whose_poses_have_frames_of_their_own_is_read_too():
    message = conversions.path_message(Header(frame_id="map"), Trajectory.from_se2([1.0, 2.0, 3.0], np.eye(3)))
    message.poses[1].header.frame_id = "another_frame"
    _, read = conversions.trajectory_from_serialized_path(serialize_message(message))
    np.testing.assert_array_equal(read.planar(), conversions.trajectory_from_path(message).planar())


@given(st.binary(max_size=300))
def test_any_bytes_that_are_no_path_are_not_read_as_one(data):
    # What is no message at all, the middleware refuses.
    rows = conversions._rows_of_path(b"\x00\x01\x00\x00" + data)
    assert rows is None or 56 * len(rows) <= len(data)


@pytest.mark.parametrize("broken", [math.nan, math.inf, 1e7])
def test_a_path_with_a_broken_pose_is_refused(broken):
    message = conversions.path_message(HEAD, Trajectory.from_se2([1.0, 2.0], np.zeros((2, 3))))
    message.poses[1].pose.position.z = broken
    with pytest.raises(InputError, match="pose of the path"):
        conversions.trajectory_from_path(message)


def test_an_empty_cloud_survives_its_message():
    cloud = Cloud(np.empty((0, 3)), np.empty((0, 3)))
    back = conversions.cloud_from_message(through_the_wire(conversions.cloud_to_message(HEAD, cloud)))
    assert len(back) == 0


@given(
    order=st.permutations(["x", "y", "z", "vx", "vy", "vz", "intensity", "ring"]),
    kinds=st.lists(st.sampled_from(sorted(TYPES)), min_size=8, max_size=8),
    padding=st.integers(0, 5),
    row_padding=st.integers(0, 9),
    height=st.sampled_from([1, 2, 3]),
    big=st.booleans(),
    width=st.integers(0, 4),
)
def test_fields_may_have_any_order_type_padding_and_byte_order(order, kinds, padding, row_padding, height, big, width):
    values = np.random.default_rng(1).integers(0, 100, (height * width, 8)).astype(float)
    message = layout_message(
        values,
        list(zip(order, kinds, strict=True)),
        padding=padding,
        big=big,
        row_padding=row_padding,
        height=height,
    )
    cloud = conversions.cloud_from_message(message)
    by_name = dict(zip(order, values.T, strict=True))
    np.testing.assert_array_equal(cloud.points, np.column_stack([by_name[name] for name in "xyz"]))
    np.testing.assert_array_equal(cloud.sensor, np.column_stack([by_name["v" + name] for name in "xyz"]))


@given(
    height=st.integers(0, 2**32 - 1) | st.integers(0, 3),
    width=st.integers(0, 2**32 - 1) | st.integers(0, 3),
    point_step=st.integers(0, 2**32 - 1) | st.integers(0, 40),
    row_step=st.integers(0, 2**32 - 1) | st.integers(0, 99),
    data=st.binary(max_size=100),
    fields=st.lists(
        st.tuples(
            st.sampled_from(["x", "y", "z", "vx", "vy", "vz", "rgb", ""]),
            st.integers(0, 2**32 - 1) | st.integers(0, 40),
            st.integers(0, 255) | st.integers(1, 8),
        ),
        max_size=8,
    ),
    big=st.booleans(),
)
def test_any_cloud_message_gives_a_cloud_or_is_refused(height, width, point_step, row_step, data, fields, big):
    message = PointCloud2(
        height=height,
        width=width,
        point_step=point_step,
        row_step=row_step,
        data=array.array("B", data),
        is_bigendian=big,
        fields=[PointField(name=name, offset=offset, datatype=kind, count=1) for name, offset, kind in fields],
    )
    try:
        cloud = conversions.cloud_from_message(message)
    except InputError:
        return
    assert len(cloud) == height * width


def test_a_single_row_needs_no_row_step():
    message = layout_message(np.ones((3, 3)), [(name, FLOAT32) for name in "xyz"])
    message.row_step = 0
    assert len(conversions.cloud_from_message(message)) == 3


def test_a_cloud_whose_data_is_cut_short_is_refused():
    message = layout_message(np.ones((3, 3)), [(name, FLOAT64) for name in "xyz"])
    message.data = message.data[:-1]
    with pytest.raises(InputError, match="does not fit"):
        conversions.cloud_from_message(message)


@pytest.mark.parametrize("width", [0, 3])
def test_points_of_more_bytes_than_memory_has_are_refused_or_none(width):
    message = layout_message(np.ones((3, 3)), [(name, FLOAT32) for name in "xyz"])
    message.width, message.point_step = width, 2**32 - 1
    if width:
        with pytest.raises(InputError, match="does not fit"):
            conversions.cloud_from_message(message)
    else:
        assert len(conversions.cloud_from_message(message)) == 0


def test_a_cloud_without_z_is_refused_and_says_so():
    message = layout_message(np.ones((3, 2)), [(name, FLOAT32) for name in "xy"])
    with pytest.raises(InputError, match="no field z"):
        conversions.cloud_from_message(message)


def test_an_occupancy_grid_becomes_a_message_row_by_row_from_its_origin():
    cells = np.array([[-1, 0, 100], [50, 7, -1]], np.int8)
    head = Header(stamp=Time(sec=7, nanosec=5), frame_id="map")
    message = conversions.grid_message(head, OccupancyGrid(0.05, np.array([-1.5, 2.0, np.pi / 2]), cells))
    assert isinstance(message.data, array.array) and message.data.typecode == "b"
    back = through_the_wire(message)
    assert back.header == head and back.info.map_load_time == head.stamp
    assert (back.info.width, back.info.height) == (3, 2)
    assert back.info.resolution == np.float32(0.05)
    assert back.data.tolist() == [-1, 0, 100, 50, 7, -1]
    origin = conversions.pose_matrix(back.info.origin)
    np.testing.assert_allclose(origin, se3.from_se2((-1.5, 2.0, np.pi / 2)), atol=1e-12)  # m; rounding


def test_a_grid_without_cells_becomes_a_message():
    grid = OccupancyGrid(0.05, np.zeros(3), np.empty((0, 0), np.int8))
    message = through_the_wire(conversions.grid_message(HEAD, grid))
    assert (message.info.width, message.info.height, len(message.data)) == (0, 0, 0)


def test_the_covariance_of_what_hangs_on_a_pose_is_that_of_its_turns_too():
    turns = np.zeros((6, 6))
    turns[5, 5] = 0.01**2
    moved = conversions.moved_covariance(turns, [2.0, 0.0, 0.0])
    # A yaw of 0.01 rad moves what is 2 m ahead 2 cm to the left.
    assert np.sqrt(np.diag(moved)) == pytest.approx([0, 0.02, 0, 0, 0, 0.01])
    assert moved[1, 5] > 0
