# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import threading

import numpy as np
import pytest
from scipy.sparse.csgraph import shortest_path

from g2_recon.reconstruction import reoptimization
from g2_recon.reconstruction.lattice import rectangular
from g2_recon.reconstruction.reoptimization import border_region, reoptimize_batch, reoptimize_online
from g2_recon.reconstruction.som import best_matching_units, shuffle

RATES = {"learning_rate_start": 0.5, "learning_rate_end": 0.005, "seed": 3}


class Row:
    """Flat submaps of 4 x 3 neurons in a row along x, joined end to end, over 300 points each."""

    def __init__(self, count=3, seed=0):
        rng = np.random.default_rng(seed)
        lattice = rectangular(4, 3)
        flat = np.column_stack([lattice.coordinates, np.zeros(12)])
        self.weights = np.concatenate([flat + (4.5 * number, 0, 0) for number in range(count)])
        self.submap = np.repeat(np.arange(count), 12)
        self.edges = np.concatenate([lattice.edges + 12 * number for number in range(count)])
        last_row, first_row = np.arange(9, 12), np.arange(3)
        pairs = [np.stack([last_row + 12 * n, first_row + 12 * (n + 1)], axis=1) for n in range(count - 1)]
        self.joins = np.concatenate(pairs)
        self.points = rng.random((300 * count, 3)) * (4.5 * count, 2, 0.1)
        self.bmu = best_matching_units(self.points, self.weights)

    def region(self, width):
        return border_region(self.points, self.bmu, len(self.weights), self.edges, self.joins, width=width)


def test_only_neurons_near_joins_and_their_data_take_part():
    row = Row()
    region = row.region(0)
    joined = [9, 10, 11, 12, 13, 14, 21, 22, 23, 24, 25, 26]
    assert region.neurons.tolist() == joined
    assert len(region.points) == np.isin(row.bmu, joined).sum()
    assert region.neurons[region.bmu].tolist() == row.bmu[np.isin(row.bmu, joined)].tolist()
    assert row.region(1).neurons.tolist() == [*range(6, 18), *range(18, 30)]


def test_joins_are_neighbors_like_any_other_in_the_region():
    degree = np.asarray(Row().region(0).graph.sum(axis=1)).ravel()
    assert degree.tolist() == [2, 3, 2] * 4


@pytest.mark.parametrize("rule", ["iterative", "batch"])
def test_neurons_far_from_joins_stay_where_they_are(rule):
    row = Row()
    region = row.region(0)
    if rule == "iterative":
        weights = reoptimize_online(row.weights, row.submap, region, passes=5, **RATES)
    else:
        weights = reoptimize_batch(row.weights, region, passes=5)
    moved = np.abs(weights - row.weights).max(axis=1) > 1e-6
    assert moved[region.neurons].all()
    assert np.count_nonzero(moved) == len(region.neurons)


def test_the_kernel_follows_the_rule_of_training_on_the_joined_graph():
    """A plain twin: submap after submap in rounds that share no neuron, each pass in the order of its own shuffle."""
    row = Row()
    region = row.region(1)
    submap = row.submap[region.neurons]
    graph = region.graph.toarray() > 0
    passes = 3
    expected = row.weights[region.neurons].copy()
    orders = [np.arange(np.sum(submap[region.bmu] == part), dtype=np.int32) for part in range(3)]
    states = [np.array([2 * (RATES["seed"] + part) + 1], np.uint64) for part in range(3)]
    for number in range(passes):
        rate = 0.5 + (0.005 - 0.5) * number / (passes - 1)
        # Submap 1 shares neurons with both others and is taken first; 0 and 2 share none.
        for part in (1, 0, 2):
            own = submap == part
            members = np.flatnonzero(own | (graph @ own))
            steps = shortest_path(graph[np.ix_(members, members)], unweighted=True)
            shuffle(orders[part], states[part])
            for point in region.points[submap[region.bmu] == part][orders[part]]:
                bmu = np.linalg.norm(expected[members] - point, axis=1).argmin()
                pull = rate * np.exp(-2 * steps[bmu] ** 2)
                expected[members] += pull[:, None] * (point - expected[members])
    weights = reoptimize_online(row.weights, row.submap, region, passes=passes, **RATES)
    # Single precision, and a few points that are nearly as far from two neurons.
    assert weights[region.neurons] == pytest.approx(expected, abs=1e-4)


def test_the_result_does_not_depend_on_threads(monkeypatch):
    row = Row(count=9)
    region = row.region(1)
    alone = reoptimize_online(row.weights, row.submap, region, passes=120, workers=4, **RATES)
    monkeypatch.setattr(reoptimization, "_WORTH_A_THREAD", 1)
    for workers in (1, 2, 3):
        threads = reoptimize_online(row.weights, row.submap, region, passes=120, workers=workers, **RATES)
        assert threads.tolist() == alone.tolist()


@pytest.mark.parametrize("rule", ["iterative", "batch"])
def test_border_data_is_nearer_to_neurons_afterwards(rule):
    """The paper: "It precises the joining" (section 3.4)."""
    row = Row()
    row.weights += (0, 0, 0.3)
    region = row.region(1)
    if rule == "iterative":
        weights = reoptimize_online(row.weights, row.submap, region, passes=100, **RATES)
    else:
        weights = reoptimize_batch(row.weights, region, passes=30)

    def error(neurons):
        return np.linalg.norm(region.points - neurons[best_matching_units(region.points, neurons)], axis=1).mean()

    assert error(weights) < 0.9 * error(row.weights)


def test_a_submap_without_data_of_its_own_does_no_harm():
    row = Row()
    row.bmu[row.submap[row.bmu] == 0] = 12
    weights = reoptimize_online(row.weights, row.submap, row.region(0), passes=3, **RATES)
    assert np.isfinite(weights).all()


def test_without_any_data_in_the_region_nothing_moves():
    row = Row()
    row.bmu[:] = 0
    weights = reoptimize_online(row.weights, row.submap, row.region(0), passes=3, **RATES)
    assert weights.tolist() == row.weights.tolist()


def test_progress_is_told_to_the_end_and_a_stop_is_heard():
    row, seen, stop = Row(), [], threading.Event()
    arguments = (row.weights, row.submap, row.region(0))
    reoptimize_online(*arguments, passes=250, **RATES, progress=lambda _, done, total: seen.append((done, total)))
    assert seen == [(100, 250), (200, 250), (250, 250)]
    stop.set()
    assert reoptimize_online(*arguments, passes=10**6, **RATES, stop=stop) == pytest.approx(row.weights, abs=1e-6)
