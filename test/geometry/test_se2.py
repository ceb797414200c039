# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from g2_recon.geometry import se2, se3

coordinate = st.floats(-1e3, 1e3)
poses = st.tuples(coordinate, coordinate, st.floats(-10, 10)).map(np.array)


@given(poses)
def test_a_pose_and_its_inverse_cancel(pose):
    assert se2.compose(pose, se2.inverse(pose)) == pytest.approx([0, 0, 0], abs=1e-9)


@given(poses, poses)
def test_relative_leads_from_one_pose_to_the_other(first, second):
    reached = se2.compose(first, se2.relative(first, second))
    assert reached[:2] == pytest.approx(second[:2], abs=1e-8)
    assert se2.wrap_angle(reached[2] - second[2]) == pytest.approx(0, abs=1e-9)


@given(poses, poses)
def test_planar_and_spatial_composition_agree(first, second):
    planar = se2.compose(first, second)
    spatial = se2.from_se3(se3.from_se2(first) @ se3.from_se2(second))
    assert spatial[:2] == pytest.approx(planar[:2], abs=1e-8)
    assert se2.wrap_angle(spatial[2] - planar[2]) == pytest.approx(0, abs=1e-9)


def test_points_turn_counterclockwise():
    moved = se2.transform_points([1.0, 2.0, np.pi / 2], [[1.0, 0.0], [0.0, 1.0]])
    assert moved == pytest.approx(np.array([[1.0, 3.0], [0.0, 2.0]]))


def test_composition_broadcasts_over_arrays_of_poses():
    many = np.random.default_rng(0).normal(size=(4, 5, 3))
    assert se2.compose(se2.IDENTITY, many) == pytest.approx(
        np.concatenate([many[..., :2], se2.wrap_angle(many[..., 2:])], axis=-1)
    )
