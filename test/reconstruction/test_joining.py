# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.reconstruction.joining import join_borders, mean_neighbor_distance
from g2_recon.reconstruction.lattice import rectangular


def side_by_side(gap, count=2, shift=0.0):
    """Flat 3 x 3 maps of 1 m cells in a row, `gap` metres apart: neurons, submap, edges and border."""
    lattice = rectangular(3, 3)
    weights = [
        np.column_stack([lattice.coordinates, np.zeros(9)]) + (number * (2 + gap), number * shift, 0)
        for number in range(count)
    ]
    submap = np.repeat(np.arange(count), 9)
    edges = np.concatenate([lattice.edges + 9 * number for number in range(count)])
    return np.concatenate(weights), submap, edges, np.tile(lattice.border, count)


def test_facing_borders_are_joined_neuron_by_neuron():
    joins = join_borders(*side_by_side(gap=1.0), theta=1.8)
    assert joins.tolist() == [[6, 9], [7, 10], [8, 11]]


@pytest.mark.parametrize(("gap", "joined"), [(1.79, 3), (1.81, 0)])
def test_the_threshold_is_theta_times_the_mean_neighbor_distance(gap, joined):
    assert len(join_borders(*side_by_side(gap=gap), theta=1.8)) == joined


def test_a_larger_theta_never_joins_less():
    counts = [len(join_borders(*side_by_side(gap=1.0, shift=0.3), theta=theta)) for theta in (0.5, 1.0, 1.5, 2.0, 3.0)]
    assert counts == sorted(counts)


def test_inner_neurons_and_own_neighbors_are_never_joined():
    weights, submap, edges, border = side_by_side(gap=0.1, shift=1.0)
    joins = join_borders(weights, submap, edges, border, theta=10.0)
    assert len(joins)
    assert border[joins].all()
    assert (submap[joins[:, 0]] != submap[joins[:, 1]]).all()


def test_each_neuron_has_at_most_one_candidate_in_each_other_submap():
    weights, submap, edges, border = side_by_side(gap=1.0, count=3, shift=0.5)
    joins = join_borders(weights, submap, edges, border, theta=3.0)
    distance = np.linalg.norm(weights[joins[:, 0]] - weights[joins[:, 1]], axis=1)
    for (one, other), length in zip(joins.tolist(), distance, strict=True):
        nearest = [
            np.linalg.norm(weights[border & (submap == submap[end])] - weights[start], axis=1).min()
            for start, end in ((one, other), (other, one))
        ]
        assert length == pytest.approx(min(nearest)) or length == pytest.approx(max(nearest))


def test_mean_neighbor_distance_of_a_square_lattice_is_its_cell():
    weights, _, edges, _ = side_by_side(gap=1.0)
    assert mean_neighbor_distance(weights, edges) == pytest.approx(1.0)
