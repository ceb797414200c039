# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What the three methods have in common, and what each is worth on its own."""

import numpy as np
import pytest
import simulated_sweeps
from scipy.spatial import cKDTree

from g2_recon.config import SweepConfig
from g2_recon.geometry import se3
from g2_recon.registration.coarse_alignment import candidates
from g2_recon.registration.horn import absolute_orientation
from g2_recon.registration.prepared_sweep import prepare
from g2_recon.registration.sweep_matching import METHODS

# Metres; of 36,200 points with 1 cm of noise. Point-to-point methods feel how far the beams are apart.
ACCURACY = {"gicp": 0.003, "kiss": 0.013, "paper": 0.01}


@pytest.mark.parametrize("method", METHODS)
def test_a_known_transform_comes_back(room, method):
    guess = room.T @ simulated_sweeps.off_by(np.random.default_rng(0), 0.2, 5.0)
    found = METHODS[method].align(room.moving, room.fixed, guess, 1.5, 0.1)
    metres, degrees = simulated_sweeps.errors(found, room.T)
    assert metres < ACCURACY[method]
    assert degrees < 0.15


@pytest.mark.parametrize("method", METHODS)
def test_where_no_pairs_are_the_guess_comes_back(room, method):
    far = se3.from_xyz_rpy([500.0, 0, 0, 0, 0, 0])
    assert METHODS[method].align(room.moving, room.fixed, far, 1.5, 0.1) == pytest.approx(far)


@pytest.mark.parametrize("method", METHODS)
def test_the_same_sweeps_give_the_same_transform(room, method):
    first, second = (METHODS[method].align(room.moving, room.fixed, room.T, 0.3, 0.1) for _ in range(2))
    assert np.array_equal(first, second)


@pytest.mark.parametrize("every", [False, True], ids=["one a voxel", "all points"])
def test_where_paper_ends_the_points_of_its_setting_would_have_it(room, every):
    moving = prepare(room.points[1], SweepConfig(all_points=every))
    assert len(moving.paired) == len(moving.measured if every else moving.points)
    T = METHODS["paper"].align(moving, room.fixed, room.T, 0.3, 0.1)
    placed = se3.transform_points(T, moving.paired)
    distances, rows = cKDTree(room.fixed.measured).query(placed, distance_upper_bound=0.1)
    paired = np.isfinite(distances)
    step = absolute_orientation(room.fixed.measured[rows[paired]], placed[paired])
    assert np.abs(se3.transform_points(step, placed) - placed).max() < 0.0002  # m: twice what ends the iteration


def test_one_of_the_coarse_candidates_is_near_the_truth(room):
    guess = room.T @ se3.from_xyz_rpy([1.0, -0.9, 0, 0, 0, 0.6])
    apart = [
        simulated_sweeps.errors(found, room.T) for found in candidates(room.moving, room.fixed, guess, SweepConfig())
    ]
    # Cells are 20 cm wide, headings 4 deg apart.
    assert any(metres < 0.3 and degrees < 5 for metres, degrees in apart)


def test_coarse_candidates_lie_within_the_window(room):
    config = SweepConfig(search=1.0, search_angle=0.2)
    for found in candidates(room.moving, room.fixed, room.T, config):
        metres, degrees = simulated_sweeps.errors(found, room.T)
        assert metres <= 1.0 * 2**0.5 + 1e-9
        assert degrees <= np.degrees(0.2) + 1e-9
