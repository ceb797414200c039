# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.reconstruction.lattice import hexagonal, make_lattice, rectangular, triangular


def test_a_lattice_of_ten_by_five_has_the_parts_it_should():
    lattice = rectangular(10, 5)
    assert len(lattice) == 50
    assert len(lattice.edges) == 9 * 5 + 10 * 4
    assert len(lattice.cells) == 9 * 4
    assert lattice.border.sum() == 2 * 10 + 2 * 5 - 4
    assert lattice.longest_path == 9 + 4


@pytest.mark.parametrize(("rows", "columns"), [(2, 2), (2, 7), (10, 5), (20, 30)])
def test_the_shortest_path_is_counted_along_rows_and_columns(rows, columns):
    lattice = rectangular(rows, columns)
    place = lattice.coordinates
    assert lattice.steps.tolist() == np.abs(place[:, None] - place[None]).sum(axis=2).tolist()


def test_cells_run_round_their_corners_along_edges():
    lattice = rectangular(4, 3)
    edges = {frozenset(edge) for edge in lattice.edges.tolist()}
    for cell in lattice.cells.tolist():
        assert {frozenset((cell[i], cell[(i + 1) % 4])) for i in range(4)} <= edges


def test_cells_all_turn_the_same_way():
    lattice = rectangular(4, 3)
    first, second, _, last = (lattice.coordinates[lattice.cells[:, corner]] for corner in range(4))
    one, other = second - first, last - first
    assert (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0] > 0).all()


def number_of_neighbors(lattice):
    return np.bincount(lattice.edges.ravel(), minlength=len(lattice))


@pytest.mark.parametrize("make", [hexagonal, triangular])
@pytest.mark.parametrize(("rows", "columns"), [(2, 2), (2, 5), (3, 2), (10, 5), (5, 8)])
def test_a_lattice_of_triangles_has_the_parts_it_should(make, rows, columns):
    lattice = make(rows, columns)
    cells = (rows - 1) * (columns - 1)
    assert len(lattice) == rows * columns
    assert len(lattice.triangles) == 2 * cells
    assert len(lattice.cells) == 0
    assert len(lattice.edges) == len(rectangular(rows, columns).edges) + cells
    assert (number_of_neighbors(lattice)[~lattice.border] == 6).all()
    assert (number_of_neighbors(lattice)[lattice.border] < 6).all()


def test_all_neighbors_in_a_hexagonal_lattice_are_one_step_off():
    lattice = hexagonal(6, 5)
    one, other = lattice.coordinates[lattice.edges[:, 0]], lattice.coordinates[lattice.edges[:, 1]]
    assert np.linalg.norm(one - other, axis=1) == pytest.approx(1)
    # And there is no other pair as near as that.
    distance = np.linalg.norm(lattice.coordinates[:, None] - lattice.coordinates[None], axis=2)
    assert np.count_nonzero(distance < 1.01) == 30 + 2 * len(lattice.edges)


def test_every_other_row_of_a_hexagonal_lattice_is_shifted_by_half_a_step():
    place = hexagonal(4, 3).coordinates.reshape(4, 3, 2)
    assert place[:, 0, 1].tolist() == [0, 0.5, 0, 0.5]
    assert np.diff(place[:, 0, 0]) == pytest.approx(np.sqrt(3) / 2)


def test_the_shortest_path_in_a_hexagonal_lattice_is_that_of_cube_coordinates():
    """Lattice distance on a hexagonal grid: the largest difference of three coordinates that sum up to 0."""
    lattice = hexagonal(7, 6)
    row, column = np.divmod(np.arange(42), 6)
    along = column - row // 2
    cube = np.stack([along, row, -along - row], axis=1)
    assert lattice.steps.tolist() == np.abs(cube[:, None] - cube[None]).max(axis=2).tolist()


def test_diagonals_shorten_the_path_in_a_triangular_lattice_one_way_only():
    lattice = triangular(7, 6)
    row, column = np.divmod(np.arange(42), 6)
    down, right = row[:, None] - row, column[:, None] - column
    expected = np.where(down * right > 0, np.maximum(abs(down), abs(right)), abs(down) + abs(right))
    assert lattice.steps.tolist() == expected.tolist()


@pytest.mark.parametrize("make", [hexagonal, triangular])
def test_triangles_run_along_edges_the_same_way_and_fill_the_lattice(make):
    lattice = make(5, 4)
    edges = {frozenset(edge) for edge in lattice.edges.tolist()}
    sides = [frozenset((t[i], t[(i + 1) % 3])) for t in lattice.triangles.tolist() for i in range(3)]
    assert set(sides) == edges
    once = {neuron for side in edges if sides.count(side) == 1 for neuron in side}
    assert once == set(np.flatnonzero(lattice.border).tolist())
    first, second, third = (lattice.coordinates[lattice.triangles[:, corner]] for corner in range(3))
    one, other = second - first, third - first
    assert (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0] > 0).all()


def test_borders_of_a_triangular_lattice_are_straight():
    assert triangular(5, 4).coordinates.tolist() == rectangular(5, 4).coordinates.tolist()


@pytest.mark.parametrize("make", [rectangular, hexagonal, triangular])
def test_a_lattice_is_made_by_its_name(make):
    assert make_lattice(make.__name__, 4, 3).edges.tolist() == make(4, 3).edges.tolist()
