# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Several robots, one map: logs cut into robots that know nothing of each other, and simulated robots on one floor.

    python benchmarks/collaboration.py --data FOLDER

What `python benchmarks/merger_cost.py` measured goes to the same page. FOLDER is that of benchmarks/localization.py;
without it the logs are left out. The page goes to out/benchmarks/collaboration_benchmarks.md.
"""

from __future__ import annotations

import argparse
import itertools
import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import clouds
import numpy as np
import report
from numpy.typing import NDArray
from random_floors import random_floor
from report import Row, Table

from g2_recon import joint_pipeline, pipeline
from g2_recon.collaboration.alignment import Alignment, align, fitted
from g2_recon.collaboration.map_merger import JointMap, merge
from g2_recon.config import G2ReconConfig, LocalizationConfig, SimulationConfig
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
not known. claimed: robots whose place was found."""
SIMULATED_NOTE = """\
Robots that each drive through a part of the simulated floor, 45 % of its tour from anywhere on, with noise of their
own. right: of the alignments that are claimed, those within 5 cm, at the middle of the robot's way, and 0.5 deg; mean:
of all keyframes from the truth, after the best rigid motion of all."""
STRANGERS_NOTE = "Maps of different buildings, each looked for in the other; none may be found."
FLOORS_NOTE = """\
Maps of the floors at random of benchmarks/random_floors.py, six rooms each, that a robot drove through; each pair is
looked for in each other, and none may be found. agreement: the highest that any pair reached; 0.87 are needed, 0.94
where only one part of the map speaks for a place."""
MESHES_NOTE = """\
The same robots, with vertical scans, to one mesh (`g2-recon run` of four recordings). F5: F-score at 5 cm, of the
surfaces that were seen, after the rigid motion that lays the keyframes on the truth. Robots that are not in the map
are not in the mesh."""
# A laser at this height, scans so far apart, with this noise and that of its wheels.
FLOOR_HEIGHT_M, FLOOR_STEP_M, FLOOR_NOISE_M, FLOOR_WHEELS = 0.35, 0.1, 0.01, 0.01
ROBOTS, WINDOW = 4, 0.45
TABLES = ("logs", "simulated", "meshes", "strangers", "floors")
NEAR_M, NEAR_DEG = 0.05, 0.5


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


def table_logs(data: Path) -> tuple[Table, dict[str, dict[str, Robot]]]:
    """Logs that are cut into robots."""
    rows: list[Row] = []
    all_robots = {}
    for name, count, turned in (("intel", 3, False), ("aces", 2, True)):
        log.info("%s in %d", name, count)
        recording = read_recording(next(data.glob(f"carmen/{name}*.clf*")))
        robots = all_robots[name] = cut(recording, count, last_backwards=turned)
        began = time.perf_counter()
        merged = merge({robot: one.session for robot, one in robots.items()})
        seconds = time.perf_counter() - began
        rows.append(
            {"log": name, "robots": count, "claimed": len(merged.rows)}
            | relations_of(read_relations(next(data.glob(f"relations/{name}.relations"))), robots, merged)
            | {"loops between": loops_between(merged), "s to merge": f"{seconds:.1f}"}
        )
    return Table("Logs cut into robots", LOGS_NOTE, {"": rows}), all_robots


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


def table_simulated(seeds: Sequence[int]) -> Table:
    """Simulated robots on one floor, seed by seed."""
    rows = []
    for seed in seeds:
        log.info("simulated, seed %d", seed)
        rng = np.random.default_rng(seed)
        drives = {f"robot{k}": drive(1000 * seed + k, rng.uniform(0, 1 - WINDOW)) for k in range(ROBOTS)}
        robots = {name: mapped(simulation.recording) for name, simulation in drives.items()}
        began = time.perf_counter()
        merged = merge({name: robot.session for name, robot in robots.items()})
        rows.append({"seed": seed} | placed_of(merged, drives) | {"s to merge": f"{time.perf_counter() - began:.1f}"})
    return Table("Simulated robots", SIMULATED_NOTE, {"": rows})


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


def table_strangers(robots: dict[str, dict[str, Robot]]) -> Table:
    """Robots of different buildings, each looked for in the other's map."""
    rows = []
    for fixed, moving in (("intel", "aces"), ("aces", "intel")):
        for one, other in zip(robots[fixed], robots[moving], strict=False):
            found = align(robots[fixed][one].session, robots[moving][other].session)
            where = {"map": f"{fixed} {one}", "looked for": f"{moving} {other}"}
            rows.append(where | {"state": found.state, "reason": found.reason})
    return Table("Different buildings", STRANGERS_NOTE, {"": rows})


def tables_floors(pairs: int) -> Iterator[Table]:
    """Robots on different floors at random: a table after each pair, of all so far."""
    sessions: list[Session] = []
    found: list[Alignment] = []
    while len(found) < pairs:
        log.info("floor %d", len(sessions))
        sessions.append(floor_session(len(sessions)))
        for other in sessions[: min(len(sessions) - 1, pairs - len(found))]:
            found.append(align(other, sessions[-1]))
            log.info("pair %d: %s, %s", len(found), found[-1].state, found[-1].reason)
            states = Counter(alignment.state for alignment in found)
            nearest = max(found, key=lambda alignment: alignment.agreement)
            row: Row = {"floors": len(sessions), "pairs": len(found)}
            row |= {state: states[state] for state in ("aligned", "ambiguous", "rejected")}
            row |= {"agreement": f"{nearest.agreement:.2f}", "of that pair": nearest.reason}
            yield Table("Different floors", FLOORS_NOTE, {"": [row]})


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


def tables_meshes(seeds: Sequence[int]) -> Iterator[Table]:
    """The mesh of simulated robots on one floor: a table after each seed, of all so far."""
    rows = []
    for seed in seeds:
        log.info("mesh, seed %d", seed)
        rng = np.random.default_rng(seed)
        drives = {
            f"robot{k}": drive(1000 * seed + k, rng.uniform(0, 1 - WINDOW), vertical_every=6) for k in range(ROBOTS)
        }
        result = joint_pipeline.run({name: one.recording for name, one in drives.items()}, G2ReconConfig())
        poses = result.map.session.poses
        rows_of = result.map.rows
        truth = np.concatenate([true_poses(result.map.session.stamps[rows_of[name]], drives[name]) for name in rows_of])
        motion = se3.from_se2(fitted(poses, truth))
        simulation = next(iter(drives.values()))
        seen = se3.transform_points(motion, result.cloud.points)
        surface = TrueSurface(simulation.vertices, simulation.faces, seen)
        mesh = result.reconstruction.mesh
        score = score_surface(surface, se3.transform_points(motion, mesh.vertices), mesh.faces, thresholds=[0.05])
        at = score.at[0]
        row = {"seed": seed, "robots": ROBOTS, "in the map": len(rows_of), "points": len(seen)}
        rows.append(row | {"F5": f"{100 * at.f_score:.1f}"})
        log.info("%s", rows[-1])
        yield Table("One mesh of four robots", MESHES_NOTE, {"": rows})


def main(arguments: Sequence[str] | None = None) -> None:
    """Make all tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with logs and relations that are not in the repository")
    parser.add_argument("--seeds", type=int, default=10, help="so many groups of simulated robots (default: 10)")
    parser.add_argument("--pairs", type=int, default=50, help="so many pairs of floors at random (default: 50)")
    parser.add_argument("--meshes", type=int, default=3, help="so many groups of which a mesh is made (default: 3)")
    parser.add_argument("--only", nargs="+", choices=TABLES, default=TABLES, help="make these tables (default: all)")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    log.setLevel(logging.INFO)
    given.out.mkdir(parents=True, exist_ok=True)
    makers: dict[str, Callable[[], Iterable[Table]]] = {
        "simulated": lambda: [table_simulated(range(given.seeds))],
        "meshes": lambda: tables_meshes(range(given.meshes)),
        "floors": lambda: tables_floors(given.pairs),
    }
    for name in given.only:
        # What takes long is kept as far as it is.
        for table in makers[name]() if name in makers else ():
            report.save(given.out / f"collaboration_{name}.json", table)
    if not {"logs", "strangers"}.isdisjoint(given.only):
        if given.data is None:
            log.warning("the logs are left out; benchmarks/localization.py says where they are to be had")
        else:
            logs, robots = table_logs(given.data)
            report.save(given.out / "collaboration_logs.json", logs)
            report.save(given.out / "collaboration_strangers.json", table_strangers(robots))
    paths = [given.out / f"collaboration_{name}.json" for name in (*TABLES, "cost")]
    head = "# Benchmarks of several robots\n\nMade by\n\n    python benchmarks/collaboration.py --data FOLDER\n"
    (given.out / "collaboration_benchmarks.md").write_text(report.page(head, paths))
    log.info("%s", given.out / "collaboration_benchmarks.md")


if __name__ == "__main__":
    main()
