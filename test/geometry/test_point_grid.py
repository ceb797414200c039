# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial import cKDTree

from g2_recon.errors import InputError
from g2_recon.geometry.point_grid import has_point_near, nearest_point, point_grid, points_in_cell


@pytest.mark.parametrize("cell", [0.05, 0.2 / np.sqrt(3), 0.7])
def test_a_point_is_near_exactly_where_the_nearest_one_is(cell):
    rng = np.random.default_rng(0)
    points, places = rng.uniform(-1, 1, (300, 3)), rng.uniform(-1.5, 1.5, (2000, 3))
    grid = point_grid(points, cell=cell)
    near = [has_point_near(grid, *place, 0.2) for place in places]
    assert near == (cKDTree(points).query(places)[0] <= 0.2).tolist()


def test_each_point_is_in_its_cell_once():
    points = np.random.default_rng(0).normal(0, 3, (500, 3))
    grid = point_grid(points, cell=0.5)
    numbers = []
    for cell in grid.cells:
        begin, end = points_in_cell(grid, *cell)
        assert (np.floor((grid.points[begin:end] - grid.origin) / 0.5) == cell).all()
        numbers += grid.order[begin:end].tolist()
    assert sorted(numbers) == list(range(500))
    assert (grid.points == points[grid.order]).all()


def test_far_coordinates_find_the_same_neighbors():
    points = np.random.default_rng(0).uniform(0, 2, (200, 3))
    offset = np.array([4e5, 5.4e6, 300.0])
    assert has_point_near(point_grid(points + offset, cell=0.1), *(points[7] + offset), 0.01)


def test_without_points_nothing_is_near():
    assert not has_point_near(point_grid(np.empty((0, 3)), cell=0.1), 0.0, 0.0, 0.0, 5.0)


def test_points_that_are_not_finite_are_refused():
    with pytest.raises(InputError, match="not finite"):
        point_grid(np.array([[0.0, np.nan, 0.0]]), cell=0.1)


def test_a_cell_needs_a_size():
    with pytest.raises(InputError, match="cell edge"):
        point_grid(np.zeros((1, 3)), cell=0.0)


@pytest.mark.parametrize("cell", [0.05, 0.2 / np.sqrt(3), 0.7])
def test_the_nearest_point_is_that_of_a_tree(cell):
    rng = np.random.default_rng(1)
    points, places = rng.uniform(-1, 1, (300, 3)), rng.uniform(-1.5, 1.5, (500, 3))
    grid = point_grid(points, cell=cell)
    distance, nearest = cKDTree(points).query(places)
    expected = np.where(distance < 0.2, nearest, -1)
    assert [nearest_point(grid, *place, 0.2) for place in places] == expected.tolist()


def test_points_of_a_cell_keep_their_order_and_cells_come_as_their_first_points():
    points = np.random.default_rng(0).uniform(0, 2, (2000, 3))
    grid = point_grid(points, cell=0.25)
    cells = np.floor((points - points.min(axis=0)) / 0.25).astype(np.int64)
    _, first, number = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    assert (grid.cells == cells[np.sort(first)]).all()
    assert (grid.order == np.lexsort((np.arange(2000), first[number.reshape(-1)]))).all()
