# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Rooms that are all alike along a corridor: no guess where a robot is, until something tells them apart."""

import math

import numpy as np
import pytest

from g2_recon.collaboration.alignment import align
from g2_recon.config import LocalizationConfig
from g2_recon.geometry import se2
from g2_recon.geometry.scan import Scan
from g2_recon.localization.localizer import Localizer

ANGLES = np.radians(np.arange(-90.0, 91.0))
ROOMS, WIDTH = 4, 6.0


def walls(*, box_in=None):
    """Segments (S, 4) of a corridor with equal rooms on one side, and a box in one of them."""
    end = ROOMS * WIDTH
    segments = [(0, -1, end, -1), (0, -1, 0, 1), (end, -1, end, 1)]
    for x in WIDTH * np.arange(ROOMS):
        segments += [(x, 1, x + 2.5, 1), (x + 3.5, 1, x + 6, 1), (x + 0.5, 1, x + 0.5, 6), (x + 5.5, 1, x + 5.5, 6)]
        segments += [(x + 0.5, 6, x + 5.5, 6), (x + 0.5, 4, x + 1.5, 4), (x + 1.5, 4, x + 1.5, 6)]
    if box_in is not None:
        x = WIDTH * box_in + 4
        segments += [(x, 2.2, x + 0.6, 2.2), (x, 2.2, x, 2.9), (x + 0.6, 2.2, x + 0.6, 2.9)]
    return np.array(segments, float)


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


def drive(segments, corners, *, seed):
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


def visit(k):
    x = WIDTH * k + 3
    return [(x, 0), (x, 2.5), (x + 1.2, 3.4), (x + 1.2, 5), (x, 5.2), (x, 2.5), (x, 0)]


@pytest.mark.parametrize(("box_in", "state"), [(None, "ambiguous"), (2, "aligned")])
def test_equal_rooms_are_ambiguous_until_something_tells_them_apart(box_in, state):
    segments = walls(box_in=box_in)
    whole = drive(segments, [(1, 0), *(corner for k in range(ROOMS) for corner in visit(k)), (23, 0)], seed=0)
    part = drive(segments, [*visit(2)[1:-1], *visit(2)[1:3]], seed=1)
    found = align(whole, part)
    assert found.state == state, found.reason
    if state == "aligned":
        # Both maps have the same origin, but that the long one may be stretched along the corridor, m.
        assert math.hypot(*found.T_fixed_moving[:2]) < 1.0
