# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import numpy as np
import pytest

from g2_recon.config import SimulationConfig
from g2_recon.geometry import se2
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.simulation.building import first_floor, surfaces
from g2_recon.simulation.robot import RATE_HZ, SLIP, WHEEL_BASE, WHEEL_BASE_ERROR, drive, wheel_odometry
from g2_recon.simulation.tours import FULL_TOUR, SWEEP_TOUR

ROBOT_HEIGHT = 0.9


@pytest.fixture(scope="module")
def tour():
    return drive(FULL_TOUR, SimulationConfig(), start=100.0, rest=1.0).trajectory


def speeds(trajectory):
    return np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1) * RATE_HZ


def odometry_error(trajectory, **settings):
    """Distances (N,) in metres between where the wheels say the robot is and where it is."""
    odometry = wheel_odometry(trajectory, SimulationConfig(**settings), np.random.default_rng(0)).planar()
    true = se2.relative(trajectory.planar()[0], trajectory.planar())
    return np.linalg.norm(odometry[:, :2] - true[:, :2], axis=1)


@pytest.mark.parametrize("settings", [{}, {"max_speed": 1.2, "max_turn_rate": 0.4, "acceleration": 0.2}])
def test_speed_turn_rate_and_acceleration_stay_within_the_settings(settings):
    config = SimulationConfig(**settings)
    trajectory = drive(FULL_TOUR, config, start=0.0, rest=1.0).trajectory
    turn_rates = np.diff(np.unwrap(trajectory.planar()[:, 2])) * RATE_HZ
    reached = [speeds(trajectory).max(), np.abs(turn_rates).max(), np.abs(np.diff(speeds(trajectory))).max() * RATE_HZ]
    # Chords are measured, not arcs: 0.1 %.
    assert (np.array(reached) <= np.array([config.max_speed, config.max_turn_rate, config.acceleration]) * 1.001).all()


def test_the_robot_reaches_its_top_speed(tour):
    assert speeds(tour).max() == pytest.approx(0.5)


def test_the_robot_drives_where_it_looks(tour):
    poses = tour.planar()
    steps = se2.relative(poses[:-1], poses[1:])
    sideways = steps[:, 1] - steps[:, 0] * np.tan(steps[:, 2] / 2)  # the chord of an arc points half a turn ahead
    assert np.abs(sideways).max() < 5e-6  # metres in one step of up to 5e-3 m


@pytest.mark.parametrize("legs", [FULL_TOUR, SWEEP_TOUR])
def test_the_robot_keeps_clear_of_walls_and_furniture(legs):
    at = drive(legs, SimulationConfig(), start=0.0, rest=1.0).trajectory.positions[::10, :2]
    rectangles = surfaces(first_floor())
    upright = (rectangles.axis != 2) & (rectangles.low[:, 1] < ROBOT_HEIGHT)
    axis, offset = rectangles.axis[upright], rectangles.offset[upright]
    low, high = rectangles.low[upright, 0], rectangles.high[upright, 0]
    across = np.where(axis == 0, at[:, :1], at[:, 1:]) - offset
    along = np.where(axis == 0, at[:, 1:], at[:, :1])
    beside = along - np.clip(along, low, high)
    assert np.hypot(across, beside).min() >= 0.25


def test_the_full_tour_visits_every_room(tour):
    rooms = [part for part in first_floor().carved if part.high[2] > 2.1 and part.low[2] == 0]
    inside = [
        ((tour.positions[:, :2] > part.low[:2]) & (tour.positions[:, :2] < part.high[:2])).all(axis=1).any()
        for part in rooms
        if part.high[1] != 2.40  # the alcove of the workshop
    ]
    assert len(inside) == 10 and all(inside)


def test_the_full_tour_ends_near_its_start(tour):
    assert np.linalg.norm(tour.positions[-1] - tour.positions[0]) < 4.0


def test_the_full_tour_is_about_100_m_long(tour):
    assert tour.length() == pytest.approx(100.0, abs=2.0)


def test_the_robot_stands_at_its_stops():
    motion = drive(SWEEP_TOUR, SimulationConfig(), start=100.0, rest=3.0)
    moved = [
        np.ptp(motion.trajectory.positions[(motion.trajectory.stamps >= begin) & (motion.trajectory.stamps <= end)], 0)
        for begin, end in motion.stops
    ]
    assert len(moved) == len(SWEEP_TOUR) + 1
    assert np.max(moved) < 1e-12


def test_odometry_without_drift_is_perfect(tour):
    assert odometry_error(tour, odometry_drift=0.0).max() < 1e-4  # metres after 100 m: arcs for chords


def test_odometry_drifts(tour):
    assert 0.5 <= odometry_error(tour)[-1] <= 2.0


def test_drift_grows_with_its_setting(tour):
    assert odometry_error(tour, odometry_drift=3.0)[-1] > odometry_error(tour, odometry_drift=0.3)[-1]


@pytest.mark.parametrize("error", [-1e-12, 0.0, 1e-12])
def test_half_a_turn_is_to_the_right_whatever_the_rounding(error):
    legs = (((0.0, 0.0), (2.0, 0.0)), ((2.0, 0.0), (0.0, error)))
    yaw = drive(legs, SimulationConfig(), start=0.0, rest=1.0).trajectory.planar()[:, 2]
    turning = (np.abs(yaw) > 0.1) & (np.abs(yaw) < 3.0)
    assert turning.any() and (yaw[turning] < 0).all()


def test_a_wrong_wheel_base_shows_in_a_turn():
    yaw = np.linspace(0.0, math.pi, 301)
    turn = Trajectory.from_se2(np.arange(301) / RATE_HZ, np.column_stack([np.zeros((301, 2)), yaw]))
    rng = np.random.default_rng(0)
    turned = np.unwrap(wheel_odometry(turn, SimulationConfig(odometry_drift=0.1), rng).planar()[:, 2])[-1]
    noise = 0.1 * SLIP * math.sqrt(math.pi * WHEEL_BASE) / WHEEL_BASE
    assert turned == pytest.approx(math.pi / (1 + 0.1 * WHEEL_BASE_ERROR), abs=4 * noise)
