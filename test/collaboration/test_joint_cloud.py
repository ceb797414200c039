# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from itertools import count

import numpy as np
import pytest

from g2_recon.collaboration.joint_cloud import Correction, JointCloud
from g2_recon.geometry import se2
from g2_recon.geometry.cloud import ALL_PIECES, Cloud, Piece
from g2_recon.reconstruction.collected_cloud import CollectedCloud

STAMPS = np.arange(10.0)
IN_MAP = np.column_stack([STAMPS, np.zeros(10), np.zeros(10)])
TURNED = se2.compose(np.array([2.0, 1.0, 0.5]), IN_MAP)


def points(seed, number=5):
    place = np.random.default_rng(seed).uniform(-3, 3, (number, 3))
    return Cloud(place, np.zeros_like(place))


def moved(T, cloud):
    return np.column_stack([se2.transform_points(np.array(T), cloud.points[:, :2]), cloud.points[:, 2]])


@pytest.fixture
def joint():
    """With one session of robot r from 0 s to 9 s, and what somebody who collects its pieces has."""
    sources = count(100)
    cloud = JointCloud(lambda: next(sources))
    cloud.collected = CollectedCloud()

    def collect():
        for source in cloud.take_gone():
            cloud.collected.add(Cloud(np.full((1, 3), np.nan)), Piece(source, ALL_PIECES))
        sent = list(cloud.sent())
        for _, part, piece in sent:
            assert cloud.collected.add(part, piece) == ""
        return sent

    cloud.collect = collect
    return cloud


def where(joint):
    """The points that have been collected, in an order of their own."""
    found = joint.collected.cloud().points
    return found[np.lexsort(found.T)]


def expected(parts):
    found = np.concatenate(parts)
    return found[np.lexsort(found.T)]


def test_points_that_come_after_the_last_keyframe_are_in_the_world_at_once(joint):
    joint.bind("r", {7: (0.0, 9.0)})
    joint.place("r", 7, Correction.between(STAMPS, IN_MAP, TURNED))
    joint.add("r", 3.0, points(0), Piece(1, 0))
    joint.collect()
    assert len(joint.collected) == 5
    assert joint.unplaced == 0


def test_points_wait_until_their_place_is_known_and_then_are_in_the_world(joint):
    joint.add("r", 3.0, points(0), Piece(1, 0))
    assert joint.collect() == []
    joint.bind("r", {7: (0.0, 9.0)})
    assert joint.collect() == []
    assert joint.unplaced == 5
    joint.place("r", 7, Correction.between(STAMPS, IN_MAP, TURNED))
    joint.collect()
    # m, of float32.
    np.testing.assert_allclose(where(joint), expected([moved((2.0, 1.0, 0.5), points(0))]), atol=1e-5)
    assert joint.unplaced == 0


def test_scans_of_a_piece_are_added_and_a_newer_revision_replaces_them(joint):
    joint.bind("r", {7: (0.0, 9.0)})
    joint.place("r", 7, Correction.between(STAMPS, IN_MAP, IN_MAP))
    for seed in range(2):
        joint.add("r", 3.0, points(seed), Piece(1, 0))
        joint.bind("r", {7: (0.0, 9.0)})
        joint.collect()
    np.testing.assert_allclose(where(joint), expected([points(0).points, points(1).points]), atol=1e-5)
    joint.add("r", 3.0, points(2), Piece(1, 0, 1))
    assert joint.add("r", 3.0, points(3), Piece(1, 0, 0)) == "of an older revision"
    joint.collect()
    np.testing.assert_allclose(where(joint), points(2).points[np.lexsort(points(2).points.T)], atol=1e-5)


def test_what_is_moved_by_less_than_a_centimetre_is_not_sent_again(joint):
    joint.add("r", 1.0, points(0), Piece(1, 0))
    joint.add("r", 8.0, points(1), Piece(1, 1))
    joint.bind("r", {7: (0.0, 9.0)})
    joint.place("r", 7, Correction.between(STAMPS, IN_MAP, IN_MAP))
    assert len(joint.collect()) == 2
    bent = IN_MAP.copy()
    bent[5:, 1] += 0.1
    joint.place("r", 7, Correction.between(STAMPS, IN_MAP, bent))
    ((stamp, _, piece),) = joint.collect()
    assert stamp == 8.0 and piece.revision == 1
    np.testing.assert_allclose(where(joint), expected([points(0).points, moved((0.0, 0.1, 0.0), points(1))]), atol=1e-5)


def test_between_two_keyframes_a_correction_is_between_theirs():
    bent = IN_MAP.copy()
    bent[5:, 1] += 0.1
    correction = Correction.between(STAMPS, IN_MAP, bent)
    assert correction.at(np.array([-5.0, 4.25, 20.0]))[:, 1] == pytest.approx([0, 0.025, 0.1])
    alone = Correction.between(STAMPS[:1], IN_MAP[:1], TURNED[:1])
    assert alone.at(np.array([3.0]))[0] == pytest.approx((2.0, 1.0, 0.5))


def test_a_place_that_turns_out_wrong_is_taken_back_and_the_right_one_taken_later(joint):
    joint.add("r", 1.0, points(0), Piece(1, 0))
    joint.bind("r", {7: (0.0, 9.0)})
    joint.place("r", 7, Correction.between(STAMPS, IN_MAP, TURNED))
    joint.collect()
    joint.place("r", 7, None)
    joint.collect()
    assert len(joint.collected) == 0 and joint.unplaced == 5
    joint.place("r", 7, Correction.between(STAMPS, IN_MAP, IN_MAP))
    joint.collect()
    np.testing.assert_allclose(where(joint), expected([points(0).points]), atol=1e-5)


def test_a_new_map_of_a_robot_takes_nothing_from_its_old_one(joint):
    joint.add("r", 1.0, points(0), Piece(1, 0))
    joint.bind("r", {7: (0.0, 9.0)})
    joint.add("r", 9.0, Cloud(np.full((1, 3), np.nan)), Piece(1, ALL_PIECES))
    joint.add("r", 21.0, points(1), Piece(2, 0))
    joint.bind("r", {7: (0.0, 9.0)})
    joint.bind("r", {7: (0.0, 9.0), 8: (20.0, 22.0)})
    joint.place("r", 7, Correction.between(STAMPS, IN_MAP, IN_MAP))
    joint.place("r", 8, Correction.between(STAMPS + 20, IN_MAP, TURNED))
    joint.collect()
    np.testing.assert_allclose(where(joint), expected([points(0).points, moved((2.0, 1.0, 0.5), points(1))]), atol=1e-5)


def test_whoever_comes_late_gets_all(joint):
    joint.add("r", 1.0, points(0), Piece(1, 0))
    joint.bind("r", {7: (0.0, 9.0)})
    joint.place("r", 7, Correction.between(STAMPS, IN_MAP, IN_MAP))
    joint.collect()
    joint.send_all()
    ((_, cloud, piece),) = joint.collect()
    assert piece.revision == 1 and len(cloud) == 5


def test_points_with_other_fields_than_their_piece_are_refused(joint):
    joint.add("r", 1.0, points(0), Piece(1, 0))
    assert joint.add("r", 1.0, Cloud(np.ones((1, 3))), Piece(1, 0)) == "with other fields than the piece had"
    assert joint.points == 5


def test_two_robots_are_two_sources(joint):
    for robot in ("r", "s"):
        joint.add(robot, 1.0, points(0), Piece(1, 0))
        joint.bind(robot, {7: (0.0, 9.0)})
        joint.place(robot, 7, Correction.between(STAMPS, IN_MAP, IN_MAP))
    assert {piece.source for _, _, piece in joint.collect()} == {100, 101}
