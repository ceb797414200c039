# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import simulated_sweeps

from g2_recon.config import SweepConfig
from g2_recon.errors import InputError
from g2_recon.geometry import se3
from g2_recon.registration import sweep_matching
from g2_recon.registration.prepared_sweep import prepare
from g2_recon.registration.sweep_matching import METHODS, Match, match

CONFIG = SweepConfig()


def off_by(metres, degrees, seed=0):
    return simulated_sweeps.off_by(np.random.default_rng(seed), metres, degrees)


@pytest.mark.parametrize("method", METHODS)
def test_a_match_in_a_room_is_good_from_a_poor_guess(room, method):
    found = match(room.moving, room.fixed, room.T @ off_by(0.8, 20.0), SweepConfig(method=method))
    assert found.quality == "good"
    assert simulated_sweeps.errors(found.T, room.T)[0] < 0.013  # m: the least exact of the methods


def test_the_covariance_is_of_the_size_of_the_error(room):
    found = match(room.moving, room.fixed, room.T, CONFIG)
    sigmas = np.sqrt(np.diag(np.linalg.inv(found.information)))
    off = found.T[:3, 3] - room.T[:3, 3]
    assert (np.abs(off) < 4 * sigmas[:3]).all()
    assert sigmas[:3].max() < 0.01


@pytest.mark.parametrize("seed", range(3))
def test_along_a_bare_corridor_the_guess_stays_and_is_said_to(corridor, seed):
    guess = corridor.T @ off_by(0.2, 3.0, seed)
    found = match(corridor.moving, corridor.fixed, guess, CONFIG)
    axis = np.array([np.cos(np.radians(20)), -np.sin(np.radians(20)), 0])
    off = found.T[:3, 3] - corridor.T[:3, 3]
    assert found.quality == "limited"
    assert found.weak[0].startswith("along (0.9")
    assert axis @ (found.T[:3, 3] - guess[:3, 3]) == pytest.approx(0.0, abs=0.005)
    assert np.linalg.norm(off - axis * (axis @ off)) < 0.005
    # Nothing is known along the axis: 1/m^2.
    assert axis @ found.information[:3, :3] @ axis < 1e-3 * found.information[2, 2]


def test_rooms_that_do_not_overlap_are_refused_with_the_reason(rooms_apart):
    found = match(rooms_apart.moving, rooms_apart.fixed, rooms_apart.T @ off_by(0.3, 8.0), CONFIG)
    assert found.quality == "refused"
    assert "less than min_" in found.refused


def test_a_mirrored_room_is_refused(room):
    mirrored = prepare(room.points[1] * [1, -1, 1], CONFIG)
    assert match(mirrored, room.fixed, room.T, CONFIG).refused


def test_too_little_overlap_is_refused(room):
    near = room.points[1][np.linalg.norm(room.points[1], axis=1) < 1.6]
    far = room.points[0][np.linalg.norm(room.points[0], axis=1) > 5.0]
    found = match(prepare(near, CONFIG), prepare(far, CONFIG), room.T, CONFIG)
    assert "overlap" in found.refused


def test_sweeps_too_far_apart_to_see_the_same_are_refused(room):
    found = match(room.moving, room.fixed, se3.from_xyz_rpy([5e6, 0, 0, 0, 0, 0]), CONFIG)
    assert found.refused == "sweeps 5000000 m apart see nothing in common"


def test_a_match_far_from_its_guess_is_refused(room):
    narrow = SweepConfig(search=0.0, search_angle=0.0, first_gate=0.3)
    assert match(room.moving, room.fixed, room.T @ off_by(0.8, 0.0), narrow).refused


@pytest.mark.parametrize(
    "guess", [np.full((4, 4), np.nan), np.zeros((4, 4)), np.diag([1.0, 1.0, -1.0, 1.0]), np.eye(3), 3 * np.eye(4)]
)
def test_a_guess_that_is_no_transform_is_an_error(room, guess):
    with pytest.raises(InputError, match="transform"):
        match(room.moving, room.fixed, guess, CONFIG)


@pytest.mark.parametrize("method", METHODS)
def test_a_guess_that_is_not_quite_orthonormal_is_as_good(room, method):
    guess = room.T.copy()
    guess[:3, :3] *= 1.002
    guess[0, 1] += 1e-3
    assert match(room.moving, room.fixed, guess, SweepConfig(method=method)).quality == "good"


def fabricated(x, share=1.0, *, weak=(), refused=""):
    return Match(se3.from_se2([x, 0, 0]), np.eye(6), 1.0, share, 0.01, weak, refused)


def test_of_two_places_that_fit_equally_well_none_is_believed():
    best = sweep_matching._best([fabricated(0.0, 0.99), fabricated(2.0, 0.98), fabricated(5.0, 0.5)])
    assert best.refused == "it fits about as well at another place, 2.0 m from there"


def test_of_two_places_the_one_that_fits_clearly_better_is_believed():
    best = sweep_matching._best([fabricated(0.0, 0.92), fabricated(2.0, 0.99)])
    assert (best.T[0, 3], best.refused) == (2.0, "")


def test_the_same_place_twice_is_believed():
    assert not sweep_matching._best([fabricated(0.0), fabricated(0.05)]).refused


def test_a_place_that_holds_in_all_directions_goes_before_one_that_does_not():
    best = sweep_matching._best(
        [fabricated(0.0, 1.0, weak=("along x",)), fabricated(2.0, 0.95), fabricated(3.0, refused="no")]
    )
    assert best.quality == "good"
