# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
import simulated_sweeps
from simulated_sweeps import stop

from g2_recon.config import SweepConfig
from g2_recon.geometry import se3
from g2_recon.geometry.cloud import Cloud, concatenate
from g2_recon.registration.prepared_map import prepare_map
from g2_recon.registration.sweep_alignment import align_sweeps, map_sweeps

CONFIG = SweepConfig()
# Where the map of the second robot begins in the building: it knows nothing of this.
START = se3.from_xyz_rpy([4.0, -2.5, 0.0, 0.0, 0.0, 2.2])


def seen(rectangles, stops, *, seed, T_building_map=START):
    """What a robot saw at its stops, in its map, with where its laser was."""
    rng = np.random.default_rng(seed)
    clouds = []
    for at in stops:
        T = se3.inverse(T_building_map) @ at
        points = se3.transform_points(T, simulated_sweeps.sweep(rectangles, at, rng))
        clouds.append(Cloud(points, np.tile(T[:3, 3], (len(points), 1))))
    return clouds


def aligned(rectangles, stops, others, **how):
    """The map of a robot looked for in that of another, whose map is the building's."""
    fixed = prepare_map(concatenate(seen(rectangles, stops, seed=1, T_building_map=np.eye(4))), CONFIG)
    return align_sweeps(fixed, map_sweeps(seen(rectangles, others, seed=2), CONFIG), CONFIG, **how)


def test_two_robots_in_one_room_are_aligned():
    found = aligned(
        simulated_sweeps.furnished_room(),
        [stop(3.0, 3.0, 10.0), stop(12.0, 3.5, 170.0)],
        [stop(8.0, 3.0, 160.0), stop(5.0, 4.5, -20.0)],
    )
    assert found.state == "aligned"
    metres, degrees = simulated_sweeps.errors(found.T_fixed_moving, START)
    assert metres < 0.05 and degrees < 0.5
    assert found.held == 2
    # m: what one match in such a room is off by, and what is said of it.
    assert math.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3])[2]) < 0.02


@pytest.fixture(scope="module")
def block():
    return simulated_sweeps.ring()


def test_robots_that_each_went_round_a_part_of_a_block_are_aligned(block):
    rectangles, stops = block
    found = aligned(rectangles, stops[:6], [stops[k] @ stop(0.3, 0.1, 15.0) @ stop_height() for k in (3, 4, 5, 6)])
    assert found.state == "aligned"
    metres, degrees = simulated_sweeps.errors(found.T_fixed_moving, START)
    assert metres < 0.05 and degrees < 0.5


def stop_height():
    """`stop` lifts the laser from the floor: back to where it was."""
    return se3.from_xyz_rpy([0, 0, -simulated_sweeps.HEIGHT_M, 0, 0, 0])


@pytest.mark.parametrize("seed", range(4))
def test_robots_in_different_rooms_are_never_aligned(seed):
    rectangles, (one, other) = simulated_sweeps.two_rooms(np.random.default_rng(seed))
    found = aligned(rectangles, [one, one @ turned(120.0)], [other, other @ turned(120.0)])
    assert found.state != "aligned"
    assert found.reason


def turned(degrees):
    return se3.from_xyz_rpy([0, 0, 0, 0, 0, math.radians(degrees)])


def test_a_bare_corridor_is_not_believed():
    rectangles = simulated_sweeps.bare_corridor()
    found = aligned(rectangles, [stop(100.0, 1.2), stop(103.0, 1.2)], [stop(102.0, 1.2), stop(104.0, 1.2, 180.0)])
    assert found.state != "aligned"


def test_what_was_found_before_is_kept_while_it_holds_and_looked_for_where_it_does_not():
    rectangles = simulated_sweeps.furnished_room()
    stops, others = [stop(3.0, 3.0, 10.0), stop(12.0, 3.5, 170.0)], [stop(8.0, 3.0, 160.0), stop(5.0, 4.5, -20.0)]
    for off in (se3.from_xyz_rpy([0.03, 0.02, 0, 0, 0, 0.005]), se3.from_xyz_rpy([5.0, 1.0, 0, 0, 0, 1.0])):
        found = aligned(rectangles, stops, others, before=START @ off)
        assert found.state == "aligned"
        assert simulated_sweeps.errors(found.T_fixed_moving, START)[0] < 0.05


def test_sweeps_that_are_too_small_are_left_out():
    assert map_sweeps([Cloud(np.ones((10, 3)), np.zeros((10, 3))), Cloud(np.ones((10, 3)))], CONFIG) == []
