# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What reconstruction makes, a wire mesh of neurons and a mesh of triangles, and the surface that it should find."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.triangles import area_vectors, unit


@dataclass(frozen=True, slots=True)
class WireMesh:
    """The joined self-organizing map: neurons and the connections between them.

    vertices: (V, 3) metres, the neurons. edges: (E, 2) vertex indices. submap: (V,) the submap of each neuron.
    join: (E,) true where an edge joins two submaps.
    """

    vertices: NDArray[np.float64]
    edges: NDArray[np.int64]
    submap: NDArray[np.int64]
    join: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles. vertices: (V, 3) metres. faces: (F, 3) vertex indices, counterclockwise seen from the free side.

    submap: (F,) the submap that each face belongs to.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    submap: NDArray[np.int64]

    def face_normals(self) -> NDArray[np.float64]:
        """Unit normals (F, 3); zero for a face without area."""
        return unit(area_vectors(self.vertices, self.faces))


@dataclass(frozen=True, slots=True)
class TrueSurface:
    """The exact surface of what was measured. vertices: (V, 3) metres. faces: (F, 3) vertex indices.

    seen: (N, 3) metres, where beams met it, free of noise; None where all of it counts as seen.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    seen: NDArray[np.float64] | None = None
