# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from g2_recon.config import LocalizationConfig
from g2_recon.geometry import se2
from g2_recon.localization.localizer import Localizer
from g2_recon.localization.resumed import ResumedLocalizer

FULL = {"first": -math.pi, "beams": 180, "increment": 2 * math.pi / 180}
CONFIG = LocalizationConfig(keyframe_distance=0.4, keyframe_angle=0.3)


def process(localizer, scan, way, **settings):
    return [
        localizer.process(
            scan(pose, noise=0.01, seed=i, stamp=0.1 * i, **(FULL | settings)), se2.relative(way[0], pose)
        )
        for i, pose in enumerate(way)
    ]


def errors(poses, truth):
    return np.hypot(*(np.asarray(poses) - truth)[:, :2].T)


@pytest.fixture(scope="module")
def first(scan_of_halls, drive_along):
    """A map of half of the halls in their own frame."""
    way = drive_along([(1, 1), (13, 1), (13, 6)], step=0.2, turn=0.15)
    localizer = Localizer(CONFIG, np.eye(4))
    localizer.reset(way[0])
    process(localizer, scan_of_halls, way)
    return localizer


def test_mapping_goes_on_where_it_was_left(first, scan_of_halls, drive_along):
    way = drive_along([(12, 1), (13, 1), (13, 9), (1, 9), (1, 1), (5, 1)], step=0.2, turn=0.15)
    session = first.session()
    localizer = ResumedLocalizer(CONFIG, np.eye(4), session, keep_scans=True)
    results = process(localizer, scan_of_halls, way)
    assert localizer.is_placed
    placed = next(i for i, result in enumerate(results) if result.covariance[0, 0] < 100)
    assert placed < 15
    # Noise of 1 cm a beam; the drift of 40 m, which the loop takes back.
    assert errors([result.pose for result in results[placed:]], way[placed:]).max() < 0.3
    assert localizer.loops > 0
    assert localizer.unmatched == 0
    localizer.finish()
    assert errors(localizer.trajectory().planar(), way).max() < 0.1
    # What was seen before it knew its place is in the map, too.
    assert len(localizer.keyframes()) > len(session) + 60
    again = localizer.session()
    assert len(again) == len(localizer.keyframes())
    assert again.broken.sum() == 1


def test_a_place_that_the_map_does_not_have_is_mapped_until_the_robot_comes_to_one_that_it_has(
    first, scan_of_halls, drive_along, caplog
):
    way = drive_along([(3, 9), (1, 9), (1, 2), (1, 1), (13, 1), (13, 5)], step=0.2, turn=0.15)
    localizer = ResumedLocalizer(CONFIG, np.eye(4), first.session(), keep_scans=True)
    results = process(localizer, scan_of_halls, way)
    assert results[10].covariance[0, 0] > 100
    assert all(result.matched for result in results)
    assert localizer.is_placed
    assert errors([result.pose for result in results[-5:]], way[-5:]).max() < 0.15
    localizer.finish()
    # Also the scans before lie where they were taken.
    assert errors(localizer.trajectory().planar(), way).max() < 0.15


def test_what_never_finds_its_place_is_mapped_all_the_same_and_said(first, scan_of_room, caplog):
    localizer = ResumedLocalizer(LocalizationConfig(keyframe_distance=0.05), np.eye(4), first.session())
    way = [np.zeros(3)]
    for _ in range(60):
        way.append(se2.compose(way[-1], [0.06, 0, 0.06]))
    results = process(localizer, scan_of_room, np.array(way))
    assert not localizer.is_placed
    assert all(result.matched and result.covariance[0, 0] > 100 for result in results)
    assert len(localizer.keyframes()) == len(first.keyframes()) + sum(result.keyframe for result in results)
    assert "mapping goes on in a segment of its own" in caplog.text
    localizer.finish()


@pytest.mark.parametrize("late", [False, True])
def test_a_pose_that_is_given_tells_the_place(first, scan_of_halls, drive_along, late):
    way = drive_along([(4, 1), (7, 1)], step=0.2)
    given = way[0] + (0.4, -0.3, 0.2)
    localizer = ResumedLocalizer(CONFIG, np.eye(4), first.session())
    localizer.reset(None if late else given)
    if late:
        localizer.set_pose(given)
    results = process(localizer, scan_of_halls, way, reach=3.0, beams=91, first=-math.pi / 2)
    assert localizer.is_placed
    assert errors([result.pose for result in results], way).max() < 0.2


def test_a_robot_that_is_carried_away_and_says_so_begins_a_new_segment(first, scan_of_halls, drive_along):
    localizer = ResumedLocalizer(CONFIG, np.eye(4), first.session())
    process(localizer, scan_of_halls, drive_along([(4, 1), (7, 1)], step=0.2))
    assert localizer.is_placed
    count = len(localizer.keyframes())
    way = drive_along([(13, 2), (13, 6)], step=0.2)
    localizer.set_pose(way[0] + (0.2, 0.3, 0.1))
    results = process(localizer, scan_of_halls, way)
    assert errors([result.pose for result in results], way).max() < 0.15
    session = localizer.session()
    assert session.broken[count] and session.broken.sum() == 2
