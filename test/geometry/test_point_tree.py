# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from g2_recon.errors import InputError
from g2_recon.geometry.point_tree import BLOCK, PointTree, are_near, nearest_to_block, point_tree


def nearest(tree: PointTree, queries: np.ndarray, k: int, beyond: float) -> tuple[np.ndarray, np.ndarray]:
    """Squared distances and numbers (M, k) of the points nearest to queries (M, 3); inf and -1 for none."""
    squared, number = np.full((len(queries), k), np.inf), np.full((len(queries), k), -1)
    room, places, found = np.empty((BLOCK, k)), np.empty((BLOCK, k), np.int64), np.empty(BLOCK, np.int64)
    for begin in range(0, len(queries), BLOCK):
        block = queries[begin : begin + BLOCK]
        nearest_to_block(tree, block, beyond, room, places, found)
        for q in range(len(block)):
            squared[begin + q, : found[q]] = room[q, : found[q]]
            number[begin + q, : found[q]] = tree.number[places[q, : found[q]]]
    return squared, number


def nearest_of_all(
    points: np.ndarray, rows: np.ndarray, queries: np.ndarray, k: int, beyond: float
) -> tuple[np.ndarray, np.ndarray]:
    """The plain twin of `nearest`: all distances, sorted by distance and number."""
    squared, number = np.full((len(queries), k), np.inf), np.full((len(queries), k), -1)
    for q, query in enumerate(queries):
        x, y, z = (points[rows] - query).T
        distance = x * x + y * y + z * z
        order = np.lexsort((rows, distance))[:k]
        order = order[distance[order] < beyond]
        squared[q, : len(order)], number[q, : len(order)] = distance[order], rows[order]
    return squared, number


def assert_nearest(points: np.ndarray, queries: np.ndarray, k: int, beyond: float) -> None:
    squared, number = nearest(point_tree(points), queries, k, beyond)
    expected_squared, expected = nearest_of_all(points, np.arange(len(points)), queries, k, beyond)
    np.testing.assert_array_equal(squared, expected_squared)
    np.testing.assert_array_equal(number, expected)


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 200),
    k=st.integers(1, 30),
    radius=st.sampled_from([0.1, 0.7, 1e9]),
    grid=st.booleans(),
    flat=st.booleans(),
    origin=st.sampled_from([0.0, 1e6]),
)
def test_any_points_agree_with_the_plain_search(
    seed: int, count: int, k: int, radius: float, grid: bool, flat: bool, origin: float
) -> None:
    rng = np.random.default_rng(seed)
    # A grid of five a side has many points as far as others, some at the same place.
    points = rng.integers(0, 5, (count, 3)) * 0.25 if grid else rng.normal(size=(count, 3))
    points = points * (1, 1, 0 if flat else 1) + origin
    queries = np.concatenate([points, points + rng.normal(size=points.shape)])
    squared, number = nearest(point_tree(points), queries, k, radius**2)
    expected_squared, expected = nearest_of_all(points, np.arange(count), queries, k, radius**2)
    np.testing.assert_array_equal(squared, expected_squared)
    # Where k are at the place itself, which of them is open.
    open_to_choice = expected_squared[:, -1] == 0
    np.testing.assert_array_equal(number[~open_to_choice], expected[~open_to_choice])
    for row in number[open_to_choice]:
        assert len(set(row.tolist())) == k


def test_clusters_far_apart_whose_densities_differ_by_a_factor_of_a_million() -> None:
    rng = np.random.default_rng(1)
    points = np.concatenate(
        [rng.normal(size=(300, 3)) * scale + middle for scale, middle in ((1e-3, 0.0), (1.0, 50.0), (1e3, -1e5))]
    )
    assert_nearest(points, rng.permutation(points), 24, np.inf)


def test_many_points_at_one_place_are_found_once_each() -> None:
    points = np.concatenate([np.zeros((5000, 3)), np.ones((40, 3))])
    squared, number = nearest(point_tree(points), points[-48:], 24, np.inf)
    assert (squared == 0).all()
    assert (np.sort(number, axis=1)[:, 1:] > np.sort(number, axis=1)[:, :-1]).all()


def test_the_tree_of_some_points_holds_only_these() -> None:
    points = np.random.default_rng(2).uniform(size=(400, 3))
    rows = np.arange(3, 400, 7)
    squared, number = nearest(point_tree(points, rows), points, 5, 0.1)
    expected_squared, expected = nearest_of_all(points, rows, points, 5, 0.1)
    np.testing.assert_array_equal(squared, expected_squared)
    np.testing.assert_array_equal(number, expected)


def test_points_at_the_limit_are_not_found() -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.25, 0.0]])
    squared, number = nearest(point_tree(points), points[:1], 3, 0.25)
    assert number.tolist() == [[0, 2, -1]]
    assert squared.tolist() == [[0.0, 0.0625, np.inf]]


@pytest.mark.parametrize("count", [1, 7, 8, 9, 127, 128, 129, 5000])
def test_each_point_has_one_place_and_lies_in_the_boxes_above_it(count: int) -> None:
    points = np.random.default_rng(3).normal(size=(count, 3))
    tree = point_tree(points)
    assert sorted(tree.number) == list(range(count))
    placed = tree.leaves.transpose(0, 2, 1).reshape(-1, 3)
    np.testing.assert_array_equal(placed[:count], points[tree.number])
    assert np.isinf(placed[count:]).all()
    node = len(tree.boxes) // 2 + np.arange(count) // BLOCK
    while node[0] > 0:
        assert (tree.boxes[node, :3] <= placed[:count]).all()
        assert (tree.boxes[node, 3:] >= placed[:count]).all()
        node //= 2


def test_the_tree_does_not_depend_on_the_workers() -> None:
    points = np.random.default_rng(4).normal(size=(9000, 3))
    for one, three in zip(point_tree(points, workers=1), point_tree(points, workers=3), strict=True):
        np.testing.assert_array_equal(one, three)


@settings(max_examples=100, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 300),
    distance=st.sampled_from([0.1, 0.3, 2.0]),
    grid=st.booleans(),
    flat=st.booleans(),
    origin=st.sampled_from([0.0, 1e6]),
)
def test_nearness_is_that_of_all_distances(
    seed: int, count: int, distance: float, grid: bool, flat: bool, origin: float
) -> None:
    rng = np.random.default_rng(seed)
    points, others = 3 * rng.random((400, 3)), 2 * rng.random((count, 3))
    if grid:
        points, others = np.round(points, 1), np.round(others, 1)
    if flat:
        others[:, 2] = 0.0
    points, others = points + origin, others + origin
    x, y, z = (points[:, None] - others).transpose(2, 0, 1)
    expected = (x * x + y * y + z * z <= distance * distance).any(axis=1)
    np.testing.assert_array_equal(are_near(points, others, distance, 2), expected)


def test_what_is_not_finite_is_near_to_nothing():
    points = np.zeros((5, 3))
    points[:4, 1] = np.nan, np.inf, -np.inf, 1e300
    assert are_near(points, np.zeros((20, 3)), 0.3, 1).tolist() == [False, False, False, False, True]
    assert are_near(np.zeros((0, 3)), np.zeros((1, 3)), 0.3, 1).tolist() == []


@pytest.mark.parametrize("distance", [np.nan, np.inf, -1.0])
def test_a_distance_that_is_none_is_refused(distance):
    with pytest.raises(InputError, match="a distance of"):
        are_near(np.zeros((1, 3)), np.zeros((20, 3)), distance, 1)
