# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from g2_recon.reconstruction.batch_training import train_sheet
from g2_recon.reconstruction.lattice import Kind, make_lattice
from g2_recon.reconstruction.som import best_matching_units

KINDS: list[Kind] = ["rectangular", "hexagonal", "triangular"]


def bent_sheet(count: int, size: tuple[float, float], seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of a sheet around the origin, size in steps, with 5 percent of a step of noise; their weights."""
    rng = np.random.default_rng(seed)
    x, y = ((rng.random((count, 2)) - 0.5) * size).T
    z = 0.02 * x * x + rng.normal(0, 0.05, count)
    return np.column_stack([x, y, z]), rng.uniform(0.5, 1.5, count)


def sheet(kind: Kind, rows: int, columns: int) -> np.ndarray:
    place = make_lattice(kind, rows, columns).coordinates
    return np.column_stack([place - place.mean(axis=0), np.zeros(len(place))])


def trained(
    points: np.ndarray, weights: np.ndarray, kind: Kind, rows: int, columns: int, epochs: int
) -> tuple[np.ndarray, np.ndarray]:
    neurons, bmu = sheet(kind, rows, columns), np.empty(len(points), np.int64)
    train_sheet(*points.T.copy(), weights, neurons, rows, columns, kind == "hexagonal", epochs, bmu)
    return neurons, bmu


def plain_twin(
    points: np.ndarray, weights: np.ndarray, kind: Kind, rows: int, columns: int, epochs: int
) -> tuple[np.ndarray, np.ndarray]:
    """The batch rule with all distances on the lattice at once."""
    neurons, place = sheet(kind, rows, columns), make_lattice(kind, rows, columns).coordinates
    distance = np.linalg.norm(place[:, None] - place[None], axis=2)
    height = rows * (np.sqrt(0.75) if kind == "hexagonal" else 1)
    start, end = min(max(height, columns) / 2, 10), 0.35
    for epoch in range(epochs):
        width = start * (end / start) ** (epoch / max(epochs - 1, 1))
        pull = np.exp(-0.5 * (distance / width) ** 2)[:, best_matching_units(points, neurons)] * weights
        neurons = pull @ points / pull.sum(axis=1, keepdims=True)
    return neurons, best_matching_units(points, neurons)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("rows", "columns"), [(2, 2), (3, 9), (11, 5), (14, 20)])
def test_the_kernel_follows_the_batch_rule_on_every_lattice(kind: Kind, rows: int, columns: int) -> None:
    points, weights = bent_sheet(40 * rows * columns, (rows, columns))
    neurons, bmu = trained(points, weights, kind, rows, columns, 5)
    expected, expected_bmu = plain_twin(points, weights, kind, rows, columns, 5)
    # A point as near to two neurons as single precision tells goes to either, and weighs a fortieth of a neuron.
    assert np.abs(neurons - expected).max() < 2e-3
    assert np.mean(bmu != expected_bmu) < 1e-3


@pytest.mark.parametrize("epochs", [0, 1, 30])
def test_the_search_by_tiles_finds_the_nearest_of_all_neurons(epochs: int) -> None:
    """After an epoch the map covers only the middle of its points, after 30 all of them."""
    points, weights = bent_sheet(4000, (40, 25))
    points[:20] *= 3
    neurons, bmu = trained(points, weights, "rectangular", 40, 25, epochs)
    distance = np.linalg.norm(points - neurons[bmu], axis=1)
    nearest = np.linalg.norm(points - neurons[best_matching_units(points, neurons)], axis=1)
    # In steps: what single precision can tell at 60 steps from the middle.
    assert (distance - nearest).max() < 1e-4


@pytest.mark.parametrize("kind", KINDS)
def test_neurons_keep_their_places_in_the_lattice_and_nearly_reach_the_rim(kind: Kind) -> None:
    points, weights = bent_sheet(8000, (14, 9))
    neurons, _ = trained(points, weights, kind, 14, 9, 30)
    grid = neurons.reshape(14, 9, 3)
    assert (np.diff(grid[:, :, 1], axis=1) > 0.5).all()
    assert (np.diff(grid[:, :, 0], axis=0) > 0.5).all()
    # The outermost neurons are in the middle of the outermost cells, half a step within the rim.
    assert np.ptp(neurons[:, 0]) == pytest.approx(13, abs=0.5)


def test_a_point_counts_as_often_as_its_weight_says() -> None:
    points, _ = bent_sheet(300, (5, 4))
    times = np.random.default_rng(1).integers(1, 4, 300)
    once, _ = trained(points, times.astype(float), "rectangular", 5, 4, 10)
    repeated, _ = trained(np.repeat(points, times, axis=0), np.ones(times.sum()), "rectangular", 5, 4, 10)
    assert once == pytest.approx(repeated, abs=1e-6)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e3])
def test_the_scale_of_points_and_weights_changes_nothing(scale: float) -> None:
    points, weights = bent_sheet(500, (6, 5))
    neurons = sheet("hexagonal", 6, 5)
    scaled, bmu = neurons * scale, np.empty(500, np.int64)
    train_sheet(*(points * scale).T.copy(), weights * scale**2, scaled, 6, 5, True, 10, bmu)
    assert scaled / scale == pytest.approx(trained(points, weights, "hexagonal", 6, 5, 10)[0], abs=1e-3)


def test_a_single_point_draws_all_neurons() -> None:
    neurons, bmu = trained(np.array([[0.3, 0.2, 0.1]]), np.ones(1), "rectangular", 2, 2, 3)
    assert bmu.tolist() == [0]
    assert neurons[0] == pytest.approx([0.3, 0.2, 0.1], abs=1e-6)
