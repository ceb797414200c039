# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Training of one self-organizing map: the iterative rule of Kohonen and the batch rule.

Kohonen, "Self-Organizing Maps", sections 3.1 (iterative) and 3.6 (batch). The neighborhood function is
a Gaussian of the lattice distance in steps that gets narrower during training.
"""

from __future__ import annotations

import math
import threading

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from g2_recon.kernels import kernel
from g2_recon.reconstruction.lattice import Lattice

Float = NDArray[np.float64]
Stop = threading.Event
NEVER = threading.Event()

# The kernel is left this often to see whether it should stop.
_PASSES_AT_ONCE = 100
# Where the neurons are that only fill up, m: no point is nearer to them than to a real one.
FAR_OFF = 1e15


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
    weights = np.full((3, padded(len(start))), FAR_OFF, np.float32)
    weights[:, : len(start)] = (start - middle).T
    presented = np.ascontiguousarray(points - middle, dtype=np.float32)
    steps = lattice.steps.astype(np.int16)
    state = np.array([seed * 2 + 1], np.uint64)
    order = np.arange(len(points), dtype=np.int32)
    for first in range(0, passes, _PASSES_AT_ONCE):
        if stop.is_set():
            break
        done = np.arange(first, min(first + _PASSES_AT_ONCE, passes)) / max(passes - 1, 1)
        rates = learning_rate_start + (learning_rate_end - learning_rate_start) * done
        radii = lattice.longest_path + (1.0 - lattice.longest_path) * done
        _train(presented, weights, steps, order, rates, radii, state)
    return weights[:, : len(start)].T.astype(float) + middle


@kernel
def padded(count):  # type: ignore[no-untyped-def]
    """How many neurons `present` wants for `count`: a processor works on eight floats at once."""
    return (count + 7) // 8 * 8


@kernel(fastmath=True)
def _train(points, weights, steps, order, rates, radii, state):  # type: ignore[no-untyped-def]
    """A pass over the points for each rate and radius; weights, order and state are changed in place."""
    count, width = len(steps), weights.shape[1]
    pull_at = np.empty(steps.max() + 1, np.float32)
    pull = np.zeros((count, width), np.float32)
    for turn in range(len(rates)):
        for far in range(len(pull_at)):
            pull_at[far] = math.exp(-2.0 * (far / radii[turn]) ** 2)
        for i in range(count):
            for j in range(count):
                pull[i, j] = pull_at[steps[i, j]]
        present(points, weights, pull, rates[turn], order, state)


@kernel(fastmath=True)
def present(points, weights, pull, rate, order, state):  # type: ignore[no-untyped-def]
    """Present each point (N, 3) once, in random order; weights, order and state are changed in place.

    weights: (3, padded(n)), single precision, with FAR_OFF beyond the n neurons. pull: (n, padded(n)) what share of the
    learning rate a neuron gets when another one is the best matching unit; 0 beyond the n. order: (N,) numbers of the
    points. state: (1,) of the random generator. Neurons whose squared distances agree to one part in 2^17 (in 2^11 with
    thousands of neurons) count as equally near; single precision leaves not much more of them.
    """
    along_x, along_y, along_z = weights[0], weights[1], weights[2]
    width = len(along_x)
    # The bits of a float that is not negative, read as an integer, are in the order of the floats; with the number of
    # the neuron in the lowest bits, the smallest of them names the best matching unit. Unlike a search for the place
    # of the smallest float, compilers make this one look at eight neurons at once.
    distance = np.empty(width, np.float32)
    bits = distance.view(np.int32)
    number = np.arange(width).astype(np.int32)
    low = np.int32(63)
    while low < width - 1:
        low = np.int32(2 * low + 1)
    high = np.int32(~low)
    shuffle(order, state)
    # In one go the neurons move to one point and are measured against the next; at first there is none to move to.
    x, y, z = np.float32(0), np.float32(0), np.float32(0)
    pulled, share = pull[0], np.float32(0)
    for index in order:
        next_x, next_y, next_z = points[index, 0], points[index, 1], points[index, 2]
        for j in range(width):
            here_x, here_y, here_z = along_x[j], along_y[j], along_z[j]
            by = share * pulled[j]
            here_x += by * (x - here_x)
            here_y += by * (y - here_y)
            here_z += by * (z - here_z)
            along_x[j], along_y[j], along_z[j] = here_x, here_y, here_z
            dx, dy, dz = here_x - next_x, here_y - next_y, here_z - next_z
            distance[j] = dx * dx + dy * dy + dz * dz
        nearest = np.int32(0x7FFFFFFF)
        for j in range(width):
            nearest = min(nearest, np.int32((bits[j] & high) | number[j]))
        pulled, share = pull[nearest & low], np.float32(rate)
        x, y, z = next_x, next_y, next_z
    for j in range(width):
        by = share * pulled[j]
        along_x[j] += by * (x - along_x[j])
        along_y[j] += by * (y - along_y[j])
        along_z[j] += by * (z - along_z[j])


@kernel
def shuffle(order, state):  # type: ignore[no-untyped-def]
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


@kernel(fastmath=True)
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


def topographic_error(points: Float, weights: Float, edges: NDArray[np.int64]) -> float:
    """Share of the points (N, 3) whose best and second-best matching units are not neighbors (Kiviluoto, 1996).

    weights: (V, 3), two or more. edges: (E, 2) neighbors, joins too where maps are joined.
    """
    best = np.sort(cKDTree(weights).query(points, k=2)[1], axis=1)
    neighbors = np.sort(edges, axis=1)
    return 1.0 - float(np.isin(best @ (len(weights), 1), neighbors @ (len(weights), 1)).mean())


def sums_by_neuron(points: Float, bmu: NDArray[np.int64], neurons: int) -> tuple[Float, Float]:
    """Sum (n, 3) and number (n,) of the points (N, 3) of each neuron."""
    total = np.zeros((neurons, 3))
    for axis in range(3):
        total[:, axis] = np.bincount(bmu, points[:, axis], neurons)
    return total, np.bincount(bmu, minlength=neurons).astype(np.float64)
