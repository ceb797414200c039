# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The experiments of the paper (section 4) done again with mode paper, beside the times that it gives.

Two cubes with twelve joined maps, the same with one single map of as many neurons, and the floor. Prints the table,
writes it to OUTPUT/paper.md and OUTPUT/paper.json, and draws what the paper's figures 4, 5 and 6 show.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import clouds
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from g2_recon import pictures, pipeline
from g2_recon.config import G2ReconConfig, ReconstructionConfig
from g2_recon.geometry.cloud import Cloud
from g2_recon.geometry.mesh import WireMesh
from g2_recon.reconstruction.reconstructor import reconstruct
from g2_recon.reconstruction.som import topographic_error
from g2_recon.recording.clouds import read_cloud
from g2_recon.recording.files import write_text
from g2_recon.recording.recordings import read_recording

ROOT = Path(__file__).resolve().parents[1]
BUNDLED = ROOT / "bags" / "first_floor"

PUBLISHED = ReconstructionConfig(mode="paper")
CUBES = PUBLISHED.model_copy(update={"clusters": 12})
# One map must span the gap, so parts of its one cluster may be as far apart as they like.
SINGLE = PUBLISHED.model_copy(update={"clusters": 1, "rows": 20, "columns": 30, "cluster_gap": 1000.0})
CUBES_IN_PAPER, SINGLE_IN_PAPER, FLOOR_IN_PAPER = "6 min", "30 min", "2 h"

HEADER = (
    "| experiment | clustering | lattice | clusters | neurons | joins | connected parts | quantization error | "
    "topographic error | time | time of all cores | paper |\n|---|---|---|---|---|---|---|---|---|---|---|---|"
)


@dataclass(frozen=True, slots=True)
class Result:
    """One experiment: what was done, what came out, how long it took; cpu_seconds: all threads together."""

    experiment: str
    clustering: str
    lattice: str
    points: int
    clusters: int
    neurons: int
    joins: int
    connected_parts: int
    quantization_error_m: float
    topographic_error: float
    seconds: float
    cpu_seconds: float
    paper: str

    def row(self) -> str:
        """One line of the table."""
        cells = [
            self.experiment,
            self.clustering,
            self.lattice,
            f"{self.clusters}",
            f"{self.neurons:,}",
            f"{self.joins:,}",
            f"{self.connected_parts}",
            f"{100 * self.quantization_error_m:.1f} cm",
            f"{100 * self.topographic_error:.1f} %",
            f"{self.seconds:.1f} s",
            f"{self.cpu_seconds:.1f} s",
            self.paper,
        ]
        return f"| {' | '.join(cells)} |"


def floor(file: Path | None) -> Cloud:
    """The cloud in a file, or that of the bundled recording."""
    if file is not None:
        return read_cloud(file)
    settings = G2ReconConfig()
    recording = read_recording(BUNDLED, settings.recording)
    trajectory = pipeline.localize(recording, settings.localization).trajectory
    return pipeline.register(recording, trajectory, settings.registration).cloud


def connected_parts(wire: WireMesh) -> int:
    """How many parts the graph of neurons falls into."""
    count = len(wire.vertices)
    graph = coo_array((np.ones(len(wire.edges)), wire.edges.T), shape=(count, count))
    return int(connected_components(graph, directed=False)[0])


def measure(
    experiment: str, cloud: Cloud, config: ReconstructionConfig, *, paper: str = "", repeat: int = 1
) -> tuple[Result, WireMesh]:
    """Reconstruct so many times; the times are those of the fastest."""
    fastest = (float("inf"), float("inf"))
    for _ in range(repeat):
        started = time.perf_counter(), time.process_time()
        result = reconstruct(cloud, config)
        fastest = min(fastest, (time.perf_counter() - started[0], time.process_time() - started[1]))
    wire = result.wire_mesh
    measured = Result(
        experiment=experiment,
        clustering=config.clustering if config.clusters > 1 else "none",
        lattice=f"{config.lattice} {config.rows} x {config.columns}",
        points=result.points,
        clusters=result.clusters,
        neurons=len(wire.vertices),
        joins=int(wire.join.sum()),
        connected_parts=connected_parts(wire),
        quantization_error_m=result.quantization_error,
        topographic_error=topographic_error(cloud.finite().points, wire.vertices, wire.edges),
        seconds=fastest[0],
        cpu_seconds=fastest[1],
        paper=paper,
    )
    print(measured.row(), flush=True)
    return measured, wire


def main() -> None:
    """Do the experiments one after the other."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cloud", type=Path, help="cloud of the floor; else that of the recording in bags/")
    parser.add_argument("--output", type=Path, default=ROOT / "out" / "paper", help="folder for the table")
    parser.add_argument("--pictures", type=Path, default=ROOT / "docs", help="folder for the pictures")
    options = parser.parse_args()

    cubes = clouds.two_cubes().cloud()
    for clustering in ("k_means", "neural_gas"):  # compiles the kernels
        reconstruct(cubes, CUBES.model_copy(update={"clustering": clustering, "passes": 100}))
    print(HEADER)
    results, wires = [], []
    for lattice, clustering in itertools.product(("rectangular", "hexagonal"), ("k_means", "neural_gas")):
        config = CUBES.model_copy(update={"clustering": clustering, "lattice": lattice})
        as_published = (lattice, clustering) == ("rectangular", "k_means")
        result, wire = measure("two cubes", cubes, config, paper=CUBES_IN_PAPER if as_published else "", repeat=3)
        results.append(result)
        wires.append(wire)
    single, single_wire = measure("two cubes, one map", cubes, SINGLE, paper=SINGLE_IN_PAPER)
    whole, floor_wire = measure("floor", floor(options.cloud), PUBLISHED, paper=FLOOR_IN_PAPER)
    results += [single, whole]

    write_text(options.output / "paper.md", "\n".join([HEADER, *(result.row() for result in results)]) + "\n")
    record = {"cores": os.cpu_count(), "results": [asdict(result) for result in results]}
    write_text(options.output / "paper.json", json.dumps(record, indent=2) + "\n")
    titles = [
        f"{name}: {result.connected_parts} connected {'parts' if result.connected_parts > 1 else 'part'}"
        for name, result in (("12 maps of 10 x 5, joined", results[0]), ("one map of 20 x 30", single))
    ]
    pictures.draw_wire_meshes(options.pictures / "two_cubes.png", [wires[0], single_wire], titles)
    title = f"{whole.clusters} maps of 10 x 5 neurons, {whole.joins:,} joins (red)"
    pictures.draw_wire_meshes(options.pictures / "paper_floor.png", [floor_wire], [title], elevation=50, height=6)


if __name__ == "__main__":
    main()
