# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""From lattice cells to triangles: "each rectangle is split into two triangles" (paper, section 5)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.cloud import Cloud
from g2_recon.geometry.triangles import area_vectors

Float = NDArray[np.float64]


def split_cells(weights: Float, cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles (2 C, 3) of lattice cells (C, 4), each cut along its shorter diagonal; weights (V, 3) in metres."""
    a, b, c, d = cells.T
    along_ac = np.linalg.norm(weights[a] - weights[c], axis=1) <= np.linalg.norm(weights[b] - weights[d], axis=1)
    first = np.where(along_ac[:, None], np.stack([a, b, c], axis=1), np.stack([a, b, d], axis=1))
    second = np.where(along_ac[:, None], np.stack([a, c, d], axis=1), np.stack([b, c, d], axis=1))
    return np.stack([first, second], axis=1).reshape(-1, 3)


def face_towards_sensor(
    weights: Float, faces: NDArray[np.int64], submap: NDArray[np.int64], cloud: Cloud, bmu: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The faces (F, 3), those of a submap turned over where most of it faces away from where it was seen from.

    submap: (F,) of each face. bmu: (N,) neuron of each point of the cloud. Without sensor positions the faces are
    returned as they are.
    """
    if cloud.sensor is None or not len(faces):
        return faces
    view = np.stack([np.bincount(bmu, (cloud.sensor - cloud.points)[:, axis], len(weights)) for axis in range(3)], 1)
    towards = np.einsum("fx,fx->f", area_vectors(weights, faces), view[faces].sum(axis=1))
    away = np.bincount(submap, towards, int(submap.max()) + 1) < 0
    return np.where(away[submap, None], faces[:, ::-1], faces)
