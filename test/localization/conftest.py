# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import functools
import math

import numpy as np
import pytest

from g2_recon.geometry import se2
from g2_recon.geometry.scan import Scan
from g2_recon.localization.beams import beams
from g2_recon.localization.keyframes import Keyframes

# A world is one closed outline (N, 2) or a list of them, m.
ROOM = np.array([[-3, -2], [5, -2], [5, 1], [3, 1], [3, 3], [-3, 3], [-3, -2]], float)
CORRIDOR = np.array([[-100, -1], [100, -1], [100, 1], [-100, 1], [-100, -1]], float)

# Corridors 2 m wide around a block, 40 m along their middle. Niches and doors are nowhere the same.
HALLS = [
    np.array(
        [
            [0, 0], [3, 0], [3, -0.5], [4.2, -0.5], [4.2, 0], [9, 0], [9, -1.2], [9.8, -1.2], [9.8, 0], [14, 0],
            [14, 2.6], [15, 2.6], [15, 4.4], [14, 4.4], [14, 7.5], [14.4, 7.5], [14.4, 8.1], [14, 8.1], [14, 10],
            [11, 10], [11, 11.5], [9.6, 11.5], [9.6, 10], [6, 10], [6, 10.4], [4, 10.4], [4, 10], [0, 10],
            [0, 7], [-0.8, 7], [-0.8, 6.2], [0, 6.2], [0, 3.3], [-1.5, 3.3], [-1.5, 2.2], [0, 2.2], [0, 0],
        ],
        float,
    ),
    np.array(
        [
            [2, 2], [6, 2], [6, 2.5], [6.6, 2.5], [6.6, 2], [12, 2], [12, 5.2], [11.5, 5.2], [11.5, 6.4], [12, 6.4],
            [12, 8], [8, 8], [8, 7.6], [7.3, 7.6], [7.3, 8], [2, 8], [2, 5.5], [2.6, 5.5], [2.6, 4.6], [2, 4.6], [2, 2],
        ],
        float,
    ),
]  # fmt: skip
AROUND = [(1, 1), (13, 1), (13, 9), (1, 9), (1, 1)]


def cast(
    world,
    pose,
    *,
    beams=181,
    first=-np.pi / 2,
    increment=None,
    noise=0.0,
    seed=0,
    stamp=0.0,
    upside_down=False,
    time_increment=0.0,
    reach=80.0,
):
    """An exact scan of a world from a pose: nearest crossing of each beam with each wall, +inf beyond reach (m).

    pose: (3,), or (B, 3) for a laser that moves from beam to beam. increment: rad, by default for half a turn.
    """
    increment = np.pi / (beams - 1) if increment is None else increment
    angles = first + increment * np.arange(beams)
    x, y, yaw = np.broadcast_to(np.asarray(pose, float), (beams, 3)).T
    heading = yaw + (-angles if upside_down else angles)
    outlines = world if isinstance(world, list) else [world]
    start = np.concatenate([outline[:-1] for outline in outlines])[None]
    along = np.concatenate([np.diff(outline, axis=0) for outline in outlines])[None]
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=1)[:, None]
    cross = direction[..., 0] * along[..., 1] - direction[..., 1] * along[..., 0]
    offset = start - np.stack([x, y], axis=1)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = (offset[..., 0] * along[..., 1] - offset[..., 1] * along[..., 0]) / cross
        share = (offset[..., 0] * direction[..., 1] - offset[..., 1] * direction[..., 0]) / cross
        hit = (ranges > 0) & (share >= -1e-9) & (share <= 1 + 1e-9)
    ranges = np.where(hit, ranges, np.inf).min(axis=1)
    ranges += np.random.default_rng(seed).normal(0, noise, beams) if noise else 0
    ranges[ranges > reach] = np.inf
    return Scan(stamp, ranges.astype(np.float32), first, increment, 0.0, 80.0, time_increment)


def distances_to_walls(world, points):
    """Distance (N,) in m of points (N, 2) from the nearest wall of a world."""
    outlines = world if isinstance(world, list) else [world]
    start = np.concatenate([outline[:-1] for outline in outlines])
    along = np.concatenate([np.diff(outline, axis=0) for outline in outlines])
    share = ((points[:, None] - start) * along).sum(axis=-1) / (along**2).sum(axis=-1)
    foot = start + np.clip(share, 0, 1)[..., None] * along
    return np.hypot(*np.moveaxis(points[:, None] - foot, -1, 0)).min(axis=1)


def drive_along(way, *, step=0.125, turn=0.1):
    """Poses (N, 3) of a robot that drives from corner to corner of a way (M, 2) and turns on the spot there."""
    way = np.asarray(way, float)
    headings = np.arctan2(*np.diff(way, axis=0).T[::-1])
    poses = [np.array([*way[0], headings[0]])]
    for corner, heading in zip(way[1:], headings, strict=True):
        swing = se2.wrap_angle(heading - poses[-1][2])
        if abs(swing) > 1e-9:
            count = math.ceil(abs(swing) / turn)
            poses += [poses[-1] + (0, 0, part) for part in swing * np.arange(1, count + 1) / count]
        length = np.hypot(*(corner - poses[-1][:2]))
        count = max(1, round(length / step))
        poses += list(poses[-1] + np.outer(np.arange(1, count + 1) / count, [*(corner - poses[-1][:2]), 0]))
    return np.array(poses)


def keyframes_of(scans, poses):
    """Keyframes from scans at poses (N, 3)."""
    keyframes = Keyframes()
    for scan, pose in zip(scans, poses, strict=True):
        keyframes.add(beams(scan, range_min=0.1, range_max=40.0), np.array(pose, float))
    return keyframes


@pytest.fixture(scope="session")
def scan_of_room():
    return functools.partial(cast, ROOM)


@pytest.fixture(scope="session")
def scan_of_corridor():
    return functools.partial(cast, CORRIDOR)


@pytest.fixture(scope="session")
def scan_of_halls():
    return functools.partial(cast, HALLS)


@pytest.fixture(scope="session")
def off_the_walls_of_the_room():
    return functools.partial(distances_to_walls, ROOM)


@pytest.fixture(scope="session")
def way_around_the_halls():
    return AROUND


@pytest.fixture(scope="session", name="drive_along")
def _drive_along():
    return drive_along


@pytest.fixture(scope="session", name="keyframes_of")
def _keyframes_of():
    return keyframes_of
