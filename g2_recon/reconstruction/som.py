# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Training of one self-organizing map: the iterative rule of Kohonen and the batch rule.

Kohonen, "Self-Organizing Maps", sections 3.1 (iterative) and 3.6 (batch). The neighborhood function is
a Gaussian of the lattice distance in steps that gets narrower during training.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from g2_recon.reconstruction.lattice import Lattice

Float = NDArray[np.float64]


def spread_over(points: Float, lattice: Lattice) -> Float:
    """Neurons (n, 3) as a flat sheet over points (N, 3): along their principal axes, longer side to longer side.

    Such a start needs no ordering phase and makes the result independent of chance (Kohonen, section 3.7).
    """
    center = points.mean(axis=0)
    _, _, axes = np.linalg.svd(np.cov((points - center).T, bias=True))
    along = (points - center) @ axes[:2].T
    low, high = np.quantile(along, 0.02, axis=0), np.quantile(along, 0.98, axis=0)
    extent = lattice.coordinates.max(axis=0)
    longer = [0, 1] if extent[0] >= extent[1] else [1, 0]
    share = (lattice.coordinates + 0.5) / (extent + 1)
    placed = low + (high - low) * share[:, longer]
    return np.asarray(center + placed @ axes[:2])


def train_online(
    points: Float,
    start: Float,
    lattice: Lattice,
    *,
    passes: int,
    learning_rate_start: float,
    learning_rate_end: float,
    seed: int,
) -> Float:
    """Neurons (n, 3) after `passes` presentations of all points (N, 3), in random order (paper, sections 3.2 and 4).

    The learning rate falls linearly from start to end, the neighborhood radius r from the longest path of the lattice
    to 1. The paper leaves the function open; here it is exp(-2 d^2 / r^2), so that r is two standard deviations. With
    r as one, neighbors would keep pulling at the end, each map would end one cell short of its data, and the two cubes
    of the paper would stay in pieces.
    """
    weights = np.ascontiguousarray(start.T, dtype=np.float32)
    _train_online(
        np.ascontiguousarray(points, dtype=np.float32),
        weights,
        lattice.steps,
        passes,
        learning_rate_start,
        learning_rate_end,
        float(lattice.longest_path),
        seed,
    )
    return weights.T.astype(float)


@numba.njit(cache=True, nogil=True, fastmath=True)
def _train_online(points, weights, steps, passes, rate_start, rate_end, width_start, seed):  # type: ignore[no-untyped-def]
    """Weights (3, n) are changed in place; the schedule advances once a pass."""
    np.random.seed(seed)  # noqa: NPY002 - Numba's own generator, one a thread
    count = weights.shape[1]
    order = np.arange(len(points))
    distance = np.empty(count, np.float32)
    pull = np.empty((count, count), np.float32)
    for number in range(passes):
        done = number / max(passes - 1, 1)
        rate = rate_start + (rate_end - rate_start) * done
        width = width_start + (1.0 - width_start) * done
        for i in range(count):
            for j in range(count):
                pull[i, j] = rate * math.exp(-2.0 * (steps[i, j] / width) ** 2)
        np.random.shuffle(order)  # noqa: NPY002
        for index in order:
            x, y, z = points[index, 0], points[index, 1], points[index, 2]
            for j in range(count):
                dx, dy, dz = weights[0, j] - x, weights[1, j] - y, weights[2, j] - z
                distance[j] = dx * dx + dy * dy + dz * dz
            bmu = 0
            for j in range(1, count):
                if distance[j] < distance[bmu]:
                    bmu = j
            for j in range(count):
                weights[0, j] += pull[bmu, j] * (x - weights[0, j])
                weights[1, j] += pull[bmu, j] * (y - weights[1, j])
                weights[2, j] += pull[bmu, j] * (z - weights[2, j])


def train_batch(points: Float, start: Float, lattice: Lattice, *, epochs: int, width_end: float) -> Float:
    """Neurons (n, 3) after `epochs` batch updates with all points (N, 3).

    The neighborhood is exp(-d^2 / (2 w^2)), its width w shrinks geometrically from half the longest path to
    `width_end`. A final width of 1 would leave every map smaller than its data by about one cell.
    """
    weights = np.ascontiguousarray(start, float)
    width_start = max(0.5 * lattice.longest_path, width_end)
    for epoch in range(epochs):
        width = width_start * (width_end / width_start) ** (epoch / max(epochs - 1, 1))
        neighborhood = np.exp(-0.5 * (lattice.steps / width) ** 2)
        bmu = best_matching_units(points, weights)
        total, count = sums_by_neuron(points, bmu, len(weights))
        pulled = neighborhood @ count
        reached = pulled > 1e-12
        weights[reached] = (neighborhood @ total)[reached] / pulled[reached, None]
    return weights


@numba.njit(cache=True, nogil=True, fastmath=True)
def best_matching_units(points, weights):  # type: ignore[no-untyped-def]
    """The nearest neuron (N,) to each point (N, 3) among weights (n, 3), by looking at all: fastest for small maps."""
    columns = np.ascontiguousarray(weights.T)
    count = columns.shape[1]
    distance = np.empty(count)
    bmu = np.empty(len(points), np.int64)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for j in range(count):
            dx, dy, dz = columns[0, j] - x, columns[1, j] - y, columns[2, j] - z
            distance[j] = dx * dx + dy * dy + dz * dz
        nearest = 0
        for j in range(1, count):
            if distance[j] < distance[nearest]:
                nearest = j
        bmu[i] = nearest
    return bmu


def sums_by_neuron(points: Float, bmu: NDArray[np.int64], neurons: int) -> tuple[Float, Float]:
    """Sum (n, 3) and number (n,) of the points (N, 3) of each neuron."""
    total = np.zeros((neurons, 3))
    for axis in range(3):
        total[:, axis] = np.bincount(bmu, points[:, axis], neurons)
    return total, np.bincount(bmu, minlength=neurons).astype(np.float64)
