# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The paper's two cubes (section 4, figures 5 and 6): twelve joined maps beside one single map of as many neurons.

Usage: python benchmarks/two_cubes.py [PICTURE]; the picture goes to docs/two_cubes.png unless told otherwise.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import clouds
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from g2_recon import pictures
from g2_recon.config import ReconstructionConfig
from g2_recon.geometry.mesh import WireMesh
from g2_recon.reconstruction.reconstructor import reconstruct

JOINED = ReconstructionConfig(mode="paper", clusters=12, rows=10, columns=5)
# One map must span the gap, so parts of its one cluster may be as far apart as they like.
SINGLE = ReconstructionConfig(mode="paper", clusters=1, rows=20, columns=30, cluster_gap=1000)


def connected_parts(wire: WireMesh) -> int:
    """How many parts the graph of neurons falls into."""
    count = len(wire.vertices)
    graph = coo_array((np.ones(len(wire.edges)), wire.edges.T), shape=(count, count))
    return int(connected_components(graph, directed=False)[0])


def main() -> None:
    """Reconstruct both ways, say what came out, draw it."""
    cloud = clouds.two_cubes().cloud()
    reconstruct(cloud, ReconstructionConfig(mode="paper", passes=1))  # compiles the kernels
    wires, titles = [], []
    for name, config in (("12 maps of 10 x 5, joined", JOINED), ("one map of 20 x 30", SINGLE)):
        started = time.perf_counter()
        result = reconstruct(cloud, config)
        seconds = time.perf_counter() - started
        parts = connected_parts(result.wire_mesh)
        wires.append(result.wire_mesh)
        titles.append(f"{name}: {parts} connected {'parts' if parts > 1 else 'part'}")
        print(
            f"{name}: {result.clusters} clusters, {parts} connected parts, {int(result.wire_mesh.join.sum())} joins, "
            f"quantization error {100 * result.quantization_error:.1f} cm, {seconds:.1f} s"
        )
    default = Path(__file__).resolve().parents[1] / "docs" / "two_cubes.png"
    pictures.draw_wire_meshes(sys.argv[1] if len(sys.argv) > 1 else default, wires, titles)


if __name__ == "__main__":
    main()
