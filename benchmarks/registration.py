# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""All tables of docs/registration_benchmarks.md: stop-and-go sweeps, and what of them is refused; vertical scans.

Usage: python benchmarks/registration.py [--data FOLDER] [--only TABLE ...] [--quick] [--jobs N] [--out FOLDER]

Writes registration_benchmarks.md and a JSON file a table to the folder. The page is put together from all tables that
lie there, so that one can be made anew. Without --data, recorded sweeps and scans are left out.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import report
import simulated_sweeps as simulated
import vertical_scans
from numpy.typing import NDArray
from report import Row, Table
from scipy.spatial import cKDTree
from simulated_sweeps import errors, off_by, stop, sweep

from g2_recon.config import SweepConfig
from g2_recon.geometry import se3
from g2_recon.geometry.cloud import Cloud
from g2_recon.recording.slam6d import from_left_handed
from g2_recon.recording.sweeps import read_sweep
from g2_recon.registration.horn import absolute_orientation
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

# The methods that recorded sweeps are laid on each other by.
RECORDED: dict[str, dict[str, Any]] = {name: {"method": name} for name in METHODS} | {
    "paper, all points": {"method": "paper", "all_points": True}
}
SLAM6D_SETTINGS = {"min_range": 0.5, "min_inliers": 0.5}
SLAM6D_OFF = (0.3, 8.0)
# As slam6D has it where nothing else is said: gate in metres, and iterations; a sweep is matched with all before it.
SLAM6D_GATE_M, SLAM6D_STEPS = 0.25, 50
# Of two sweeps as they lie on each other: pairs that count, and a distance that the farthest of them have at most.
FIT_NEAR_M, FIT_PARALLEL, FIT_MOST_M = 0.3, 0.97, 0.05
# Patches of walls: cubes of this edge with so many points, at most so thin and at least so wide, standard deviations;
# and how far apart two of the same wall may lie. Of pairs of points, the nearer part.
PATCH_M, PATCH_POINTS, PATCH_THIN_M, PATCH_WIDE_M = 0.5, 30, 0.02, 0.08
WALL_M, WALL_DEG = 0.15, 10.0
LEVEL = 0.9
NEARER_PART = 0.7

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
walls: position and heading only; beside it the judges take roll and pitch of the method. Starts: {PCL_STARTS} guesses
at random within {PCL_START_M:g} m and {PCL_START_DEG:g} deg of it; right: believed, within
{100 * PCL_RIGHT_STARTS_M:.0f} cm and {RIGHT_DEG} deg of heading.
3dtk: three sweeps of a pitching laser in a corridor, beside what slam6D made of them (.frames), from its odometry
(.pose), and from a guess 30 cm and 8 deg off that. Walls and floors of these sweeps do not fit each other rigidly, no
method has more than two thirds within 6 cm: min_inliers is {SLAM6D_SETTINGS["min_inliers"]}, and with the default all
are refused. Where a method ends depends on how it weights near and far points, by some centimetres. all points: with
all_points, as slam6D has it. slam6D's end: where slam6D has a sweep after {SLAM6D_STEPS} iterations, see below.
apart, mm: RMS distance of the points of one sweep from the surfaces of the other, none counted as more than
{100 * FIT_MOST_M:.0f} cm, beside what it is where the truth has them: which of the two fits the sweeps better. Methods
minimize something like it, so there are more judges, of the points as measured. walls apart: between the planes of
the same wall in both sweeps, fitted to cubes of {PATCH_M:g} m, medians. level apart: how much higher one sweep has the
floors and ceilings of the other, of the same cubes, median. points apart: RMS distance from the points of
one sweep to the nearest of the other, of the nearer {NEARER_PART:.0%}."""
FRAMES_NOTE = f"""\
.frames are lines of slam6D's ICP with the options it has by itself: point to point, all points, pairs nearer than
{100 * SLAM6D_GATE_M:.0f} cm, against all sweeps before, from .pose moved as the sweep before was. That ICP, done anew,
beside its lines: of sweep 1 there are the first iteration and the end; of sweep 2 the first iteration only, which is
where odometry has it."""
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
    """Where recordings are, None if there are none, whether to do a few of each only, and where pictures go.

    jobs: how many cases are done at once; with more than one, what a case takes is not said.
    """

    data: Path | None
    quick: bool
    out: Path
    jobs: int = 1

    def some(self, count: int) -> range:
        """So many, or two."""
        return range(min(count, 2) if self.quick else count)

    def each(self, function: Callable[..., Any], cases: Iterable[tuple[Any, ...]], *, table: str) -> list[Any]:
        """What a function makes of this and each case, in their order, as many at once as jobs."""
        function = functools.partial(function, self)
        return report.each(function, cases, jobs=self.jobs, table=self.out / f"registration_{table}.json")


def room_table(bench: Bench) -> Table:
    """Accuracy and time of the methods in the simulated room."""
    kinds = list(itertools.product(METHODS, GUESSES))
    cases = [(*kind, seed) for kind in kinds for seed in bench.some(SEEDS)]
    results = bench.each(_in_the_room, cases, table="room")
    rows = []
    for kind in kinds:
        method, guess = kind
        off, seconds, good = zip(
            *(of for case, of in zip(cases, results, strict=True) if case[:2] == kind), strict=True
        )
        row = {
            "method": method,
            "guess off by": f"{100 * guess[0]:.0f} cm, {guess[1]:.0f} deg",
            "median, mm": f"{np.median(off):.1f}",
            "worst, mm": f"{max(off):.1f}",
            "good": f"{sum(good)} of {len(off)}",
        }
        if bench.jobs == 1:
            row["ms"] = f"{1000 * np.median(seconds):.0f} ({1000 * min(seconds):.0f})"
        rows.append(row)
    return Table("A simulated room", ROOM_NOTE, {"": rows})


def _in_the_room(bench: Bench, method: str, guess: tuple[float, float], seed: int) -> tuple[float, float, bool]:
    """Error of the position in mm, least seconds of processor time, and whether the match is good."""
    config = SweepConfig(method=method)
    rectangles = simulated.furnished_room()
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
    return 1000 * errors(found.T, truth)[0], min(tries), found.quality == "good"


def recordings_table(bench: Bench) -> Table | None:
    """The recorded sweeps."""
    if bench.data is None:
        return None
    starts = list(itertools.product(RECORDED, (None, *bench.some(PCL_STARTS))))
    found = bench.each(_pcl_room, starts, table="recordings")
    rooms = []
    for method in RECORDED:
        row, *right = (of for (name, _), of in zip(starts, found, strict=True) if name == method)
        rooms.append({"method": method} | row | {"right of the starts": f"{sum(right)} of {len(right)}"})
    pairs = list(itertools.product(RECORDED, ((0, 1), (1, 2))))
    corridor = [
        {"method": method, "sweeps": f"{i}, {j}"} | row
        for (method, (i, j)), row in zip(pairs, bench.each(_slam6d, pairs, table="recordings"), strict=True)
    ]
    sections = {"pcl_room": rooms, "3dtk": corridor, "What .frames of 3dtk are": frames_rows(bench.data)}
    return Table("Recorded sweeps", f"{RECORDINGS_NOTE}\n\n{FRAMES_NOTE}", sections)


def _pcl_room(bench: Bench, method: str, start: int | None) -> Row | bool:
    """The columns of a method from the robot's odometry; from a start, whether it is right."""
    assert bench.data is not None
    clouds = [read_sweep(bench.data / f"sweeps/pcl_room/room_scan{number}.pcd").cloud for number in (1, 2)]
    truth = se3.from_xyz_rpy(PCL_TRUTH)
    config = SweepConfig(**RECORDED[method])
    fixed, moving = (prepare(cloud, config) for cloud in clouds)
    if start is not None:
        found = match(moving, fixed, pcl_starts(truth)[start], config)
        metres, degrees = planar_errors(found.T, truth)
        return not found.refused and metres < PCL_RIGHT_STARTS_M and degrees < RIGHT_DEG
    found = match(moving, fixed, se3.from_xyz_rpy(PCL_ODOMETRY), config)
    metres, degrees = planar_errors(found.T, truth)
    return {
        "from odometry": found.quality,
        "position off, cm": f"{100 * metres:.2f}",
        "heading off, deg": f"{degrees:.2f}",
        "overlap": f"{found.overlap:.0%}",
        "inliers": f"{found.inlier_share:.0%}",
        "residual, mm": f"{1000 * found.residual:.0f}",
    } | judged(moving, fixed, found.T, with_tilt_of(found.T, truth), "truth")


def with_tilt_of(T: Float, truth: Float) -> Float:
    """The position and heading of one place (4, 4) with roll and pitch of another."""
    result = se3.from_xyz_rpy([*truth[:3, 3], 0.0, 0.0, heading(truth) - heading(T)])
    result[:3, :3] = result[:3, :3] @ T[:3, :3]
    return result


def pcl_starts(truth: Float) -> list[Float]:
    """Guesses (4, 4) at random about the truth of pcl_room."""
    rng = np.random.default_rng(0)
    starts = []
    for _ in range(PCL_STARTS):
        reach = PCL_START_M * math.sqrt(rng.random())
        starts.append(truth @ off_by(rng, reach, PCL_START_DEG * rng.random()))
    return starts


def apart(moving: PreparedSweep, fixed: PreparedSweep, T: Float) -> float:
    """RMS distance in metres of the points of a sweep from the surfaces of another that they lie on."""
    placed = se3.transform_points(T, moving.points)
    rows, distances = fixed.pairs(placed)
    normals = fixed.normals[rows]
    parallel = np.abs(np.einsum("ij,ij->i", normals, moving.normals @ T[:3, :3].T)) > FIT_PARALLEL
    off = np.einsum("ij,ij->i", normals, placed - fixed.points[rows])[parallel & (distances < FIT_NEAR_M)]
    return float(np.sqrt(np.mean(np.minimum(off**2, FIT_MOST_M**2))))


@dataclass(frozen=True, slots=True)
class Patches:
    """Flat parts of a sweep, of its points as measured: centers (P, 3) m and unit normals (P, 3)."""

    centers: Float
    normals: Float


def patches(points: Float) -> Patches:
    """The flat ones among the cubes of half a metre that points (N, 3) in metres are in."""
    cells, number, count = np.unique(
        np.floor(points / PATCH_M).astype(int), axis=0, return_inverse=True, return_counts=True
    )
    number = number.reshape(-1)
    sums = np.stack([np.bincount(number, column, len(cells)) for column in points.T], axis=1)
    centers = sums / count[:, None]
    away = points - centers[number]
    products = np.einsum("ni,nj->nij", away, away).reshape(-1, 9)
    scatter = np.stack([np.bincount(number, column, len(cells)) for column in products.T], axis=1)
    square, axes = np.linalg.eigh((scatter / count[:, None]).reshape(-1, 3, 3))
    spread = np.sqrt(np.maximum(square, 0.0))
    flat = (count >= PATCH_POINTS) & (spread[:, 0] < PATCH_THIN_M) & (spread[:, 1] > PATCH_WIDE_M)
    return Patches(centers[flat], axes[flat, :, 0])


def planes_apart(moving: Patches, fixed: Patches, places: Sequence[Float]) -> list[tuple[float, float, float]]:
    """For each place (4, 4): mm and deg between the same planes in both sweeps, and mm that level ones are higher.

    Medians over the patches. A patch of one sweep is of the plane that the patch of the other nearest to it is on, in
    all of the places.
    """
    tree = cKDTree(fixed.centers)
    placed = [se3.transform_points(T, moving.centers) for T in places]
    turned = [moving.normals @ T[:3, :3].T for T in places]
    near = tree.query(np.mean(placed, axis=0))[1]
    upward = fixed.normals[near] * np.copysign(1.0, fixed.normals[near, 2:])
    off = [np.einsum("pi,pi->p", upward, centers - fixed.centers[near]) for centers in placed]
    angles = [np.arccos(np.minimum(np.abs(np.einsum("pi,pi->p", upward, n)), 1.0)) for n in turned]
    beside = np.linalg.norm(np.mean(placed, axis=0) - fixed.centers[near], axis=1) < PATCH_M
    same = beside & (np.max(np.abs(off), axis=0) < WALL_M) & (np.max(angles, axis=0) < math.radians(WALL_DEG))
    level = same & (upward[:, 2] > LEVEL)
    return [
        (1000 * np.median(np.abs(o[same])), math.degrees(np.median(a[same])), 1000 * np.median(o[level]))
        for o, a in zip(off, angles, strict=True)
    ]


def points_apart(moving: Float, fixed: Float, T: Float) -> float:
    """RMS in mm over the nearer part of the points (N, 3) of a sweep, as measured, of how far the next of others is."""
    distances = np.sort(cKDTree(fixed).query(se3.transform_points(T, moving))[0])
    return float(1000 * np.sqrt(np.mean(distances[: int(NEARER_PART * len(distances))] ** 2)))


def judged(moving: PreparedSweep, fixed: PreparedSweep, own: Float, truth: Float, name: str) -> Row:
    """Columns that say which of two places fits two sweeps better, by what no method of ours minimizes."""
    planes = planes_apart(patches(moving.measured), patches(fixed.measured), (own, truth))
    points = [points_apart(moving.measured, fixed.measured, T) for T in (own, truth)]
    surfaces = [1000 * apart(moving, fixed, T) for T in (own, truth)]
    return {
        "apart, mm": f"{surfaces[0]:.1f} ({name} {surfaces[1]:.1f})",
        "walls apart, mm": f"{planes[0][0]:.1f} ({name} {planes[1][0]:.1f})",
        "walls apart, deg": f"{planes[0][1]:.2f} ({name} {planes[1][1]:.2f})",
        "level apart, mm": f"{planes[0][2]:.1f} ({name} {planes[1][2]:.1f})",
        "points apart, mm": f"{points[0]:.1f} ({name} {points[1]:.1f})",
    }


def planar_errors(T: Float, truth: Float) -> tuple[float, float]:
    """Metres between two positions (4, 4) and degrees between their headings."""
    turn = heading(T) - heading(truth)
    return float(np.linalg.norm(T[:3, 3] - truth[:3, 3])), math.degrees(abs(math.remainder(turn, 2 * math.pi)))


def heading(T: Float) -> float:
    """In radians."""
    return math.atan2(T[1, 0], T[0, 0])


def _slam6d(bench: Bench, method: str, pair: tuple[int, int]) -> Row:
    """The columns of a method and a pair of sweeps."""
    assert bench.data is not None
    sweeps = Slam6DSweeps.read(bench.data)
    config = SweepConfig(**RECORDED[method], **SLAM6D_SETTINGS)
    fixed, moving = (prepare(sweeps.points[number], config) for number in pair)
    odometry = se3.inverse(sweeps.poses[pair[0]]) @ sweeps.poses[pair[1]]
    from_frames = se3.inverse(sweeps.last_frame(pair[0]))
    truth = from_frames @ sweeps.last_frame(pair[1])
    row: Row = {}
    off = odometry @ off_by(np.random.default_rng(0), *SLAM6D_OFF)
    found = [match(moving, fixed, start, config) for start in (odometry, off)]
    for name, each in zip(("from .pose", "from 30 cm, 8 deg off"), found, strict=True):
        row[name] = f"{_off(each.T, truth)} ({each.quality})"
    row["from slam6D's end"] = _off(found[0].T, from_frames @ sweeps.iterations(pair[1])[-1])
    row["odometry itself"] = _off(odometry, truth)
    return row | judged(moving, fixed, found[0].T, truth, ".frames")


def _off(T: Float, truth: Float) -> str:
    metres, degrees = errors(T, truth)
    return f"{100 * metres:.1f} cm, {degrees:.2f} deg"


@dataclass(frozen=True, slots=True)
class Slam6DSweeps:
    """The sweeps of 3DTK: points (N, 3) m in their frames, T_map_laser (4, 4) by odometry, and what slam6D wrote."""

    points: list[Float]
    poses: list[Float]
    frames: list[list[Float]]

    @classmethod
    def read(cls, data: Path) -> Slam6DSweeps:
        """From the folder with recorded sweeps and scans."""
        files = [data / f"sweeps/3dtk/scan00{number}.3d.gz" for number in range(3)]
        sweeps = [read_sweep(file) for file in files]
        frames = [read_frames(file.with_name(file.name.replace(".3d.gz", ".frames"))) for file in files]
        poses = [sweep.T_map_file for sweep in sweeps if sweep.T_map_file is not None]
        return cls([sweep.cloud.points for sweep in sweeps], poses, frames)

    def last_frame(self, number: int) -> Float:
        """T_map_laser (4, 4) of a sweep in the last line that slam6D wrote."""
        return self.frames[number][-1]

    def iterations(self, number: int) -> list[Float]:
        """T_map_laser (4, 4) of a sweep after each iteration of slam6D's ICP, with those before where it has them."""
        before = range(number)
        surface = np.concatenate([se3.transform_points(self.last_frame(k), self.points[k]) for k in before])
        tree = cKDTree(surface)
        T = self.last_frame(number - 1) @ se3.inverse(self.poses[number - 1]) @ self.poses[number]
        result = []
        for _ in range(SLAM6D_STEPS):
            placed = se3.transform_points(T, self.points[number])
            distances, rows = tree.query(placed, distance_upper_bound=SLAM6D_GATE_M)
            paired = np.isfinite(distances)
            T = absolute_orientation(surface[rows[paired]], placed[paired]) @ T
            result.append(T)
        return result


def frames_rows(data: Path) -> list[Row]:
    """What the lines of .frames are, by slam6D's ICP done anew."""
    sweeps = Slam6DSweeps.read(data)
    rows = []
    for number, iteration, line in ((1, 1, 0), (1, SLAM6D_STEPS, -1), (2, 1, -1), (2, SLAM6D_STEPS, -1)):
        frames = sweeps.frames[number]
        metres, degrees = errors(sweeps.iterations(number)[iteration - 1], frames[line])
        rows.append(
            {
                "sweep": number,
                "iteration": iteration,
                "beside the line": "first" if line == 0 else "last",
                "apart, mm": f"{1000 * metres:.2f}",
                "apart, deg": f"{degrees:.4f}",
            }
        )
    return rows


def read_frames(file: Path) -> list[Float]:
    """T_map_laser (4, 4) of each line of a .frames file."""
    lines = [line for line in file.read_text().splitlines() if line.strip()]
    return [from_left_handed(np.array(line.split()[:16], float).reshape(4, 4).T) for line in lines]


def ring_table(bench: Bench) -> Table:
    """Sweeps round a block, with and without loops."""
    cases = list(itertools.product((True, False), bench.some(3)))
    return Table("A ring of sweeps", RING_NOTE, {"": bench.each(_round_the_block, cases, table="ring")})


def _round_the_block(bench: Bench, loops: bool, seed: int) -> Row:
    rectangles, stops = simulated.ring()
    rng = np.random.default_rng(seed)
    merger = SweepMerger(SweepConfig(method="gicp", loop_closure=loops))
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
    row = {
        "loop closure": "on" if loops else "off",
        "seed": seed,
        "last to first, mm": f"{off[-1]:.1f}",
        "largest, mm": f"{max(off):.1f}",
        "odometry alone": f"{odometry[0]:.1f} m, {odometry[1]:.0f} deg",
    }
    return row | ({} if bench.jobs > 1 else {"seconds": f"{time.perf_counter() - began:.1f}"})


def corridor_table(bench: Bench) -> Table:
    """What a bare corridor leaves open."""
    cases = list(itertools.product(METHODS, bench.some(CORRIDOR_PAIRS)))
    results = bench.each(_along_the_corridor, cases, table="corridor")
    rows = []
    for method in METHODS:
        of_method = [of for (name, _), of in zip(cases, results, strict=True) if name == method]
        along, odometry, across, said = zip(*of_method, strict=True)
        rows.append(
            {
                "method": method,
                "along, from odometry, mm": f"{1000 * np.median(along):.1f}, at most {1000 * max(along):.1f}",
                "odometry off along, mm": f"{1000 * np.median(odometry):.0f}, at most {1000 * max(odometry):.0f}",
                "across, mm": f"{1000 * np.median(across):.1f}, at most {1000 * max(across):.1f}",
                "said": ", ".join(f"{word}: {count}" for word, count in Counter(said).items()),
            }
        )
    return Table("A bare corridor", CORRIDOR_NOTE, {"": rows})


def _along_the_corridor(bench: Bench, method: str, seed: int) -> tuple[float, float, float, str]:
    """How far the match is along the axis from odometry, odometry from the truth; how far across; what was said."""
    rng = np.random.default_rng(seed)
    first = stop(100.0, 1.2, rng.uniform(-30, 30))
    second = stop(100.0 + CORRIDOR_STEP_M, rng.uniform(0.9, 1.5), rng.uniform(-30, 30))
    truth = se3.inverse(first) @ second
    guess = truth @ off_by(rng, *CORRIDOR_ODOMETRY)
    found = matched(simulated.bare_corridor(), first, second, guess, rng, method)
    axis = first[0, :3]
    off = found.T[:3, 3] - truth[:3, 3]
    along = abs(float(axis @ (found.T[:3, 3] - guess[:3, 3])))
    odometry = abs(float(axis @ (guess[:3, 3] - truth[:3, 3])))
    return along, odometry, float(np.linalg.norm(off - axis * (axis @ off))), found.quality


def rooms_table(bench: Bench) -> Table:
    """Rooms that do not overlap."""
    methods = ("gicp", "paper")
    cases = list(itertools.product(methods, bench.some(ROOM_PAIRS)))
    results = bench.each(_in_two_rooms, cases, table="rooms")
    rows = []
    for method in methods:
        refused = [of for (name, _), of in zip(cases, results, strict=True) if name == method]
        said = [f"{sum(column)} of {len(column)} refused" for column in zip(*refused, strict=True)]
        rows.append({"method": method} | dict(zip(("from odometry", "from the same place"), said, strict=True)))
    return Table("Rooms that do not overlap", ROOMS_NOTE, {"": rows})


def _in_two_rooms(bench: Bench, method: str, seed: int) -> tuple[bool, bool]:
    """Whether two sweeps are refused from odometry, and from the guess that both were taken at the same place."""
    rng = np.random.default_rng(seed)
    rectangles, (first, second) = simulated.two_rooms(rng)
    by_odometry = se3.inverse(first) @ second @ off_by(rng, 0.3, 8.0)
    from_odometry = matched(rectangles, first, second, by_odometry, rng, method)
    from_the_same_place = matched(rectangles, first, second, np.eye(4), rng, method)
    return bool(from_odometry.refused), bool(from_the_same_place.refused)


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
    "calibration": vertical_scans.calibration_table,
    "sides": alog_table,
    "speed": lambda bench: vertical_scans.speed_table(bench.quick),
}

HEAD = f"""\
# Benchmarks of registration

Made by

    python benchmarks/registration.py --data FOLDER

which takes a quarter of an hour; `--only TABLE` makes one of
{", ".join(TABLES)} anew,
`--quick` shows that all of it runs, and `--jobs N` does N cases at once, of which it does not say the time. The result
is in `out/benchmarks/`; this page is copied from there. FOLDER holds `sweeps/pcl_room/room_scan*.pcd`,
`sweeps/3dtk/scan00*` (the sample scans of 3DTK) and `vertical/QuadTree_Alog.alog.gz` (of the New College data set);
without `--data` they are left out.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the tables that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with recorded sweeps and scans")
    parser.add_argument(
        "--only", nargs="+", choices=TABLES, default=list(TABLES), metavar="TABLE", help=", ".join(TABLES)
    )
    parser.add_argument("--quick", action="store_true", help="two of each only, to see that it runs")
    parser.add_argument("--jobs", type=int, default=1, help="so many cases at once; their time is not told then")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    log.setLevel(logging.INFO)
    given.out.mkdir(parents=True, exist_ok=True)
    bench = Bench(given.data, given.quick, given.out, given.jobs)
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
