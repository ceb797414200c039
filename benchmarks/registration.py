# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""All tables of docs/registration_benchmarks.md: stop-and-go sweeps, and what of them is refused; vertical scans.

Usage: python benchmarks/registration.py [--data FOLDER] [--only TABLE ...] [--quick] [--out FOLDER]

Writes registration_benchmarks.md and a JSON file a table to the folder. The page is put together from all tables that
lie there, so that one can be made anew. Without --data, recorded sweeps and scans are left out.
"""

from __future__ import annotations

import argparse
import itertools
import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import report
import simulated_sweeps as simulated
import vertical_scans
from numpy.typing import NDArray
from report import Row, Table
from simulated_sweeps import errors, off_by, stop, sweep

from g2_recon.config import SweepConfig
from g2_recon.geometry import se3
from g2_recon.geometry.cloud import Cloud
from g2_recon.recording.slam6d import from_left_handed
from g2_recon.recording.sweeps import read_sweep
from g2_recon.registration.prepared_sweep import PreparedSweep, prepare
from g2_recon.registration.sweep_matching import METHODS, Match, match
from g2_recon.registration.sweep_merger import SweepMerger

Float = NDArray[np.float64]

log = logging.getLogger("benchmarks")

GUESSES = ((0.05, 2.0), (0.3, 8.0), (0.8, 20.0))
"""How far odometry is off, in metres and degrees."""
SEEDS, TRIES = 6, 5

# Of the second sweep of pcl_room as seen from the first: by multi-start ICP on walls, and by the robot's odometry.
PCL_TRUTH = (1.98, 0.06, 0.016, 0.0, 0.0, 0.710)
PCL_ODOMETRY = (1.79, 0.72, 0.0, 0.0, 0.0, 0.6931)
PCL_STARTS, PCL_START_M, PCL_START_DEG = 20, 1.0, 30.0
RIGHT_M, RIGHT_DEG = 0.02, 0.3
PCL_RIGHT_STARTS_M = 0.03

SLAM6D_SETTINGS = {"min_range": 0.5, "min_inliers": 0.5}
SLAM6D_OFF = (0.3, 8.0)
# Of two sweeps as they lie on each other: pairs that count, and a distance that the farthest of them have at most.
FIT_NEAR_M, FIT_PARALLEL, FIT_MOST_M = 0.3, 0.97, 0.05

RING_ODOMETRY = (0.1, 3.0)
CORRIDOR_STEP_M, CORRIDOR_ODOMETRY = 3.0, (0.2, 3.0)
CORRIDOR_PAIRS, ROOM_PAIRS = 20, 100

ROOM_NOTE = f"""\
A room of 16 m x 7 m x 2.8 m with four boxes, two sweeps of 36,200 points with 1 cm of noise, 1.6 m and 15 deg apart,
6 seeds; a guess that is off by what is said, along the floor and in heading. Error of the position, median and worst
of the seeds; ms of processor time for one sweep: thinning, normals, match and judgement, on one core, median and least
of the seeds; of gicp, the least of {TRIES} tries for each."""
RECORDINGS_NOTE = f"""\
pcl_room: two sweeps of a room, from the robot's odometry, which is 0.7 m off. Its truth is that of multi-start ICP on
walls with a level robot: position and heading only. Starts: {PCL_STARTS} guesses at random within {PCL_START_M:g} m and
{PCL_START_DEG:g} deg of it; right: believed, within {100 * PCL_RIGHT_STARTS_M:.0f} cm and {RIGHT_DEG} deg of heading.
3dtk: three sweeps of a pitching laser in a corridor, beside what slam6D made of them (.frames), from its odometry
(.pose), and from a guess 30 cm and 8 deg off that. Walls and floors of these sweeps do not fit each other rigidly, no
method has more than two thirds within 6 cm: min_inliers is {SLAM6D_SETTINGS["min_inliers"]}, and with the default all
are refused. Where a method ends depends on how it weights near and far points, by some centimetres; point-to-point ICP
of all points with a gate of 25 cm, as slam6D does it, ends on .frames of the first pair.
apart, mm: RMS distance of the points of one sweep from the surfaces of the other, none counted as more than
{100 * FIT_MOST_M:.0f} cm, beside what it is where the truth has them: which of the two fits the sweeps better."""
RING_NOTE = """\
12 stops in a corridor round a block of four rooms, 4.6 m apart, odometry 10 cm and 3 deg off a step. Error of the last
sweep as seen from the first, and the largest of all sweeps, three seeds."""
CORRIDOR_NOTE = f"""\
A bare corridor without an end, two stops {CORRIDOR_STEP_M:g} m apart, odometry 20 cm and 3 deg off, {CORRIDOR_PAIRS}
pairs. along: how far the position along the axis is from where odometry has it, and what that is off; across: error of
the rest. The match must be limited or refused, never good."""
ROOMS_NOTE = f"""\
Two furnished rooms of random size with a wall between, a sweep in each, {ROOM_PAIRS} pairs, from odometry that is
30 cm and 8 deg off; and from the guess that both were taken at the same place, which sweeps alone cannot tell where
rooms are alike."""


@dataclass(frozen=True, slots=True)
class Bench:
    """Where recordings are, None if there are none, whether to do a few of each only, and where pictures go."""

    data: Path | None
    quick: bool
    out: Path

    def some(self, count: int) -> range:
        """So many, or two."""
        return range(min(count, 2) if self.quick else count)


def room_table(bench: Bench) -> Table:
    """Accuracy and time of the methods in the simulated room."""
    rectangles = simulated.furnished_room()
    rows = []
    for method, guess in itertools.product(METHODS, GUESSES):
        config = SweepConfig(method=method)
        off, seconds, good = [], [], 0
        for seed in bench.some(SEEDS):
            rng = np.random.default_rng(seed)
            first, second = stop(5.0, 3.0, 10.0), stop(6.5, 3.6, 25.0)
            fixed = prepare(sweep(rectangles, first, rng), config)
            points, truth = sweep(rectangles, second, rng), se3.inverse(first) @ second
            start = truth @ off_by(rng, *guess)
            tries = []
            for _ in bench.some(TRIES if method == "gicp" else 1):
                began = time.process_time()
                found = match(prepare(points, config), fixed, start, config)
                tries.append(time.process_time() - began)
            seconds.append(min(tries))
            off.append(1000 * errors(found.T, truth)[0])
            good += found.quality == "good"
        rows.append(
            {
                "method": method,
                "guess off by": f"{100 * guess[0]:.0f} cm, {guess[1]:.0f} deg",
                "median, mm": f"{np.median(off):.1f}",
                "worst, mm": f"{max(off):.1f}",
                "good": f"{good} of {len(off)}",
                "ms": f"{1000 * np.median(seconds):.0f} ({1000 * min(seconds):.0f})",
            }
        )
    return Table("A simulated room", ROOM_NOTE, {"": rows})


def recordings_table(bench: Bench) -> Table | None:
    """The recorded sweeps."""
    if bench.data is None:
        return None
    return Table("Recorded sweeps", RECORDINGS_NOTE, {"pcl_room": pcl_rows(bench), "3dtk": list(slam6d_rows(bench))})


def pcl_rows(bench: Bench) -> list[Row]:
    """A row a method."""
    assert bench.data is not None
    clouds = [read_sweep(bench.data / f"sweeps/pcl_room/room_scan{number}.pcd").cloud for number in (1, 2)]
    truth = se3.from_xyz_rpy(PCL_TRUTH)
    rows = []
    for method in METHODS:
        config = SweepConfig(method=method)
        fixed, moving = (prepare(cloud, config) for cloud in clouds)
        found = match(moving, fixed, se3.from_xyz_rpy(PCL_ODOMETRY), config)
        rng = np.random.default_rng(0)
        right = 0
        for _ in bench.some(PCL_STARTS):
            reach = PCL_START_M * math.sqrt(rng.random())
            start = truth @ off_by(rng, reach, PCL_START_DEG * rng.random())
            other = match(moving, fixed, start, config)
            metres, degrees = planar_errors(other.T, truth)
            right += not other.refused and metres < PCL_RIGHT_STARTS_M and degrees < RIGHT_DEG
        metres, degrees = planar_errors(found.T, truth)
        rows.append(
            {
                "method": method,
                "from odometry": found.quality,
                "position off, cm": f"{100 * metres:.2f}",
                "heading off, deg": f"{degrees:.2f}",
                "overlap": f"{found.overlap:.0%}",
                "inliers": f"{found.inlier_share:.0%}",
                "residual, mm": f"{1000 * found.residual:.0f}",
                "apart, mm": "{:.1f} (truth {:.1f})".format(
                    *(1000 * apart(moving, fixed, T) for T in (found.T, truth))
                ),
                "right of the starts": f"{right} of {len(bench.some(PCL_STARTS))}",
            }
        )
    return rows


def apart(moving: PreparedSweep, fixed: PreparedSweep, T: Float) -> float:
    """RMS distance in metres of the points of a sweep from the surfaces of another that they lie on."""
    placed = se3.transform_points(T, moving.points)
    rows, distances = fixed.pairs(placed)
    normals = fixed.normals[rows]
    parallel = np.abs(np.einsum("ij,ij->i", normals, moving.normals @ T[:3, :3].T)) > FIT_PARALLEL
    off = np.einsum("ij,ij->i", normals, placed - fixed.points[rows])[parallel & (distances < FIT_NEAR_M)]
    return float(np.sqrt(np.mean(np.minimum(off**2, FIT_MOST_M**2))))


def planar_errors(T: Float, truth: Float) -> tuple[float, float]:
    """Metres between two positions (4, 4) and degrees between their headings."""
    turn = math.atan2(T[1, 0], T[0, 0]) - math.atan2(truth[1, 0], truth[0, 0])
    return float(np.linalg.norm(T[:3, 3] - truth[:3, 3])), math.degrees(abs(math.remainder(turn, 2 * math.pi)))


def slam6d_rows(bench: Bench) -> Iterator[Row]:
    """A row a method and pair."""
    assert bench.data is not None
    files = [bench.data / f"sweeps/3dtk/scan00{number}.3d.gz" for number in range(3)]
    sweeps = [read_sweep(file) for file in files]
    frames = [last_frame(file.with_name(file.name.replace(".3d.gz", ".frames"))) for file in files]
    for method in METHODS:
        config = SweepConfig(method=method, **SLAM6D_SETTINGS)
        prepared = [prepare(entry.cloud, config) for entry in sweeps]
        for i, j in ((0, 1), (1, 2)):
            poses = [entry.T_map_file for entry in sweeps]
            odometry = se3.inverse(poses[i]) @ poses[j]  # type: ignore[arg-type]
            truth = se3.inverse(frames[i]) @ frames[j]
            row: Row = {"method": method, "sweeps": f"{i}, {j}"}
            off = odometry @ off_by(np.random.default_rng(0), *SLAM6D_OFF)
            found = [match(prepared[j], prepared[i], start, config) for start in (odometry, off)]
            for name, each in zip(("from .pose", "from 30 cm, 8 deg off"), found, strict=True):
                metres, degrees = errors(each.T, truth)
                row[name] = f"{100 * metres:.1f} cm, {degrees:.2f} deg ({each.quality})"
            metres, degrees = errors(odometry, truth)
            row["odometry itself"] = f"{100 * metres:.1f} cm, {degrees:.2f} deg"
            own, slam6d = (1000 * apart(prepared[j], prepared[i], T) for T in (found[0].T, truth))
            row["apart, mm"] = f"{own:.1f} (.frames {slam6d:.1f})"
            yield row


def last_frame(file: Path) -> Float:
    """T_map_laser (4, 4) of the last line of a .frames file."""
    lines = [line for line in file.read_text().splitlines() if line.strip()]
    return from_left_handed(np.array(lines[-1].split()[:16], float).reshape(4, 4).T)


def ring_table(bench: Bench) -> Table:
    """Sweeps round a block, with and without loops."""
    rectangles, stops = simulated.ring()
    rows = []
    for method, loops, seed in itertools.product(("gicp",), (True, False), bench.some(3)):
        rng = np.random.default_rng(seed)
        merger = SweepMerger(SweepConfig(method=method, loop_closure=loops))
        driven = [np.eye(4)]
        began = time.perf_counter()
        for index, at in enumerate(stops):
            if index:
                driven.append(driven[-1] @ se3.inverse(stops[index - 1]) @ at @ off_by(rng, *RING_ODOMETRY))
            merger.add(Cloud(sweep(rectangles, at, rng)), driven[-1])
        poses = merger.poses()
        off = [
            1000 * errors(se3.inverse(poses[0]) @ pose, se3.inverse(stops[0]) @ at)[0]
            for pose, at in zip(poses, stops, strict=True)
        ]
        odometry = errors(driven[-1], se3.inverse(stops[0]) @ stops[-1])
        rows.append(
            {
                "loop closure": "on" if loops else "off",
                "seed": seed,
                "last to first, mm": f"{off[-1]:.1f}",
                "largest, mm": f"{max(off):.1f}",
                "odometry alone": f"{odometry[0]:.1f} m, {odometry[1]:.0f} deg",
                "seconds": f"{time.perf_counter() - began:.1f}",
            }
        )
    return Table("A ring of sweeps", RING_NOTE, {"": rows})


def corridor_table(bench: Bench) -> Table:
    """What a bare corridor leaves open."""
    rectangles = simulated.bare_corridor()
    rows = []
    for method in METHODS:
        along, across, odometry = [], [], []
        said: Counter[str] = Counter()
        for seed in bench.some(CORRIDOR_PAIRS):
            rng = np.random.default_rng(seed)
            first = stop(100.0, 1.2, rng.uniform(-30, 30))
            second = stop(100.0 + CORRIDOR_STEP_M, rng.uniform(0.9, 1.5), rng.uniform(-30, 30))
            truth = se3.inverse(first) @ second
            guess = truth @ off_by(rng, *CORRIDOR_ODOMETRY)
            found = matched(rectangles, first, second, guess, rng, method)
            axis = first[0, :3]
            off = found.T[:3, 3] - truth[:3, 3]
            along.append(abs(float(axis @ (found.T[:3, 3] - guess[:3, 3]))))
            odometry.append(abs(float(axis @ (guess[:3, 3] - truth[:3, 3]))))
            across.append(float(np.linalg.norm(off - axis * (axis @ off))))
            said[found.quality] += 1
        rows.append(
            {
                "method": method,
                "along, from odometry, mm": f"{1000 * np.median(along):.1f}, at most {1000 * max(along):.1f}",
                "odometry off along, mm": f"{1000 * np.median(odometry):.0f}, at most {1000 * max(odometry):.0f}",
                "across, mm": f"{1000 * np.median(across):.1f}, at most {1000 * max(across):.1f}",
                "said": ", ".join(f"{word}: {count}" for word, count in said.items()),
            }
        )
    return Table("A bare corridor", CORRIDOR_NOTE, {"": rows})


def rooms_table(bench: Bench) -> Table:
    """Rooms that do not overlap."""
    rows = []
    for method in ("gicp", "paper"):
        refused: Counter[str] = Counter()
        for seed in bench.some(ROOM_PAIRS):
            rng = np.random.default_rng(seed)
            rectangles, (first, second) = simulated.two_rooms(rng)
            by_odometry = se3.inverse(first) @ second @ off_by(rng, 0.3, 8.0)
            for name, guess in (("from odometry", by_odometry), ("from the same place", np.eye(4))):
                refused[name] += bool(matched(rectangles, first, second, guess, rng, method).refused)
        pairs = len(bench.some(ROOM_PAIRS))
        rows.append({"method": method, **{name: f"{count} of {pairs} refused" for name, count in refused.items()}})
    return Table("Rooms that do not overlap", ROOMS_NOTE, {"": rows})


def matched(
    rectangles: simulated.Rectangles,
    first: Float,
    second: Float,
    guess: Float,
    rng: np.random.Generator,
    method: str,
) -> Match:
    """The match of two sweeps of a simulated building."""
    config = SweepConfig(method=method)
    fixed: PreparedSweep = prepare(sweep(rectangles, first, rng), config)
    return match(prepare(sweep(rectangles, second, rng), config), fixed, guess, config)


def alog_table(bench: Bench) -> Table | None:
    """Two lasers to the sides, outdoors."""
    return None if bench.data is None else vertical_scans.alog_table(bench.data, bench.out)


TABLES: dict[str, Callable[[Bench], Table | None]] = {
    "room": room_table,
    "recordings": recordings_table,
    "ring": ring_table,
    "corridor": corridor_table,
    "rooms": rooms_table,
    "beams": lambda bench: vertical_scans.beams_table(),
    "whole": lambda bench: vertical_scans.whole_table(bench.quick),
    "follow": lambda bench: vertical_scans.follow_table(),
    "calibration": lambda bench: vertical_scans.calibration_table(bench.quick),
    "sides": alog_table,
    "speed": lambda bench: vertical_scans.speed_table(bench.quick),
}

HEAD = f"""\
# Benchmarks of registration

Made by

    python benchmarks/registration.py --data FOLDER

which takes a quarter of an hour; `--only TABLE` makes one of {", ".join(TABLES)} anew, `--quick` shows that all of
it runs. The result is in `out/benchmarks/`; this page is copied from there. FOLDER holds
`sweeps/pcl_room/room_scan*.pcd`, `sweeps/3dtk/scan00*` (the sample scans of 3DTK) and `vertical/QuadTree_Alog.alog.gz`
(of the New College data set); without `--data` they are left out.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the tables that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with recorded sweeps and scans")
    parser.add_argument(
        "--only", nargs="+", choices=TABLES, default=list(TABLES), metavar="TABLE", help=", ".join(TABLES)
    )
    parser.add_argument("--quick", action="store_true", help="two of each only, to see that it runs")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    log.setLevel(logging.INFO)
    given.out.mkdir(parents=True, exist_ok=True)
    bench = Bench(given.data, given.quick, given.out)
    for name in given.only:
        table = TABLES[name](bench)
        if table is None:
            log.warning("%s: not made, there is no --data", name)
            continue
        report.save(given.out / f"registration_{name}.json", table)
        paths = [given.out / f"registration_{other}.json" for other in TABLES]
        (given.out / "registration_benchmarks.md").write_text(report.page(HEAD, paths))
        log.info("%s", name)


if __name__ == "__main__":
    main()
