# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Surface normals of a cloud."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from g2_recon.geometry.cloud import Cloud

Float = NDArray[np.float64]

# Enough neighbors to reach the next scan line beside the own one.
_NEIGHBORS = 24


def estimate_normals(cloud: Cloud, *, workers: int = 1) -> Float:
    """Unit normals (N, 3): the direction in which the nearest neighbors of a point scatter least.

    Turned towards where the point was seen from; of arbitrary sign where the cloud has no sensor positions.
    """
    count = min(_NEIGHBORS, len(cloud))
    index = cKDTree(cloud.points).query(cloud.points, k=count, workers=workers)[1].reshape(-1, count)
    # Sums over the neighborhood, relative to the point itself so that large coordinates cost no precision.
    total, squares = np.zeros((len(cloud), 3)), np.zeros((len(cloud), 3, 3))
    for neighbor in index.T:
        offset = cloud.points[neighbor] - cloud.points
        total += offset
        squares += offset[:, :, None] * offset[:, None, :]
    scatter = squares / count - (total[:, :, None] * total[:, None, :]) / count**2
    normal = np.linalg.eigh(scatter)[1][:, :, 0]
    if cloud.sensor is not None:
        away = np.einsum("ij,ij->i", normal, cloud.sensor - cloud.points) < 0
        normal = np.where(away[:, None], -normal, normal)
    return normal
