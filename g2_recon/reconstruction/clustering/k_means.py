# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""K-Means clustering of points (paper, section 3.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2, vq

# The centers are found on at most this many points, drawn at random, and then all points are assigned: more points
# move the centers by less than a change of the seed does.
_SAMPLE = 30_000
_ITERATIONS = 30


def k_means(
    points: NDArray[np.float64], clusters: int, *, seed: int, start: NDArray[np.float64] | None = None
) -> NDArray[np.int64]:
    """The cluster (N,) of each point (N, D), numbered from 0 without gaps.

    There are at most `clusters`; fewer where points coincide. Lloyd's iteration from the centers `start` (K, D), or
    from k-means++ seeds.
    """
    rng = np.random.default_rng(seed)
    sample = points if len(points) <= _SAMPLE else points[np.sort(rng.choice(len(points), _SAMPLE, replace=False))]
    distinct = np.unique(sample, axis=0)
    if len(distinct) <= clusters:
        centers = distinct
    elif start is None:
        centers, _ = kmeans2(sample, clusters, iter=_ITERATIONS, minit="++", rng=rng)
    else:
        centers, _ = kmeans2(sample, start, iter=_ITERATIONS, minit="matrix")
    label, _ = vq(points, centers, check_finite=False)
    return np.unique(label, return_inverse=True)[1].reshape(-1).astype(np.int64)


def centers(points: NDArray[np.float64], label: NDArray[np.int64]) -> NDArray[np.float64]:
    """The centroid (K, D) of each cluster of points (N, D) with clusters (N,) numbered from 0 without gaps."""
    total = np.stack([np.bincount(label, column) for column in points.T], axis=1)
    return total / np.bincount(label)[:, None]
