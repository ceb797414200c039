# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""How well each face of a mesh fits the points that it was made from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.closest import closest_on_mesh
from g2_recon.geometry.mesh import Mesh


def face_errors(mesh: Mesh, points: NDArray[np.float64], *, limit: float, workers: int = 1) -> NDArray[np.float64]:
    """The root mean square distance (F,) m of the points (N, 3) to which a face is the closest one; NaN without any.

    limit: m, farther points are not of this surface.
    """
    if not len(mesh.faces):
        return np.empty(0)
    places = closest_on_mesh(points, mesh.vertices, mesh.faces, limit=limit, workers=workers)
    near = places.face >= 0
    count = np.bincount(places.face[near], minlength=len(mesh.faces))
    square = np.bincount(places.face[near], places.distance[near] ** 2, len(mesh.faces))
    return np.where(count > 0, np.sqrt(square / np.maximum(count, 1)), np.nan)
