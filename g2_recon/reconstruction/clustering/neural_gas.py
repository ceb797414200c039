# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Neural Gas clustering of points (paper, section 3.1).

Martinetz, Berkovich, Schulten, "Neural-gas network for vector quantization and its application to time-series
prediction", IEEE Transactions on Neural Networks 4(4), 1993; the schedule is the one that Fritzke, "Some competitive
learning methods", 1997, quotes from it, with 40,000 input signals.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from g2_recon.kernels import kernel

Float = NDArray[np.float64]

_RATE_START, _RATE_END = 0.5, 0.005
_RANGE_START, _RANGE_END = 10.0, 0.01
# Units that are in order already need no more than their neighbors.
_RANGE_FROM_A_START = 1.0
# Ranks farther than so many ranges are left as they are: exp(-20) is 2e-9, all 40,000 of which move no unit.
_RANGES_REACHED = 20.0


def neural_gas(
    points: Float, clusters: int, *, seed: int, presentations: int, start: Float | None = None
) -> NDArray[np.int64]:
    """The cluster (N,) of each point (N, D), that of the nearest unit, numbered from 0 without gaps.

    There are at most `clusters`; fewer where points coincide. The units start on points drawn at random, or at
    `start` (K, D), which is taken to be in order. Single points are presented in random order, each as often as the
    others. Each presentation moves the k-th nearest unit, counted from 0, by e exp(-k / l) of its way to the point;
    e falls from 0.5 to 0.005 and l from 10 to 0.01, both geometrically.
    """
    rng = np.random.default_rng(seed)
    units = points[rng.choice(len(points), min(clusters, len(points)), replace=False)] if start is None else start
    passes = -(-presentations // len(points))
    presented = np.concatenate([rng.permutation(len(points)) for _ in range(passes)])[:presentations]
    done = np.arange(presentations) / max(presentations - 1, 1)
    range_start = _RANGE_START if start is None else _RANGE_FROM_A_START
    # Around the middle of the points, so that it does not matter where on earth they are.
    middle = points.mean(axis=0)
    units = np.ascontiguousarray(units - middle)
    _present(
        np.ascontiguousarray(points - middle),
        presented,
        units,
        _RATE_START * (_RATE_END / _RATE_START) ** done,
        range_start * (_RANGE_END / range_start) ** done,
    )
    label = cKDTree(units).query(points - middle)[1]
    return np.unique(label, return_inverse=True)[1].reshape(-1).astype(np.int64)


@kernel
def _present(points, presented, units, rates, ranges):  # type: ignore[no-untyped-def]
    """Present the points of these numbers one after the other; units (K, D) are changed in place."""
    count, dimensions = units.shape
    distance, nearest = np.empty(count), np.empty(count, np.int64)
    for number in range(len(presented)):
        point = points[presented[number]]
        # Only the units that are moved need to be in order: a unit is sorted in where it is nearer than the last.
        reached = min(int(_RANGES_REACHED * ranges[number]) + 1, count)
        for unit in range(count):
            squared = 0.0
            for axis in range(dimensions):
                squared += (units[unit, axis] - point[axis]) ** 2
            rank = min(unit, reached)
            while rank > 0 and distance[rank - 1] > squared:
                rank -= 1
                if rank + 1 < reached:
                    distance[rank + 1], nearest[rank + 1] = distance[rank], nearest[rank]
            if rank < reached:
                distance[rank], nearest[rank] = squared, unit
        for rank in range(reached):
            pull = rates[number] * math.exp(-rank / ranges[number])
            for axis in range(dimensions):
                units[nearest[rank], axis] += pull * (point[axis] - units[nearest[rank], axis])
