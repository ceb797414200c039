# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rosbags import rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from g2_recon.config import RecordingConfig
from g2_recon.errors import InputError
from g2_recon.geometry import se3
from g2_recon.geometry.recording import Recording
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.recording.bags import RecordedQos, messages, read_bag, write_bag, write_ros1_bag

DATA = Path(__file__).resolve().parents[2] / ".." / "shared" / "data"
T_BASE_LASER = se3.from_xyz_rpy([0.2, 0.0, 0.3, 0.0, 0.0, 0.1])
T_BASE_VERTICAL = se3.from_xyz_rpy([-0.1, 0.0, 0.6, np.pi / 2, 0.0, 0.0])
STORE = get_typestore(Stores.ROS2_JAZZY)


def _scan(stamp: float, frame_id: str = "laser", ranges: Any = (1.0, 2.0, 3.0), **changes: float) -> Scan:
    limits = {"range_min": 0.0, "range_max": 80.0, "time_increment": 0.0, **changes}
    return Scan(stamp, np.array(ranges, np.float32), -0.5, 0.25, frame_id=frame_id, **limits)


def _recording() -> Recording:
    rng = np.random.default_rng(0)
    stamps = 1731745824.123456 + np.arange(20) / 7
    return Recording(
        scans=[_scan(stamp, "laser", rng.uniform(0.1, 70, 180)) for stamp in stamps],
        scans_vertical=[_scan(stamp + 0.01, "laser_vertical", rng.uniform(0.1, 70, 181)) for stamp in stamps],
        scans_tilt=[_scan(stamp + 0.02, "laser_tilt", rng.uniform(0.1, 70, 5)) for stamp in stamps],
        odometry=Trajectory.from_se2(stamps + 0.03, rng.uniform(-3, 3, (20, 3))),
        tilt_stamps=stamps + 0.04,
        tilt_angles=rng.uniform(-1, 1, 20),
        T_base_laser=T_BASE_LASER,
        T_base_laser_vertical=T_BASE_VERTICAL,
        T_base_tilt=np.eye(4),
    )


def _write(path: Path, recording: Recording) -> Path:
    (write_ros1_bag if path.suffix == ".bag" else write_bag)(path, recording)
    return path


@pytest.fixture(params=["bag", "drive.bag"], ids=["ros2", "ros1"])
def bag_path(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return tmp_path / str(request.param)


@pytest.mark.parametrize("series", ["scans", "scans_vertical", "scans_tilt"])
def test_scans_come_back_exactly(bag_path: Path, series: str) -> None:
    written = getattr(_recording(), series)
    read = getattr(read_bag(_write(bag_path, _recording())), series)
    assert [scan.stamp for scan in read] == [scan.stamp for scan in written]
    np.testing.assert_array_equal([scan.ranges for scan in read], [scan.ranges for scan in written])


def test_the_frame_of_a_scan_comes_back(bag_path: Path) -> None:
    assert read_bag(_write(bag_path, _recording())).scans_vertical[0].frame_id == "laser_vertical"


def test_odometry_comes_back(bag_path: Path) -> None:
    written, read = _recording().odometry, read_bag(_write(bag_path, _recording())).odometry
    np.testing.assert_array_equal(read.stamps, written.stamps)
    np.testing.assert_allclose(read.matrices(), written.matrices(), atol=1e-12)


def test_the_angles_of_a_sweeping_laser_come_back(bag_path: Path) -> None:
    read = read_bag(_write(bag_path, _recording()))
    np.testing.assert_array_equal(read.tilt_angles, _recording().tilt_angles)
    np.testing.assert_array_equal(read.tilt_stamps, _recording().tilt_stamps)


def test_mounting_poses_come_back(bag_path: Path) -> None:
    read = read_bag(_write(bag_path, _recording()))
    np.testing.assert_allclose(
        [read.T_base_laser, read.T_base_laser_vertical, read.T_base_tilt],
        [T_BASE_LASER, T_BASE_VERTICAL, np.eye(4)],
        atol=1e-12,
    )


def test_a_mounting_pose_that_is_not_known_stays_unknown(bag_path: Path) -> None:
    assert read_bag(_write(bag_path, Recording(scans=[_scan(1.0)]))).T_base_laser is None


def test_an_intact_bag_has_no_drops(bag_path: Path) -> None:
    assert read_bag(_write(bag_path, _recording())).drops == {}


def test_ranges_follow_rep_117(bag_path: Path) -> None:
    ranges = [np.nan, np.inf, -np.inf, 0.0, 8.0, 8.5]
    recording = Recording(scans=[_scan(1.0, ranges=ranges, range_max=8.0)])
    read = read_bag(_write(bag_path, recording)).scans[0].ranges
    np.testing.assert_array_equal(read, np.array([np.nan, np.inf, -np.inf, 0.0, 8.0, np.inf], np.float32))


def test_steps_back_in_time_keep_their_order_and_are_counted(bag_path: Path) -> None:
    recording = Recording(scans=[_scan(stamp) for stamp in (5.0, 4.0, 4.5, 6.0)])
    read = read_bag(_write(bag_path, recording))
    assert [scan.stamp for scan in read.scans] == [5.0, 4.0, 4.5, 6.0]
    assert read.drops == {"scan messages stamped earlier than the one before (kept, in their order)": 1}


def test_the_odometry_of_scans_comes_back_though_their_stamps_step_back(bag_path: Path) -> None:
    stamps = [5.0, 4.0, 4.5, 4.5, 6.0, 5.5]
    poses = np.random.default_rng(0).uniform(-3, 3, (6, 3))
    wheels = Trajectory.from_se2([3.0, 7.0], np.zeros((2, 3)))
    recording = Recording(scans=[_scan(stamp) for stamp in stamps], odometry=wheels, scan_odometry=poses)
    read = read_bag(_write(bag_path, recording)).scan_odometry
    np.testing.assert_allclose(read, poses, atol=1e-12)


def test_the_odometry_of_scans_stays_exact_where_stamps_ascend(bag_path: Path) -> None:
    poses = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    recording = Recording(scans=[_scan(stamp) for stamp in (1.0, 2.0, 3.0)], scan_odometry=poses)
    read = read_bag(_write(bag_path, recording))
    assert read.scan_odometry is None
    np.testing.assert_allclose(read.odometry.planar(), poses, atol=1e-12)


def test_messages_come_in_time_order(bag_path: Path) -> None:
    stamps = [message.stamp_ns for message in messages(_write(bag_path, _recording()))]
    assert (len(stamps), stamps) == (101, sorted(stamps))


def test_messages_are_cdr_of_ros_2(bag_path: Path) -> None:
    scans = [item for item in messages(_write(bag_path, _recording())) if item.msgtype == "sensor_msgs/msg/LaserScan"]
    decoded: Any = STORE.deserialize_cdr(scans[0].cdr, scans[0].msgtype)
    assert scans[0].topic == "/scan"
    np.testing.assert_array_equal(decoded.ranges, _recording().scans[0].ranges)


def test_the_static_transforms_are_latched(bag_path: Path) -> None:
    qos = {message.topic: message.qos for message in messages(_write(bag_path, _recording()))}
    assert qos["/tf_static"] is not None and qos["/tf_static"].transient_local


def test_recorded_quality_of_service_is_told(tmp_path: Path) -> None:
    first = next(message for message in messages(_write(tmp_path / "bag", _recording())) if message.topic == "/scan")
    assert first.qos == RecordedQos(reliable=True, transient_local=False, depth=10)


def test_the_description_is_kept_in_the_metadata(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", _recording(), description={"origin": "simulated"})
    metadata = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())
    assert metadata["rosbag2_bagfile_information"]["custom_data"] == {"origin": "simulated"}


def test_the_same_recording_gives_the_same_bytes(tmp_path: Path) -> None:
    contents = [(_write(tmp_path / name / "bag", _recording()) / "bag.mcap").read_bytes() for name in "ab"]
    assert contents[0] == contents[1]


def test_an_existing_bag_is_not_overwritten(bag_path: Path) -> None:
    _write(bag_path, _recording())
    with pytest.raises(InputError, match="exists already"):
        _write(bag_path, _recording())


def test_a_bag_is_overwritten_on_demand_and_nothing_else_is_left(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", _recording())
    write_bag(tmp_path / "bag", Recording(scans=[_scan(1.0)]), overwrite=True)
    assert len(read_bag(tmp_path / "bag").scans) == 1
    assert [file.name for file in tmp_path.iterdir()] == ["bag"]


def test_a_directory_that_is_no_bag_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "thesis.txt").touch()
    with pytest.raises(InputError, match="is no bag"):
        write_bag(tmp_path / "bag", _recording(), overwrite=True)


def test_a_bag_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written"):
        write_bag(tmp_path / "file" / "bag", _recording())
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


def test_a_name_that_is_too_long_is_told(bag_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"):
        _write(bag_path.with_name("x" * 300 + bag_path.suffix), _recording())


def test_an_empty_recording_is_not_written(bag_path: Path) -> None:
    with pytest.raises(InputError, match="empty"):
        _write(bag_path, Recording())


def test_negative_stamps_shift_all_stamps_by_whole_seconds(bag_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    odometry = Trajectory.from_se2([-1.5, 2.25], np.zeros((2, 3)))
    read = read_bag(_write(bag_path, Recording(scans=[_scan(-0.25), _scan(2.0)], odometry=odometry)))
    assert ([scan.stamp for scan in read.scans], read.odometry.stamps.tolist()) == ([1.75, 4.0], [0.5, 4.25])
    assert "shifted by 2 s" in caplog.text


@pytest.mark.parametrize("stamp", [2.0**31])
def test_a_stamp_that_is_no_ros_time_is_not_written(bag_path: Path, stamp: float) -> None:
    with pytest.raises(InputError, match="cannot be a ROS time"):
        _write(bag_path, Recording(scans=[_scan(stamp)]))


def test_two_mounting_poses_of_one_frame_are_not_written(bag_path: Path) -> None:
    recording = Recording(
        scans=[_scan(1.0)],
        scans_vertical=[_scan(1.0)],
        T_base_laser=T_BASE_LASER,
        T_base_laser_vertical=T_BASE_VERTICAL,
    )
    with pytest.raises(InputError, match="two different mounting poses"):
        _write(bag_path, recording)


class _Bag:
    """A hand-made rosbag2, for what write_bag never writes."""

    def __init__(self, path: Path, storage: rosbag2.StoragePlugin = rosbag2.StoragePlugin.MCAP) -> None:
        self.path = path
        self._writer = rosbag2.Writer(path, version=9, storage_plugin=storage)
        self._connections: dict[str, Any] = {}
        self._time = 0

    def __enter__(self) -> _Bag:
        self._writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def topic(self, topic: str, name: str) -> None:
        self._connections[topic] = self._writer.add_connection(topic, name, typestore=STORE)

    def add(self, topic: str, message: Any = None, raw: bytes = b"") -> None:
        if topic not in self._connections:
            self.topic(topic, message.__msgtype__)
        self._time += 1
        content = raw or STORE.serialize_cdr(message, message.__msgtype__)
        self._writer.write(self._connections[topic], self._time, content)


def _new(name: str, /, **fields: Any) -> Any:
    return STORE.types[name](**fields)


def _header(frame_id: str, second: int = 1) -> Any:
    stamp = _new("builtin_interfaces/msg/Time", sec=second, nanosec=0)
    return _new("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def _laser_scan(frame_id: str = "laser", **changes: Any) -> Any:
    fields: dict[str, Any] = {
        "header": _header(frame_id),
        **dict.fromkeys(["angle_min", "angle_max", "time_increment", "scan_time", "range_min"], 0.0),
        "angle_increment": 0.1,
        "range_max": 80.0,
        "ranges": np.ones(3, np.float32),
        "intensities": np.empty(0, np.float32),
    }
    return _new("sensor_msgs/msg/LaserScan", **{**fields, **changes})


def _transforms(*links: tuple[str, str, float]) -> Any:
    def link(parent: str, child: str, x: float) -> Any:
        shift = _new("geometry_msgs/msg/Vector3", x=x, y=0.0, z=0.0)
        turn = _new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        transform = _new("geometry_msgs/msg/Transform", translation=shift, rotation=turn)
        return _new(
            "geometry_msgs/msg/TransformStamped", header=_header(parent), child_frame_id=child, transform=transform
        )

    return _new("tf2_msgs/msg/TFMessage", transforms=[link(*item) for item in links])


def _odometry(x: float = 0.0, w: float = 1.0) -> Any:
    position = _new("geometry_msgs/msg/Point", x=x, y=0.0, z=0.0)
    orientation = _new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=w)
    pose = _new("geometry_msgs/msg/Pose", position=position, orientation=orientation)
    still = _new("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = _new("geometry_msgs/msg/Twist", linear=still, angular=still)
    return _new(
        "nav_msgs/msg/Odometry",
        header=_header("odom"),
        child_frame_id="base_link",
        pose=_new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
        twist=_new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )


def _joints(names: list[str], angles: list[float]) -> Any:
    none = np.empty(0)
    return _new(
        "sensor_msgs/msg/JointState",
        header=_header(""),
        name=names,
        position=np.array(angles),
        velocity=none,
        effort=none,
    )


def test_a_sqlite_bag_is_read(tmp_path: Path) -> None:
    with _Bag(tmp_path / "bag", rosbag2.StoragePlugin.SQLITE3) as bag:
        bag.add("/scan", _laser_scan())
    assert len(read_bag(tmp_path / "bag").scans) == len(read_bag(tmp_path / "bag" / "bag.db3").scans) == 1


def test_the_only_laser_scan_is_taken_whatever_its_name(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with _Bag(tmp_path / "bag") as bag:
        bag.add("/front/laser", _laser_scan())
        bag.add("/scan_vertical", _laser_scan("up"))
    with caplog.at_level(logging.INFO):
        assert len(read_bag(tmp_path / "bag").scans) == 1
    assert "taking /front/laser, the only sensor_msgs/msg/LaserScan" in caplog.text


def test_the_only_odometry_is_taken_whatever_its_name(tmp_path: Path) -> None:
    with _Bag(tmp_path / "bag") as bag:
        bag.add("/scan", _laser_scan())
        bag.add("/wheels/odometry", _odometry())
    assert len(read_bag(tmp_path / "bag").odometry) == 1


def test_among_several_laser_scans_none_is_guessed(tmp_path: Path) -> None:
    with _Bag(tmp_path / "bag") as bag:
        bag.add("/front", _laser_scan())
        bag.add("/back", _laser_scan())
    with pytest.raises(InputError, match=r"several LaserScan topics.*/back.*/front"):
        read_bag(tmp_path / "bag")


def test_topics_come_from_the_config_with_or_without_slash(tmp_path: Path) -> None:
    with _Bag(tmp_path / "bag") as bag:
        bag.add("/front", _laser_scan())
        bag.add("/back", _laser_scan())
    for name in ("front", "/front"):
        assert len(read_bag(tmp_path / "bag", RecordingConfig(scan_topic=name)).scans) == 1


def test_a_bag_without_a_laser_scan_is_told_with_its_topics(tmp_path: Path) -> None:
    with _Bag(tmp_path / "bag") as bag:
        bag.add("/odom", _odometry())
    with pytest.raises(InputError, match=r"no LaserScan.*its topics: /odom \(nav_msgs/msg/Odometry\)"):
        read_bag(tmp_path / "bag")


def test_a_bag_whose_scan_topic_is_empty_is_told(tmp_path: Path) -> None:
    with _Bag(tmp_path / "bag") as bag:
        bag.topic("/scan", "sensor_msgs/msg/LaserScan")
    with pytest.raises(InputError, match="no usable scan: the topics are empty"):
        read_bag(tmp_path / "bag")


def test_a_bag_without_topics_is_told(tmp_path: Path) -> None:
    with _Bag(tmp_path / "bag"):
        pass
    with pytest.raises(InputError, match="its topics: none"):
        read_bag(tmp_path / "bag")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"angle_increment": float("nan")}, "scans whose angles"),
        ({"angle_increment": 0.0}, "scans whose angles"),
        ({"angle_min": float("inf")}, "scans whose angles"),
        ({"range_max": float("nan")}, "scans whose range_max"),
        ({"range_max": 0.0}, "scans whose range_max"),
        ({"ranges": np.empty(0, np.float32)}, "scans without a beam"),
        ({"ranges": np.ones(100_001, np.float32)}, "scans without a beam or with more than 100,000"),
    ],
)
def test_an_unusable_scan_is_left_out_and_counted(tmp_path: Path, changes: dict[str, Any], reason: str) -> None:
    with _Bag(tmp_path / "bag") as bag:
        bag.add("/scan", _laser_scan())
        bag.add("/scan", _laser_scan(**changes))
    recording = read_bag(tmp_path / "bag")
    assert len(recording.scans) == 1
    assert [(text.startswith(reason), count) for text, count in recording.drops.items()] == [(True, 1)]


def test_a_bag_of_unusable_scans_only_is_told_with_the_reason(tmp_path: Path) -> None:
    with _Bag(tmp_path / "bag") as bag:
        bag.add("/scan", _laser_scan(range_max=0.0))
    with pytest.raises(InputError, match="no usable scan: 1 scans whose range_max is not above"):
        read_bag(tmp_path / "bag")


def test_messages_that_cannot_be_decoded_are_left_out_and_counted(tmp_path: Path) -> None:
    with _Bag(tmp_path / "bag") as bag:
        bag.add("/scan", _laser_scan())
        bag.add("/scan", raw=b"\0\1\0\0nonsense")
    assert read_bag(tmp_path / "bag").drops == {"LaserScan messages that cannot be decoded": 1}


@pytest.mark.parametrize("fields", [{"x": float("nan")}, {"w": 0.0}, {"w": float("inf")}])
def test_broken_odometry_is_left_out_and_counted(tmp_path: Path, fields: dict[str, float]) -> None:
    with _Bag(tmp_path / "bag") as bag:
        bag.add("/scan", _laser_scan())
        bag.add("/odom", _odometry())
        bag.add("/odom", _odometry(**fields))
    recording = read_bag(tmp_path / "bag")
    assert len(recording.odometry) == 1
    assert recording.drops == {"odometry messages whose pose is not finite or no rotation": 1}


def test_the_tilting_joint_is_found_among_others(tmp_path: Path) -> None:
    with _Bag(tmp_path / "bag") as bag:
        bag.add("/scan_tilt", _laser_scan())
        bag.add("/joint_states", _joints(["wheel", "Laser_Tilt"], [9.0, 0.5]))
        bag.add("/joint_states", _joints(["wheel", "arm"], [9.0, 9.0]))
        bag.add("/joint_states", _joints(["servo"], [0.7]))
    recording = read_bag(tmp_path / "bag")
    assert recording.tilt_angles.tolist() == [0.5, 0.7]
    assert recording.drops == {"joint states without exactly one joint whose name has 'tilt' in it": 1}


def test_the_beam_spacing_of_180_beams_is_put_right_and_told_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    message = _laser_scan(ranges=np.ones(180, np.float32), angle_increment=np.pi / 179)
    with _Bag(tmp_path / "bag") as bag:
        bag.add("/scan", message)
        bag.add("/scan", message)
    with caplog.at_level(logging.WARNING):
        scans = read_bag(tmp_path / "bag").scans
    assert [np.degrees(scan.angle_increment) for scan in scans] == pytest.approx([1.0, 1.0])
    assert caplog.text.count("beam spacing") == 1


def test_mounting_poses_follow_the_chain_of_frames(tmp_path: Path) -> None:
    with _Bag(tmp_path / "bag") as bag:
        bag.add("/tf_static", _transforms(("/plate", "/laser", 0.1)))
        bag.add("/tf_static", _transforms(("base_link", "plate", 0.2), ("odom", "base_link", 9.0)))
        bag.add("/scan", _laser_scan("/laser"))
    pose = read_bag(tmp_path / "bag").T_base_laser
    assert pose is not None
    assert pose[:3, 3] == pytest.approx([0.3, 0, 0])


def test_old_bags_have_mounting_poses_in_tf(tmp_path: Path) -> None:
    with _Bag(tmp_path / "bag") as bag:
        bag.add("/scan", _laser_scan())
        bag.add("/tf", _transforms(("odom", "base_link", 9.0)))
        bag.add("/tf", _transforms(("base_link", "laser", 0.1)))
        bag.add("/tf", _transforms(("base_link", "laser", 0.2)))
    pose = read_bag(tmp_path / "bag").T_base_laser
    assert pose is not None
    assert pose[0, 3] == pytest.approx(0.1)


def test_the_mount_of_a_sweeping_laser_is_not_taken_from_moving_transforms(tmp_path: Path) -> None:
    with _Bag(tmp_path / "bag") as bag:
        bag.add("/scan_tilt", _laser_scan())
        bag.add("/tf", _transforms(("base_link", "laser", 0.1)))
    assert read_bag(tmp_path / "bag").T_base_tilt is None


def test_frames_in_a_circle_give_no_mounting_pose(tmp_path: Path) -> None:
    with _Bag(tmp_path / "bag") as bag:
        bag.add("/scan", _laser_scan())
        bag.add("/tf_static", _transforms(("b", "laser", 0.1), ("laser", "b", 0.1)))
    assert read_bag(tmp_path / "bag").T_base_laser is None


def test_the_base_frame_comes_from_the_config(tmp_path: Path) -> None:
    with _Bag(tmp_path / "bag") as bag:
        bag.add("/scan", _laser_scan())
        bag.add("/tf_static", _transforms(("robot", "laser", 0.1)))
    assert read_bag(tmp_path / "bag", RecordingConfig(base_frame="robot")).T_base_laser is not None


def test_progress_reaches_its_end(tmp_path: Path) -> None:
    steps: list[tuple[str, int, int]] = []
    read_bag(_write(tmp_path / "bag", _recording()), progress=lambda *step: steps.append(step))
    assert steps[-1] == ("read bag", 100, 100)


@pytest.mark.parametrize(("name", "scans", "steps_back"), [("aces", 7374, 0), ("intel", 13631, 631)])
def test_a_published_ros_1_bag_is_read_in_file_order(name: str, scans: int, steps_back: int) -> None:
    file = DATA / "bags" / f"{name}.orig.bag"
    if not file.exists():
        pytest.skip(f"{file} is not here")
    stamps = np.array([scan.stamp for scan in read_bag(file).scans])
    assert (len(stamps), int((np.diff(stamps) < 0).sum())) == (scans, steps_back)


def _odometry_of_scans(tmp_path: Path, *arrivals: tuple[str, float]) -> list[float]:
    """x at each scan of a bag with these messages; odometry drives 1 m from one message to the next."""
    with _Bag(tmp_path / "bag") as bag:
        x = 0.0
        for kind, stamp in arrivals:
            message = _laser_scan() if kind == "scan" else _odometry(x := x + 1.0)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(round(stamp * 10**9), 10**9)
            bag.add(f"/{kind}", message)
    scan_odometry = read_bag(tmp_path / "bag").scan_odometry
    assert scan_odometry is not None
    return np.round(scan_odometry[:, 0], 9).tolist()


@pytest.mark.parametrize(("line", "changed"), [("float32 range_max\n", ""), ("float32 range_max", "string range_max")])
def test_messages_of_a_type_that_the_bag_defines_otherwise_are_counted(tmp_path: Path, line: str, changed: str) -> None:
    definition = STORE.generate_msgdef("sensor_msgs/msg/LaserScan")[0].partition("=" * 80)[0]
    assert line in definition
    store = get_typestore(Stores.ROS2_JAZZY)
    del store.fielddefs["sensor_msgs/msg/LaserScan"], store.types["sensor_msgs/msg/LaserScan"]
    store.register(get_types_from_msg(definition.replace(line, changed), "sensor_msgs/msg/LaserScan"))
    with rosbag2.Writer(tmp_path / "bag", version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/scan", "sensor_msgs/msg/LaserScan", typestore=store)
        writer.write(connection, 1, STORE.serialize_cdr(_laser_scan(), "sensor_msgs/msg/LaserScan"))
    with pytest.raises(InputError, match="1 LaserScan messages that cannot be decoded"):
        read_bag(tmp_path / "bag")


def test_a_scan_gets_the_odometry_around_it_though_later_odometry_has_its_stamp_too(tmp_path: Path) -> None:
    arrivals = [("odom", 1.0), ("scan", 1.5), ("odom", 2.0), ("odom", 1.4), ("scan", 1.5), ("odom", 1.6)]
    assert _odometry_of_scans(tmp_path, *arrivals) == [1.5, 3.5]


def test_a_scan_where_the_stamps_step_back_gets_the_odometry_before_it(tmp_path: Path) -> None:
    assert _odometry_of_scans(tmp_path, ("odom", 1.0), ("odom", 2.0), ("scan", 2.1), ("odom", 1.4)) == [2.0]


def test_odometry_long_before_a_scan_is_not_taken_for_it(tmp_path: Path) -> None:
    known = _odometry_of_scans(tmp_path, ("odom", 2.0), ("odom", 1.0), ("scan", 1.0), ("scan", 9.0))
    np.testing.assert_array_equal(known, [2.0, np.nan])
