# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from g2_recon.config import SimulationConfig
from g2_recon.geometry import se2, se3
from g2_recon.simulation.simulator import Simulation, simulate

SPARSE = {"horizontal_every": 60, "vertical_every": 104}
EXACT = {"range_noise": 0.0, "mixed_pixels": False, "odometry_drift": 0.0}


@pytest.fixture(scope="module")
def first_floor() -> Simulation:
    return simulate(SimulationConfig(horizontal_every=30))


@pytest.fixture(scope="module")
def exact() -> Simulation:
    return simulate(SimulationConfig(**SPARSE, **EXACT))


@pytest.fixture(scope="module")
def sweeps() -> Simulation:
    return simulate(SimulationConfig(setup="sweeping", **EXACT))


def registered(simulation, scans, mount):
    """Points (N, 3) in the map frame; mount gives T_base_laser at the beams' times."""
    parts = [(scan, *scan.points()) for scan in scans]
    times = np.concatenate([scan.beam_stamps()[beams] for scan, _, beams in parts])
    points = np.concatenate([points for _, points, _ in parts])
    T_map_base, known = simulation.trajectory.interpolate(times)
    assert known.all()
    return se3.transform_points(T_map_base @ mount(times), np.column_stack([points, np.zeros(len(points))]))


def registered_vertical(simulation):
    mount = simulation.recording.T_base_laser_vertical
    return registered(simulation, simulation.recording.scans_vertical, lambda times: mount)


def registered_sweeps(simulation):
    recording = simulation.recording

    def mount(times):
        angles = np.interp(times, recording.tilt_stamps, recording.tilt_angles)
        tilt = np.tile(np.eye(4), (len(times), 1, 1))
        tilt[:, :3, :3] = Rotation.from_rotvec(np.outer(angles, (0, 1, 0))).as_matrix()
        return recording.T_base_tilt @ tilt

    return registered(simulation, recording.scans_tilt, mount)


def distances_to_surfaces(simulation, points):
    """Metres (N,); the surfaces are axis-aligned in the map frame too, since the robot starts along the corridor."""
    corners = simulation.vertices[simulation.faces[::2]]
    assert np.ptp(corners, axis=1).min(axis=1).max() < 1e-12
    nearest = np.full(len(points), np.inf)
    for lower, upper in zip(corners.min(axis=1), corners.max(axis=1), strict=True):
        gap = np.maximum(np.maximum(lower - points, points - upper), 0)
        nearest = np.minimum(nearest, np.einsum("ij,ij->i", gap, gap))
    return np.sqrt(nearest)


def test_exact_vertical_points_lie_on_the_true_surfaces(exact):
    # Half a count of the range, 0.5 mm, is all that is left.
    assert distances_to_surfaces(exact, registered_vertical(exact)[::5]).max() < 0.55e-3


def test_exact_horizontal_points_lie_on_the_true_surfaces(exact):
    mount = exact.recording.T_base_laser
    points = registered(exact, exact.recording.scans, lambda times: mount)
    assert distances_to_surfaces(exact, points[::5]).max() < 0.55e-3


def test_clean_points_lie_on_the_true_surfaces(first_floor):
    assert distances_to_surfaces(first_floor, first_floor.clean_vertical[::10]).max() < 1e-6


def test_clean_points_are_in_the_order_of_the_valid_beams(exact):
    assert np.linalg.norm(registered_vertical(exact) - exact.clean_vertical, axis=1).max() < 0.55e-3


def test_noise_about_the_clean_points_is_as_set():
    simulation = simulate(SimulationConfig(**SPARSE, mixed_pixels=False, range_noise=0.02))
    errors = np.linalg.norm(registered_vertical(simulation) - simulation.clean_vertical, axis=1)
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(0.02, rel=0.02)  # 31,000 samples: 0.4 %


def test_a_beam_is_cast_from_its_own_time():
    """With the pose of the first beam instead, points of a moving robot miss the walls by more than the resolution."""
    simulation = simulate(SimulationConfig(**SPARSE, **EXACT, max_turn_rate=3.0))
    frozen = [replace(scan, time_increment=0.0) for scan in simulation.recording.scans]
    mount = simulation.recording.T_base_laser
    points = registered(simulation, frozen, lambda times: mount)
    assert distances_to_surfaces(simulation, points[::5]).max() > 0.005


def test_the_map_frame_is_the_start_pose_on_the_floor(first_floor):
    np.testing.assert_allclose(first_floor.trajectory.matrices()[0], np.eye(4), atol=1e-12)
    assert first_floor.vertices[:, 2].min() == 0.0


def test_the_trajectory_has_a_pose_at_every_scan_and_odometry_stamp(first_floor):
    recording = first_floor.recording
    stamps = [scan.stamp for scan in (*recording.scans, *recording.scans_vertical)]
    assert np.isin([*stamps, *recording.odometry.stamps], first_floor.trajectory.stamps).all()


def test_the_trajectory_is_dense(first_floor):
    assert np.diff(first_floor.trajectory.stamps).max() <= 0.02


def test_the_vertical_laser_records_what_the_robot_of_the_paper_did(first_floor):
    assert sum(int(scan.valid().sum()) for scan in first_floor.recording.scans_vertical) == pytest.approx(
        126_000, abs=3000
    )


def test_the_default_horizontal_laser_keeps_25_scans_a_second():
    stamps = [scan.stamp for scan in simulate(SimulationConfig(vertical_every=1000)).recording.scans]
    np.testing.assert_allclose(np.diff(stamps), 0.04, atol=1e-6)


def test_both_lasers_say_that_nothing_is_there(first_floor):
    recording = first_floor.recording
    assert all(
        any(np.isposinf(scan.ranges).any() for scan in scans) for scans in (recording.scans, recording.scans_vertical)
    )


def test_half_a_degree_halves_the_scan_rate():
    scans = simulate(SimulationConfig(beam_spacing="0.5", **SPARSE)).recording.scans
    assert len(scans[0].ranges) == 361
    np.testing.assert_allclose(np.diff([scan.stamp for scan in scans]), 60 / 37.5, atol=1e-6)


def test_exact_odometry_follows_the_true_trajectory(exact):
    odometry = exact.recording.odometry
    T_map_base, _ = exact.trajectory.interpolate(odometry.stamps)
    assert np.linalg.norm(T_map_base[:, :3, 3] - odometry.positions, axis=1).max() < 1e-4


@pytest.mark.parametrize("seed", range(4))
def test_odometry_ends_off_by_half_a_metre_to_two(seed):
    simulation = simulate(SimulationConfig(seed=seed, horizontal_every=1000, vertical_every=1000))
    true = se2.from_se3(simulation.trajectory.matrices()[-1])
    assert 0.5 <= np.linalg.norm(simulation.recording.odometry.positions[-1, :2] - true[:2]) <= 2.0


def test_odometry_comes_at_the_rate_set():
    odometry = simulate(SimulationConfig(odometry_rate=30.0, **SPARSE)).recording.odometry
    np.testing.assert_allclose(np.diff(odometry.stamps), 1 / 30, atol=1e-6)


def test_the_same_seed_gives_the_same_recording():
    first, second = (simulate(SimulationConfig(seed=3, **SPARSE)) for _ in range(2))
    for one, other in zip(first.recording.scans_vertical, second.recording.scans_vertical, strict=True):
        np.testing.assert_array_equal(one.ranges, other.ranges)
    np.testing.assert_array_equal(first.recording.odometry.positions, second.recording.odometry.positions)


def test_another_seed_gives_other_noise():
    first, second = (simulate(SimulationConfig(seed=seed, **SPARSE)).recording.scans[0].ranges for seed in (3, 4))
    assert not np.array_equal(first, second)


def test_progress_is_told_to_the_end():
    calls = []
    simulate(SimulationConfig(**SPARSE), progress=lambda stage, done, total: calls.append((stage, done, total)))
    assert {stage for stage, done, total in calls if done == total} == {"laser", "laser_vertical"}


def test_the_sweeping_setup_records_sweeps_and_nothing_else(sweeps):
    recording = sweeps.recording
    assert not recording.scans and not recording.scans_vertical and recording.T_base_tilt is not None


def test_exact_sweeps_lie_on_the_true_surfaces(sweeps):
    assert distances_to_surfaces(sweeps, registered_sweeps(sweeps)[::20]).max() < 0.55e-3


def test_clean_points_of_sweeps_are_in_the_order_of_the_valid_beams(sweeps):
    assert np.linalg.norm(registered_sweeps(sweeps) - sweeps.clean_vertical, axis=1).max() < 0.55e-3


def test_a_sweep_has_about_200_lines(sweeps):
    stamps = np.array([scan.stamp for scan in sweeps.recording.scans_tilt])
    lines = [len(part) for part in np.split(stamps, np.flatnonzero(np.diff(stamps) > 1.0) + 1)]
    assert len(lines) == 6 and min(lines) >= 150 and max(lines) <= 250


def test_the_robot_stands_while_it_sweeps(sweeps):
    times = np.concatenate([scan.beam_stamps()[[0, -1]] for scan in sweeps.recording.scans_tilt])
    positions = sweeps.trajectory.interpolate(times)[0][:, :3, 3].reshape(-1, 2, 3)
    assert np.abs(np.diff(positions, axis=1)).max() < 1e-9


def test_sweeps_look_down_and_up(sweeps):
    assert np.ptp(sweeps.clean_vertical[:, 2]) == pytest.approx(2.8, abs=1e-6)
