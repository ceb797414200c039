# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""kiss-icp ends the process where one of its checks fails, so that this is tried in another process."""

import signal
import subprocess
import sys

FUZZ = """
import sys
import warnings

import numpy as np

from g2_recon.config import SweepConfig
from g2_recon.errors import G2ReconError
from g2_recon.geometry import se3
from g2_recon.geometry.cloud import Cloud
from g2_recon.registration.prepared_sweep import prepare
from g2_recon.registration.sweep_matching import match
from g2_recon.registration.sweep_merger import SweepMerger

rng = np.random.default_rng(int(sys.argv[1]))
config = SweepConfig(method="kiss", search=0.0, search_angle=0.0)
NUMBERS = [np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-308, 1e308, 1e18, -1e18, 1e6, 1e-9]


def some_points():
    points = rng.uniform(-5, 5, (rng.choice([0, 1, 3, 60, 800]), 3))
    kind = rng.integers(6)
    if kind == 0:
        points[:, 2] = 0.0
    if kind == 1:
        points[:] = points[:1]
    if kind == 2:
        points *= 10.0 ** rng.integers(-6, 9)
    if kind == 3 and points.size:
        points[rng.random(points.shape) < 0.3] = rng.choice(NUMBERS)
    return points


def some_guess():
    guess = se3.from_xyz_rpy([*rng.normal(0, 2, 3), *rng.uniform(-3, 3, 3)])
    kind = rng.integers(8)
    if kind == 0:
        guess[:3, :3] += rng.normal(0, 10.0 ** -rng.integers(1, 9), (3, 3))
    if kind == 1:
        guess[:3, :3] *= rng.choice([-1.0, 0.0, 0.95, 1.001, 2.0])
    if kind == 2:
        guess[tuple(rng.integers(0, 4, 2))] = rng.choice(NUMBERS)
    if kind == 3:
        guess[:3, 3] *= 10.0 ** rng.integers(0, 300)
    if kind == 4:
        guess = guess.astype(np.float32).astype(float)
    return guess


def merge_anything():
    merger = SweepMerger(config)
    for _ in range(2):
        merger.add(Cloud(some_points()), some_guess())
    merger.cloud()


def match_from_anywhere():
    first, second = rng.uniform(-5, 5, (2, 300, 3))
    match(prepare(first, config), prepare(second, config), some_guess(), config)


matched = refused = 0
with warnings.catch_warnings():
    warnings.simplefilter("error")
    for attempt in [merge_anything, match_from_anywhere] * 150:
        try:
            attempt()
            matched += 1
        except G2ReconError:
            refused += 1
print("alive", matched, refused)
"""

ABORTS = """
import numpy as np
from kiss_icp.mapping import VoxelHashMap
from kiss_icp.registration import Registration

points = np.random.default_rng(0).uniform(-5, 5, (300, 3))
voxels = VoxelHashMap(voxel_size=0.5, max_distance=100.0, max_points_per_voxel=20)
voxels.add_points(points)
guess = np.eye(4)
guess[0, 1] = 1e-3
Registration(100, 1e-4, 1).align_points_to_map(points, voxels, guess, 1.0, 0.3)
print("alive")
"""


def run(code, *arguments):
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=120)


def test_no_sweep_and_no_guess_ends_the_process():
    for seed in ("0", "1"):
        ran = run(FUZZ, seed)
        assert ran.returncode == 0, ran.stderr[-2000:]
        word, matched, refused = ran.stdout.split()
        assert word == "alive"
        assert int(matched) > 50
        assert int(refused) > 50


def test_the_guard_is_needed_as_the_library_ends_the_process_by_itself():
    # If this fails, kiss-icp has learned to raise, and its guess need no longer be made orthonormal.
    assert run(ABORTS).returncode == -signal.SIGABRT
