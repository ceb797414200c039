# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A differential-drive robot on a tour through way-points, and what its wheels measure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.config import SimulationConfig
from g2_recon.geometry import se2
from g2_recon.geometry.trajectory import Trajectory

Float = NDArray[np.float64]

RATE_HZ = 100.0
"""Poses a second; in between the robot moves linearly, as Trajectory.interpolate does."""

WHEEL_BASE = 0.40
"""Metres between the two wheels."""

CORNER_LENGTH = 0.7
"""Metres of path before and after a corner over which it is rounded."""

# How the wheels err at odometry_drift 1: the two systematic errors of Borenstein and Feng, "Measurement and Correction
# of Systematic Odometry Errors in Mobile Robots", IEEE T-RA 12(6), 1996, and noise. They are chosen so that the
# robot ends 0.5 to 2 m beside where its wheels say it is after 100 m indoors.
WHEEL_RATIO_ERROR = 0.0007
WHEEL_BASE_ERROR = 0.008
SLIP = 0.0007
"""Standard deviation of a wheel's travel after one metre, in metres; it grows with the square root of the way."""

_PATH_STEP = 0.002  # metres between the samples of a path
_TURN_STEP = 0.002  # radians between the samples of a turn in place


@dataclass(frozen=True, slots=True)
class Drive:
    """How the robot moved.

    trajectory: planar poses, RATE_HZ a second. stops: (L + 1, 2) stamps of the begin and the end of each rest: before
    the first of L legs, between legs, and after the last.
    """

    trajectory: Trajectory
    stops: Float


def drive(legs: Sequence[ArrayLike], config: SimulationConfig, *, start: float, rest: float) -> Drive:
    """Drive along legs, each a polyline of way-points (K, 2) in metres that starts where the one before ends.

    The corners of a leg are rounded. Before each leg the robot rests for `rest` seconds and turns in place to where the
    leg goes, and it rests after the last one. Speed, acceleration and turn rate stay within the settings.

    start: stamp of the first pose in seconds.
    """
    paths = [_round_corners(np.asarray(leg, float)) for leg in legs]
    resting = max(1, round(rest * RATE_HZ))
    parts: list[Float] = []
    pose, first, stops = paths[0][0], 0, []
    for path in paths:
        moves = [np.repeat(pose[None], resting, axis=0), _turn(pose, path[0, 2], config), _follow(path, config)]
        parts += moves
        stops.append((first, first + resting - 1))
        first += sum(len(part) for part in moves)
        pose = path[-1]
    parts.append(np.repeat(pose[None], resting, axis=0))
    stops.append((first, first + resting - 1))
    poses = np.concatenate(parts)
    stamps = start + np.arange(len(poses)) / RATE_HZ
    return Drive(Trajectory.from_se2(stamps, poses), stamps[np.array(stops)])


def wheel_odometry(trajectory: Trajectory, config: SimulationConfig, rng: np.random.Generator) -> Trajectory:
    """T_odom_base, starting at the identity, as wheels measure it that differ in size, are mounted wrong and slip.

    The true travel of each wheel between two poses follows from the motion; the wrong wheels' travel is turned into a
    motion again by someone who takes them to be right.
    """
    steps = se2.relative(trajectory.planar()[:-1], trajectory.planar()[1:])
    way, turn = steps[:, 0] / np.sinc(steps[:, 2] / (2 * np.pi)), steps[:, 2]
    travel = way[:, None] + turn[:, None] * WHEEL_BASE / 2 * np.array([-1.0, 1.0])
    drift = config.odometry_drift
    travel *= 1 + drift * WHEEL_RATIO_ERROR / 2 * np.array([-1.0, 1.0])
    travel += drift * SLIP * np.sqrt(np.abs(travel)) * rng.standard_normal(travel.shape)
    turn = (travel[:, 1] - travel[:, 0]) / (WHEEL_BASE * (1 + drift * WHEEL_BASE_ERROR))
    yaw = np.concatenate([[0.0], np.cumsum(turn)])
    chord = travel.mean(axis=1) * np.sinc(turn / (2 * np.pi))
    heading = yaw[:-1] + turn / 2
    moved = np.column_stack([chord * np.cos(heading), chord * np.sin(heading)])
    positions = np.vstack([np.zeros(2), np.cumsum(moved, axis=0)])
    return Trajectory.from_se2(trajectory.stamps, np.column_stack([positions, yaw]))


def _round_corners(leg: Float) -> Float:
    """Poses (K, 3) along a polyline, densely sampled, its corners replaced by curves of continuous curvature.

    The polyline is averaged over its own length with a triangular window, which leaves straight parts as they are.
    """
    lengths = np.linalg.norm(np.diff(leg, axis=0), axis=1)
    step = lengths.sum() / round(lengths.sum() / _PATH_STEP)
    reach = round(CORNER_LENGTH / step)
    at = step * np.arange(-reach, round(lengths.sum() / step) + reach + 1)
    before = leg[0] + at[0] / lengths[0] * (leg[1] - leg[0])
    after = leg[-1] + reach * step / lengths[-1] * (leg[-1] - leg[-2])
    along = np.concatenate([at[:1], np.cumsum(lengths[:-1]), at[-1:]])
    corners = np.vstack([before, leg[1:-1], after])
    window = np.bartlett(2 * reach + 1)
    path = np.column_stack(
        [np.convolve(np.interp(at, along, corners[:, axis]), window / window.sum(), "valid") for axis in range(2)]
    )
    tangents = np.gradient(path, axis=0)
    return np.column_stack([path, np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0]))])


def _follow(path: Float, config: SimulationConfig) -> Float:
    """Poses (M, 3) on a path, one every 1 / RATE_HZ seconds, from rest to rest."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1))])
    bends = np.abs(np.diff(path[:, 2])) / np.diff(way)
    curvature = np.maximum(np.append(bends, 0.0), np.insert(bends, 0, 0.0))
    limit = config.max_turn_rate / np.maximum(curvature, config.max_turn_rate / config.max_speed)
    at = _progress_along(way, limit, config.acceleration)
    return np.column_stack([np.interp(at, way, path[:, column]) for column in range(3)])


def _turn(pose: Float, yaw: float, config: SimulationConfig) -> Float:
    """Poses (M, 3) of a turn in place to a yaw, the shorter way round, from rest to rest."""
    # Half a turn is always to the right: which way must not hang on rounding.
    angle = float(se2.wrap_angle(yaw - pose[2] + _TURN_STEP)) - _TURN_STEP
    if abs(angle) < _TURN_STEP:
        return np.empty((0, 3))
    turned = np.linspace(0.0, abs(angle), math.ceil(abs(angle) / _TURN_STEP) + 1).astype(float)
    # The wheels accelerate as they do on a straight line.
    at = _progress_along(turned, np.full(len(turned), config.max_turn_rate), config.acceleration / (WHEEL_BASE / 2))
    return np.column_stack([np.tile(pose[:2], (len(at), 1)), pose[2] + math.copysign(1.0, angle) * at])


def _progress_along(way: Float, limit: Float, acceleration: float) -> Float:
    """How far (M,) the robot is every 1 / RATE_HZ seconds, the start left out, if it goes as fast as it may.

    way: (K,) from 0, ascending. limit: (K,) top speed at each. It starts and ends at rest; between two samples of the
    way the acceleration is constant and at most `acceleration`.
    """
    cap = limit**2
    cap[[0, -1]] = 0.0
    rising = np.minimum.accumulate(cap - 2 * acceleration * way) + 2 * acceleration * way
    falling = np.minimum.accumulate((rising + 2 * acceleration * way)[::-1])[::-1] - 2 * acceleration * way
    speed = np.sqrt(np.maximum(falling, 0.0))
    durations = 2 * np.diff(way) / (speed[1:] + speed[:-1])
    times = np.concatenate([[0.0], np.cumsum(durations)])
    count = math.ceil(times[-1] * RATE_HZ - 1e-6)
    wanted = np.minimum(np.arange(1, count + 1) / RATE_HZ, times[-1])
    piece = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, len(durations) - 1)
    since = wanted - times[piece]
    change = np.diff(speed)[piece] / durations[piece]
    return np.minimum(way[piece] + speed[piece] * since + change / 2 * since**2, way[-1])
