# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What a reconstruction gives."""

from __future__ import annotations

from dataclasses import dataclass

from g2_recon.geometry.mesh import Mesh, WireMesh


@dataclass(frozen=True, slots=True)
class Reconstruction:
    """The result: the wire mesh, the triangles, and counts.

    points: how many points were used. left_out: how many were not, by reason. clusters: how many, each with its submap.
    quantization_error: m, mean distance of a point to its best matching unit.
    """

    wire_mesh: WireMesh
    mesh: Mesh
    points: int
    left_out: dict[str, int]
    clusters: int
    quantization_error: float
