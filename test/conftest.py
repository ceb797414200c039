# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Robots that drive along lines between walls, each in a map of its own."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from g2_recon.config import LocalizationConfig
from g2_recon.geometry import se2
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.session import SessionPart, session_number
from g2_recon.localization.localizer import Localizer

ANGLES = np.radians(np.arange(-90.0, 91.0))
# A hall, two rooms and a niche, no two corners of which look alike, x y x y of each wall, m.
FLOOR = np.array(
    [
        *[(0, 0, 16, 0), (16, 0, 16, 9), (16, 9, 0, 9), (0, 9, 0, 0)],
        *[(5, 9, 5, 5.5), (5, 3.5, 5, 0), (11, 0, 11, 2.5), (11, 4.5, 11, 9)],
        *[(7, 9, 7, 7.2), (7, 7.2, 8.5, 7.2), (8.5, 7.2, 8.5, 9), (13, 1.2, 14.5, 2), (14.5, 2, 14.5, 0)],
        *[(1.5, 0, 1.5, 1.5), (1.5, 1.5, 0, 2.2), (14, 7, 15, 7), (15, 7, 15, 6), (15, 6, 14, 6), (14, 6, 14, 7)],
    ],
    float,
)
WAYS = {
    "one": [(2.5, 3), (2.5, 7), (3.5, 4.5), (8, 4.5), (9.5, 6.5), (9.5, 2), (8, 2), (6.5, 4.5), (8, 5.5)],
    "two": [(13, 5), (12.5, 3.5), (8, 3.5), (6.5, 2), (6.5, 5.5), (9.5, 6), (9.5, 3.5), (13, 3.5), (12.5, 8)],
    "three": [(9, 2), (8, 5.5), (6.5, 4.5), (3, 4.5), (3.5, 7.5), (2, 6), (2.5, 3), (4, 4.5), (8, 4.5)],
}


def look(segments, pose, stamp, rng):
    directions = np.column_stack([np.cos(ANGLES + pose[2]), np.sin(ANGLES + pose[2])])[:, None]
    begin, along = segments[:, :2] - pose[:2], segments[:, 2:] - segments[:, :2]
    cross = directions[..., 0] * along[:, 1] - directions[..., 1] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = (begin[:, 0] * along[:, 1] - begin[:, 1] * along[:, 0]) / cross
        share = (begin[:, 0] * directions[..., 1] - begin[:, 1] * directions[..., 0]) / cross
    ranges = np.where((ranges > 0) & (share >= 0) & (share <= 1), ranges, np.inf).min(axis=1)
    return Scan(stamp, (ranges + rng.normal(0, 0.01, len(ranges))).astype(np.float32), ANGLES[0], math.radians(1.0))


def way(corners):
    """Poses (N, 3) every 10 cm along a line, turning on the spot where it bends."""
    poses = []
    for begin, end in zip(np.array(corners[:-1], float), np.array(corners[1:], float), strict=True):
        yaw = math.atan2(end[1] - begin[1], end[0] - begin[0])
        if poses:
            turn = float(se2.wrap_angle(yaw - poses[-1][2]))
            poses += [(*begin, poses[-1][2] + share * turn) for share in np.linspace(0, 1, math.ceil(abs(turn) / 0.15))]
        steps = max(1, round(math.dist(begin, end) / 0.1))
        poses += [(*(begin + share * (end - begin)), yaw) for share in np.arange(steps) / steps]
    return np.array(poses)


def driven(segments, corners, *, seed):
    """The session of a robot that drives along a line; its map has the origin of the building."""
    rng = np.random.default_rng(seed)
    poses = way(corners)
    steps = se2.relative(poses[:-1], poses[1:])
    localizer = Localizer(LocalizationConfig(), np.eye(4), keep_scans=True)
    localizer.reset(poses[0])
    odometry = np.zeros(3)
    for k, pose in enumerate(poses):
        if k:
            odometry = se2.compose(odometry, steps[k - 1] * (1 + 0.01 * rng.normal(size=3)))
        localizer.process(look(segments, pose, 0.1 * k, rng), odometry)
    localizer.finish()
    return localizer.session()


@pytest.fixture(scope="session")
def drive():
    """`drive(segments, corners, seed=0)`: the session of a robot that goes along corners between walls (S, 4)."""
    return driven


def sessions_of(ways):
    found = {}
    for number, (name, corners) in enumerate(ways.items()):
        session = driven(FLOOR, corners, seed=number)
        start = se2.inverse(session.poses[0])
        found[name] = replace(session, poses=se2.compose(start, session.poses), stamps=session.stamps + 1000.0 * number)
    return found


@pytest.fixture(scope="session")
def sessions():
    """Three robots on one floor, each in a map that begins where it did, one after the other in time."""
    return sessions_of(WAYS)


@pytest.fixture(scope="session")
def short_sessions():
    """The same for half of their ways."""
    return sessions_of({name: corners[:5] for name, corners in WAYS.items()})


def parts_of(session, *, size=10):
    """A session as its robot tells it: so many keyframes at a time, with the poses and the graph of all until then."""
    number = session_number(float(session.stamps[0]), session.points[0], session.kinds[0])
    for first in range(0, len(session), size):
        count = min(first + size, len(session))
        rows = slice(first, count)
        begins = session.local_maps[session.local_maps < count]
        kept = (session.loops < len(begins)).all(axis=1)
        yield SessionPart(
            number=number,
            count=count,
            revision=count,
            last_stamp=float(session.stamps[count - 1]),
            poses=session.poses[:count],
            first=first,
            **session.of_rows(rows),
            local_maps=begins,
            loops=session.loops[kept],
            loop_information=session.loop_information[kept],
        )


@pytest.fixture(scope="session")
def parts():
    """`parts(session, size=10)`: what its robot tells of a session, one after the other."""
    return parts_of


@pytest.fixture(scope="session")
def floor():
    """Walls (S, 4) of the floor of `sessions`, m, and the poses (N, 3) that its robots go through, 10 cm apart."""
    return FLOOR, {name: way(corners) for name, corners in WAYS.items()}


@pytest.fixture(scope="session")
def seen():
    """`seen(segments, pose, stamp, rng)`: the scan of a laser at a pose (3,) between walls (S, 4)."""
    return look
