# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/registration_benchmarks.md on vertical scans; made by benchmarks/registration.py."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import moos
import numpy as np
import simulated_drives as drives
import simulated_sweeps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from report import Row, Table
from scipy.spatial import cKDTree
from scipy.stats import chi2

from g2_recon import pipeline
from g2_recon.config import G2ReconConfig, LocalizationConfig, RecordingConfig, RegistrationConfig, SimulationConfig
from g2_recon.evaluation.surface import SAMPLES, THRESHOLDS_M, sample_surface, score_surface
from g2_recon.geometry import se3
from g2_recon.geometry.closest import closest_in_tree, triangle_tree
from g2_recon.geometry.cloud import Cloud, Piece, concatenate
from g2_recon.geometry.mesh import TrueSurface
from g2_recon.geometry.recording import Recording
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.localization.localizer import Localizer
from g2_recon.reconstruction.collected_cloud import CollectedCloud
from g2_recon.recording.recordings import read_recording
from g2_recon.registration.calibration import calibrate
from g2_recon.registration.registrar import Registrar
from g2_recon.simulation.building import Rectangles, first_floor, surfaces
from g2_recon.simulation.raycasting import cast
from g2_recon.simulation.simulator import simulate
from g2_recon.simulation.tours import FULL_TOUR

Float = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[1]
BUNDLED = ROOT / "bags" / "first_floor"
ALOG = "vertical/QuadTree_Alog.alog.gz"

SIGMA_M = 0.01
SEEN_M = 0.10
TURN_RATE = np.radians(45.0)
SPEED_SCANS, SPEED_TRIES = 4000, 5
CALIBRATION_SEEDS = 8
START_M, START_DEG = 0.05, 3.0
LATENCY_RATE = 1.0

BEAMS_NOTE = """\
Registered with the true trajectory, 25 poses a second. Distance along the beam from the registered point to the exact
surface, mean of the absolute values, in units of the noise of a range (sigma 1 cm, without mixed pixels; for a normal
distribution it would be 0.80). Straight on at 0.5 m/s, and turning in place at 45 deg/s."""
WHOLE_NOTE = """\
`g2-recon run bags/first_floor`: distance of the points of `cloud.ply` to the nearest true surface; the mesh as by
`g2-recon evaluate surface`. F5, F2: of surfaces within 10 cm of a place where a beam of the vertical laser really met
a surface, by the simulation, without noise and mixed pixels; what of the truth is farther from all such places does not
count. seen: of these only what faces the way that the surface met there does; the lower side of a desk and the back of
a panel are near to what was seen, but nobody has seen them. live: scans and poses as they come on the robot, keyframes
once a second, no refinement at the end; the cloud that somebody has who takes in all pieces, without scans that showed
nothing new. true trajectory: what
the best of all localizers would lead to."""
FOLLOW_NOTE = """\
bags/first_floor live, with an error in every keyframe that a closed loop takes back: after 150 s all keyframes
until then are moved, the last by 0.5 m and 2 deg, earlier ones in proportion. All scans are kept. Distance of the
points to where the trajectory at the end has them; pieces handed out anew, and the most processor time one took."""
CALIBRATION_NOTE = f"""\
From a start {START_DEG:g} deg and {100 * START_M:g} cm off, about and along random axes, with a laser that is mounted
otherwise each time (up to 5 cm and 10 deg an axis). Largest error of the axes that are said to be observed: position
and turns; within 95 %: how often the error of all of them together lies in the region that the covariance gives.
room: two legs through a furnished room, trajectory off by 4 mm and 0.05 deg, alike for about a second; first floor:
the tour of the bundled recording, with the same errors of the trajectory."""
ALOG_NOTE = """\
3.5 s of the New College data set: two lasers that look to the sides, 75 scans a second each, of beams from 45 deg
down to 45 deg up, and wheel odometry; nothing else is used. RMS distance of the points from the plane through the
ground beside the robot (height below 15 cm, within 3 m) and through the wall (0.3 m to 1.5 m high, farther than 4 m to
the left); the farthest tenth does not count. The robot leans by some 2 deg, and so the ground rises to the right."""
SPEED_NOTE = f"""\
registrar: {SPEED_SCANS} scans of 181 beams at 75 a second, 25 poses a second, by processor time, fastest of
{SPEED_TRIES} tries; all are kept and handed out.
live: `localizer_node` and `registrar_node` as processes, bags/first_floor replayed at real time; from when the pose
that a scan waited for is there to when the cloud is there, both as received by a third process."""


def beams_table() -> Table:
    """How far registered points are from the surface along their beams."""
    room = simulated_sweeps.furnished_room()
    rows = []
    spin = [((4.0, 3.5), (4.02, 3.5))] + [((4.02, 3.5), (4.0, 3.5)), ((4.0, 3.5), (4.02, 3.5))] * 3
    for name, legs, settings in (
        ("0.5 m/s", drives.STRAIGHT_LEGS, {}),
        ("turning at 45 deg/s", spin, {"max_turn_rate": float(TURN_RATE)}),
    ):
        found = drives.vertical_drive(room, legs, drives.mount(), 0, every=2, mixed_pixels=False, **settings)
        known = found.trajectory.resampled(0.04)
        clouds = register(found.scans, known, drives.mount())
        speed = moving(found.trajectory, [stamp for stamp, _ in clouds])
        fast = speed[:, 0] > 0.49 if name == "0.5 m/s" else speed[:, 1] > 0.99 * TURN_RATE
        cloud = concatenate([cloud for (_, cloud), takes in zip(clouds, fast, strict=True) if takes])
        off = along_the_beam(room, cloud)
        rows.append(
            {
                "motion": name,
                "scans": int(fast.sum()),
                "points": f"{len(cloud):,}",
                "off, in sigma": f"{np.mean(np.abs(off)) / SIGMA_M:.2f}",
                "bias, mm": f"{1000 * np.mean(off):.2f}",
            }
        )
    return Table("Vertical scans with the true trajectory", BEAMS_NOTE, {"": rows})


def moving(trajectory: Trajectory, stamps: list[float]) -> Float:
    """Speed in m/s and turn rate in rad/s (N, 2) at times within."""
    step = 0.05
    before, after = (trajectory.interpolate(np.array(stamps) + side * step)[0] for side in (-1, 1))
    moved = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    turned = np.arccos(np.clip((np.einsum("nij,nij->n", before[:, :3, :3], after[:, :3, :3]) - 1) / 2, -1, 1))
    return np.nan_to_num(np.column_stack([moved, turned]) / (2 * step))


def register(scans: list, trajectory: Trajectory, T_base_laser: Float) -> list[tuple[float, Cloud]]:
    """Stamp and cloud of each scan that can be placed."""
    registrar = Registrar(RegistrationConfig(), T_base_laser)
    for stamp, pose in zip(trajectory.stamps.tolist(), trajectory.matrices(), strict=True):
        registrar.add_pose(stamp, pose)
        while scans and scans[0].last_stamp <= stamp:
            registrar.add_scan(scans[0])
            scans = scans[1:]
    return [(registered.stamp, registered.cloud) for registered in registrar.finish()]


def along_the_beam(rectangles: Rectangles, cloud: Cloud) -> Float:
    """How far (N,) points lie behind the surface that their beams meet first, in metres."""
    assert cloud.sensor is not None
    away = cloud.points - cloud.sensor
    ranges = np.linalg.norm(away, axis=1)
    return ranges - cast(rectangles, cloud.sensor, away / ranges[:, None])


def whole_table(quick: bool) -> Table:
    """The whole way on the bundled recording."""
    recording = read_recording(BUNDLED, RecordingConfig())
    simulation = simulate(SimulationConfig())
    truth = TrueSurface(simulation.vertices, simulation.faces, simulation.clean_vertical)
    tree = triangle_tree(truth.vertices, truth.faces)
    clouds = {"live": live(recording, RegistrationConfig())[0]}
    if not quick:
        exact = pipeline.register(recording, simulation.trajectory, RegistrationConfig()).cloud
        clouds |= {"offline": pipeline.run(recording, G2ReconConfig()).registration.cloud, "true trajectory": exact}
    rows = []
    for name, cloud in clouds.items():
        off = 100 * closest_in_tree(cloud.points, tree, workers=0).distance
        row: Row = {"cloud": name, "points": f"{len(cloud):,}", "cloud off, cm": f"{off.mean():.2f}"}
        row["median, cm"] = f"{np.median(off):.2f}"
        if not quick:
            mesh = pipeline.reconstruct_surface(cloud, G2ReconConfig().reconstruction).mesh
            score = score_surface(truth, mesh.vertices, mesh.faces, workers=0)
            row |= {f"F{100 * at.threshold:.0f}": f"{100 * at.f_score:.1f}" for at in score.at}
            row |= dict(zip(("F5, seen", "F2, seen"), seen_scores(truth, mesh.vertices, mesh.faces), strict=True))
            row |= {
                "accuracy, cm": f"{100 * score.accuracy:.2f}",
                "completeness, cm": f"{100 * score.completeness:.2f}",
            }
        rows.append(row)
    return Table("The whole way on bags/first_floor", WHOLE_NOTE, {"": rows})


def seen_scores(truth: TrueSurface, vertices: Float, faces: NDArray[np.int64]) -> list[str]:
    """F-scores at 5 and 2 cm of what was seen from its side."""
    assert truth.seen is not None
    true_tree = triangle_tree(truth.vertices, truth.faces)
    normals = np.cross(*(truth.vertices[truth.faces[:, k]] - truth.vertices[truth.faces[:, 0]] for k in (1, 2)))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    met = normals[closest_in_tree(truth.seen, true_tree, workers=0).face]
    on_truth, facing = sample_surface(truth.vertices, truth.faces, SAMPLES, 1)
    # In metres and, so that other sides are far away, unit normals.
    seen = cKDTree(np.hstack([truth.seen, met])).query(np.hstack([on_truth, facing]))[0] < SEEN_M
    on_mesh, _ = sample_surface(vertices, faces, SAMPLES, 2)
    to_truth = closest_in_tree(on_mesh, true_tree, workers=0).distance
    to_mesh = closest_in_tree(on_truth[seen], triangle_tree(vertices, faces), workers=0).distance
    scores = []
    for threshold in THRESHOLDS_M:
        precision, recall = (to_truth < threshold).mean(), (to_mesh < threshold).mean()
        scores.append(f"{200 * precision * recall / (precision + recall):.1f}")
    return scores


def live(
    recording: Recording, config: RegistrationConfig, error: Float | None = None
) -> tuple[Cloud, Registrar, Trajectory, list[float]]:
    """The cloud of somebody who takes in all pieces, the registrar, the trajectory at the end, seconds for each piece.

    error: (3,) of the keyframe at 150 s, which is taken back then; earlier ones have a share of it.
    """
    assert recording.T_base_laser is not None and recording.T_base_laser_vertical is not None
    localizer = Localizer(LocalizationConfig(), recording.T_base_laser, keep_scans=True)
    registrar = Registrar(config, recording.T_base_laser_vertical, keep_scans=True)
    odometry = pipeline.odometry_at_scans(recording)
    collected, seconds = CollectedCloud(), []
    begin = recording.scans[0].stamp
    next_told, keyframes_changed = begin, False

    def spoiled(trajectory: Trajectory, now: float) -> Trajectory:
        if error is None:
            return trajectory
        share = np.clip((trajectory.stamps - begin) / 150.0, 0, 1) * (now < begin + 150.0)
        return Trajectory.from_se2(trajectory.stamps, trajectory.planar() + share[:, None] * error)

    def take_in() -> None:
        for registered in registrar.take():
            collected.add(registered.cloud, Piece(0, registered.piece, registered.revision))

    vertical = iter([*recording.scans_vertical, None])
    waiting = next(vertical)
    for index, scan in enumerate(recording.scans):
        while waiting is not None and waiting.stamp <= scan.stamp:
            registrar.add_scan(waiting)
            waiting = next(vertical)
        result = localizer.process(scan, odometry[index])
        keyframes_changed |= result.keyframe
        pose = spoiled(Trajectory.from_se2([scan.stamp], result.pose[None]), scan.stamp)
        registrar.add_pose(scan.stamp, pose.matrices()[0])
        take_in()
        if keyframes_changed and scan.stamp >= next_told:
            next_told, keyframes_changed = scan.stamp + 1.0, False
            registrar.follow(spoiled(localizer.keyframes(), scan.stamp))
            began = time.thread_time()
            while (renewed := registrar.renew()) is not None:
                seconds.append(time.thread_time() - began)
                collected.add(renewed.cloud, Piece(0, renewed.piece, renewed.revision))
                began = time.thread_time()
    registrar.follow(localizer.keyframes())
    for renewed in iter(registrar.renew, None):
        collected.add(renewed.cloud, Piece(0, renewed.piece, renewed.revision))
    return collected.cloud(), registrar, localizer.trajectory(), seconds


def follow_table() -> Table:
    """What becomes of a cloud when the past is corrected."""
    recording = read_recording(BUNDLED, RecordingConfig())
    rows = []
    # The points are compared one by one.
    every_scan = RegistrationConfig(new_points=0.0, scan_distance=0.0)
    for name, error in (("as localized", None), ("with an error", np.array([0.5, 0.0, np.radians(2.0)]))):
        followed, registrar, trajectory, seconds = live(recording, every_scan, error)
        end = pipeline.register(recording, trajectory, RegistrationConfig()).cloud
        off = 1000 * np.linalg.norm(followed.points - end.points, axis=1)
        rows.append(
            {
                "drive": name,
                "off, mean, mm": f"{off.mean():.1f}",
                "largest, mm": f"{off.max():.0f}",
                "pieces placed anew": len(seconds),
                "longest, ms": f"{1000 * max(seconds):.1f}",
                "scans kept": registrar.kept,
            }
        )
    return Table("Clouds that follow closed loops", FOLLOW_NOTE, {"": rows})


class Cases(Protocol):
    """What a table of many cases needs of registration.Bench."""

    def some(self, count: int) -> range:
        """So many, or a few."""

    def each(self, function: Callable[..., Any], cases: Iterable[tuple[Any, ...]], *, table: str) -> list[Any]:
        """What a function makes of this and each case, in their order."""


def calibration_table(bench: Cases) -> Table:
    """How well the mounting pose is found."""
    drives_of = tuple(_calibration_drives())
    cases = [(name, seed) for name in drives_of for seed in bench.some(CALIBRATION_SEEDS)]
    results = bench.each(_calibrated, cases, table="calibration")
    rows = []
    for name in drives_of:
        found = [of for case, of in zip(cases, results, strict=True) if case[0] == name]
        off = np.abs(np.array([errors for errors, _ in found]))
        rows.append(
            {
                "drive": name,
                "drives": len(found),
                "largest, cm": f"{100 * np.nanmax(off[:, :3]):.2f}",
                "largest, deg": f"{np.degrees(np.nanmax(off[:, 3:])):.3f}",
                "median, cm": f"{100 * np.nanmedian(off[:, :3]):.2f}",
                "median, deg": f"{np.degrees(np.nanmedian(off[:, 3:])):.3f}",
                "within 95 %": f"{sum(inside for _, inside in found)} of {len(found)}",
                "height observed": f"{int(np.isfinite(off[:, 2]).sum())} of {len(found)}",
            }
        )
    return Table("Calibration of the vertical laser", CALIBRATION_NOTE, {"": rows})


def _calibration_drives() -> dict[str, tuple[Rectangles, drives.Legs, int]]:
    """What is driven through and how; of the scans, one in how many is kept."""
    return {
        "room": (simulated_sweeps.furnished_room(), drives.ROOM_LEGS, 13),
        "first floor": (surfaces(first_floor()), FULL_TOUR, 26),
    }


def _calibrated(bench: Cases, name: str, seed: int) -> tuple[list[float], bool]:
    """Errors (6,) in m and rad, NaN where the axis is not observed, and whether they are within the region of 95 %."""
    rectangles, legs, every = _calibration_drives()[name]
    rng = np.random.default_rng(seed)
    truth = drives.mount(rng)
    found = drives.vertical_drive(rectangles, legs, truth, seed, every=every)
    start = drives.off_by(truth, rng, START_M, START_DEG)
    result = calibrate(found.scans, drives.as_localized(found.trajectory, seed), start, RegistrationConfig())
    off = drives.error(result.T_base_laser, truth)
    axes = np.flatnonzero(result.sigma < 0.02)
    score = off[axes] @ np.linalg.solve(result.covariance[np.ix_(axes, axes)], off[axes])
    observed = np.where(np.isin(np.arange(6), axes), off, np.nan)
    return observed.tolist(), bool(score < chi2.ppf(0.95, len(axes)))


def alog_table(data: Path, out: Path) -> Table:
    """Two lasers that look to the sides, and a picture."""
    scans, odometry = moos.read_alog(data / ALOG)
    clouds = {}
    rows = []
    for side in scans:
        registered = register(scans[side], odometry, moos.mounting_pose(side))
        cloud = concatenate([cloud for _, cloud in registered])
        if not clouds:
            T = along_the_wall(cloud.points, odometry)
        clouds[side] = se3.transform_points(se3.inverse(T), cloud.points)
        ground = clouds[side][(clouds[side][:, 2] < 0.15) & (np.abs(clouds[side][:, 1]) < 3.0)]
        row: Row = {"laser": side, "scans": f"{len(registered)} of {len(scans[side])}", "points": f"{len(cloud):,}"}
        row["ground, RMS, mm"] = f"{1000 * thickness(ground):.0f}"
        wall = clouds[side][(clouds[side][:, 2] > 0.3) & (clouds[side][:, 2] < 1.5) & (clouds[side][:, 1] > 4.0)]
        row["wall, RMS, mm"] = f"{1000 * thickness(wall):.0f}" if len(wall) > 100 else "none near"
        rows.append(row)
    draw_sides(out / "vertical_lasers.png", clouds)
    return Table("Two lasers to the sides, outdoors", ALOG_NOTE, {"": rows}, ["vertical_lasers.png"])


def along_the_wall(points: Float, trajectory: Trajectory) -> Float:
    """A frame (4, 4) at the start of the way: forward, as the wall to the left goes, to the left, up."""
    way = trajectory.positions[-1] - trajectory.positions[0]
    T = se3.from_se2([*trajectory.positions[0, :2], np.arctan2(way[1], way[0])])
    seen = se3.transform_points(se3.inverse(T), points)
    wall = seen[(seen[:, 2] > 0.3) & (seen[:, 2] < 1.2) & (seen[:, 1] > 4.0), :2]
    along = np.linalg.svd(wall - wall.mean(axis=0), full_matrices=False)[2][0]
    return T @ se3.from_se2([0.0, 0.0, np.arctan(along[1] / along[0])])


def thickness(points: Float) -> float:
    """RMS distance in metres of points (N, 3) from the plane through them; the farthest tenth does not count."""
    keep = points
    for _ in range(5):
        center = keep.mean(axis=0)
        normal = np.linalg.svd(keep - center, full_matrices=False)[2][2]
        off = np.abs((points - center) @ normal)
        keep = points[off <= np.quantile(off, 0.9)]
    return float(np.sqrt(np.mean(((keep - center) @ normal) ** 2)))


def draw_sides(path: Path, clouds: dict[str, Float]) -> None:
    """Both clouds, from behind and from the right."""
    figure = Figure(figsize=(11, 7), layout="constrained")
    FigureCanvasAgg(figure)
    behind, side = figure.subplots(2, 1)
    for (name, points), color in zip(clouds.items(), ("#24476b", "#d1495b"), strict=True):
        near = points[(np.abs(points[:, 1]) < 12) & (points[:, 2] < 6)]
        behind.plot(-near[:, 1], near[:, 2], ",", color=color)
        side.plot(near[:, 0], near[:, 2], ",", color=color, label=name)
    behind.set(xlabel="across, m", ylabel="height, m", aspect="equal", title="from behind, along the wall")
    side.set(xlabel="along, m", ylabel="height, m", aspect="equal", title="from the right")
    figure.savefig(path, dpi=90)


def speed_table(quick: bool) -> Table:
    """How fast the registrar is, and how long a live cloud takes."""
    rows = [{"": "registrar, scans a second", "measured": f"{scans_a_second(500 if quick else SPEED_SCANS):,.0f}"}]
    rows += [] if quick else list(latency_rows())
    return Table("Speed of vertical scans", SPEED_NOTE, {"": rows})


def scans_a_second(count: int) -> float:
    """Of 181 beams, on one core, where all are needed."""
    every_scan = RegistrationConfig(new_points=0.0, scan_distance=0.0)
    found = drives.vertical_drive(simulated_sweeps.furnished_room(), drives.ROOM_LEGS, drives.mount(), 0, every=1)
    scans = [replace(found.scans[i % len(found.scans)], stamp=i / 75.0) for i in range(count)]
    poses = found.trajectory.matrices()
    best = np.inf
    for _ in range(SPEED_TRIES):
        registrar = Registrar(every_scan, drives.mount(), keep_scans=True)
        began = time.thread_time()
        posed = 0
        for scan in scans:
            while posed / 25.0 <= scan.stamp:
                registrar.add_pose(posed / 25.0, poses[4 * posed % len(poses)])
                posed += 1
            registrar.add_scan(scan)
            registrar.take()
        best = min(best, time.thread_time() - began)
    return count / best


def latency_rows() -> Iterator[Row]:
    """Live, over ROS; nothing where it is not installed."""
    try:
        import rclpy
    except ImportError:
        return
    yield from measured_latency(rclpy)


def measured_latency(rclpy) -> Iterator[Row]:  # type: ignore[no-untyped-def]
    """Replay the bundled recording through processes and note when poses and clouds come."""
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from sensor_msgs.msg import PointCloud2

    from g2_recon.nodes import conversions

    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}

    def start(name: str, *arguments: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"g2_recon.nodes.{name}", "--ros-args", *arguments]
        return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    rclpy.init()
    node = rclpy.create_node("latency")
    poses: list[tuple[float, float]] = []
    clouds: list[tuple[float, float]] = []

    def on_pose(message: PoseWithCovarianceStamped) -> None:
        poses.append((conversions.stamp_seconds(message.header.stamp), time.monotonic()))

    def on_cloud(message: PointCloud2) -> None:
        piece = conversions.piece_from_message(message)
        if piece is not None and piece.revision == 0:
            clouds.append((conversions.stamp_seconds(message.header.stamp), time.monotonic()))

    node.create_subscription(PoseWithCovarianceStamped, "pose", on_pose, 1000)
    node.create_subscription(PointCloud2, "cloud", on_cloud, 1000)
    parameters = ["--params-file", str(ROOT / "config/g2.yaml")]
    processes = [start(name, *parameters) for name in ("localizer_node", "registrar_node")]
    try:
        replay = start("replay_node", "-p", f"bag:={BUNDLED}", "-p", f"rate:={LATENCY_RATE}")
        while replay.poll() is None:
            rclpy.spin_once(node, timeout_sec=0.2)
        end = time.monotonic() + 3.0
        while time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.2)
    finally:
        for process in processes:
            process.send_signal(signal.SIGINT)
            process.wait(20)
        node.destroy_node()
        rclpy.try_shutdown()
    last_beam = 180 / (75.0 * 360)
    stamps, received = np.array(sorted(poses)).T
    waited = np.searchsorted(stamps, np.array([stamp + last_beam for stamp, _ in clouds]))
    late = np.array([seconds for _, seconds in clouds])[waited < len(stamps)] - received[waited[waited < len(stamps)]]
    late = 1000 * np.maximum(late, 0.0)
    yield {
        "": "live clouds",
        "measured": f"{len(late)} of {len(read_recording(BUNDLED, RecordingConfig()).scans_vertical)}",
    }
    yield {"": "median, ms after the pose", "measured": f"{np.median(late):.1f}"}
    yield {"": "99 %, ms after the pose", "measured": f"{np.quantile(late, 0.99):.1f}"}
    yield {"": "within 20 ms", "measured": f"{100 * np.mean(late < 20):.1f} %"}
