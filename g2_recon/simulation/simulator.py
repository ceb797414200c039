# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The simulated drive: what the robot recorded, and the truth beside it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.config import SimulationConfig
from g2_recon.geometry import se3
from g2_recon.geometry.recording import Recording
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.progress import Progress, silent
from g2_recon.simulation.building import Rectangles, first_floor, surfaces, triangles
from g2_recon.simulation.lms200 import Lms200
from g2_recon.simulation.raycasting import cast
from g2_recon.simulation.robot import Drive, drive, wheel_odometry
from g2_recon.simulation.tours import FULL_TOUR, SWEEP_TOUR

Float = NDArray[np.float64]

START = 1_100_000_000.0
"""Stamp of the first pose in seconds."""

LASER_POSE = (0.15, 0.0, 0.35, 0.0, 0.0, 0.0)
LASER_VERTICAL_POSE = (-0.05, 0.0, 0.60, 0.0, -math.pi / 2, 0.0)
LASER_TILT_POSE = (0.15, 0.0, 0.60, 0.0, 0.0, 0.0)
"""Mounting poses on the robot: x y z in metres, roll pitch yaw in radians."""

SWEEP_FROM, SWEEP_TO = math.radians(40.0), math.radians(-70.0)
"""Angles in radians between which the laser sweeps; positive is down."""

SWEEP_RATE = math.radians(12.5)
"""Radians a second."""

JOINT_RATE_HZ = 50.0
"""Angles of the sweeping laser a second; in between it moves linearly."""

REST = 1.0
"""Seconds that the robot stands before it does something else."""

_DELAY = {"laser": 0.010, "laser_vertical": 0.015, "laser_tilt": 0.010}  # s to the first beam: the lasers run freely
_CHUNK = 256  # scans that are cast at a time


@dataclass(frozen=True, slots=True)
class Simulation:
    """What the robot recorded, and the truth in the map frame, which is the robot's start pose on the floor.

    recording: scans of the horizontal and the vertical laser, or of the sweeping one, and wheel odometry.
    trajectory: T_map_base, 100 poses a second and one at every scan and odometry stamp; in between the robot moved
    as Trajectory.interpolate says.
    vertices (V, 3) in metres, faces (T, 3): the surfaces of the building, counterclockwise seen from the free side.
    clean_vertical: (N, 3) metres, where the beams of the vertical (or the sweeping) laser that measured something
    met a surface, without noise, quantization and mixed pixels; in the order of the scans and their valid beams.
    """

    recording: Recording
    trajectory: Trajectory
    vertices: Float
    faces: NDArray[np.int64]
    clean_vertical: Float


def simulate(
    config: SimulationConfig, *, legs: Sequence[ArrayLike] | None = None, progress: Progress = silent
) -> Simulation:
    """Drive the robot through the building and record. The same settings give the same result.

    legs: another way than that of the setup; see `drive`.
    """
    rectangles = surfaces(first_floor())
    rng, *laser_rngs = (np.random.default_rng(child) for child in np.random.SeedSequence(config.seed).spawn(3))
    record, usual = (_record_driving, FULL_TOUR) if config.setup == "orthogonal" else (_record_standing, SWEEP_TOUR)
    robot, recording, hits = record(usual if legs is None else legs, config, rectangles, laser_rngs, progress)
    odometry = _resample(wheel_odometry(robot.trajectory, config, rng), config.odometry_rate)

    T_map_building = se3.inverse(robot.trajectory.matrices()[0])
    scans = (*recording.scans, *recording.scans_vertical, *recording.scans_tilt)
    stamps = np.unique(np.concatenate([robot.trajectory.stamps, odometry.stamps, [scan.stamp for scan in scans]]))
    vertices, faces = triangles(rectangles)
    return Simulation(
        recording=replace(recording, odometry=odometry),
        trajectory=Trajectory.from_matrices(stamps, T_map_building @ robot.trajectory.interpolate(stamps)[0]),
        vertices=se3.transform_points(T_map_building, vertices),
        faces=faces,
        clean_vertical=se3.transform_points(T_map_building, hits),
    )


@dataclass(frozen=True, slots=True)
class _Laser:
    """A laser on the robot. T_base_laser: transforms (N, 4, 4) at times (N,)."""

    device: Lms200
    frame_id: str
    T_base_laser: Callable[[Float], Float]


def _record_driving(
    legs: Sequence[ArrayLike],
    config: SimulationConfig,
    rectangles: Rectangles,
    rngs: list[np.random.Generator],
    progress: Progress,
) -> tuple[Drive, Recording, Float]:
    """Horizontal and vertical scans on a way, and the hits of the vertical beams."""
    robot = drive(legs, config, start=START, rest=REST)
    whole = robot.trajectory.stamps[[0, -1]]
    scans = []
    for frame_id, pose, every, rng in (
        ("laser", LASER_POSE, config.horizontal_every, rngs[0]),
        ("laser_vertical", LASER_VERTICAL_POSE, config.vertical_every, rngs[1]),
    ):
        laser = _Laser(Lms200.from_config(config), frame_id, _fixed(pose))
        stamps = _scan_stamps(laser, every, whole)
        scans.append(_observe(laser, stamps, robot.trajectory, rectangles, rng, progress))
    (horizontal, _), (vertical, hits) = scans
    recording = Recording(
        scans=horizontal,
        scans_vertical=vertical,
        T_base_laser=se3.from_xyz_rpy(LASER_POSE),
        T_base_laser_vertical=se3.from_xyz_rpy(LASER_VERTICAL_POSE),
    )
    return robot, recording, hits


def _record_standing(
    legs: Sequence[ArrayLike],
    config: SimulationConfig,
    rectangles: Rectangles,
    rngs: list[np.random.Generator],
    progress: Progress,
) -> tuple[Drive, Recording, Float]:
    """Sweeps, alternately up and down, at the stops of a way, and the hits of their beams."""
    duration = abs(SWEEP_TO - SWEEP_FROM) / SWEEP_RATE
    robot = drive(legs, config, start=START, rest=duration + 2 * REST)
    sweeps = robot.stops[:, :1] + REST + np.array([0.0, duration])
    upward = np.arange(len(sweeps)) % 2 == 0
    ends = np.where(upward[:, None], [SWEEP_FROM, SWEEP_TO], [SWEEP_TO, SWEEP_FROM])
    joint_stamps = _regular(robot.trajectory, JOINT_RATE_HZ)
    angles = np.interp(joint_stamps, sweeps.ravel(), ends.ravel())

    def tilted(stamps: Float) -> Float:
        return se3.from_xyz_rpy(LASER_TILT_POSE) @ _about_y(np.interp(stamps, joint_stamps, angles))

    laser = _Laser(Lms200.from_config(config), "laser_tilt", tilted)
    stamps = np.concatenate([_scan_stamps(laser, config.horizontal_every, sweep) for sweep in sweeps])
    scans, hits = _observe(laser, stamps, robot.trajectory, rectangles, rngs[0], progress)
    recording = Recording(
        scans_tilt=scans,
        tilt_stamps=joint_stamps,
        tilt_angles=angles,
        T_base_tilt=se3.from_xyz_rpy(LASER_TILT_POSE),
    )
    return robot, recording, hits


def _fixed(pose: ArrayLike) -> Callable[[Float], Float]:
    T_base_laser = se3.from_xyz_rpy(pose)
    return lambda stamps: np.broadcast_to(T_base_laser, (len(stamps), 4, 4))


def _about_y(angles: Float) -> Float:
    """Rotations (N, 4, 4) about the y axis; a positive angle turns the x axis down."""
    matrices = np.tile(np.eye(4), (len(angles), 1, 1))
    matrices[:, 0, 0] = matrices[:, 2, 2] = np.cos(angles)
    matrices[:, 0, 2], matrices[:, 2, 0] = np.sin(angles), -np.sin(angles)
    return matrices


def _regular(trajectory: Trajectory, rate: float) -> Float:
    """Stamps `rate` times a second from the start of a trajectory to its end."""
    count = int((trajectory.stamps[-1] - trajectory.stamps[0]) * rate + 1e-6) + 1
    return np.minimum(trajectory.stamps[0] + np.arange(count) / rate, trajectory.stamps[-1])


def _resample(trajectory: Trajectory, rate: float) -> Trajectory:
    stamps = _regular(trajectory, rate)
    return Trajectory.from_matrices(stamps, trajectory.interpolate(stamps)[0])


def _scan_stamps(laser: _Laser, every: int, interval: Float) -> Float:
    """Stamps (S,) of the scans that are kept and lie wholly in an interval (2,) of time."""
    first = interval[0] + _DELAY[laser.frame_id]
    last = interval[1] - laser.device.beam_times()[-1]
    period = every / laser.device.scan_rate
    return first + period * np.arange(math.floor((last - first) / period) + 1)


def _observe(
    laser: _Laser,
    stamps: Float,
    motion: Trajectory,
    rectangles: Rectangles,
    rng: np.random.Generator,
    progress: Progress,
) -> tuple[list[Scan], Float]:
    """Scans at S stamps, and the points (N, 3) in the frame of the rectangles that their valid beams really hit."""
    distances, hits = [], []
    for first in range(0, len(stamps), _CHUNK):
        progress(laser.frame_id, first, len(stamps))
        origins, directions = _rays(laser, stamps[first : first + _CHUNK], motion)
        reached = cast(rectangles, origins, directions)
        distances.append(reached)
        hits.append(origins + np.where(np.isfinite(reached), reached, 0.0)[:, None] * directions)
    progress(laser.frame_id, len(stamps), len(stamps))
    ranges = laser.device.measure(np.concatenate(distances).reshape(len(stamps), -1), rng)
    scans = [laser.device.scan(float(stamp), row, laser.frame_id) for stamp, row in zip(stamps, ranges, strict=True)]
    valid = np.concatenate([scan.valid() for scan in scans])
    return scans, np.concatenate(hits)[valid]


def _rays(laser: _Laser, stamps: Float, motion: Trajectory) -> tuple[Float, Float]:
    """Origins and directions (S B, 3) of the beams of S scans, each from where the laser was at the beam's own time."""
    times = (stamps[:, None] + laser.device.beam_times()).ravel()
    T_building_laser = motion.interpolate(times)[0] @ laser.T_base_laser(times)
    angles = np.tile(laser.device.angles(), len(stamps))[:, None]
    directions = T_building_laser[:, :3, 0] * np.cos(angles) + T_building_laser[:, :3, 1] * np.sin(angles)
    return T_building_laser[:, :3, 3], directions
