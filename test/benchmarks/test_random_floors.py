# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks.clouds import Survey, drive, scan, surface
from benchmarks.random_floors import random_floor

COARSE = Survey(noise=0.0, step=0.4, rotated=False)


@pytest.mark.parametrize("seed", range(3))
def test_the_laser_keeps_clear_of_the_walls_and_visits_all_rooms(seed):
    parts, way = random_floor(seed)
    cloud = scan(*surface(parts), way, COARSE)
    low = cloud.clean[np.abs(cloud.clean[:, 2] - COARSE.height) < 0.3, :2]
    path = drive(way, 0.05, 0.0)[:, :2, 3]
    assert cKDTree(low).query(path)[0].min() > 0.25
    for room, _ in parts[1:7]:
        inside = (path > room.low[:2]) & (path < room.high[:2])
        assert inside.all(axis=1).any()


def test_walls_between_rooms_are_thin():
    rooms = [part for part, _ in random_floor(0)[0][1:7]]
    assert rooms[2].low[0] - rooms[0].high[0] == pytest.approx(0.1)
    assert rooms[1].low[1] - rooms[0].high[1] == pytest.approx(0.1)


def test_a_seed_is_always_the_same_floor_and_another_one_is_another():
    one, same, other = (surface(random_floor(seed)[0])[0] for seed in (0, 0, 1))
    assert np.array_equal(one, same)
    assert one.shape != other.shape or not np.allclose(one, other)
