# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np

from g2_recon.geometry.voxels import VoxelFilter, voxel_numbers


def test_points_have_the_number_of_their_cube():
    points = np.random.default_rng(0).uniform(-20, 20, (5000, 3))
    numbers = voxel_numbers(points, 2.0)
    cubes = np.floor(points / 2.0)
    _, first, inverse = np.unique(cubes, axis=0, return_index=True, return_inverse=True)
    assert np.array_equal(numbers, numbers[first][inverse.ravel()])
    assert len(np.unique(numbers)) == len(first)


def test_the_first_point_of_each_cube_is_let_through_in_order():
    points = np.array([[0.9, 0, 0], [-0.1, 0, 0], [0.1, 0, 0], [5.0, 0, 0], [-0.9, 0, 0]])
    assert VoxelFilter(1.0).first(points).tolist() == [0, 1, 3]


def test_a_cube_that_had_its_point_gets_no_other_later():
    voxels = VoxelFilter(1.0)
    assert voxels.first(np.array([[0.5, 0.5, 0.5]])).tolist() == [0]
    assert voxels.first(np.array([[0.6, 0.5, 0.5], [1.5, 0.5, 0.5]])).tolist() == [1]


def test_no_points_are_none():
    assert VoxelFilter(1.0).first(np.empty((0, 3))).tolist() == []
