# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.reconstruction.joining import join_borders, mean_neighbor_distance
from g2_recon.reconstruction.lattice import rectangular
from g2_recon.reconstruction.reoptimization import border_region, reoptimize_batch, reoptimize_online


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


@pytest.fixture
def flat_data():
    rng = np.random.default_rng(0)
    weights, submap, edges, border = side_by_side(gap=1.0)
    points = np.column_stack([5 * rng.random(2000) - 0, 2 * rng.random(2000), np.zeros(2000)])
    bmu = np.linalg.norm(points[:, None] - weights[None], axis=2).argmin(axis=1)
    joins = join_borders(weights, submap, edges, border, theta=1.8)
    return points, bmu, weights, edges, joins


def test_the_region_holds_the_neurons_near_joins_and_their_data_only(flat_data):
    points, bmu, weights, edges, joins = flat_data
    region = border_region(points, bmu, len(weights), edges, joins, width=0)
    assert region.neurons.tolist() == [6, 7, 8, 9, 10, 11]
    assert len(region.points) == np.isin(bmu, region.neurons).sum()
    assert region.neurons[region.bmu].tolist() == bmu[np.isin(bmu, region.neurons)].tolist()
    wider = border_region(points, bmu, len(weights), edges, joins, width=1)
    assert wider.neurons.tolist() == list(range(3, 15))


def test_joins_are_neighbors_like_any_other_in_the_region(flat_data):
    points, bmu, weights, edges, joins = flat_data
    region = border_region(points, bmu, len(weights), edges, joins, width=0)
    degree = np.asarray(region.graph.sum(axis=1)).ravel()
    assert degree.tolist() == [2, 3, 2, 2, 3, 2]


@pytest.mark.parametrize("rule", ["online", "batch"])
def test_reoptimization_moves_only_the_region_and_fits_its_data_better(flat_data, rule):
    points, bmu, weights, edges, joins = flat_data
    bent = weights + np.where(np.isin(np.arange(18), [6, 7, 8, 9, 10, 11])[:, None], [0, 0, 0.3], 0)
    region = border_region(points, bmu, len(weights), edges, joins, width=0)
    if rule == "online":
        result = reoptimize_online(bent, region, passes=20, learning_rate_start=0.5, learning_rate_end=0.005, seed=0)
    else:
        result = reoptimize_batch(bent, region, passes=20)
    moved = np.flatnonzero((result != bent).any(axis=1))
    assert set(moved) <= set(region.neurons)
    assert np.abs(result[region.neurons, 2]).max() < 0.01
