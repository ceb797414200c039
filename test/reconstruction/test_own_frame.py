# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from g2_recon.geometry.cloud import Cloud
from g2_recon.reconstruction.own_frame import own_frame


def lopsided_box(seed=0):
    """Points of a box of 8 x 5 x 2 m, more of them on one side along each axis."""
    return np.random.default_rng(seed).random((2000, 3)) ** 1.5 * (8, 5, 2)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_a_cloud_that_is_turned_and_moved_looks_the_same_in_its_frame(seed):
    points = lopsided_box()
    turn, step = Rotation.random(random_state=seed), np.random.default_rng(seed).normal(0, 50, 3)
    one = own_frame(points).of(Cloud(points, points + 1.0))
    moved = turn.apply(points) + step
    other = own_frame(moved).of(Cloud(moved, turn.apply(points + 1.0) + step))
    # Rounding of coordinates of some 50 m.
    assert other.points == pytest.approx(one.points, abs=1e-9)
    assert other.sensor == pytest.approx(one.sensor, abs=1e-9)


def test_the_way_back_ends_where_it_began():
    points = lopsided_box() + (4e5, 5.4e6, 300.0)
    frame = own_frame(points)
    # A thousandth of a micrometre of coordinates of 5,400 km.
    assert frame.back(frame.of(Cloud(points)).points) == pytest.approx(points, abs=1e-8)


def test_the_axes_are_right_handed_unit_vectors():
    axes = own_frame(lopsided_box()).axes
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)


@pytest.mark.parametrize("points", [np.zeros((4, 3)), np.array([[0.0, 0, 0], [1, 2, 3]])])
def test_points_without_axes_of_their_own_get_some(points):
    axes = own_frame(points).axes
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-12)
