# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry import se3
from g2_recon.registration.horn import absolute_orientation

POINTS = np.random.default_rng(0).normal(size=(30, 3))


@pytest.mark.parametrize("angles", [(0, 0, 0), (0.3, -0.2, 2.9), (np.pi, 0, 0), (0, np.pi / 2, -1)])
def test_a_transform_comes_back(angles):
    T = se3.from_xyz_rpy([1.0, -2.0, 0.5, *angles])
    assert absolute_orientation(se3.transform_points(T, POINTS), POINTS) == pytest.approx(T, abs=1e-12)


def test_the_result_is_a_rotation_even_where_a_mirror_would_fit_better():
    T = absolute_orientation(POINTS * [1, 1, -1], POINTS)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_the_sum_of_squared_distances_is_least():
    rng = np.random.default_rng(1)
    fixed = se3.transform_points(se3.from_xyz_rpy([0.1, 0, 0, 0, 0, 0.2]), POINTS) + rng.normal(0, 0.05, POINTS.shape)
    best = absolute_orientation(fixed, POINTS)

    def cost(T):
        return np.sum((se3.transform_points(T, POINTS) - fixed) ** 2)

    for step in rng.normal(0, 0.01, (20, 6)):
        assert cost(best) <= cost(best @ se3.from_xyz_rpy(step))


def test_pairs_without_weight_do_not_count():
    fixed = POINTS + [1.0, 0, 0]
    fixed[:10] += 5.0
    weights = np.r_[np.zeros(10), np.ones(20)]
    assert absolute_orientation(fixed, POINTS, weights)[:3, 3] == pytest.approx([1, 0, 0])
