# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.reconstruction.lattice import rectangular


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
