# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Vertical scans of a robot that drives through simulated rooms, with the laser mounted in any way."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from g2_recon.config import SimulationConfig
from g2_recon.geometry import se3
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.simulation.building import Rectangles
from g2_recon.simulation.lms200 import Lms200
from g2_recon.simulation.raycasting import cast
from g2_recon.simulation.robot import RATE_HZ, drive
from g2_recon.simulation.simulator import LASER_VERTICAL_POSE

Float = NDArray[np.float64]

Legs = Sequence[Sequence[tuple[float, float]]]

ROOM_LEGS: Legs = (
    ((2.0, 4.5), (11.0, 4.5), (11.0, 1.5), (3.0, 1.5), (3.0, 5.5), (9.0, 5.5)),
    ((9.0, 5.5), (5.0, 5.5), (5.0, 2.0), (12.0, 2.0)),
)
"""Through the furnished room of simulated_sweeps, so that walls are seen at many headings."""

STRAIGHT_LEGS: Legs = (((2.0, 3.5), (12.5, 3.5)),)
"""Through the same room without a turn."""


@dataclass(frozen=True, slots=True)
class VerticalDrive:
    """scans: as the vertical laser recorded them. trajectory: T_map_base.

    exact: (N, 3) m, where the beams that measured something met a surface.
    """

    scans: list[Scan]
    trajectory: Trajectory
    exact: Float


def vertical_drive(
    rectangles: Rectangles, legs: Legs, T_base_laser: Float, seed: int, *, every: int = 13, **settings: float | bool
) -> VerticalDrive:
    """Drive along legs; the laser keeps one scan in `every` of the 75 a second. settings: of SimulationConfig."""
    config = SimulationConfig(**settings)  # type: ignore[arg-type]
    trajectory = drive(legs, config, start=0.0, rest=1.0).trajectory
    laser = Lms200.from_config(config)
    stamps = np.arange(0.01, trajectory.stamps[-1] - laser.beam_times()[-1], every / laser.scan_rate)
    times = (stamps[:, None] + laser.beam_times()).ravel()
    T = trajectory.interpolate(times)[0] @ T_base_laser
    angles = np.tile(laser.angles(), len(stamps))[:, None]
    rays = T[:, :3, 0] * np.cos(angles) + T[:, :3, 1] * np.sin(angles)
    distances = cast(rectangles, T[:, :3, 3], rays)
    ranges = laser.measure(distances.reshape(len(stamps), -1), np.random.default_rng(seed))
    scans = [laser.scan(float(stamp), row, "laser_vertical") for stamp, row in zip(stamps, ranges, strict=True)]
    valid = np.concatenate([scan.valid() for scan in scans])
    return VerticalDrive(scans, trajectory, (T[:, :3, 3] + distances[:, None] * rays)[valid])


def as_localized(trajectory: Trajectory, seed: int, *, metres: float = 0.004, degrees: float = 0.05) -> Trajectory:
    """A trajectory that is off by so much, standard deviation, alike for about a second."""
    rng = np.random.default_rng(seed)
    noise = gaussian_filter1d(rng.normal(size=(len(trajectory), 3)), RATE_HZ / 2, axis=0, mode="nearest")
    noise *= np.array([metres, metres, math.radians(degrees)]) / noise.std(axis=0)
    return Trajectory.from_se2(trajectory.stamps, trajectory.planar() + noise)


def mount(rng: np.random.Generator | None = None, *, metres: float = 0.05, degrees: float = 10.0) -> Float:
    """T_base_laser (4, 4) of the robot G2, or one that is mounted otherwise, by up to so much an axis."""
    usual = se3.from_xyz_rpy(LASER_VERTICAL_POSE)
    if rng is None:
        return usual
    shift = rng.uniform(-metres, metres, 3)
    return moved(usual, np.concatenate([shift, rng.uniform(-1, 1, 3) * math.radians(degrees)]))


def off_by(T: Float, rng: np.random.Generator, metres: float, degrees: float) -> Float:
    """A pose (4, 4) moved by so much in a random direction, and turned by so much about a random axis."""
    way, axis = (direction / np.linalg.norm(direction) for direction in rng.normal(size=(2, 3)))
    return moved(T, np.concatenate([metres * way, math.radians(degrees) * axis]))


def moved(T: Float, step: Float) -> Float:
    """A pose (4, 4) moved along, and turned about, the axes of the robot (6,), m and rad."""
    result = T.copy()
    result[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ T[:3, :3]
    result[:3, 3] += step[:3]
    return result


def error(T: Float, truth: Float) -> Float:
    """Along and about the axes of the robot (6,), m and rad: the inverse of `moved`."""
    turn = Rotation.from_matrix(T[:3, :3] @ truth[:3, :3].T).as_rotvec()
    return np.concatenate([T[:3, 3] - truth[:3, 3], turn])
