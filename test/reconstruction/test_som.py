# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import threading

import numpy as np
import pytest

from g2_recon.reconstruction.lattice import rectangular
from g2_recon.reconstruction.som import (
    best_matching_units,
    spread_over,
    sums_by_neuron,
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


def topographic_error(points, weights, lattice):
    """Share of the points whose two nearest neurons are no neighbors."""
    nearest = np.argsort(np.linalg.norm(points[:, None] - weights[None], axis=2), axis=1)[:, :2]
    # In a rectangular lattice the second nearest may be the one across a cell.
    return np.mean(lattice.steps[nearest[:, 0], nearest[:, 1]] > 2)


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


@pytest.mark.parametrize("rule", ["online", "batch"])
def test_a_trained_map_covers_its_data_in_order(sheet, rule):
    lattice = rectangular(10, 5)
    start = spread_over(sheet, lattice)
    if rule == "online":
        weights = train_online(sheet, start, lattice, passes=200, **SCHEDULE)
    else:
        weights = train_batch(sheet, start, lattice, epochs=30, width_end=0.35)
    # Fifty squares of 2 m x 1 m are 20 cm wide; their points lie 7.7 cm from their middle on average.
    assert quantization_error(sheet, weights) < 0.1
    assert topographic_error(sheet, weights, lattice) < 0.05


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
