# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry.scan import Scan

ROOM = np.array([[-3, -2], [5, -2], [5, 1], [3, 1], [3, 3], [-3, 3], [-3, -2]], float)
CORRIDOR = np.array([[-100, -1], [100, -1], [100, 1], [-100, 1], [-100, -1]], float)


def cast(outline, pose, *, beams=181, noise=0.0, seed=0, stamp=0.0, upside_down=False):
    """An exact scan of a closed outline (N, 2) from a pose: nearest crossing of each beam with each wall."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, beams)
    heading = pose[2] + (-angles if upside_down else angles)
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=1)[:, None]
    start, along = outline[:-1][None], np.diff(outline, axis=0)[None]
    cross = direction[..., 0] * along[..., 1] - direction[..., 1] * along[..., 0]
    offset = start - np.asarray(pose[:2])
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = (offset[..., 0] * along[..., 1] - offset[..., 1] * along[..., 0]) / cross
        share = (offset[..., 0] * direction[..., 1] - offset[..., 1] * direction[..., 0]) / cross
        hit = (ranges > 0) & (share >= 0) & (share <= 1)
    ranges = np.where(hit, ranges, np.inf).min(axis=1)
    ranges += np.random.default_rng(seed).normal(0, noise, beams) if noise else 0
    return Scan(stamp, ranges.astype(np.float32), -np.pi / 2, np.pi / (beams - 1), 0.0, 80.0)


@pytest.fixture
def scan_of_room():
    def scan(pose, **settings):
        return cast(ROOM, pose, **settings)

    return scan


@pytest.fixture
def scan_of_corridor():
    def scan(pose, **settings):
        return cast(CORRIDOR, pose, **settings)

    return scan
