# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import threading

import numpy as np
import pytest

from g2_recon.reconstruction.lattice import make_lattice, rectangular
from g2_recon.reconstruction.som import (
    FAR_OFF,
    best_matching_units,
    padded,
    present,
    shuffle,
    spread_over,
    sums_by_neuron,
    topographic_error,
    train_batch,
    train_online,
)

SCHEDULE = {"learning_rate_start": 0.5, "learning_rate_end": 0.005, "seed": 0}


@pytest.fixture
def sheet():
    """A bent sheet of 2 x 1 m, 2000 points."""
    rng = np.random.default_rng(0)
    x, y = 2 * rng.random(2000), rng.random(2000)
    return np.column_stack([x, y, 0.2 * np.sin(2 * x)])


def quantization_error(points, weights):
    return np.linalg.norm(points - weights[best_matching_units(points, weights)], axis=1).mean()


def test_best_matching_units_are_the_nearest_neurons():
    rng = np.random.default_rng(0)
    points, weights = rng.random((500, 3)), rng.random((50, 3))
    distance = np.linalg.norm(points[:, None] - weights[None], axis=2)
    assert best_matching_units(points, weights).tolist() == distance.argmin(axis=1).tolist()


def test_the_kernel_follows_the_rule_of_kohonen():
    """A plain twin of the kernel: one point, so that the random order does not matter."""
    lattice, point = rectangular(3, 2), np.array([0.3, 0.7, 0.2])
    start = np.random.default_rng(0).random((6, 3))
    passes, rate_start, rate_end = 5, 0.5, 0.005
    expected = start.copy()
    for number in range(passes):
        done = number / (passes - 1)
        rate = rate_start + (rate_end - rate_start) * done
        radius = lattice.longest_path + (1 - lattice.longest_path) * done
        bmu = np.linalg.norm(expected - point, axis=1).argmin()
        pull = rate * np.exp(-2 * (lattice.steps[bmu] / radius) ** 2)
        expected += pull[:, None] * (point - expected)
    schedule = {"learning_rate_start": rate_start, "learning_rate_end": rate_end, "seed": 0}
    weights = train_online(point[None], start, lattice, passes=passes, **schedule)
    assert weights == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("neurons", [3, 40, 50, 300])
def test_the_kernel_presents_points_one_by_one_in_shuffled_order(neurons):
    """A plain twin of the kernel for a few points and any pull between neurons."""
    rng = np.random.default_rng(neurons)
    points, start = rng.random((20, 3)).astype(np.float32), rng.random((neurons, 3)).astype(np.float32)
    pull = np.zeros((neurons, padded(neurons)), np.float32)
    pull[:, :neurons] = rng.random((neurons, neurons))
    expected, order, state = start.astype(float), np.arange(20, dtype=np.int32), np.array([1], np.uint64)
    for rate in (0.5, 0.2, 0.05):
        shuffle(order, state)
        for point in points[order]:
            bmu = np.linalg.norm(expected - point, axis=1).argmin()
            expected += rate * pull[bmu, :neurons, None] * (point - expected)
    weights = np.full((3, padded(neurons)), FAR_OFF, np.float32)
    weights[:, :neurons] = start.T
    order, state = np.arange(20, dtype=np.int32), np.array([1], np.uint64)
    for rate in (0.5, 0.2, 0.05):
        present(points, weights, pull, rate, order, state)
    moved = weights[:, :neurons].T
    assert moved == pytest.approx(expected, abs=1e-4)
    assert (weights[:, neurons:] == np.float32(FAR_OFF)).all()


def test_without_points_the_kernel_moves_nothing():
    weights = np.ones((3, 8), np.float32)
    present(
        np.empty((0, 3), np.float32),
        weights,
        np.ones((8, 8), np.float32),
        0.5,
        np.arange(0, dtype=np.int32),
        np.ones(1, np.uint64),
    )
    assert (weights == 1).all()


def test_a_shuffle_keeps_all_numbers_and_changes_their_order():
    order, state = np.arange(1000, dtype=np.int32), np.array([7], np.uint64)
    shuffle(order, state)
    assert sorted(order) == list(range(1000))
    assert np.mean(order == np.arange(1000)) < 0.02


def test_topographic_error_is_the_share_of_points_between_neurons_that_are_no_neighbors():
    weights = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0.0]])
    points = np.array([[0.4, 0, 0], [1.4, 0, 0], [2.4, 0, 0], [2.6, 0, 0.0]])
    edges = np.array([[1, 0], [2, 3]])
    assert topographic_error(points, weights, edges) == 0.25
    assert topographic_error(points, weights, np.array([[0, 1], [1, 2], [2, 3]])) == 0
    assert topographic_error(points, weights, np.empty((0, 2), np.int64)) == 1


def test_one_batch_epoch_is_a_weighted_mean_of_the_data(sheet):
    lattice = rectangular(4, 3)
    start = spread_over(sheet, lattice)
    width = 0.5 * lattice.longest_path
    bmu = best_matching_units(sheet, start)
    expected = np.empty_like(start)
    for neuron in range(len(start)):
        weight = np.exp(-0.5 * (lattice.steps[neuron, bmu] / width) ** 2)
        expected[neuron] = weight @ sheet / weight.sum()
    assert train_batch(sheet, start, lattice, epochs=1, width_end=width) == pytest.approx(expected)


@pytest.mark.parametrize("kind", ["rectangular", "hexagonal", "triangular"])
@pytest.mark.parametrize("rule", ["online", "batch"])
def test_a_trained_map_covers_its_data_in_order(sheet, rule, kind):
    lattice = make_lattice(kind, 10, 5)
    start = spread_over(sheet, lattice)
    if rule == "online":
        weights = train_online(sheet, start, lattice, passes=200, **SCHEDULE)
    else:
        weights = train_batch(sheet, start, lattice, epochs=30, width_end=0.35)
    # Fifty squares of 2 m x 1 m are 20 cm wide; their points lie 7.7 cm from their middle on average.
    assert quantization_error(sheet, weights) < 0.1
    # The second nearest may be the one across a cell, which is a neighbor only along a diagonal that is an edge.
    across = np.argwhere(lattice.steps == 2)
    assert topographic_error(sheet, weights, np.concatenate([lattice.edges, across])) < 0.02


def test_the_sheet_starts_along_the_long_side_of_the_data(sheet):
    lattice = rectangular(10, 5)
    start = spread_over(sheet, lattice).reshape(10, 5, 3)
    along, across = start[-1, 0] - start[0, 0], start[0, -1] - start[0, 0]
    assert np.linalg.norm(along) > 1.5 * np.linalg.norm(across)
    assert abs(along[0]) > abs(along[1])


def test_the_same_seed_gives_the_same_map_in_any_thread(sheet):
    from concurrent.futures import ThreadPoolExecutor

    lattice = rectangular(4, 3)
    start = spread_over(sheet, lattice)
    with ThreadPoolExecutor(4) as pool:
        maps = list(pool.map(lambda _: train_online(sheet, start, lattice, passes=3, **SCHEDULE), range(8)))
    assert all(one.tolist() == maps[0].tolist() for one in maps)


def test_sums_by_neuron_add_up_to_the_data(sheet):
    bmu = best_matching_units(sheet, spread_over(sheet, rectangular(4, 3)))
    total, count = sums_by_neuron(sheet, bmu, 12)
    assert total.sum(axis=0) == pytest.approx(sheet.sum(axis=0))
    assert count.sum() == len(sheet)


def test_training_far_from_the_origin_loses_no_precision(sheet):
    lattice = rectangular(4, 3)
    utm = np.array([5e5, 5.4e6, 300.0])
    near = train_online(sheet, spread_over(sheet, lattice), lattice, passes=20, **SCHEDULE)
    far = train_online(sheet + utm, spread_over(sheet + utm, lattice), lattice, passes=20, **SCHEDULE)
    assert far - utm == pytest.approx(near, abs=1e-3)


def test_training_ends_when_it_is_told_to(sheet):
    stop = threading.Event()
    stop.set()
    lattice = rectangular(4, 3)
    start = spread_over(sheet, lattice)
    assert train_online(sheet, start, lattice, passes=10**6, stop=stop, **SCHEDULE) == pytest.approx(start, abs=1e-5)
