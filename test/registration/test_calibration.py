# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import numpy as np
import pytest
import simulated_drives
import simulated_sweeps
from simulated_drives import ROOM_LEGS, STRAIGHT_LEGS, as_localized, error, mount, moved, off_by, vertical_drive

from g2_recon.config import RegistrationConfig
from g2_recon.errors import InputError
from g2_recon.registration.calibration import calibrate

ROOM = simulated_sweeps.furnished_room()
# What the calibration must reach, m and rad.
NEAR = np.array([0.01] * 3 + [math.radians(0.3)] * 3)
HEIGHT = 2


def calibrated(legs, truth, start, seed=0, **settings):
    found = vertical_drive(ROOM, legs, truth, seed, **settings)
    return calibrate(found.scans, as_localized(found.trajectory, seed), start, RegistrationConfig())


@pytest.fixture(scope="module")
def turning():
    """What comes of a drive with turns, 3 deg and 5 cm off at the start, and the true pose."""
    truth = mount()
    return calibrated(ROOM_LEGS, truth, off_by(truth, np.random.default_rng(1), 0.05, 3.0)), truth


def test_from_3_deg_and_5_cm_off_it_comes_within_a_third_of_a_degree_and_a_centimetre(turning):
    found, truth = turning
    off = np.abs(error(found.T_base_laser, truth)) < NEAR
    assert np.delete(off, HEIGHT).all()


def test_the_height_is_not_observed_without_the_floor_and_stays_as_it_was(turning):
    found, truth = turning
    assert not found.floor
    assert [text.split(",")[0] for text in found.unobserved] == ["z"]
    start = off_by(truth, np.random.default_rng(1), 0.05, 3.0)
    assert error(found.T_base_laser, start)[HEIGHT] == pytest.approx(0.0, abs=1e-3)


def test_the_error_is_as_large_as_it_says(turning):
    found, truth = turning
    score = np.delete(error(found.T_base_laser, truth) / found.sigma, HEIGHT)
    # Of five numbers, 4 sigma: once in 3000.
    assert np.abs(score).max() < 4
    assert np.delete(found.sigma / NEAR, HEIGHT).max() < 1


def test_a_laser_that_sees_the_floor_knows_its_height():
    truth = moved(mount(), np.array([0, 0, 0, math.radians(25), 0, 0]))
    found = calibrated(ROOM_LEGS, truth, off_by(truth, np.random.default_rng(2), 0.05, 3.0))
    assert found.floor and not found.unobserved
    assert (np.abs(error(found.T_base_laser, truth)) < NEAR).all()


def test_a_drive_without_a_turn_tells_little_and_says_so():
    truth = mount()
    start = off_by(truth, np.random.default_rng(3), 0.05, 3.0)
    found = calibrated(STRAIGHT_LEGS, truth, start)
    assert len(found.unobserved) == 6
    assert error(found.T_base_laser, start) == pytest.approx(np.zeros(6), abs=1e-9)


def test_the_pose_is_that_of_the_laser_as_it_is_mounted():
    truth = mount(np.random.default_rng(5))
    found = calibrated(ROOM_LEGS, truth, truth)
    assert np.delete(np.abs(error(found.T_base_laser, truth)) < NEAR, HEIGHT).all()


def test_too_little_to_see_is_refused():
    found = vertical_drive(ROOM, STRAIGHT_LEGS, mount(), 0)
    with pytest.raises(InputError, match="drive farther"):
        calibrate(found.scans[:3], found.trajectory, mount(), RegistrationConfig())
    with pytest.raises(InputError, match="only 0 beams"):
        calibrate([], found.trajectory, mount(), RegistrationConfig())


def test_a_recording_without_a_flat_surface_is_refused():
    found = vertical_drive(ROOM, STRAIGHT_LEGS, mount(), 0)
    rng = np.random.default_rng(0)
    bushes = [replace(scan, ranges=rng.uniform(1, 8, 181).astype(np.float32)) for scan in found.scans]
    with pytest.raises(InputError, match="flat surface"):
        calibrate(bushes, found.trajectory, mount(), RegistrationConfig())


def test_a_start_that_is_no_rotation_is_refused():
    found = vertical_drive(ROOM, STRAIGHT_LEGS, mount(), 0)
    with pytest.raises(InputError, match="transform"):
        calibrate(found.scans, found.trajectory, np.full((4, 4), np.nan), RegistrationConfig())


def test_the_simulated_laser_stands_where_it_is_said_to():
    truth = mount(np.random.default_rng(0))
    step = np.array([0.1, -0.2, 0.3, 0.01, -0.02, 0.03])
    assert error(simulated_drives.moved(truth, step), truth) == pytest.approx(step)
