# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry import se2, se2_kernels

POSES = np.random.default_rng(0).uniform(-10, 10, (40, 2, 3))


def test_the_kernels_compose_as_se2_does():
    for first, second in POSES:
        assert se2_kernels.compose(first, second) == pytest.approx(se2.compose(first, second), abs=1e-12)


def test_the_kernels_give_the_relative_pose_that_se2_gives():
    for first, second in POSES:
        assert se2_kernels.relative(first, second) == pytest.approx(se2.relative(first, second), abs=1e-12)


@pytest.mark.parametrize("angle", [-np.pi, np.pi, 3 * np.pi, 0.0, 7.0, -7.0, np.nextafter(np.pi, 0), -1e-300])
def test_the_kernels_wrap_as_se2_does(angle):
    wrapped = se2_kernels.wrap(angle)
    assert wrapped == se2.wrap_angle(angle)
    assert -np.pi <= wrapped < np.pi


@pytest.mark.parametrize(
    "matrix", [[[3, 1], [1, 2]], [[1, -2], [-2, 1]], [[5, 0], [0, 2]], [[2, 0], [0, 5]], [[0, 0], [0, 0]]]
)
def test_the_weakest_direction_is_that_of_the_least_eigenvalue(matrix):
    matrix = np.array(matrix, float)
    least, direction = se2_kernels.weakest(matrix)
    assert least == pytest.approx(np.linalg.eigvalsh(matrix)[0])
    assert np.linalg.norm(direction) == pytest.approx(1)
    assert matrix @ direction == pytest.approx(least * direction)
