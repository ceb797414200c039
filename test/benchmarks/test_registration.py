# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import gzip

import moos
import numpy as np
import pytest
import vertical_scans
from simulated_drives import STRAIGHT_LEGS, mount, vertical_drive

from benchmarks import registration
from benchmarks.simulated_sweeps import errors, furnished_room, off_by, ring, stop, sweep, two_rooms
from g2_recon.geometry import se3
from g2_recon.geometry.cloud import Cloud


def test_a_sweep_has_the_points_that_the_table_says() -> None:
    rectangles, stops = ring()
    assert sweep(rectangles, stops[0], np.random.default_rng(0)).shape == (36200, 3)


def test_points_of_a_sweep_lie_in_the_frame_of_the_laser() -> None:
    rectangles, _ = ring()
    seen = [sweep(rectangles, stop(1.1, y), np.random.default_rng(0), noise=0.0) for y in (1.1, 1.0)]
    # The wall on the right is 10 cm nearer from the second place; the floor stays where it is.
    assert seen[0][:, 1].min() - seen[1][:, 1].min() == pytest.approx(-0.1)
    assert seen[0][:, 2].min() == pytest.approx(-0.75)


def test_a_guess_is_off_by_what_is_said() -> None:
    metres, degrees = errors(off_by(np.random.default_rng(0), 0.3, 8.0), np.eye(4))
    assert (metres, degrees) == pytest.approx((0.3, 8.0))


def test_stops_in_two_rooms_do_not_see_each_other() -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        rectangles, (first, second) = two_rooms(rng)
        reach = se3.transform_points(first, sweep(rectangles, first, rng, noise=0.0))[:, 0].max()
        assert reach < se3.transform_points(second, sweep(rectangles, second, rng, noise=0.0))[:, 0].min()


def test_all_tables_that_need_no_recordings_are_made(tmp_path) -> None:
    registration.main(["--quick", "--only", "ring", "corridor", "recordings", "beams", "sides", "--out", str(tmp_path)])
    page = (tmp_path / "registration_benchmarks.md").read_text()
    assert "## A ring of sweeps" in page
    assert "## A bare corridor" in page
    assert "Recorded" not in page
    assert "## Vertical scans with the true trajectory" in page
    assert "good" not in page.split("## A bare corridor")[1].split("|---")[1]


def test_the_beams_of_a_simulated_drive_meet_the_surface_where_they_should() -> None:
    drive = vertical_drive(furnished_room(), STRAIGHT_LEGS, mount(), 0, every=75, range_noise=0.0, mixed_pixels=False)
    clouds = vertical_scans.register(drive.scans, drive.trajectory, mount())
    points = np.concatenate([cloud.points for _, cloud in clouds])
    # The laser counts whole millimetres; what is nearer than 0.2 m is left out, and nothing is.
    assert np.linalg.norm(points - drive.exact[-len(points) :], axis=1).max() < 0.001


def test_points_are_measured_along_their_beams() -> None:
    cloud = Cloud(np.array([[5.0, 7.1, 1.0], [5.0, 6.95, 1.0]]), np.array([[5.0, 3.0, 1.0]] * 2))
    assert vertical_scans.along_the_beam(furnished_room(), cloud) == pytest.approx([0.1, -0.05])


def test_a_plane_is_as_thick_as_its_noise() -> None:
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(-3, 3, (5000, 2)), rng.normal(0, 0.02, 5000)])
    # Of a normal distribution without its farthest tenth, in sigma.
    assert vertical_scans.thickness(plane) == pytest.approx(0.79 * 0.02, rel=0.05)


ALOG = """\
%% LOGSTART 1225719811.65
61.85 LMS_LASER_2D_LEFT LMS1 ID=1,time=1225719873.50,angRes=0.50,minAngle=45.00,maxAngle=135.00,Range=[3]{1.5,-1.0,2.5}
61.86 ODOMETRY_POSE iPlatform Pose=[3x1]{4.0,18.0,-0.5},Vel=[3x1]{-0.8,-0.8,-6.3},time=1225719873.51,Speed=1.1
61.87 DESIRED_THRUST iJoystick 85.57
"""


def test_a_log_of_moos_is_read(tmp_path) -> None:
    file = tmp_path / "some.alog.gz"
    file.write_bytes(gzip.compress(ALOG.encode()))
    scans, odometry = moos.read_alog(file)
    (scan,) = scans["left"]
    assert scan.stamp == 1225719873.50
    assert scan.valid().tolist() == [True, False, True]
    # 45 deg down, half a degree apart.
    assert np.degrees(scan.angles()) == pytest.approx([-45.0, -44.5, -44.0])
    assert odometry.planar()[0] == pytest.approx([4.0, 18.0, np.pi / 2 - 0.5])


@pytest.mark.parametrize(("side", "y"), [("left", 1.0), ("right", -1.0)])
def test_a_laser_looks_to_its_side_and_neither_is_mirrored(side, y) -> None:
    T = moos.mounting_pose(side)
    assert T[:3, 0] == pytest.approx([0, y, 0])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_a_truth_without_tilt_gets_that_of_another_place() -> None:
    place, truth = se3.from_xyz_rpy([1, 2, 3, 0.02, -0.03, 0.5]), se3.from_xyz_rpy([4, 5, 6, 0, 0, -2.8])
    expected = se3.from_xyz_rpy([4, 5, 6, 0.02, -0.03, -2.8])
    assert registration.with_tilt_of(place, truth) == pytest.approx(expected, abs=1e-3)


def test_planes_are_as_far_apart_as_the_places_that_sweeps_are_laid_on() -> None:
    """A room seen from one place twice: 2 cm too high, and half a degree too far about the upright."""
    rng = np.random.default_rng(0)
    walls, T = furnished_room(), stop(5.0, 3.0)
    seen = [registration.patches(sweep(walls, T, rng)) for _ in range(2)]
    higher, turned = se3.from_xyz_rpy([0, 0, 0.02, 0, 0, 0]), se3.from_xyz_rpy([0, 0, 0, 0, 0, np.radians(0.5)])
    (exact, _, level), (_, _, raised), (_, degrees, _) = registration.planes_apart(*seen, [np.eye(4), higher, turned])
    assert (exact, level) == pytest.approx((0.0, 0.0), abs=2.0)  # mm: patches of 30 points and more, each 1 cm off
    assert raised == pytest.approx(20.0, abs=2.0)
    assert degrees < 1.5


def test_lines_of_frames_are_right_handed_and_in_metres(tmp_path) -> None:
    (tmp_path / "scan001.frames").write_text("1 0 0 0 0 1 0 0 0 0 1 0 10 20 30 1 2\n\n" * 2)
    first, second = registration.read_frames(tmp_path / "scan001.frames")
    assert np.array_equal(first, second)
    assert first == pytest.approx(se3.from_xyz_rpy([0.3, -0.1, 0.2, 0, 0, 0]))


def test_slam6d_brings_a_sweep_to_those_before_it(monkeypatch) -> None:
    """Three sweeps of a room; odometry is 5 cm off, and what the second was off is taken off the third as well."""
    monkeypatch.setattr(registration, "SLAM6D_STEPS", 8)
    rng = np.random.default_rng(0)
    stops = [stop(5.0, 3.0), stop(5.2, 3.1, 3.0), stop(5.4, 3.2, 6.0)]
    points = [sweep(furnished_room(), at, rng)[::4] for at in stops]
    shift = se3.from_xyz_rpy([0.04, -0.03, 0, 0, 0, 0])
    sweeps = registration.Slam6DSweeps(points, [stops[0], shift @ stops[1], shift @ stops[2]], [[at] for at in stops])
    second, third = sweeps.iterations(1), sweeps.iterations(2)
    assert len(second) == 8
    assert errors(second[-1], stops[1])[0] < errors(second[0], stops[1])[0] < 0.05
    assert errors(third[0], stops[2])[0] < 0.01
