# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Several robots, one map: logs cut into robots that know nothing of each other, and simulated robots on one floor.

    python benchmarks/collaboration.py --data FOLDER --jobs 16

What `python benchmarks/merger_cost.py` measured goes to the same page. FOLDER is that of benchmarks/localization.py;
without it the logs are left out. The page goes to out/benchmarks/collaboration_benchmarks.md, and beside it, as JSON,
each table and the scores of all alignments. All are written anew with each piece of work that is done, so that nothing
is lost where time runs out. `--only` without a table puts the page together from what lies there.
"""

from __future__ import annotations

import argparse
import itertools
import logging
import math
import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import Any

import clouds
import numpy as np
import report
from numpy.typing import NDArray
from random_floors import random_floor
from report import Row, Table

from g2_recon import joint_pipeline, pipeline
from g2_recon.collaboration.alignment import Alignment, align, fitted
from g2_recon.collaboration.map_merger import JointMap, merge
from g2_recon.config import G2ReconConfig, LocalizationConfig, ReconstructionConfig, SimulationConfig
from g2_recon.evaluation.relations import read_relations, score_relations
from g2_recon.evaluation.surface import score_surface
from g2_recon.geometry import se2, se3
from g2_recon.geometry.mesh import TrueSurface
from g2_recon.geometry.recording import Recording
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.session import Session
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.localization.localizer import Localizer
from g2_recon.recording.recordings import read_recording
from g2_recon.simulation.simulator import Simulation, simulate

Float = NDArray[np.float64]

log = logging.getLogger("collaboration")

LOGS_NOTE = """\
Relations of Kuemmerle et al., 2009: of scans of the same robot (within), and of different ones (between). Intel is cut
into three by time; of ACES the second half is played backwards. Each robot is mapped by itself; where it started is
not known. claimed: robots whose place was found; agreement: the least of theirs."""
SIMULATED_NOTE = """\
Robots that each drive through a part of the simulated floor, 45 % of its tour from anywhere on, with noise of their
own. right: of the alignments that are claimed, those within 5 cm, at the middle of the robot's way, and 0.5 deg;
agreement: the least of those that are claimed; mean: of all keyframes from the truth, after the best rigid motion of
all."""
STRANGERS_NOTE = "Maps of different buildings, each looked for in the other; none may be found."
FLOORS_NOTE = """\
Maps of the floors at random of benchmarks/random_floors.py, six rooms each, that a robot drove through; each pair is
looked for in each other, and none may be found. agreement: the highest that any pair reached; 0.87 are needed, 0.94
where only one part of the map speaks for a place. parts: of the map, that speak for the best place."""
MESHES_NOTE = """\
The same robots, with vertical scans, to one mesh (`g2-recon run` of four recordings). F5: F-score at 5 cm, of the
surfaces that were seen, after the rigid motion that lays the keyframes on the truth. Robots that are not in the map
are not in the mesh."""
# A laser at this height, scans so far apart, with this noise and that of its wheels.
FLOOR_HEIGHT_M, FLOOR_STEP_M, FLOOR_NOISE_M, FLOOR_WHEELS = 0.35, 0.1, 0.01, 0.01
ROBOTS, WINDOW = 4, 0.45
TABLES = ("logs", "simulated", "meshes", "strangers", "floors")
NEAR_M, NEAR_DEG = 0.05, 0.5
# So many of the pairs of floors are on the page.
SHOWN_PAIRS = 5
LOGS = {"intel": (3, False), "aces": (2, True)}

Made = Iterator[tuple[str, Table]]
"""Tables as far as they are done, each with the name of its file: anew with each piece of work."""


@dataclass(frozen=True, slots=True)
class Robot:
    """A localizer that has seen the recording of a robot, and the true stamps (N,) of its scans."""

    localizer: Localizer
    stamps: Float

    @property
    def session(self) -> Session:
        """Its map."""
        return self.localizer.session()


def mapped(recording: Recording, stamps: Float | None = None) -> Robot:
    """A robot that has mapped a recording by itself."""
    localizer = pipeline.map_recording(recording, LocalizationConfig()).localizer
    assert isinstance(localizer, Localizer)
    return Robot(localizer, np.array([scan.stamp for scan in recording.scans]) if stamps is None else stamps)


def part(recording: Recording, rows: slice) -> Recording:
    """Some of the horizontal scans of a recording, with their odometry."""
    odometry = pipeline.odometry_at_scans(recording)[rows]
    return replace(recording, scans=recording.scans[rows], scan_odometry=odometry)


def backwards(recording: Recording) -> Recording:
    """The last scan first, as if the robot had driven so."""
    odometry = pipeline.odometry_at_scans(recording)
    stamps = [scan.stamp for scan in recording.scans]
    scans = [replace(scan, stamp=min(stamps) + max(stamps) - scan.stamp) for scan in reversed(recording.scans)]
    return replace(recording, scans=scans, scan_odometry=odometry[::-1])


def cut(recording: Recording, count: int, *, last_backwards: bool) -> dict[str, Robot]:
    """Robots that each have a part of a recording, one after the other in time."""
    bounds = np.linspace(0, len(recording.scans), count + 1).round().astype(int)
    robots = {}
    for number, (begin, end) in enumerate(itertools.pairwise(bounds)):
        piece = part(recording, slice(begin, end))
        stamps = np.array([scan.stamp for scan in piece.scans])
        if last_backwards and number == count - 1:
            robots[f"robot{number}"] = mapped(backwards(piece), stamps[::-1])
        else:
            robots[f"robot{number}"] = mapped(piece, stamps)
    return robots


def done(pool: Executor, title: str, make: Callable[..., Any], given: Sequence[tuple]) -> Iterator[list[Any]]:
    """What is made of each of the given arguments, in their order, as far as it is there: with each that is done."""
    futures = {pool.submit(make, *arguments): number for number, arguments in enumerate(given)}
    results: dict[int, Any] = {}
    for future in as_completed(futures):
        number = futures[future]
        try:
            results[number] = future.result()
        except Exception:
            # The others count all the same, and what lacks is missed in the table.
            log.exception("%s %s", title, given[number])
            continue
        log.info("%s: %d of %d", title, len(results), len(given))
        yield [results[number] for number in sorted(results)]


def scores_of(alignment: Alignment) -> Row:
    """What speaks for an alignment and against it."""
    sigma = math.sqrt(np.linalg.eigvalsh(alignment.covariance[:2, :2])[1]) if alignment.way else math.inf
    return {
        "state": alignment.state,
        "agreement": f"{alignment.agreement:.3f}",
        "way in common, m": f"{alignment.way:.1f}",
        "parts": len(alignment.keyframes),
        "sigma, m": f"{sigma:.3f}",
        "reason": alignment.reason,
    }


def scores_of_map(merged: JointMap) -> list[Row]:
    """The scores of all robots but that where the world is."""
    first = next(iter(merged.rows))
    return [{"robot": name} | scores_of(one) for name, one in sorted(merged.alignments.items()) if name != first]


def least_agreement(scores: list[Row]) -> str:
    """Of the robots whose place was found."""
    return min((row["agreement"] for row in scores if row["state"] == "aligned"), default="")


def tables_logs(pool: Executor, data: Path) -> Made:
    """Logs that are cut into robots, and the robots of each looked for in the other."""
    made: list[tuple[Row, list[Row], dict[str, Session]]] = []
    for made in done(pool, "logs", log_row, [(name, data) for name in LOGS]):
        yield "logs", Table("Logs cut into robots", LOGS_NOTE, {"": [row for row, _, _ in made]})
        yield "logs_scores", Table("Logs", "", {"": [score for _, scores, _ in made for score in scores]})
    sessions = {row["log"]: robots for row, _, robots in made}
    given = [
        (f"{one} {robot}", f"{other} {robot}", sessions[one][robot], sessions[other][robot])
        for one, other in itertools.permutations(sessions, 2)
        for robot in ("robot0", "robot1")
    ]
    for rows in done(pool, "strangers", strangers_row, given):
        yield "strangers", Table("Different buildings", STRANGERS_NOTE, {"": rows})


def log_row(name: str, data: Path) -> tuple[Row, list[Row], dict[str, Session]]:
    """A log cut into robots; its row, the scores of the robots, and their maps."""
    count, turned = LOGS[name]
    recording = read_recording(next(data.glob(f"carmen/{name}*.clf*")))
    robots = cut(recording, count, last_backwards=turned)
    sessions = {robot: one.session for robot, one in robots.items()}
    began = time.perf_counter()
    merged = merge(sessions)
    seconds = time.perf_counter() - began
    scores = [{"log": name} | row for row in scores_of_map(merged)]
    row = (
        {"log": name, "robots": count, "claimed": len(merged.rows), "agreement": least_agreement(scores)}
        | relations_of(read_relations(next(data.glob(f"relations/{name}.relations"))), robots, merged)
        | {"loops between": loops_between(merged), "s to merge": f"{seconds:.1f}"}
    )
    return row, scores, sessions


def strangers_row(one: str, other: str, fixed: Session, moving: Session) -> Row:
    """A robot looked for in the map of another building."""
    return {"map": one, "looked for": other} | scores_of(align(fixed, moving))


def relations_of(relations: Float, robots: dict[str, Robot], merged: JointMap) -> Row:
    """The errors in relations within and between robots that are in the map."""
    stamps, poses, owners = [], [], []
    for number, name in enumerate(merged.rows):
        robots[name].localizer.move_keyframes(merged.poses(name))
        stamps.append(robots[name].stamps)
        poses.append(robots[name].localizer.trajectory().planar())
        owners.append(np.full(len(stamps[-1]), number))
    order = np.argsort(np.concatenate(stamps), kind="stable")
    sorted_stamps, owner = np.concatenate(stamps)[order], np.concatenate(owners)[order]
    trajectory = Trajectory.from_se2(sorted_stamps, np.concatenate(poses)[order])
    first, second = (owner[nearest(sorted_stamps, relations[:, column])] for column in (0, 1))
    row: Row = {}
    for title, chosen in (("within", first == second), ("between", first != second)):
        score = score_relations(relations[chosen], trajectory)
        row[f"{title}, m"] = f"{score.translation_mean:.4f} +- {score.translation_std:.4f}"
        row[f"{title}, deg"] = f"{score.rotation_mean:.3f}"
        row[f"relations {title}"] = int(chosen.sum())
    return row


def nearest(stamps: Float, wanted: Float) -> NDArray[np.int64]:
    """Index (M,) of the sorted stamp (N,) that is nearest to each wanted one (M,)."""
    right = np.clip(np.searchsorted(stamps, wanted), 1, len(stamps) - 1)
    return right - (wanted - stamps[right - 1] < stamps[right] - wanted)


def loops_between(merged: JointMap) -> int:
    """How many loops tie different robots to each other."""
    begins = np.array([rows.start for rows in merged.rows.values()])
    owner = np.searchsorted(begins, merged.session.local_maps, side="right")
    return int((owner[merged.session.loops[:, 0]] != owner[merged.session.loops[:, 1]]).sum())


def tables_simulated(pool: Executor, seeds: int) -> Made:
    """Simulated robots on one floor, seed by seed."""
    for made in done(pool, "simulated", simulated_row, [(seed,) for seed in range(seeds)]):
        yield "simulated", Table("Simulated robots", SIMULATED_NOTE, {"": [row for row, _ in made]})
        yield "simulated_scores", Table("Simulated", "", {"": [score for _, scores in made for score in scores]})


def simulated_row(seed: int) -> tuple[Row, list[Row]]:
    """Simulated robots on one floor; their row, and the scores of each."""
    drives = drives_of(seed)
    sessions = {name: mapped(simulation.recording).session for name, simulation in drives.items()}
    began = time.perf_counter()
    merged = merge(sessions)
    seconds = time.perf_counter() - began
    scores = [{"seed": seed} | row for row in scores_of_map(merged)]
    row = {"seed": seed} | placed_of(merged, drives) | {"agreement": least_agreement(scores)}
    return row | {"s to merge": f"{seconds:.1f}"}, scores


def drives_of(seed: int, *, vertical_every: int = 1000) -> dict[str, Simulation]:
    """Robots that each drive through a part of the floor."""
    rng = np.random.default_rng(seed)
    begins = {f"robot{k}": rng.uniform(0, 1 - WINDOW) for k in range(ROBOTS)}
    return {
        name: drive(1000 * seed + k, begin, vertical_every=vertical_every)
        for k, (name, begin) in enumerate(begins.items())
    }


def drive(seed: int, begin: float, *, vertical_every: int = 1000) -> Simulation:
    """A part of the tour of the simulated robot, from this share of it on, with one vertical scan in so many."""
    simulation = simulate(SimulationConfig(seed=seed, horizontal_every=12, vertical_every=vertical_every))
    count = len(simulation.recording.scans)
    rows = slice(int(begin * count), int((begin + WINDOW) * count))
    return replace(simulation, recording=part(simulation.recording, rows))


def placed_of(merged: JointMap, drives: dict[str, Simulation]) -> Row:
    """How many robots are in the map, and whether they are where they belong."""
    truths = {name: true_poses(merged.session.stamps[rows], drives[name]) for name, rows in merged.rows.items()}
    motions = {name: fitted(merged.poses(name), truths[name]) for name in merged.rows}
    root, *others = merged.rows
    right = 0
    for name in others:
        middle = np.array([*merged.poses(name)[:, :2].mean(axis=0), 0.0])
        off = se2.relative(se2.compose(motions[root], middle), se2.compose(motions[name], middle))
        right += math.hypot(off[0], off[1]) <= NEAR_M and abs(math.degrees(off[2])) <= NEAR_DEG
    poses, truth = merged.session.poses, np.concatenate(list(truths.values()))
    error = se2.relative(truth, se2.compose(fitted(poses, truth), poses))
    return {
        "robots": len(drives),
        "claimed": len(others),
        "right": right,
        "mean, cm": f"{100 * np.hypot(error[:, 0], error[:, 1]).mean():.2f}",
    }


def true_poses(stamps: Float, simulation: Simulation) -> Float:
    """T_map_laser (N, 3) as it really was."""
    T_map_base, _ = simulation.trajectory.interpolate(stamps)
    assert simulation.recording.T_base_laser is not None
    return se2.compose(se2.from_se3(T_map_base), se2.from_se3(simulation.recording.T_base_laser))


def tables_floors(pool: Executor, pairs: int) -> Made:
    """Robots on different floors at random, each looked for in the maps of those before it."""
    numbers = list(itertools.islice(((one, other) for other in itertools.count() for one in range(other)), pairs))
    seeds = range(1 + max((other for _, other in numbers), default=-1))
    *_, sessions = [[], *done(pool, "floors", floor_session, [(seed,) for seed in seeds])]
    if len(sessions) < len(seeds):
        return
    given = [(one, other, sessions[one], sessions[other]) for one, other in numbers]
    for rows in done(pool, "pairs of floors", floors_row, given):
        states = Counter(row["state"] for row in rows)
        nearest = sorted(rows, key=lambda row: -float(row["agreement"]))[:SHOWN_PAIRS]
        total: Row = {"floors": len(seeds), "pairs": len(rows)}
        total |= {state: states[state] for state in ("aligned", "ambiguous", "rejected")}
        total["agreement"] = nearest[0]["agreement"]
        sections = {"": [total], "The pairs that came nearest": nearest}
        yield "floors", Table("Different floors", FLOORS_NOTE, sections)
        yield "floors_scores", Table("All pairs of floors", "", {"": rows})


def floors_row(one: int, other: int, fixed: Session, moving: Session) -> Row:
    """The robot of one floor looked for in the map of another."""
    return {"map of floor": one, "looked for": other} | scores_of(align(fixed, moving))


def floor_session(seed: int) -> Session:
    """The map of a robot that drove through a floor at random."""
    rng = np.random.default_rng(seed)
    parts, way = random_floor(seed)
    upright = clouds.drive(way, FLOOR_STEP_M, FLOOR_HEIGHT_M)
    ahead = np.cross(upright[:, :3, 1], upright[:, :3, 0])
    poses = np.column_stack([upright[:, :2, 3], np.arctan2(ahead[:, 1], ahead[:, 0])])
    level = se3.from_se2(poses)
    level[:, 2, 3] = FLOOR_HEIGHT_M
    angles = np.radians(np.arange(-90.0, 91.0))
    ranges = clouds.cast(*clouds.surface(parts), level, angles)
    ranges = (ranges + rng.normal(0, FLOOR_NOISE_M, ranges.shape)).astype(np.float32)
    localizer = Localizer(LocalizationConfig(), np.eye(4), keep_scans=True)
    odometry = np.zeros(3)
    for k, row in enumerate(ranges):
        if k:
            step = se2.relative(poses[k - 1], poses[k])
            odometry = se2.compose(odometry, step * (1 + FLOOR_WHEELS * rng.normal(size=3)))
        localizer.process(Scan(0.2 * k, row, angles[0], math.radians(1.0)), odometry)
    localizer.finish()
    return localizer.session()


def tables_meshes(pool: Executor, seeds: int, workers: int) -> Made:
    """The mesh of simulated robots on one floor, seed by seed."""
    for rows in done(pool, "meshes", mesh_row, [(seed, workers) for seed in range(seeds)]):
        yield "meshes", Table("One mesh of four robots", MESHES_NOTE, {"": rows})


def mesh_row(seed: int, workers: int) -> Row:
    """Simulated robots on one floor, and their mesh, made by so many threads."""
    drives = drives_of(seed, vertical_every=6)
    settings = G2ReconConfig(reconstruction=ReconstructionConfig(workers=workers))
    result = joint_pipeline.run({name: one.recording for name, one in drives.items()}, settings)
    poses = result.map.session.poses
    rows_of = result.map.rows
    truth = np.concatenate([true_poses(result.map.session.stamps[rows_of[name]], drives[name]) for name in rows_of])
    motion = se3.from_se2(fitted(poses, truth))
    simulation = next(iter(drives.values()))
    seen = se3.transform_points(motion, result.cloud.points)
    surface = TrueSurface(simulation.vertices, simulation.faces, seen)
    mesh = result.reconstruction.mesh
    score = score_surface(surface, se3.transform_points(motion, mesh.vertices), mesh.faces, thresholds=[0.05])
    row = {"seed": seed, "robots": ROBOTS, "in the map": len(rows_of), "points": len(seen)}
    return row | {"F5": f"{100 * score.at[0].f_score:.1f}"}


def main(arguments: Sequence[str] | None = None) -> None:
    """Make all tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with logs and relations that are not in the repository")
    parser.add_argument("--seeds", type=int, default=10, help="so many groups of simulated robots (default: 10)")
    parser.add_argument("--pairs", type=int, default=50, help="so many pairs of floors at random (default: 50)")
    parser.add_argument("--meshes", type=int, default=10, help="so many groups of which a mesh is made (default: 10)")
    parser.add_argument(
        "--only",
        nargs="*",
        choices=TABLES,
        default=TABLES,
        help="make these tables (default: all); logs and strangers go together",
    )
    parser.add_argument("--jobs", type=int, default=1, help="so many processes, of one thread each (default: 1)")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    log.setLevel(logging.INFO)
    given.out.mkdir(parents=True, exist_ok=True)
    wanted = {name.replace("strangers", "logs") for name in given.only}
    if "logs" in wanted and given.data is None:
        wanted.remove("logs")
        log.warning("the logs are left out; benchmarks/localization.py says where they are to be had")
    with pool_of(given.jobs) as pool:
        # What takes longest begins first; it does not matter which table a process works for.
        makers: dict[str, Callable[[], Made]] = {
            "logs": lambda: tables_logs(pool, given.data),
            "floors": lambda: tables_floors(pool, given.pairs),
            "meshes": lambda: tables_meshes(pool, given.meshes, 1 if given.jobs > 1 else 0),
            "simulated": lambda: tables_simulated(pool, given.seeds),
        }
        with ThreadPoolExecutor(len(makers)) as threads:
            for future in [threads.submit(keep, make(), given.out) for name, make in makers.items() if name in wanted]:
                future.result()
    write_page(given.out)
    log.info("%s", given.out / "collaboration_benchmarks.md")


def pool_of(jobs: int) -> Executor:
    """Processes of one thread each; for one job this process will do."""
    if jobs == 1:
        return ThreadPoolExecutor(1)
    # They are started afresh, and read these before anything else.
    os.environ |= dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    return ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"))


def keep(made: Made, out: Path) -> None:
    """Write tables, and the page, as they come."""
    for name, table in made:
        with _writing:
            report.save(out / f"collaboration_{name}.json", table)
            write_page(out)


_writing = Lock()


def write_page(out: Path) -> None:
    """The page, of the tables that lie there."""
    paths = [out / f"collaboration_{name}.json" for name in (*TABLES, "cost")]
    head = (
        "# Benchmarks of several robots\n\nMade by\n\n    python benchmarks/collaboration.py --data FOLDER --jobs 16\n"
    )
    (out / "collaboration_benchmarks.md").write_text(report.page(head, paths))


if __name__ == "__main__":
    main()
