# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""All tables of docs/benchmarks.md: how good, fast and large the meshes are, ours beside those of other programs.

Usage: python benchmarks/surface.py [--data FOLDER] [--only TABLE ...] [--clouds NAME ...] [--ours] [--quick]
       [--jobs N] [--out FOLDER] [--peers-python PYTHON]

Writes benchmarks.md, a JSON file a table and pictures to the folder. benchmarks.md is put together from all tables that
lie there, so that one can be made anew. Programs that are not installed are left out, and named.
"""

from __future__ import annotations

import argparse
import functools
import gzip
import io
import itertools
import logging
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import clouds
import numpy as np
import peers
import random_floors
import report
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import NDArray
from report import Row, Table
from scipy.spatial.transform import Rotation

from g2_recon import pictures
from g2_recon.config import ReconstructionConfig, RegistrationConfig, SimulationConfig
from g2_recon.evaluation.surface import sample_surface, score_surface, topology
from g2_recon.geometry.cloud import Cloud, concatenate
from g2_recon.geometry.mesh import Mesh, TrueSurface
from g2_recon.reconstruction.reconstructor import reconstruct
from g2_recon.recording.clouds import read_cloud
from g2_recon.registration.registrar import Registrar
from g2_recon.simulation.simulator import simulate

log = logging.getLogger("benchmarks")

SHARED = ("floor_rot", "floor_s3", "floor_out", "floor_drift", "cubes", "curved")
# Other spacings than 20 cm; the two clouds are of things of 1 m.
SPACINGS = {"cubes": 0.12, "curved": 0.12, "two cubes": 0.12, "sphere and torus": 0.12}
COPIES = (1, 2, 4, 8, 16)
SEEDS = range(10)
FLOORS = range(8)
TURNS = ((0, 0, 0), (90, 0, 0), (17, 33, 71), (-50, 10, 45), (120, -65, 200), (5, 5, 5))
"""Degrees about x, y and z."""

ACCURACY_NOTE = """\
acc: distance from the mesh to the true surface; comp: from the true surface, as far as it lies within 10 cm of a hit,
to the mesh; each mean / 95 % quantile in cm. P, R, F: precision, recall and their harmonic mean at 5 and 2 cm, in %.
normals: mean |cos| between normals, both ways. open: boundary edges (loops). bad: non-manifold edges + vertices.
cross: share of faces that cross others, in %, and MeshLab's count where pymeshlab is installed (it counts touching
faces, too). parts: connected components. s: wall time of a run after one on a few points; MB: peak memory of the whole
process."""


@dataclass(frozen=True, slots=True)
class Bench:
    """What all tables need. clouds: for table peers, empty for all. methods: those installed and asked for.

    jobs: how many meshes are made at once; with more than one, what a mesh costs is not said.
    """

    data: Path | None
    out: Path
    quick: bool
    jobs: int
    clouds: tuple[str, ...]
    peers_python: str
    methods: tuple[peers.Method, ...]
    has_meshlab: bool
    scratch: Path

    def shared(self, *parts: str) -> Path | None:
        """A file or folder of --data; None where there is none."""
        path = self.data.joinpath(*parts) if self.data else None
        return path if path and path.exists() else None

    @property
    def workers(self) -> int:
        """Threads for one mesh, 0 for one a core."""
        return 1 if self.jobs > 1 else 0

    def settings(self, *, spacing: float = 0.2, seed: int = 0) -> ReconstructionConfig:
        """Ours at the defaults."""
        return ReconstructionConfig(spacing=spacing, seed=seed, workers=self.workers)

    def each(self, function: Callable[..., Any], cases: Iterable[tuple[Any, ...]], *, table: str) -> list[Any]:
        """What a function makes of this and each case, in their order, as many at once as jobs."""
        function = functools.partial(function, self)
        return report.each(function, cases, jobs=self.jobs, table=self.out / f"{table}.json")

    def mesh_of(
        self, method: peers.Method, cloud: Cloud, *, spacing: float = 0.2, repeats: int = 1
    ) -> tuple[NDArray[np.float64], NDArray[np.int64], dict[str, Any]]:
        """Vertices, faces, and seconds and memory of a method in a process of its own."""
        python = sys.executable if method.name == peers.OURS else self.peers_python
        with tempfile.TemporaryDirectory(dir=self.scratch) as folder:
            points, mesh = Path(folder, "cloud.npz"), Path(folder, "mesh.npz")
            np.savez(points, points=cloud.points, **({} if cloud.sensor is None else {"sensor": cloud.sensor}))
            cost = peers.call(python, method.name, points, mesh, "--spacing", spacing, "--repeats", repeats)
            made = np.load(mesh)
            return made["vertices"].astype(float), made["faces"].astype(np.int64), cost

    def crossings(self, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> str:
        """MeshLab's count of faces that cross others, in parentheses; nothing where it is not installed."""
        if not self.has_meshlab:
            return ""
        with tempfile.NamedTemporaryFile(dir=self.scratch, suffix=".npz") as mesh:
            np.savez(mesh.name, vertices=vertices, faces=faces)
            return f" ({peers.call(self.peers_python, 'crossings', mesh.name, mesh.name)['crossings']:,})"


def truth_of(scanned: clouds.Scanned) -> TrueSurface:
    """What a mesh of a cloud is measured against."""
    return TrueSurface(scanned.vertices, scanned.faces, scanned.clean if len(scanned.clean) else None)


def load(path: Path) -> clouds.Scanned:
    """A cloud with its truth from an NPZ file of the layout of benchmarks/clouds.py."""
    data = np.load(path)
    return clouds.Scanned(
        data["points"].astype(float),
        data["sensor"].astype(float) if "sensor" in data else None,
        data["clean"].astype(float) if "clean" in data else np.empty((0, 3)),
        data["truth_vertices"].astype(float),
        data["truth_faces"].astype(np.int64),
    )


def figures(bench: Bench, scanned: clouds.Scanned, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> Row:
    """The columns about a mesh."""
    score = score_surface(truth_of(scanned), vertices, faces, workers=bench.workers)
    at_5, at_2 = score.at
    return {
        "faces": f"{len(faces):,}",
        "acc": f"{100 * score.accuracy:.2f} / {100 * score.accuracy_95:.2f}",
        "comp": f"{100 * score.completeness:.2f} / {100 * score.completeness_95:.2f}",
        "P5 / R5": f"{100 * at_5.precision:.1f} / {100 * at_5.recall:.1f}",
        "F5": f"{100 * at_5.f_score:.1f}",
        "F2": f"{100 * at_2.f_score:.1f}",
        "normals": f"{score.normals:.3f}",
    } | soundness(bench, vertices, faces)


def soundness(bench: Bench, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> Row:
    """The columns about how the faces of a mesh hang together."""
    found = topology(vertices, faces)
    return {
        "open": f"{found.boundary_edges:,} ({found.loops:,})",
        "bad": f"{found.nonmanifold_edges:,} + {found.nonmanifold_vertices:,}",
        "cross": f"{100 * found.self_intersecting:.2f}{bench.crossings(vertices, faces)}",
        "parts": f"{found.components:,}",
    }


def cost_of(cost: dict[str, Any]) -> Row:
    """The columns about time and memory."""
    return {"s": f"{cost['seconds']:.1f}", "MB": f"{cost['peak_mb']:.0f}"}


def generated() -> dict[str, Callable[[], clouds.Scanned]]:
    """The clouds that are made here."""
    buildings = {name: functools.partial(clouds.make, name) for name in clouds.BUILDINGS}
    return buildings | {"two cubes": clouds.two_cubes, "sphere and torus": clouds.solids}


def shared(bench: Bench, names: Sequence[str] = SHARED) -> dict[str, Callable[[], clouds.Scanned]]:
    """The clouds in --data."""
    paths = {name: bench.shared("surfaces", f"{name}.npz") for name in names}
    return {name: functools.partial(load, path) for name, path in paths.items() if path}


def sources_of(bench: Bench) -> dict[str, Callable[[], clouds.Scanned]]:
    """The clouds in --data and those that are made here."""
    return shared(bench) | generated()


def ours() -> peers.Method:
    """The method that is g2_recon."""
    return peers.METHODS[peers.OURS]


def table_peers(bench: Bench) -> Table:
    """Ours beside other programs on all clouds."""
    names = ("offices_half", "two cubes") if bench.quick else tuple(sources_of(bench))
    names = tuple(name for name in names if not bench.clouds or name in bench.clouds)
    cases = [(name, method.name) for name in names for method in bench.methods]
    sections: dict[str, list[Row]] = {}
    for (name, _), (points, row) in zip(cases, bench.each(_beside, cases, table="peers"), strict=True):
        sections.setdefault(f"{name}: {points:,} points", []).append(row)
    left_out = [name for name, method in peers.METHODS.items() if method not in bench.methods]
    note = f"{ACCURACY_NOTE} g2_recon at its defaults, but a spacing of 12 cm for clouds of things of 1 m."
    if left_out:
        note += f"\n\nNot installed here, or left out: {'; '.join(left_out)}."
    return Table("Beside other programs", note, sections)


def _beside(bench: Bench, name: str, method: str) -> tuple[int, Row]:
    """The number of points of a cloud, and the row of a method."""
    scanned = clouds.make(name) if name.startswith("offices_") else sources_of(bench)[name]()
    spacing = SPACINGS.get(name, 0.2)
    try:
        repeats = 3 if method == peers.OURS and bench.jobs == 1 else 1
        vertices, faces, cost = bench.mesh_of(peers.METHODS[method], scanned.cloud(), spacing=spacing, repeats=repeats)
        row = ({} if bench.jobs > 1 else cost_of(cost)) | figures(bench, scanned, vertices, faces)
    except RuntimeError as error:
        row = {"s": f"failed: {error}"}
    return len(scanned.points), {"method": method} | row


def table_robustness(bench: Bench) -> Table:
    """Ours on other noise, sampling and poses."""
    variants = ("s3", "out") if bench.quick else ("", *clouds.VARIANTS)
    buildings = ("offices",) if bench.quick else ("offices", "hall", "corridor")
    cases = [(f"{building}_{variant}" if variant else building,) for building in buildings for variant in variants]
    sections: dict[str, list[Row]] = {}
    for (name,), row in zip(cases, bench.each(_of_name, cases, table="robustness"), strict=True):
        sections.setdefault(name.split("_")[0], []).append({"cloud": name} | row)
    note = (
        "Names as in `benchmarks/clouds.py`: s05, s2, s3: noise of 0.5, 2, 3 cm instead of 1 cm; out: 1 % of the beams "
        "cut short by something in the air, and mixed pixels; drift: poses up to 5 cm and 0.5 deg off; half, double: a "
        "scan each 13 or 3.25 cm; fine: a beam each 0.5 deg; round: two lasers back to back at 1.2 m, so that the "
        "floor is seen; level: not rotated; nosensor: without sensor positions. Columns as above."
    )
    return Table("Noise, sampling, poses", note, sections)


def _of_name(bench: Bench, name: str) -> Row:
    return _at_defaults(bench, clouds.make(name))


def _at_defaults(bench: Bench, scanned: clouds.Scanned) -> Row:
    """Number of points, and the columns about our mesh."""
    mesh = reconstruct(scanned.cloud(), bench.settings()).mesh
    return {"points": f"{len(scanned.points):,}"} | figures(bench, scanned, mesh.vertices, mesh.faces)


def table_buildings(bench: Bench) -> Table:
    """Ours in other buildings."""
    kinds = {
        "Buildings of several kinds": [*clouds.BUILDINGS, "simulated"],
        "Floors at random": [f"floor {seed}" for seed in FLOORS],
    }
    cases = [(name,) for names in kinds.values() for name in names[: 1 if bench.quick else None]]
    rows = dict(zip((name for (name,) in cases), bench.each(_of_building, cases, table="buildings"), strict=True))
    sections = {
        title: [{"building": name} | rows[name] for name in names if name in rows] for title, names in kinds.items()
    }
    note = (
        "Of `benchmarks/clouds.py`: offices, with walls of 10 cm seen from both faces, niches, columns, furniture; "
        "hall, 4 m high, with columns, beams, a gallery; corridor, with steps, a duct, a parapet; slanted, with walls "
        "at odd angles under pitched roofs; vaulted, with round arches, columns and a dome. simulated: what `g2-recon "
        "simulate` drives through, laid together by the true trajectory. Floors at random: "
        "`benchmarks/random_floors.py`; six rooms, each another size and height. All at the defaults and a noise of "
        "1 cm. Columns as above."
    )
    return Table("Other buildings", note, sections)


def _of_building(bench: Bench, name: str) -> Row:
    if name == "simulated":
        return _at_defaults(bench, simulated())
    kind, *seed = name.split()
    return _at_defaults(bench, random_floors.make(int(seed[0])) if seed else clouds.make(kind))


def simulated() -> clouds.Scanned:
    """The vertical scans of the simulated robot where they truly were."""
    simulation = simulate(SimulationConfig())
    recording, truth = simulation.recording, simulation.trajectory
    registrar = Registrar(RegistrationConfig(), recording.T_base_laser_vertical)
    for scan in recording.scans_vertical:
        nearby = np.abs(truth.stamps - scan.stamp) < 0.1
        for stamp, T_map_base in zip(truth.stamps[nearby], truth.matrices()[nearby], strict=True):
            registrar.add_pose(stamp, T_map_base)
        registrar.add_scan(scan)
    cloud = concatenate([registered.cloud for registered in registrar.take()])
    return clouds.Scanned(cloud.points, cloud.sensor, simulation.clean_vertical, simulation.vertices, simulation.faces)


_STEADY = ("F5", "F2", "acc", "comp", "normals", "faces", "loops", "cross")


def table_steadiness(bench: Bench) -> Table:
    """Ours with other seeds, on turned and on shuffled clouds."""
    names = [*shared(bench, ("floor_rot",)), *(("offices_half",) if bench.quick else ("offices", "hall"))]
    variants: dict[str, Sequence[Any]] = {
        "seeds": SEEDS[:3] if bench.quick else SEEDS,
        "rotations": TURNS[:2] if bench.quick else TURNS,
        "orders of points": range(2 if bench.quick else 4),
    }
    cases = [(name, kind, which) for name in names for kind, all_of in variants.items() for which in all_of]
    results = bench.each(_steady, cases, table="steadiness")
    sections: dict[str, list[Row]] = {}
    for name, (kind, all_of) in itertools.product(names, variants.items()):
        numbers = np.array([of for case, of in zip(cases, results, strict=True) if case[:2] == (name, kind)])
        # More is better for F-scores and normals, less for the others.
        more = np.array([column in ("F5", "F2", "normals") for column in _STEADY])
        for what, values in (
            ("mean", numbers.mean(axis=0)),
            ("worst", np.where(more, numbers.min(axis=0), numbers.max(axis=0))),
            ("largest - smallest", np.ptp(numbers, axis=0)),
        ):
            shown = {c: f"{v:.4g}" if c != "faces" else f"{v:.0f}" for c, v in zip(_STEADY, values, strict=True)}
            sections.setdefault(name, []).append({"of": f"{len(all_of)} {kind}", "": what} | shown)
    note = "acc and comp: means in cm; cross: share of faces in %, as counted here; the rest as above."
    return Table("Seeds, rotations, order of points", note, sections)


def _steady(bench: Bench, name: str, kind: str, which: Any) -> list[float]:
    """The figures of _STEADY for a seed, a rotation or an order of points."""
    scanned = (shared(bench, (name,)) or {name: functools.partial(clouds.make, name)})[name]()
    if kind == "rotations":
        scanned = turned(scanned, which)
    elif kind == "orders of points":
        scanned = shuffled(scanned, which)
    mesh = reconstruct(scanned.cloud(), bench.settings(seed=which if kind == "seeds" else 0)).mesh
    score = score_surface(truth_of(scanned), mesh.vertices, mesh.faces, workers=bench.workers)
    return [
        *(100 * at.f_score for at in score.at),
        100 * score.accuracy,
        100 * score.completeness,
        score.normals,
        score.topology.faces,
        score.topology.loops,
        100 * score.topology.self_intersecting,
    ]


def turned(scanned: clouds.Scanned, degrees: tuple[float, float, float]) -> clouds.Scanned:
    """A cloud and its truth, rotated."""
    turn = Rotation.from_euler("xyz", degrees, degrees=True).apply
    sensor = None if scanned.sensor is None else turn(scanned.sensor)
    clean = turn(scanned.clean) if len(scanned.clean) else scanned.clean
    return clouds.Scanned(turn(scanned.points), sensor, clean, turn(scanned.vertices), scanned.faces)


def shuffled(scanned: clouds.Scanned, seed: int) -> clouds.Scanned:
    """The same points in another order."""
    order = np.random.default_rng(seed).permutation(len(scanned.points))
    sensor = None if scanned.sensor is None else scanned.sensor[order]
    return clouds.Scanned(scanned.points[order], sensor, scanned.clean, scanned.vertices, scanned.faces)


def table_fine(bench: Bench) -> Table:
    """Small things, at a spacing of 12 cm."""
    cases = [(name,) for name in SPACINGS if name in sources_of(bench)]
    rows = [{"cloud": name} | row for (name,), row in zip(cases, bench.each(_fine, cases, table="fine"), strict=True)]
    return Table("Cubes and curved solids, spacing 12 cm", "Columns as above.", {"": rows})


def _fine(bench: Bench, name: str) -> Row:
    scanned = sources_of(bench)[name]()
    vertices, faces, cost = bench.mesh_of(ours(), scanned.cloud(), spacing=SPACINGS[name], repeats=3)
    return ({} if bench.jobs > 1 else cost_of(cost)) | figures(bench, scanned, vertices, faces)


def table_growth(bench: Bench) -> Table:
    """Time and memory over the number of points."""
    path = bench.shared("surfaces", "floor_rot.npz")
    base = load(path).cloud() if path else clouds.make("offices").cloud()
    rows, counts, seconds, peaks = [], [], [], []
    for copies in COPIES[:2] if bench.quick else COPIES:
        log.info("growth: x %d", copies)
        _, faces, cost = bench.mesh_of(ours(), clouds.tiled(base, copies), repeats=2 if copies < 8 else 1)
        counts.append(cost["points"])
        seconds.append(cost["seconds"])
        peaks.append(cost["peak_mb"])
        rows.append(
            {
                "copies": copies,
                "points": f"{cost['points']:,}",
                **cost_of(cost),
                "CPU s": f"{cost['cpu_seconds']:.1f}",
                "us a point": f"{1e6 * cost['seconds'] / cost['points']:.1f}",
                "faces": f"{len(faces):,}",
            }
        )
    exponents = [float(np.polyfit(np.log(counts), np.log(values), 1)[0]) for values in (seconds, peaks)]
    draw_growth(bench.out / "growth.png", counts, seconds, peaks)
    note = (
        f"{'floor_rot' if path else 'offices'}, copied side by side 1 m apart. Over the number of points, time grows "
        f"with exponent {exponents[0]:.2f} and peak memory, that of the program itself included, with "
        f"{exponents[1]:.2f}; 1 is proportional."
    )
    return Table("Growth", note, {"": rows}, ["growth.png"])


def draw_growth(path: Path, counts: Sequence[int], seconds: Sequence[float], peaks: Sequence[float]) -> None:
    """Time and memory over points, both logarithmic, with what grows as the points do."""
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    for number, (values, unit, limit) in enumerate(((seconds, "s", 20), (peaks, "MB", 3000)), start=1):
        axes = figure.add_subplot(1, 2, number)
        axes.loglog(counts, values, "o-", label="measured")
        axes.loglog(counts, [values[0] * count / counts[0] for count in counts], "--", label="as the points grow")
        axes.axhline(limit, color="tab:red", lw=0.8, label=f"{limit} {unit}")
        axes.set(xlabel="thousand points", ylabel="time [s]" if unit == "s" else "peak memory [MB]")
        axes.set_xticks(counts, [f"{count / 1000:.0f}" for count in counts])
        axes.set_xticks([], minor=True)
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(path, dpi=100)


def table_files(bench: Bench) -> Table:
    """Meshes of others, sampled with noise, and real scans of a room."""
    meshes = {name: bench.shared("meshes", f"{name}.obj.gz") for name in ("stanford-bunny", "fandisk", "rocker-arm")}
    scans = {name: bench.shared("sweeps", "pcl_room", f"{name}.pcd") for name in ("room_scan1", "room_scan2")}
    cases = [(path,) for path in (*meshes.values(), *scans.values()) if path]
    if not cases:
        return Table("Meshes and scans from files", "Not made: this needs --data.", {})
    with tempfile.TemporaryDirectory(dir=bench.scratch) as folder:
        made = functools.partial(_of_file, folder=Path(folder))
        rows = dict(zip((path for (path,) in cases), bench.each(made, cases, table="files"), strict=True))
        drawn = {name: path for name, path in (meshes | scans).items() if path}
        found = [Mesh(**np.load(Path(folder) / f"{path.name}.npz")) for path in drawn.values()]
    pictures.draw_meshes(bench.out / "files.png", found, list(drawn))
    note = (
        "Meshes scaled to a diagonal of 10 m, sampled evenly with normal noise of 1 cm (0.1 %), without sensor "
        "positions, at a spacing of 10 cm; then two real scans of a room, at the defaults. Columns as above; of the "
        "room no truth is known. The bunny is from the Stanford 3D Scanning Repository, the room from the Point Cloud "
        "Library."
    )
    sections = {
        "Sampled meshes": [{"mesh": name} | rows[path] for name, path in meshes.items() if path],
        "Room": [{"scan": name} | rows[path] for name, path in scans.items() if path],
    }
    return Table("Meshes and scans from files", note, sections, ["files.png"])


def _of_file(bench: Bench, path: Path, *, folder: Path) -> Row:
    """The columns about our mesh of a packed mesh or of a scan; the mesh itself goes to a folder."""
    if path.suffix == ".gz":
        scanned = sampled(path, count=100_000)
        mesh = reconstruct(scanned.cloud(), bench.settings(spacing=0.1)).mesh
        row = {"points": f"{len(scanned.points):,}"} | figures(bench, scanned, mesh.vertices, mesh.faces)
    else:
        cloud = read_cloud(path)
        result = reconstruct(cloud, bench.settings())
        mesh = result.mesh
        row = {"points": f"{len(cloud):,}", "of them used": f"{result.points:,}", "faces": f"{len(mesh.faces):,}"}
        row |= soundness(bench, mesh.vertices, mesh.faces)
    np.savez(folder / f"{path.name}.npz", vertices=mesh.vertices, faces=mesh.faces, submap=mesh.submap)
    return row


def sampled(path: Path, count: int) -> clouds.Scanned:
    """Points evenly on a mesh in a packed OBJ file, made 10 m large, with 1 cm of noise."""
    import trimesh

    mesh = trimesh.load(io.BytesIO(gzip.decompress(path.read_bytes())), file_type="obj", process=False, force="mesh")
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    vertices = vertices * 10 / np.linalg.norm(np.ptp(vertices, axis=0))
    clean, _ = sample_surface(vertices, faces, count, 0)
    noise = np.random.default_rng(0).normal(0, 0.01, clean.shape)
    return clouds.Scanned(clean + noise, None, clean, vertices, faces)


TABLES: dict[str, Callable[[Bench], Table]] = {
    "peers": table_peers,
    "buildings": table_buildings,
    "robustness": table_robustness,
    "steadiness": table_steadiness,
    "fine": table_fine,
    "growth": table_growth,
    "files": table_files,
}


def page(out: Path) -> str:
    """All tables that are in a folder, as one page."""
    names = ", ".join(TABLES)
    head = f"""\
# Benchmarks of the surfaces

Made by

    python benchmarks/surface.py --data FOLDER

which takes about an hour. `--only TABLE` makes one of {names} anew;
`--quick` shows in a few minutes that all of it runs, `--jobs N` makes N meshes at once, of which it does not say time
and memory, and `--ours` leaves the other programs out. The result is in `out/benchmarks/`; this page and its pictures
are copied from there.
`pip install open3d pymeshlab` brings the other programs; where they have an environment of their own, `--peers-python`
names its Python. FOLDER holds `surfaces/` with clouds and their truth (NPZ, as `benchmarks/clouds.py` writes them),
`meshes/` and `sweeps/pcl_room/`; without `--data` only the clouds are used that `benchmarks/clouds.py` makes: buildings
that are known exactly, scanned by an upright LMS200 that drives through them.
"""
    return report.page(head, [out / f"{name}.json" for name in TABLES])


def main() -> None:
    """Make the tables that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with clouds, meshes and scans that are not in the repository")
    parser.add_argument(
        "--only", nargs="+", choices=TABLES, default=list(TABLES), metavar="TABLE", help=", ".join(TABLES)
    )
    parser.add_argument("--quick", action="store_true", help="few and small clouds, to see that it runs")
    parser.add_argument("--clouds", nargs="+", default=(), metavar="NAME", help="table peers of these clouds only")
    parser.add_argument("--ours", action="store_true", help="table peers with our rows only")
    parser.add_argument("--jobs", type=int, default=1, help="so many meshes at once; time and memory are not told then")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    parser.add_argument("--peers-python", default=sys.executable, help="the Python that has open3d and pymeshlab")
    given = parser.parse_args()
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    log.setLevel(logging.INFO)
    given.out.mkdir(parents=True, exist_ok=True)
    installed = peers.call(given.peers_python, "installed") | {"g2_recon": True}
    with tempfile.TemporaryDirectory() as scratch:
        bench = Bench(
            data=given.data,
            out=given.out,
            quick=given.quick,
            jobs=given.jobs,
            clouds=tuple(given.clouds),
            peers_python=given.peers_python,
            methods=(ours(),) if given.ours else tuple(m for m in peers.METHODS.values() if installed[m.needs]),
            has_meshlab=installed["pymeshlab"],
            scratch=Path(scratch),
        )
        for name in given.only:
            report.save(given.out / f"{name}.json", TABLES[name](bench))
            (given.out / "benchmarks.md").write_text(page(given.out))
    log.info("%s", given.out / "benchmarks.md")


if __name__ == "__main__":
    main()
