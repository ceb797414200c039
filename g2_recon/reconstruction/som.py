# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Training of one self-organizing map: the iterative rule of Kohonen and the batch rule.

Kohonen, "Self-Organizing Maps", sections 3.1 (iterative) and 3.6 (batch). The neighborhood function is
a Gaussian of the lattice distance in steps that gets narrower during training.
"""

from __future__ import annotations

import math
import threading

import numba
import numpy as np
from numpy.typing import NDArray

from g2_recon.reconstruction.lattice import Lattice

Float = NDArray[np.float64]
Stop = threading.Event
NEVER = threading.Event()

# The kernel is left this often to see whether it should stop.
_PASSES_AT_ONCE = 100


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
    stop: Stop = NEVER,
) -> Float:
    """Neurons (n, 3) after `passes` presentations of all points (N, 3), in random order (paper, sections 3.2 and 4).

    The learning rate falls linearly from start to end, the neighborhood radius r from the longest path of the lattice
    to 1. The paper leaves the function open; here it is exp(-2 d^2 / r^2), so that r is two standard deviations. With
    r as one, neighbors would keep pulling at the end, each map would end one cell short of its data, and the two cubes
    of the paper would stay in pieces. Training ends early when `stop` is set.
    """
    # Single precision is fast; around the middle of the points it is also fine enough, wherever on earth they are.
    middle = points.mean(axis=0)
    weights = np.ascontiguousarray((start - middle).T, dtype=np.float32)
    presented = np.ascontiguousarray(points - middle, dtype=np.float32)
    state = np.array([seed * 2 + 1], np.uint64)
    order = np.arange(len(points))
    for first in range(0, passes, _PASSES_AT_ONCE):
        if stop.is_set():
            break
        numbers = np.arange(first, min(first + _PASSES_AT_ONCE, passes))
        done = numbers / max(passes - 1, 1)
        rates = learning_rate_start + (learning_rate_end - learning_rate_start) * done
        radii = lattice.longest_path + (1.0 - lattice.longest_path) * done
        _present(presented, weights, lattice.steps, order, rates, radii, state)
    return weights.T.astype(float) + middle


@numba.njit(cache=True, nogil=True, fastmath=True)
def _present(points, weights, steps, order, rates, radii, state):  # type: ignore[no-untyped-def]
    """A pass over the points for each rate and radius; weights (3, n), order and state are changed in place."""
    count = weights.shape[1]
    distance = np.empty(count, np.float32)
    pull = np.empty((count, count), np.float32)
    for number in range(len(rates)):
        for i in range(count):
            for j in range(count):
                pull[i, j] = rates[number] * math.exp(-2.0 * (steps[i, j] / radii[number]) ** 2)
        _shuffle(order, state)
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


@numba.njit(cache=True, nogil=True)
def _shuffle(order, state):  # type: ignore[no-untyped-def]
    """Fisher and Yates' shuffle with Marsaglia's xorshift generator, so that each map has a sequence of its own."""
    x = state[0]
    for i in range(len(order) - 1, 0, -1):
        x ^= x << np.uint64(13)
        x ^= x >> np.uint64(7)
        x ^= x << np.uint64(17)
        k = np.int64(x % np.uint64(i + 1))
        order[i], order[k] = order[k], order[i]
    state[0] = x


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
