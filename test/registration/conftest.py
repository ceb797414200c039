# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from dataclasses import dataclass

import numpy as np
import pytest
import simulated_sweeps

from g2_recon.config import SweepConfig
from g2_recon.geometry import se3
from g2_recon.registration.prepared_sweep import PreparedSweep, prepare


@dataclass(frozen=True)
class Pair:
    """Two sweeps of a room, 36,200 points each with 1 cm of noise, and where the second is as seen from the first."""

    points: tuple[np.ndarray, np.ndarray]
    fixed: PreparedSweep
    moving: PreparedSweep
    T: np.ndarray


def pair_of(rectangles, first, second, seed=0):
    rng = np.random.default_rng(seed)
    points = tuple(simulated_sweeps.sweep(rectangles, at, rng) for at in (first, second))
    fixed, moving = (prepare(each, SweepConfig()) for each in points)
    return Pair(points, fixed, moving, se3.inverse(first) @ second)


@pytest.fixture(scope="session")
def room():
    stop = simulated_sweeps.stop
    return pair_of(simulated_sweeps.furnished_room(), stop(5.0, 3.0, 10.0), stop(6.5, 3.6, 25.0))


@pytest.fixture(scope="session")
def corridor():
    stop = simulated_sweeps.stop
    return pair_of(simulated_sweeps.bare_corridor(), stop(100.0, 1.2, 20.0), stop(103.0, 1.1, -10.0))


@pytest.fixture(scope="session")
def rooms_apart():
    rectangles, stops = simulated_sweeps.two_rooms(np.random.default_rng(1))
    return pair_of(rectangles, *stops)
