# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from collections import Counter

import numpy as np
import pytest

from g2_recon.geometry.cloud import Cloud
from g2_recon.geometry.voxels import (
    VoxelCounts,
    VoxelFilter,
    numbers_of_same_side,
    sided_voxel_numbers,
    voxel_numbers,
)


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


def test_the_two_sides_of_a_thin_wall_are_told_apart():
    rng = np.random.default_rng(1)
    wall = np.column_stack([rng.uniform(0.05, 0.15, 100), rng.uniform(0, 0.2, 100), rng.uniform(0, 0.2, 100)])
    left, right = (sided_voxel_numbers(Cloud(wall, np.full((100, 3), (x, 3.0, 3.0))), 0.2) for x in (-3.0, 3.0))
    assert len(np.unique(left)) == len(np.unique(right)) == 1
    assert left[0] != right[0]


def test_where_no_sensor_is_known_the_octant_is_that_of_the_cube():
    points = np.array([[0.05, 0.05, 0.05], [0.09, 0.01, 0.02], [0.15, 0.05, 0.05], [0.25, 0.05, 0.05]])
    numbers = sided_voxel_numbers(Cloud(points), 0.2)
    assert numbers[0] == numbers[1]
    assert len(np.unique(numbers)) == 3


def counted_of_other(one, other, *, count=100):
    """How many points of a cube of 0.2 m that are seen from `one` are known to who sees them from `other` (3,)."""
    points = np.random.default_rng(3).uniform(0.09, 0.11, (count, 3))
    counts = VoxelCounts()
    counts.add(sided_voxel_numbers(Cloud(points, points + one), 0.2))
    known = counts.of(numbers_of_same_side(Cloud(points, points + other), 0.2)).sum(axis=0)
    assert len(set(known.tolist())) == 1
    return int(known[0])


@pytest.mark.parametrize(("one", "other"), [((3.0, 0.2, 1.0), (3.0, -0.2, 1.0)), ((-0.1, 1.5, -1.0), (0.1, 1.5, -1.0))])
def test_who_comes_back_the_other_way_sees_the_same_side(one, other):
    assert counted_of_other(one, one) == counted_of_other(one, other) == counted_of_other(other, one) == 100


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ((0.3, 1.4, -0.6), (0.3, 1.4, 0.9)),  # a board from below and from above
        ((0.9, 0.9, -0.1), (0.9, 0.9, 0.1)),
        ((0.3, 0.5, 1.0), (-0.3, 0.5, 1.0)),  # a wall from both sides, near to it
        ((3.0, 0.2, 1.0), (-3.0, -0.2, 1.0)),
    ],
)
def test_the_other_side_is_not_known(one, other):
    assert counted_of_other(one, other) == 0
    assert counted_of_other(other, one) == 0


def test_points_of_both_octants_count_together():
    points = np.full((3, 3), 0.1)
    ways = np.array([(3.0, 0.2, 1.0), (3.0, 0.1, 1.0), (3.0, -0.2, 1.0)])
    counts = VoxelCounts()
    counts.add(sided_voxel_numbers(Cloud(points, points + ways), 0.2))
    assert counts.of(numbers_of_same_side(Cloud(points[:1], points[:1] + ways[:1]), 0.2)).tolist() == [[2], [1]]


def test_the_first_number_of_the_same_side_is_that_of_the_octant():
    rng = np.random.default_rng(4)
    cloud = Cloud(rng.uniform(-5, 5, (500, 3)), rng.uniform(-5, 5, (500, 3)))
    own, other = numbers_of_same_side(cloud, 0.2)
    assert np.array_equal(own, sided_voxel_numbers(cloud, 0.2))
    assert (own != other).all()
    assert 0 < np.count_nonzero(other >= 0) < 500


def test_without_a_sensor_there_is_no_other_octant():
    cloud = Cloud(np.random.default_rng(5).uniform(-5, 5, (50, 3)))
    own, other = numbers_of_same_side(cloud, 0.2)
    assert np.array_equal(own, sided_voxel_numbers(cloud, 0.2))
    assert (other == -1).all()


def test_points_are_counted_cube_by_cube_and_taken_away_again():
    rng = np.random.default_rng(2)
    counts, twin = VoxelCounts(), Counter()
    one, other = rng.integers(0, 50, 200), rng.integers(20, 90, 200)
    for numbers, times in ((one, 1), (other, 1), (one, -1), (one, 1), (other, -1), (one, 1)):
        counts.add(numbers, times)
        twin.update({int(number): times * count for number, count in Counter(numbers.tolist()).items()})
        asked = rng.integers(-5, 60, 100)
        assert counts.of(asked).tolist() == [twin[number] for number in asked.tolist()]


def test_no_points_have_no_counts():
    counts = VoxelCounts()
    counts.add(np.empty(0, np.int64))
    assert counts.of(np.array([3])).tolist() == [0]
    assert counts.of(np.empty(0, np.int64)).tolist() == []
