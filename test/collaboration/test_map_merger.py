# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import dataclasses
import math

import numpy as np
import pytest

from g2_recon.collaboration import alignment, map_merger
from g2_recon.collaboration.alignment import align
from g2_recon.collaboration.joint_map import joined
from g2_recon.collaboration.map_merger import merge
from g2_recon.config import LocalizationConfig, SimulationConfig
from g2_recon.geometry import se2, se3
from g2_recon.geometry.scan import Scan
from g2_recon.localization.localizer import Localizer
from g2_recon.localization.relocalization import Place
from g2_recon.pipeline import odometry_at_scans
from g2_recon.simulation.simulator import simulate

START = np.array([5.0, -3.0, 2.0])


@pytest.fixture(scope="module")
def simulation():
    return simulate(SimulationConfig(seed=2, horizontal_every=12, vertical_every=1000))


@pytest.fixture(scope="module")
def robots(simulation):
    """Sessions of the first and of the last 60 % of a drive, each in a map of its own."""
    recording = simulation.recording
    count = len(recording.scans)
    odometry = odometry_at_scans(recording)
    return {
        name: session_of(recording.scans[rows], odometry[rows], recording.T_base_laser, pose)
        for name, rows, pose in [
            ("one", slice(0, 6 * count // 10), se2.IDENTITY),
            ("two", slice(4 * count // 10, count), START),
        ]
    }


def session_of(scans, odometry, T_base_laser, pose=se2.IDENTITY):
    localizer = Localizer(LocalizationConfig(), T_base_laser, keep_scans=True)
    localizer.reset(pose)
    for scan, at in zip(scans, odometry, strict=True):
        localizer.process(scan, at)
    localizer.finish()
    return localizer.session()


@pytest.fixture(scope="module")
def elsewhere():
    """A session in a long hall with round columns, as there are none on the simulated floor."""
    angles = np.radians(np.arange(-90.0, 91.0))
    columns = np.array([[3.0 + 5 * k, y] for k in range(6) for y in (-2.5, 2.5)])
    scans, poses = [], []
    for k in range(60):
        pose = np.array([0.4 * k, 0.3 * math.sin(0.2 * k), 0.2 * math.sin(0.3 * k)])
        directions = np.column_stack([np.cos(angles + pose[2]), np.sin(angles + pose[2])])
        with np.errstate(divide="ignore"):
            x = np.where(directions[:, 0] > 0, 32.0 - pose[0], -1.0 - pose[0]) / directions[:, 0]
            y = np.where(directions[:, 1] > 0, 6.0 - pose[1], -4.0 - pose[1]) / directions[:, 1]
        ranges = np.minimum(x, y)
        for center in columns - pose[:2]:
            along = directions @ center
            squared = 0.4**2 - (center @ center - along**2)
            hit = (squared > 0) & (along > 0)
            ranges[hit] = np.minimum(ranges[hit], along[hit] - np.sqrt(squared[hit]))
        scans.append(Scan(0.2 * k, ranges.astype(np.float32), angles[0], math.radians(1.0)))
        poses.append(pose)
    return session_of(scans, np.array(poses), np.eye(4))


def errors(session, simulation):
    """How far (m, rad) keyframes are from the truth, after the best rigid motion of all."""
    truth, known = simulation.trajectory.interpolate(session.stamps)
    assert known.all()
    mount = se2.from_se3(simulation.recording.T_base_laser)
    true_poses = se2.compose(se2.from_se3(truth), mount)
    motion = alignment.fitted(session.poses, true_poses)
    off = se2.relative(true_poses, se2.compose(motion, session.poses))
    return np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])


def test_two_robots_that_start_anywhere_come_into_one_map(robots, simulation):
    merged = merge(robots)
    assert merged.alignments["two"].state == "aligned"
    assert len(merged.session) == sum(map(len, robots.values()))
    metres, radians = errors(merged.session, simulation)
    # What one robot reaches on the whole drive, cm.
    assert metres.mean() < 0.03
    assert radians.mean() < math.radians(0.5)
    between = merged.session.local_maps[merged.session.loops] < len(robots["one"])
    assert (between[:, 0] & ~between[:, 1]).any()


def test_the_order_of_robots_does_not_matter(robots):
    one, other = merge(robots), merge(dict(reversed(robots.items())))
    assert (one.session.poses == other.session.poses).all()
    assert one.rows == other.rows


def test_the_first_that_began_is_where_the_world_is(robots):
    merged = merge(robots)
    assert merged.poses("one")[0] == pytest.approx(robots["one"].poses[0], abs=0.02)


def test_a_start_that_is_known_is_where_a_robot_is(robots, simulation):
    T_world_two = align(robots["one"], robots["two"]).T_fixed_moving
    about = se2.compose(T_world_two, np.array([0.3, -0.2, 0.03]))
    merged = merge(robots, starts={"one": se2.IDENTITY, "two": about})
    assert merged.alignments["two"].reason.startswith("its start is given; ")
    assert merged.alignments["two"].agreement > 0.9
    metres, _ = errors(merged.session, simulation)
    assert metres.mean() < 0.04  # m; loops pull the map to where it belongs


def test_a_start_that_maps_contradict_is_not_believed_and_its_robot_is_looked_for(robots, simulation):
    T_world_two = align(robots["one"], robots["two"]).T_fixed_moving
    wrong = se2.compose(T_world_two, np.array([3.0, 1.5, 1.0]))
    merged = merge(robots, starts={"one": se2.IDENTITY, "two": wrong})
    assert merged.alignments["two"].reason == "the start that is given does not hold: it was found elsewhere"
    metres, _ = errors(merged.session, simulation)
    assert metres.mean() < 0.04  # m, as above


def began_later(session):
    return dataclasses.replace(session, stamps=session.stamps + 2e9)


def test_a_robot_of_another_building_is_left_out_though_its_start_is_given_on_top_of_others(robots, sessions):
    one, stranger = robots["one"], began_later(sessions["two"])
    merged = merge({"one": one, "stranger": stranger}, starts={"one": se2.IDENTITY, "stranger": one.poses[68]})
    assert merged.alignments["stranger"].state == "rejected"
    assert merged.alignments["stranger"].reason.startswith("the start that is given does not hold, and ")


def test_a_start_where_nobody_else_was_is_believed(robots, elsewhere):
    both = {"one": robots["one"], "far": began_later(elsewhere)}
    merged = merge(both, starts={"one": se2.IDENTITY, "far": (500.0, 0.0, 0.0)})
    assert merged.alignments["far"].state == "aligned"
    assert merged.alignments["far"].reason == "its start is given; too little is in common to judge it"


def test_a_robot_in_another_building_is_left_out_and_said_to_be(robots, elsewhere):
    merged = merge({**robots, "stranger": elsewhere})
    assert list(merged.rows) == ["stranger"] or "stranger" not in merged.rows
    state = merged.alignments["stranger" if "stranger" not in merged.rows else "one"]
    assert state.state == "rejected"
    assert state.reason


def test_where_too_little_is_recognized_once_maps_are_joined_the_place_is_not_believed(robots, monkeypatch):
    monkeypatch.setattr(map_merger, "_WAY_A_LOOP_M", 0.1)
    merged = merge(robots)
    assert list(merged.rows) == ["one"]
    assert merged.alignments["two"].state == "rejected"
    assert "places were recognized only" in merged.alignments["two"].reason


def test_maps_of_different_lasers_are_joined_beam_by_beam(robots):
    one, two = robots["one"], robots["two"]
    fewer = dataclasses.replace(two, points=two.points[:, :90], normals=two.normals[:, :90], kinds=two.kinds[:, :90])
    T = align(one, two).T_fixed_moving
    both = joined(one, fewer, T, np.arange(len(fewer)))
    assert both.kinds.shape == (len(one) + len(two), 181)
    assert not both.kinds[len(one) :, 90:].any()


def test_what_one_part_leaves_open_another_holds():
    # One in a corridor along x, another 10 m on in a corridor along y.
    corridors = ((0.0, [1e-4, 1e4, 1e4]), (10.0, [1e4, 1e-4, 1e4]))
    one, other = (Place(np.array([x, 0.0, 0.5]), np.diag(known), 1.0, 1.0, 1.0, 1.0, 10.0) for x, known in corridors)
    together = np.linalg.inv(alignment._together([one, other], one.pose))
    assert np.sqrt(np.diag(together)) == pytest.approx([0.01, 0.01, 0.01 / math.sqrt(2)], rel=1e-3)
    alone = np.linalg.inv(alignment._together([one], one.pose))
    assert alone == pytest.approx(np.linalg.inv(one.information))


def test_a_rigid_motion_is_found_from_poses():
    rng = np.random.default_rng(0)
    poses = rng.uniform(-5, 5, (10, 3))
    T = np.array([3.0, -1.0, 2.5])
    assert alignment.fitted(poses, se2.compose(T, poses)) == pytest.approx(T)


@pytest.mark.parametrize("count", [1, 15, 40, 400])
def test_parts_are_all_looked_for_the_far_apart_first(count):
    ends = alignment._ends(count)
    assert len(set(ends)) == len(ends)
    assert max(ends) <= count
    if len(ends) > 4:
        assert abs(ends[0] - ends[1]) > (max(ends) - min(ends)) / 3


def judged(way, agreement, *, sigma=0.01, parts=3):
    covariance = np.diag([sigma**2, sigma**2, 1e-4])
    return alignment.Alignment("aligned", "", se2.IDENTITY, way, agreement, covariance, np.arange(parts))


@pytest.mark.parametrize(
    ("best", "rivals", "state", "reason"),
    [
        (judged(40, 0.97), [], "aligned", ""),
        (judged(40, 0.97), [judged(30, 0.5)], "aligned", ""),
        (judged(40, 0.97), [judged(35, 0.95)], "ambiguous", "another place"),
        (judged(40, 0.998), [judged(40, 0.96)], "aligned", ""),
        (judged(40, 0.97, sigma=2.0), [], "ambiguous", "one direction"),
        (judged(3, 0.99), [], "rejected", "way in common"),
        (judged(40, 0.6), [], "rejected", "agrees by 0.60"),
        (judged(40, 0.9, parts=1), [], "rejected", "not 0.94"),
    ],
)
def test_what_speaks_against_an_alignment_is_said(best, rivals, state, reason):
    found = alignment._believed(best, rivals)
    assert found.state == state
    assert reason in found.reason


def test_keyframes_that_are_moved_take_their_scans_along(simulation):
    recording = simulation.recording
    odometry = odometry_at_scans(recording)
    localizer = Localizer(LocalizationConfig(), recording.T_base_laser, keep_scans=True)
    for scan, at in zip(recording.scans[:300], odometry, strict=False):
        localizer.process(scan, at)
    localizer.finish()
    before = localizer.trajectory().planar()
    poses = localizer.session().poses
    localizer.move_keyframes(se2.compose(START, poses))
    after = localizer.trajectory().planar()
    assert np.abs(se2.relative(se2.compose(START, before), after)).max() < 0.01  # m, rad
    assert se3.from_se2(after).shape == (300, 4, 4)
