# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""All tables of docs/localization_benchmarks.md: how good, robust and fast localization is, beside published figures.

Usage: python benchmarks/localization.py [--data FOLDER] [--only TABLE ...] [--logs NAME ...] [--quick]
       [--jobs N] [--out FOLDER]

Writes localization_benchmarks.md, a JSON file a table and a picture to the folder. The page is put together from all
tables that lie there, so that one can be made anew. Without --data, or where a log is not in it, it says where the log
is to be had; the simulated robot in bags/ is always there.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import logging
import math
import multiprocessing
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import random_poses
import report
from numpy.typing import NDArray
from random_poses import Search
from report import Row, Table

from g2_recon import pictures, pipeline
from g2_recon.config import LocalizationConfig, SimulationConfig
from g2_recon.errors import InputError
from g2_recon.evaluation.relations import RelationsScore, read_relations, score_relations
from g2_recon.evaluation.trajectory_error import mean_position_error
from g2_recon.geometry import se2
from g2_recon.geometry.occupancy_grid import OccupancyGrid
from g2_recon.geometry.recording import Recording
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.localization.beams import Beams, beams
from g2_recon.localization.keyframes import Keyframes
from g2_recon.localization.methods import make_localizer
from g2_recon.localization.occupancy import GridBuilder
from g2_recon.localization.tracking import Tracker
from g2_recon.localization.warm_up import warm_up_localization
from g2_recon.recording.recordings import read_recording
from g2_recon.recording.trajectories import read_tum
from g2_recon.simulation.simulator import simulate
from g2_recon.switching import switching_soon

Float = NDArray[np.float64]

log = logging.getLogger("benchmarks")

ROOT = Path(__file__).resolve().parents[1]
BUNDLED = ROOT / "bags" / "first_floor"
FREIBURG = "http://ais.informatik.uni-freiburg.de/slamevaluation/datasets"
LASERAZOS = "laserazosSM3"
LASERAZOS_URL = "https://purl.org/censi/research/2007-plicp/laserazosSM3.log.gz"

DEFAULTS = LocalizationConfig()
NO_ODOMETRY = LocalizationConfig(use_odometry=False)
OURS = {
    "ours": (DEFAULTS, "trajectory"),
    "ours, causal": (DEFAULTS, "causal"),
    "ours, scan matching alone": (LocalizationConfig(loop_closure=False), "causal"),
    "ours, method paper": (LocalizationConfig(method="paper"), "trajectory"),
}
"""Settings, and which of the two trajectories."""

RANGE_NOISE_M = 0.01
NOISE = "noise of 1 cm"
NOISE_DRAWS = 5
DROPPED_SCANS, INVALID_BEAMS = 0.1, 0.2

# Guesses that are wrong by up to so many metres and degrees; the last are those of Minguez et al.
DISPLACEMENTS = ((0.05, 10.0), (0.1, 25.0), (0.2, 45.0))
PAIRS = 300
BACK_M, BACK_DEG = 0.02, 0.5

CHI_SQUARED_95 = -2 * math.log(0.05)  # two degrees of freedom
LASER_PERIOD_MS = 1000 / 75
# Free space seen from far away makes a floor plan of rays.
FARTHEST_DRAWN_M = 20.0
OTHER_SEEDS = (1, 2, 3, 4, 5)

ACCURACY_NOTE = """\
Mean +- standard deviation of the error in the relations of Kuemmerle et al., On measuring the accuracy of SLAM
algorithms, Autonomous Robots 27(4), 2009, from where the figures of scan matching, GMapping and Graph Mapping are;
those of Cartographer are from Hess et al., ICRA 2016. Those methods were tuned log by log, ours has its defaults for
all. In parentheses: the graph of that method helped to make the truth. ours: the trajectory after the end; causal: each
pose as it was known when its scan came, with the loops closed until then; scan matching alone: causal, with
loop_closure off; method paper: ICP of each scan against a global point map."""
ROBUSTNESS_NOTE = """\
Mean error in the relations and, in parentheses, how many times that of the undisturbed log it is. no odometry:
use_odometry off. Noise is normal and on every range; scans are dropped and beams made invalid at random. Relations of
dropped scans do not count."""
SPEED_NOTE = f"""\
Each in a process of its own with nothing beside it, all kernels compiled. MB: peak memory of the whole process, Python
and its libraries included. At once: loop closure and refinement included; the seconds of Cartographer are as published.
One by one: scans come with 75 Hz, whatever the speed of the recording, and loops are closed as they come: within how
many ms 50, 99 and 100 % of the scans have their pose, counted from when they came, and how many have it later than the
{LASER_PERIOD_MS:.1f} ms until the next one; s: of work, without waiting for scans."""
PAIRS_NOTE = f"""\
As in Minguez, Montesano and Lamiraux, T-RO 22(5), 2006, from whom {LASERAZOS} is: scans at random, laid on themselves
from a guess that is off by a random step, even in x, y and angle up to what is said; and laid on the scan before, where
what comes of the odometry as it is counts as the truth. The localizer knows one scan. guess, alone: it is told where to
look, and no odometry; odometry: it takes the guess for odometry, to which it holds where the scan says little, as along
a bare wall. back: within {100 * BACK_M:.0f} cm and {BACK_DEG}
deg; turned: not within {BACK_DEG} deg; wrong, believed: not back, and the match says that it is good."""
SIMULATION_NOTE = """\
The recording in bags/, 100 m through a simulated floor with corridors, beside its exact trajectory. mean: distance from
the truth, of the trajectory after the end and of the causal one; end: error of the last pose as seen from the first;
inside: share of the causal poses whose 95 % ellipse, by the covariance that came with each, holds the truth, which
counts over all drives together: the poses of one drive err together, by where its heading has drifted to; sigma:
median along the longer axis of the ellipse."""

# A place is right within this.
RIGHT_M, RIGHT_DEG = 0.1, 2.0
SEARCHES, BOXES, MAPPED_SHARE = 200, 15, 0.6
RELOCALIZATION_NOTE = f"""\
A simulated robot is put down at random on the floor of the recording in bags/, with the saved map of that recording and
no idea of its pose. It turns once around on the spot and then drives twice to where there is most room, 3 m at most,
until the place is sure. right: within {RIGHT_M:g} m and {RIGHT_DEG:g} deg of the truth; wrong: sure, but not right; at
once: right from a single scan of 180 deg and 8 m; slowest: longest time for one scan. {BOXES} new boxes: so many of the
size of people stand around that are not in the map; partly mapped: the map is that of the first {MAPPED_SHARE:.0%} of
the drive, and robots are also put down where it has never been, which they cannot know."""

# --quick: so many scans, draws and pairs.
QUICK_SCANS, QUICK_DRAWS, QUICK_PAIRS = 300, 1, 20


@dataclass(frozen=True, slots=True)
class Log:
    """A published log, with what OTHERS reach on it.

    stem: of its files. seconds: that Cartographer takes. translation: m, of all of OTHERS. rotation: degrees, of the
    last two. also: where else it is to be had.
    """

    name: str
    stem: str
    seconds: int
    translation: tuple[str, str, str, str]
    rotation: tuple[str, str]
    also: str = ""

    @property
    def files(self) -> str:
        """Pattern of the log in --data: people keep it packed or not."""
        return f"carmen/{self.stem}*.clf*"

    @property
    def relations(self) -> str:
        """The truth, in --data."""
        return f"relations/{self.stem}.relations"

    @property
    def url(self) -> str:
        """Where both are to be had."""
        return f"{FREIBURG}/{self.stem}.clf and {self.stem}.relations{self.also}"


OTHERS = ("scan matching", "GMapping", "Graph Mapping", "Cartographer")

LOGS = {
    "aces": Log(
        "ACES",
        "aces",
        41,
        ("0.173 +- 0.614", "0.060 +- 0.049", "0.044 +- 0.044", "0.0375 +- 0.0426"),
        ("0.4 +- 0.4", "0.373 +- 0.469"),
    ),
    "intel": Log(
        "Intel",
        "intel",
        179,
        ("0.220 +- 0.296", "0.070 +- 0.083", "0.031 +- 0.026", "0.0229 +- 0.0239"),
        ("1.3 +- 4.7", "0.453 +- 1.335"),
    ),
    "killian": Log(
        "Killian",
        "mit-killian",
        190,
        ("1.651 +- 4.138", "0.122 +- 0.386", "0.050 +- 0.056", "0.0395 +- 0.0488"),
        ("0.5 +- 0.5", "0.352 +- 0.353"),
        "; the scans also in https://github.com/MOLAorg/mola_test_datasets",
    ),
    "csail": Log(
        "CSAIL",
        "mit-csail",
        35,
        ("0.106 +- 0.325", "0.049 +- 0.049", "(0.004 +- 0.009)", "0.0319 +- 0.0363"),
        ("(0.05 +- 0.08)", "0.369 +- 0.365"),
    ),
}


# What is done in a process of its own


@dataclass(frozen=True, slots=True)
class Job:
    """A recording and how to localize it. seed: of the disturbance. scans: so many from the beginning, or all."""

    file: Path
    settings: LocalizationConfig = DEFAULTS
    disturbance: str = ""
    seed: int = 0
    scans: int | None = None

    @property
    def plain(self) -> bool:
        """Whether the recording is as it is, and the settings, too."""
        return self.settings == DEFAULTS and not self.disturbance

    def recording(self) -> Recording:
        """What is to be localized."""
        recording = kept(read_recording(self.file), slice(self.scans))
        if not self.disturbance:
            return recording
        return DISTURBANCES[self.disturbance](recording, np.random.default_rng(self.seed))

    def __str__(self) -> str:
        changed = [f"{name}={value}" for name, value in self.settings.model_dump(exclude_defaults=True).items()]
        disturbed = [f"{self.disturbance} {self.seed}"] if self.disturbance else []
        return " ".join([self.file.name.split(".")[0], *changed, *disturbed])


@dataclass(frozen=True, slots=True)
class Whole:
    """A whole log, localized: seconds to do so and, before, to read it; peak memory of the process."""

    localization: pipeline.Localization
    seconds: float
    reading_seconds: float
    peak_mb: float
    grid: OccupancyGrid | None


@dataclass(frozen=True, slots=True)
class Live:
    """N scans one by one.

    milliseconds: (N,) from when each came until it had its pose. seconds: of work, for all. poses: (N, 3). covariances:
    (N, 3, 3). peak_mb: memory of the process.
    """

    stamps: Float
    milliseconds: Float
    seconds: float
    poses: Float
    covariances: Float
    peak_mb: float


@dataclass(frozen=True, slots=True)
class Pairs:
    """Scans laid on others from wrong guesses: errors (N, 2) in m and degrees, and whether the match was believed."""

    errors: Float
    matched: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Followed:
    """A simulated robot, localized: errors in m, of poses as they came and as they were at the end.

    inside: share of the poses as they came whose 95 % ellipse holds the truth. sigma: m, median of its longer half
    axis at one standard deviation.
    """

    mean_error: float
    start_to_end: float
    causal_error: float
    inside: float
    sigma: float


def localize_whole(job: Job) -> Whole:
    """A recording at once; a plain one is timed with all kernels compiled, and there is a grid of it."""
    if job.plain:
        warm_up_localization()
    started = time.perf_counter()
    recording = job.recording()
    read = time.perf_counter()
    localization = pipeline.localize(recording, job.settings)
    done = time.perf_counter()
    peak_mb = report.peak_mb()
    grid = occupancy(recording, localization.trajectory, job.settings) if job.plain else None
    return Whole(localization, done - read, read - started, peak_mb, grid)


def localize_live(job: Job) -> Live:
    """A recording scan by scan, as a robot has them from its laser."""
    warm_up_localization()
    return live(job.recording(), job.settings, period=LASER_PERIOD_MS / 1000)


def live(recording: Recording, settings: LocalizationConfig, *, period: float = 0.0) -> Live:
    """As the node does it, but for ROS. Scans come every so many seconds, or each when the one before is done."""
    odometry = pipeline.odometry_at_scans(recording)
    localizer = make_localizer(settings, laser_pose(recording, settings))
    milliseconds = np.empty(len(recording.scans))
    found = []
    seconds = 0.0
    due = time.perf_counter()
    with switching_soon():
        for index, scan in enumerate(recording.scans):
            time.sleep(max(0.0, due - time.perf_counter()))
            started = time.perf_counter()
            found.append(localizer.process(scan, odometry[index]))
            done = time.perf_counter()
            seconds += done - started
            # One that had to wait for those before it is late by that, too.
            milliseconds[index] = 1000 * (done - due)
            due = due + period if period else done
    return Live(
        np.array([scan.stamp for scan in found]),
        milliseconds,
        seconds,
        np.array([scan.pose for scan in found]),
        np.array([scan.covariance for scan in found]),
        report.peak_mb(),
    )


def follow_simulated(job: Job, seed: int | None) -> Followed:
    """The bundled recording, or one made with another seed, beside its truth."""
    if seed is None:
        recording, truth = job.recording(), read_tum(job.file / "truth" / "trajectory.tum")
    else:
        simulation = simulate(SimulationConfig(seed=seed, vertical_every=1000))
        recording, truth = kept(simulation.recording, slice(job.scans)), simulation.trajectory
    localization = pipeline.localize(recording, job.settings)
    inside, sigma = ellipses(live(recording, job.settings), truth)
    T_map_base, known = truth.interpolate(localization.trajectory.stamps)
    ends = np.flatnonzero(known)[[0, -1]]
    true_way = se2.relative(*se2.from_se3(T_map_base[ends]))
    way = se2.relative(*localization.trajectory.planar()[ends])
    return Followed(
        mean_position_error(localization.trajectory, truth),
        float(np.hypot(*se2.relative(true_way, way)[:2])),
        mean_position_error(localization.causal, truth),
        inside,
        sigma,
    )


def ellipses(found: Live, truth: Trajectory) -> tuple[float, float]:
    """Share of the poses whose 95 % ellipse holds the truth, and median sigma in m along its longer axis."""
    T_map_base, known = truth.interpolate(found.stamps)
    errors = (found.poses[:, :2] - T_map_base[:, :2, 3])[known]
    spreads = found.covariances[known, :2, :2]
    distances = np.einsum("ni,ni->n", errors, np.linalg.solve(spreads, errors[..., None])[..., 0])
    sigma = np.sqrt(np.linalg.eigvalsh(spreads)[:, 1])
    return float(np.mean(distances <= CHI_SQUARED_95)), float(np.median(sigma))


def lay_pairs(job: Job, count: int) -> dict[tuple[bool, bool, float, float], Pairs]:
    """Scans laid on themselves or on their neighbors from wrong guesses.

    By: neighbor or not, guess from odometry or not, metres, degrees. Of neighbors the true step is not known: what the
    match makes of the odometry as it is is taken for it.
    """
    recording = job.recording()
    odometry = pipeline.odometry_at_scans(recording)
    ranges = {"range_min": job.settings.min_range, "range_max": job.settings.max_range}
    seen = [beams(scan, **ranges) for scan in recording.scans]
    result = {}
    for neighbor, trusted, (metres, degrees) in itertools.product((False, True), (False, True), DISPLACEMENTS):
        rng = np.random.default_rng(job.seed)
        most = np.array([metres, metres, math.radians(degrees)])
        picked = rng.choice(len(seen) - 1, min(count, len(seen) - 1), replace=False)
        errors, matched = [], []
        for first in picked:
            second = first + neighbor
            step = se2.relative(odometry[first], odometry[second])
            lay = functools.partial(lay_pair, seen[first], seen[second], trusted=trusted)
            truth = lay(step)[0] if neighbor else se2.IDENTITY
            found, believed = lay(se2.compose(step, rng.uniform(-most, most)))
            error = se2.relative(truth, found)
            errors.append((math.hypot(error[0], error[1]), math.degrees(abs(error[2]))))
            matched.append(believed)
        result[neighbor, trusted, metres, degrees] = Pairs(np.array(errors), np.array(matched))
    return result


def lay_pair(fixed: Beams, moving: Beams, guess: Float, *, trusted: bool) -> tuple[Float, bool]:
    """The pose (3,) of a scan seen from another, the only one that is known, and whether it is believed.

    trusted: the guess is said to come from odometry.
    """
    keyframes = Keyframes()
    keyframes.add(fixed, se2.IDENTITY)
    last, step = (se2.IDENTITY, guess) if trusted else (guess, None)
    placement = Tracker(keyframes).track(moving, last, step)
    return placement.pose, placement.matched


def laser_pose(recording: Recording, settings: LocalizationConfig) -> Float:
    """T_base_laser (4, 4)."""
    return pipeline.mounting_pose("localization", settings.laser_pose, recording.T_base_laser)


def occupancy(recording: Recording, trajectory: Trajectory, settings: LocalizationConfig) -> OccupancyGrid:
    """The grid of all scans, with the robot where the trajectory says."""
    poses = se2.compose(trajectory.planar(), se2.from_se3(laser_pose(recording, settings)))
    builder = GridBuilder(max_range=min(settings.max_range, FARTHEST_DRAWN_M))
    for pose, scan in zip(poses, recording.scans, strict=True):
        builder.add(pose, scan.angles(), scan.ranges, range_min=settings.min_range, range_max=scan.range_max)
    return builder.grid()


# Recordings that are worse than they were


def kept(recording: Recording, which: Any) -> Recording:
    """A recording with some of its horizontal scans only."""
    indices = np.arange(len(recording.scans))[which]
    odometry = None if recording.scan_odometry is None else recording.scan_odometry[indices]
    return replace(recording, scans=[recording.scans[i] for i in indices], scan_odometry=odometry)


def with_ranges(recording: Recording, change: Callable[[Scan], NDArray[Any]]) -> Recording:
    """A recording with other ranges (B,) in each scan."""
    return replace(recording, scans=[replace(s, ranges=change(s).astype(np.float32)) for s in recording.scans])


def with_noise(recording: Recording, rng: np.random.Generator) -> Recording:
    """Normal noise of 1 cm on every range."""
    return with_ranges(recording, lambda scan: scan.ranges + rng.normal(0, RANGE_NOISE_M, len(scan.ranges)))


def with_dropped_scans(recording: Recording, rng: np.random.Generator) -> Recording:
    """Scans at random are not there."""
    return kept(recording, rng.random(len(recording.scans)) >= DROPPED_SCANS)


def with_invalid_beams(recording: Recording, rng: np.random.Generator) -> Recording:
    """Beams at random measure nothing."""
    return with_ranges(recording, lambda s: np.where(rng.random(len(s.ranges)) < INVALID_BEAMS, np.nan, s.ranges))


DISTURBANCES: dict[str, Callable[[Recording, np.random.Generator], Recording]] = {
    "noise": with_noise,
    "dropped scans": with_dropped_scans,
    "invalid beams": with_invalid_beams,
}


# Tables


@dataclass(frozen=True, slots=True)
class Bench:
    """What all tables need. jobs: processes at a time. done: what was localized already, as several tables ask for."""

    data: Path | None
    out: Path
    quick: bool
    logs: tuple[str, ...]
    jobs: int
    done: dict[Job, Whole | str] = field(default_factory=dict)

    def find(self, pattern: str) -> Path | None:
        """A file of --data; None where there is none."""
        return min(self.data.glob(pattern), default=None) if self.data else None

    def present(self) -> list[tuple[Log, Path, Float]]:
        """The logs that are asked for and there, with their files and relations."""
        logs = [LOGS[name] for name in self.logs]
        found = [(entry, self.find(entry.files), self.find(entry.relations)) for entry in logs]
        return [(entry, file, read_relations(truth)) for entry, file, truth in found if file and truth]

    def job(self, file: Path, settings: LocalizationConfig = DEFAULTS, disturbance: str = "", seed: int = 0) -> Job:
        """A job on a whole recording; with --quick on its beginning."""
        return Job(file, settings, disturbance, seed, QUICK_SCANS if self.quick else None)

    def whole(self, jobs: Sequence[Job]) -> list[Whole | str]:
        """Jobs done, or why not; nothing runs beside plain ones, so that their time can be told."""
        wanted = [job for job in dict.fromkeys(jobs) if job not in self.done]
        for plain, at_a_time in ((True, 1), (False, self.jobs)):
            some = [job for job in wanted if job.plain == plain]
            self.done.update(zip(some, apart(localize_whole, [(job,) for job in some], at_a_time), strict=True))
        return [self.done[job] for job in jobs]


def apart(work: Callable[..., Any], calls: Sequence[tuple[Any, ...]], at_a_time: int = 1) -> list[Any]:
    """What a function returns, each time in a process of its own; where it fails, its last words."""

    def one(arguments: tuple[Any, ...]) -> Any:
        log.info("%s", " ".join([work.__name__, *(str(argument) for argument in arguments)]))
        try:
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
                return process.submit(told, work, arguments).result()
        except Exception as error:  # whatever it is, the other runs go on
            log.error("%s", error)
            return f"failed: {str(error).splitlines()[-1]}"

    with ThreadPoolExecutor(at_a_time) as threads:
        return list(threads.map(one, calls))


def told(work: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """What a function returns; what it raises becomes text, which can always be handed over to another process."""
    try:
        return work(*arguments)
    except Exception:
        raise RuntimeError(traceback.format_exc().rstrip()) from None


def scored(run: Whole, relations: Float, which: str = "trajectory") -> RelationsScore:
    """The error of a trajectory of a run; NaN where it covers none of the relations, as with --quick."""
    try:
        return score_relations(relations, getattr(run.localization, which))
    except InputError:
        return RelationsScore(0, len(relations), *4 * (math.nan,))


def translation(score: RelationsScore) -> str:
    """In metres, as published."""
    return f"{score.translation_mean:.4f} +- {score.translation_std:.4f}"


def rotation(score: RelationsScore) -> str:
    """In degrees, as published."""
    return f"{score.rotation_mean:.3f} +- {score.rotation_std:.3f}"


def table_accuracy(bench: Bench) -> Table | None:
    """Ours beside published figures."""
    logs = bench.present()
    if not logs:
        return None
    bench.whole([bench.job(file, settings) for settings, _ in OURS.values() for _, file, _ in logs])

    def ours(file: Path, relations: Float, shown: Callable[[RelationsScore], str]) -> Row:
        runs = {way: (bench.done[bench.job(file, settings)], which) for way, (settings, which) in OURS.items()}
        return {
            way: run if isinstance(run, str) else shown(scored(run, relations, which))
            for way, (run, which) in runs.items()
        }

    metres = [
        {"log": e.name} | dict(zip(OTHERS, e.translation, strict=True)) | ours(file, truth, translation)
        for e, file, truth in logs
    ]
    degrees = [
        {"log": e.name} | dict(zip(OTHERS[2:], e.rotation, strict=True)) | ours(file, truth, rotation)
        for e, file, truth in logs
    ]
    counts = [
        {"log": e.name, "relations": f"{scored(run, truth).relations:,} of {len(truth):,}"} | counts_of(run)
        for e, file, truth in logs
        if isinstance(run := bench.done[bench.job(file)], Whole)
    ]
    sections = {"Translation, m": metres, "Rotation, degrees": degrees, "What was done": counts}
    return Table("Accuracy", ACCURACY_NOTE, sections)


def counts_of(run: Whole) -> Row:
    """How much there was to do."""
    found = run.localization
    return {
        "scans": f"{len(found.trajectory):,}",
        "way, m": f"{found.trajectory.length():.1f}",
        "keyframes": f"{found.keyframes:,}",
        "loops": f"{found.loops:,}",
        "scans not matched": f"{found.unmatched:,}",
        "odometry jumps": f"{found.odometry_jumps:,}",
    }


def table_robustness(bench: Bench) -> Table | None:
    """Ours on recordings that are worse."""
    logs = bench.present()
    if not logs:
        return None
    draws = range(QUICK_DRAWS if bench.quick else NOISE_DRAWS)

    def jobs(file: Path) -> dict[str, list[Job]]:
        return {
            "undisturbed": [bench.job(file)],
            "no odometry": [bench.job(file, NO_ODOMETRY)],
            NOISE: [bench.job(file, disturbance="noise", seed=seed) for seed in draws],
            f"{DROPPED_SCANS:.0%} of scans dropped": [bench.job(file, disturbance="dropped scans")],
            f"{INVALID_BEAMS:.0%} of beams invalid": [bench.job(file, disturbance="invalid beams")],
        }

    bench.whole([job for _, file, _ in logs for some in jobs(file).values() for job in some])
    sections: dict[str, list[Row]] = {}
    for title, figure in FIGURES.items():
        rows = sections[title] = []
        for entry, file, truth in logs:
            row: Row = {"log": entry.name}
            undisturbed = math.nan
            for what, some in jobs(file).items():
                runs = [bench.done[job] for job in some]
                failures = [run for run in runs if isinstance(run, str)]
                values = [figure(run, truth) for run in runs if isinstance(run, Whole)]
                if failures:
                    row[what] = f"{len(failures)} of {len(runs)} {failures[0]}"
                elif what == "undisturbed":
                    undisturbed = values[0]
                    row[what] = f"{undisturbed:.4f}"
                elif what == NOISE:
                    row[f"{what}, mean of {len(draws)}"] = beside(float(np.mean(values)), undisturbed)
                    row[f"{what}, worst"] = beside(max(values), undisturbed)
                else:
                    row[what] = beside(values[0], undisturbed)
            rows.append(row)
    return Table("Robustness", ROBUSTNESS_NOTE, sections)


def beside(value: float, undisturbed: float) -> str:
    """A figure, and how many times another one it is, where that says something."""
    return f"{value:.4f}" + (f" (x {value / undisturbed:.2f})" if undisturbed > 0 else "")


def table_speed(bench: Bench) -> Table:
    """Time and memory, of a whole log at once and of scans one by one."""
    sources = [(entry.name, file, str(entry.seconds)) for entry, file, _ in bench.present()]
    sources.append((BUNDLED.name, BUNDLED, ""))
    wholes = bench.whole([bench.job(file) for _, file, _ in sources])
    lives = apart(localize_live, [(bench.job(file),) for _, file, _ in sources])
    at_once, one_by_one = [], []
    for (name, _, seconds), run, scans in zip(sources, wholes, lives, strict=True):
        at_once.append({"log": name} | (speed_of(run, seconds) if isinstance(run, Whole) else {"scans": run}))
        one_by_one.append({"log": name} | (latency_of(scans) if isinstance(scans, Live) else {"scans": scans}))
    return Table("Speed and memory", SPEED_NOTE, {"At once": at_once, "One by one": one_by_one})


def speed_of(run: Whole, published: str) -> Row:
    """The columns about a log at once."""
    trajectory = run.localization.trajectory
    return {
        "scans": f"{len(trajectory):,}",
        "recorded s": f"{np.ptp(trajectory.stamps):,.0f}",
        "Cartographer s": published,
        "s": f"{run.seconds:.1f}",
        "s to read it": f"{run.reading_seconds:.1f}",
        "MB": f"{run.peak_mb:.0f}",
    }


def latency_of(scans: Live) -> Row:
    """The columns about scans one by one."""
    times = scans.milliseconds
    return {
        "scans": f"{len(times):,}",
        **{f"{share} % within ms": f"{np.percentile(times, share):.1f}" for share in (50, 99, 100)},
        "too slow, %": f"{100 * np.mean(times > LASER_PERIOD_MS):.2f}",
        "s": f"{scans.seconds:.1f}",
        "MB": f"{scans.peak_mb:.0f}",
    }


def table_pairs(bench: Bench) -> Table:
    """Single scans from wrong guesses."""
    file = bench.find(f"carmen/{LASERAZOS}*.log*")
    sources = {"first_floor": BUNDLED} if file is None else {LASERAZOS: file, "first_floor": BUNDLED}
    count = QUICK_PAIRS if bench.quick else PAIRS
    found = apart(lay_pairs, [(bench.job(source), count) for source in sources.values()], bench.jobs)
    rows = []
    for name, result in zip(sources, found, strict=True):
        if isinstance(result, str):
            rows.append({"log": name, "laid on": result})
            continue
        for (neighbor, trusted, metres, degrees), pairs in result.items():
            guess = {
                "laid on": "neighbor" if neighbor else "itself",
                "guess": "odometry" if trusted else "alone",
                "off by up to": f"{metres:g} m, {degrees:g} deg",
            }
            rows.append({"log": name} | guess | pairs_of(pairs))
    sections = {"Pairs of scans": rows}
    if file is not None:
        alone, helped = bench.whole([bench.job(file, NO_ODOMETRY), bench.job(file)])
        if isinstance(alone, Whole) and isinstance(helped, Whole):
            apart_by = mean_position_error(alone.localization.trajectory, helped.localization.trajectory)
            sections[f"{LASERAZOS}, without odometry"] = [
                counts_of(alone) | {"from that with odometry, cm": f"{100 * apart_by:.1f}"}
            ]
    return Table("Wrong guesses", PAIRS_NOTE, sections)


def pairs_of(pairs: Pairs) -> Row:
    """The columns about pairs of scans."""
    back = (pairs.errors <= (BACK_M, BACK_DEG)).all(axis=1)
    median = np.median(pairs.errors, axis=0)
    return {
        "back, %": f"{100 * back.mean():.1f}",
        "turned, %": f"{100 * np.mean(pairs.errors[:, 1] > BACK_DEG):.1f}",
        "wrong, believed, %": f"{100 * np.mean(~back & pairs.matched):.1f}",
        "median error": f"{1000 * median[0]:.2f} mm, {median[1]:.3f} deg",
    }


def table_simulation(bench: Bench) -> Table:
    """The simulated robot beside its truth."""
    cases: list[tuple[str, LocalizationConfig, int | None]] = [
        ("first_floor", DEFAULTS, None),
        ("first_floor, no odometry", NO_ODOMETRY, None),
    ]
    for seed in () if bench.quick else OTHER_SEEDS:
        cases += [(f"with seed {seed}", DEFAULTS, seed), (f"with seed {seed}, no odometry", NO_ODOMETRY, seed)]
    calls = [(bench.job(BUNDLED, settings), seed) for _, settings, seed in cases]
    rows = []
    for (name, _, _), found in zip(cases, apart(follow_simulated, calls, bench.jobs), strict=True):
        rows.append(
            {"recording": name} | (simulation_of(found) if isinstance(found, Followed) else {"mean, cm": found})
        )
    return Table("Simulation", SIMULATION_NOTE, {"": rows})


def simulation_of(found: Followed) -> Row:
    """The columns about a simulated robot."""
    return {
        "mean, cm": f"{100 * found.mean_error:.2f}",
        "end, cm": f"{100 * found.start_to_end:.2f}",
        "mean causal, cm": f"{100 * found.causal_error:.2f}",
        "inside, %": f"{100 * found.inside:.1f}",
        "sigma, cm": f"{100 * found.sigma:.2f}",
    }


def table_relocalization(bench: Bench) -> Table:
    """Global localization in a saved map."""
    count = QUICK_PAIRS if bench.quick else SEARCHES
    cases = {
        "the floor": (1.0, 0),
        f"{BOXES} new boxes": (1.0, BOXES),
        "partly mapped": (MAPPED_SHARE, 0),
    }
    found = apart(put_down, [(bench.job(BUNDLED), *case, count) for case in cases.values()], bench.jobs)
    rows = [
        {"map": name} | (relocalization_of(result) if isinstance(result, list) else {"poses": result})
        for name, result in zip(cases, found, strict=True)
    ]
    return Table("Relocalization", RELOCALIZATION_NOTE, {"": rows})


def put_down(job: Job, share: float, boxes: int, count: int) -> list[Search]:
    """Robots in the map of a share of a recording."""
    recording = job.recording()
    mapped = pipeline.localize(kept(recording, slice(int(share * len(recording.scans)))), job.settings)
    assert mapped.session is not None
    return random_poses.searches(mapped.session, job.settings, count, boxes=boxes)


def relocalization_of(found: Sequence[Search]) -> Row:
    """The columns about robots that were put down."""
    sure = np.array([not math.isnan(one.metres) for one in found])
    right = np.array([one.metres <= RIGHT_M and one.degrees <= RIGHT_DEG for one in found])
    at_once = right & np.array([one.scans == 0 for one in found])
    errors = [one.metres for one in found if not math.isnan(one.metres)]
    return {
        "poses": len(found),
        "right, %": f"{100 * right.mean():.1f}",
        "wrong, %": f"{100 * np.mean(sure & ~right):.1f}",
        "not sure, %": f"{100 * np.mean(~sure):.1f}",
        "at once, %": f"{100 * at_once.mean():.1f}",
        "scans, median": f"{np.median([one.scans + 1 for one in found]):.0f}",
        "median error, cm": f"{100 * np.median(errors):.1f}" if errors else "",
        "slowest, s": f"{max(one.slowest for one in found):.2f}",
    }


def table_maps(bench: Bench) -> Table:
    """Floor plans."""
    logs = [(entry.name, file) for entry, file, _ in bench.present()] or [("first_floor", BUNDLED)]
    runs = bench.whole([bench.job(file) for _, file in logs])
    plans, titles = [], []
    for (name, _), run in zip(logs, runs, strict=True):
        if isinstance(run, Whole):
            trajectory = run.localization.trajectory
            plans.append(pictures.FloorPlan(np.empty((0, 2)), trajectory, run.grid))
            titles.append(f"{name}: {len(trajectory):,} scans, {trajectory.length():.0f} m")
    note = "Occupancy grids with cells of 5 cm: free white, occupied black, unknown gray; the way colored by time."
    if not plans:
        return Table("Floor plans", "All failed.", {})
    pictures.draw_floor_plans(bench.out / "localization_maps.png", plans, titles)
    return Table("Floor plans", note, {}, ["localization_maps.png"])


FIGURES: dict[str, Callable[[Whole, Float], float]] = {
    "Translation, m": lambda run, truth: scored(run, truth).translation_mean,
    "Rotation, degrees": lambda run, truth: scored(run, truth).rotation_mean,
    "Scans not matched, %": lambda run, _: 100 * run.localization.unmatched / len(run.localization.trajectory),
}
"""Of table robustness."""

TABLES: dict[str, Callable[[Bench], Table | None]] = {
    "accuracy": table_accuracy,
    "robustness": table_robustness,
    "speed": table_speed,
    "pairs": table_pairs,
    "simulation": table_simulation,
    "relocalization": table_relocalization,
    "maps": table_maps,
}


def page(out: Path) -> str:
    """All tables that are in a folder, as one page."""
    head = f"""\
# Benchmarks of localization

Made by

    python benchmarks/localization.py --data FOLDER

which takes about an hour. `--only TABLE` makes one of {", ".join(TABLES)} anew, `--logs NAME`
takes some of the logs; `--quick` shows in a few minutes that all of it runs. The result is in `out/benchmarks/`; this
page and its picture are copied from there. Without `--data` only the simulated robot in bags/ is used. FOLDER holds

| file | of |
|---|---|
"""
    head += "".join(
        f"| `{entry.files}`, `{entry.relations}` | {entry.name}: {entry.url} |\n" for entry in LOGS.values()
    )
    head += f"| `carmen/{LASERAZOS}*.log*` | {LASERAZOS}: {LASERAZOS_URL} |\n"
    return report.page(head, [path_of(out, name) for name in TABLES])


def path_of(out: Path, table: str) -> Path:
    """Where a table is kept; other benchmarks may have one of that name in the same folder."""
    return out / f"localization_{table}.json"


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the tables that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with logs and relations that are not in the repository")
    parser.add_argument(
        "--only", nargs="+", choices=TABLES, default=list(TABLES), metavar="TABLE", help=", ".join(TABLES)
    )
    parser.add_argument("--logs", nargs="+", choices=LOGS, default=list(LOGS), metavar="NAME", help=", ".join(LOGS))
    parser.add_argument("--quick", action="store_true", help="beginnings of recordings only, to see that it runs")
    parser.add_argument("--jobs", type=int, default=2, help="processes at a time, of what is not timed (default: 2)")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    log.setLevel(logging.INFO)
    given.out.mkdir(parents=True, exist_ok=True)
    bench = Bench(given.data, given.out, given.quick, tuple(given.logs), max(given.jobs, 1))
    say_what_is_missing(bench)
    apart(warm_up_localization, [()])
    for name in given.only:
        table = TABLES[name](bench)
        if table is None:
            log.warning("%s: not made, there is no log", name)
            continue
        report.save(path_of(given.out, name), table)
        (given.out / "localization_benchmarks.md").write_text(page(given.out))
    log.info("%s", given.out / "localization_benchmarks.md")


def say_what_is_missing(bench: Bench) -> None:
    """Where the logs are to be had that are not there."""
    there = {entry.name for entry, _, _ in bench.present()}
    for entry in (LOGS[name] for name in bench.logs):
        if entry.name not in there:
            log.warning("%s is left out: no %s and %s; see %s", entry.name, entry.files, entry.relations, entry.url)
    if bench.find(f"carmen/{LASERAZOS}*.log*") is None:
        log.warning("%s is left out: no carmen/%s*.log*; see %s", LASERAZOS, LASERAZOS, LASERAZOS_URL)


if __name__ == "__main__":
    main()
