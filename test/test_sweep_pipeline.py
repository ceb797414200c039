# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from itertools import count

import numpy as np
import pytest
import simulated_sweeps
from simulated_sweeps import stop

from g2_recon import pipeline
from g2_recon.collaboration.live_merger import LiveMerger, SweepWork
from g2_recon.config import RegistrationConfig, SimulationConfig
from g2_recon.geometry import se2, se3
from g2_recon.geometry.cloud import Cloud, Piece
from g2_recon.simulation.building import first_floor, surfaces
from g2_recon.simulation.simulator import simulate
from g2_recon.sweep_pipeline import place_sweeps

# Where the map of each robot begins in the building. That of the second lies lower, as the frame of its first laser.
MAPS = {"anna": np.eye(4), "bert": se3.from_xyz_rpy([4.0, -2.5, 0.2, 0.0, 0.0, 2.2])}
STOPS = {"anna": [stop(3.0, 3.0, 10.0), stop(12.0, 3.5, 170.0)], "bert": [stop(8.0, 3.0, 160.0), stop(5.0, 4.5, -20.0)]}


@pytest.fixture(scope="module")
def room():
    return simulated_sweeps.furnished_room()


@pytest.fixture(scope="module")
def clouds(room):
    """The sweeps of two robots in one room, each in a map of its own."""
    rng = np.random.default_rng(0)
    return {name: [seen(room, at, MAPS[name], rng) for at in stops] for name, stops in STOPS.items()}


def seen(rectangles, at, T_building_map, rng):
    T = se3.inverse(T_building_map) @ at
    points = se3.transform_points(T, simulated_sweeps.sweep(rectangles, at, rng))
    return Cloud(points, np.tile(T[:3, 3], (len(points), 1)))


def merger(**starts):
    sources = count(1)
    return LiveMerger({robot: np.array(start) for robot, start in starts.items()}, lambda: next(sources))


def told(live, clouds, *, stamp=100.0):
    for number, (name, sweeps) in enumerate(clouds.items()):
        for piece, cloud in enumerate(sweeps):
            assert live.take_cloud(name, stamp + 10 * piece + number, cloud, Piece(7 + number, piece)) == ""
    return live


def brought_up_to_date(live):
    while (work := live.sweep_work()) is not None:
        live.take_placed(place_sweeps(work.copied()))
    return live


def off(live, clouds):
    """How far the points in the world are from where they belong in the building, m."""
    placed = live.cloud.cloud().points
    wanted = np.concatenate([cloud.moved(MAPS[name]).points for name, sweeps in clouds.items() for cloud in sweeps])
    assert len(placed) == len(wanted)
    return np.linalg.norm(placed - wanted, axis=1)


def test_robots_that_make_sweeps_come_into_one_world(clouds):
    live = told(merger(), clouds)
    assert live.place("bert").state == "waiting"
    assert live.work(settled=True) is None
    brought_up_to_date(live)
    assert live.place("anna").reason == "the world is where its map is"
    place = live.place("bert")
    assert place.state == "aligned"
    assert place.sweeps == 2
    assert place.covariance.shape == (3, 3)
    # m: 5 cm at the robot, at 15 m from there half a degree more.
    assert off(live, clouds).max() < 0.05 + 15 * np.radians(0.5)
    assert sum(len(cloud) for _, cloud, _ in live.cloud.sent()) == live.cloud.points
    assert live.sweep_work() is None


def test_what_there_is_to_place_refers_to_points_that_are_stored_and_stays_as_it_was(clouds):
    live = told(merger(), clouds)
    work, again = live.sweep_work(), told(merger(), clouds).sweep_work()
    stored = [part for pieces in live.cloud._sources.values() for piece in pieces.values() for part in piece.parts]
    for pieces in work.robots.values():
        assert all(any(part is one for one in stored) for piece in pieces for part in piece.parts)
    live.take_cloud("anna", 300.0, clouds["anna"][0], Piece(7, 0, 1))
    live.take_cloud("bert", 301.0, clouds["bert"][0], Piece(8, 0))
    for key, copied in again.copied().robots.items():
        for one, other in zip(work.copied().robots[key], copied, strict=True):
            assert np.array_equal(one.points, other.points)


def test_a_robot_that_is_elsewhere_is_left_out_until_it_comes_by(room, clouds):
    rectangles, (other, _) = simulated_sweeps.two_rooms(np.random.default_rng(0))
    stranger = [seen(rectangles, other, np.eye(4), np.random.default_rng(1))]
    live = brought_up_to_date(told(merger(), {"anna": clouds["anna"], "bert": stranger}))
    assert live.place("bert").state == "rejected"
    assert live.place("bert").reason
    assert live.cloud.unplaced == len(stranger[0])
    for number, cloud in enumerate(clouds["bert"]):
        live.take_cloud("bert", 200.0 + number, cloud, Piece(9, number))
    brought_up_to_date(live)
    assert live.place("bert").state == "aligned"


def test_a_start_that_is_known_is_where_the_world_is_and_a_wrong_one_is_not_believed(clouds):
    live = brought_up_to_date(told(merger(anna=(10.0, 0.0, 1.0), bert=(12.0, 3.0, 0.0)), clouds))
    assert live.place("anna").T_world_map == pytest.approx([10.0, 0.0, 1.0])
    place = live.place("bert")
    assert place.state == "aligned"
    right = se2.compose(np.array([10.0, 0.0, 1.0]), se2.from_se3(MAPS["bert"]))
    assert place.T_world_map == pytest.approx(right, abs=0.05)  # m, rad


def test_what_is_forgotten_is_taken_back(clouds):
    live = brought_up_to_date(told(merger(), clouds))
    list(live.cloud.sent())
    live.forget()
    assert len(live.cloud.take_gone()) == 2
    assert live.cloud.unplaced == live.cloud.points


def test_a_scan_of_a_robot_that_stands_is_no_sweep():
    rng = np.random.default_rng(0)
    flat = np.column_stack([np.zeros(500), rng.uniform(-3, 3, 500), rng.uniform(0, 3, 500)])
    live = merger()
    live.take_cloud("anna", 1.0, Cloud(flat, np.zeros((500, 3))), Piece(1, 0))
    assert live.sweep_work() is None
    assert live.place("anna").state == "waiting"


def test_sweeps_are_laid_on_the_vertical_scans_of_a_robot_that_drives():
    driven = simulate(SimulationConfig(seed=4, horizontal_every=1000, vertical_every=6))
    world = pipeline.register(driven.recording, driven.trajectory, RegistrationConfig()).cloud
    # The world is where the robot that drives began; the other one knows nothing of that.
    T_building_world = se3.from_xyz_rpy([5.4, 1.0, 0.0, 0.0, 0.0, np.pi / 2])
    T_building_map = MAPS["bert"]
    rectangles, rng = surfaces(first_floor()), np.random.default_rng(0)
    way = T_building_world @ driven.trajectory.matrices()
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(way[:, :3, 3], axis=0), axis=1))]
    stops = [se3.to_xyz_rpy(way[np.searchsorted(along, metres)]) for metres in (2.0, 5.0, 11.0, 14.0)]
    sweeps = tuple(seen(rectangles, stop(x, y, np.degrees(yaw)), T_building_map, rng) for x, y, _, _, _, yaw in stops)
    place = place_sweeps(SweepWork(world, {"bert 1": sweeps}, {}, frozenset()))["bert 1"]
    assert place.state == "aligned", place.reason
    metres, degrees = simulated_sweeps.errors(place.T_world_map, se3.inverse(T_building_world) @ T_building_map)
    assert metres < 0.05 and degrees < 0.5
