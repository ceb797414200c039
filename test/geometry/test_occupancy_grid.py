# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.errors import InputError
from g2_recon.geometry.occupancy_grid import OccupancyGrid

CELLS = np.array([[0, 100, -1], [50, 7, 100]], np.int8)


def test_a_point_has_the_value_of_its_cell_and_outside_nothing_is_known():
    grid = OccupancyGrid(0.5, np.array([1.0, 2.0, 0.0]), CELLS)
    points = [[1.25, 2.25], [1.75, 2.25], [2.25, 2.25], [1.25, 2.75], [2.25, 2.75], [0.9, 2.2], [2.6, 2.2], [1.2, 3.1]]
    assert grid.at(points).tolist() == [0, 100, -1, 50, 100, -1, -1, -1]


def test_a_turned_grid_is_looked_up_along_its_own_axes():
    grid = OccupancyGrid(0.5, np.array([1.0, 2.0, np.pi / 2]), CELLS)
    # Columns go up from the origin, rows to the left.
    assert grid.at([[0.75, 2.75], [0.25, 2.25]]).tolist() == [100, 50]
    np.testing.assert_allclose(grid.outline(), [[1, 2], [1, 3.5], [0, 3.5], [0, 2]], atol=1e-12)  # m; rounding


def test_places_that_are_no_numbers_or_without_end_are_unknown():
    grid = OccupancyGrid(0.5, np.zeros(3), CELLS)
    assert grid.at([[np.nan, 0.1], [1e300, 0.1], [-1e300, 0.1]]).tolist() == [-1, -1, -1]


@pytest.mark.parametrize("resolution", [0.0, -1.0, np.nan, np.inf])
def test_cells_without_a_size_are_refused(resolution):
    with pytest.raises(InputError):
        OccupancyGrid(resolution, np.zeros(3), CELLS)


@pytest.mark.parametrize("origin", [np.zeros(2), np.array([0, np.nan, 0])])
def test_an_origin_that_is_no_place_is_refused(origin):
    with pytest.raises(InputError):
        OccupancyGrid(0.5, origin, CELLS)


@pytest.mark.parametrize("cells", [CELLS.astype(int), CELLS[0], np.array([[101]], np.int8), np.array([[-2]], np.int8)])
def test_cells_of_another_kind_are_refused(cells):
    with pytest.raises(InputError):
        OccupancyGrid(0.5, np.zeros(3), cells)
