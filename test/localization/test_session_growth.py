# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What a localizer says of its growth adds up to its session."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from g2_recon.config import LocalizationConfig
from g2_recon.errors import InputError
from g2_recon.geometry import se2
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.session import OF_KEYFRAMES, ScanPoses
from g2_recon.localization.localizer import Localizer

ANGLES = np.linspace(-np.pi, np.pi, 360, endpoint=False)
MOUNT = np.eye(4)


def look(stamp, x, y, yaw) -> Scan:
    """What a laser sees of a room of 6 m x 4 m."""
    cos, sin = np.cos(ANGLES + yaw), np.sin(ANGLES + yaw)
    with np.errstate(divide="ignore"):
        ranges = np.minimum((np.where(cos > 0, 3.0, -3.0) - x) / cos, (np.where(sin > 0, 2.0, -2.0) - y) / sin)
    return Scan(stamp, ranges.astype(np.float32), ANGLES[0], ANGLES[1] - ANGLES[0])


ROUNDS = 1.5
TURNS = np.arange(0, ROUNDS * 2 * np.pi, 0.05)
# Rounds about the middle of the room, long enough to complete local maps.
WAY = np.column_stack([1.2 * np.cos(TURNS), 1.2 * np.sin(TURNS), TURNS + np.pi / 2])


def true_pose(step) -> np.ndarray:
    """In the map, whose origin is where the drive began."""
    return se2.relative(WAY[0], WAY[step])


def scans_of_drive():
    """Each scan with its odometry, in a frame of its own."""
    for step, pose in enumerate(WAY):
        yield look(100 + 0.1 * step, *pose), se2.compose(np.array([7.0, 3.0, 1.0]), pose)


def drive(localizer):
    for scan, odometry in scans_of_drive():
        localizer.process(scan, odometry)
        yield


@pytest.fixture(scope="module")
def grown():
    """A localizer after its drive, and all that it said to have more after each scan."""
    localizer = Localizer(LocalizationConfig(), MOUNT)
    growths, keyframes, scans = [], 0, 0
    for _ in drive(localizer):
        growths.append(localizer.growth(keyframes, scans))
        keyframes, scans = len(growths[-1].poses), scans + len(growths[-1].scans)
    return localizer, growths


def test_keyframes_add_up_to_the_session(grown):
    localizer, growths = grown
    session = localizer.session()
    assert len(session) > 20
    for name in OF_KEYFRAMES:
        parts = np.concatenate([getattr(growth, name) for growth in growths])
        np.testing.assert_array_equal(parts, getattr(session, name), err_msg=name)


def test_local_maps_are_told_as_soon_as_no_loop_is_being_closed(grown):
    localizer, growths = grown
    graphs = [growth.graph for growth in growths if growth.graph is not None]
    begins = [graph[0].tolist() for graph in graphs]
    assert begins[0] == [0] and len(begins[-1]) > 1
    assert all(begin == localizer.session().local_maps.tolist()[: len(begin)] for begin in begins)


def test_scans_add_up_to_the_trajectory_once_they_are_remembered(grown):
    localizer, growths = grown
    scans = ScanPoses(
        **{
            field.name: np.concatenate([getattr(growth.scans, field.name) for growth in growths])
            for field in dataclasses.fields(ScanPoses)
        }
    )
    other = Localizer(LocalizationConfig(), MOUNT)
    other.resume(localizer.session())
    other.remember(scans)
    np.testing.assert_array_equal(other.trajectory().stamps, localizer.trajectory().stamps)
    np.testing.assert_allclose(other.trajectory().positions, localizer.trajectory().positions, atol=1e-12)


def test_after_a_crash_it_goes_on_as_if_nothing_had_happened(grown):
    """Every 20 scans a new localizer takes up what the one before has said."""
    whole, _ = grown
    localizer = Localizer(LocalizationConfig(), MOUNT)
    way = list(whole.trajectory().stamps)
    for number, (scan, odometry) in enumerate(scans_of_drive()):
        if number and number % 20 == 0:
            said = localizer.growth(0, 0)
            before, localizer = localizer, Localizer(LocalizationConfig(), MOUNT)
            localizer.go_on(before.session(), said.scans, said.last)
        placed = localizer.process(scan, odometry)
        assert placed.matched
    np.testing.assert_array_equal(localizer.trajectory().stamps, way)
    assert abs(len(localizer.keyframes()) - len(whole.keyframes())) <= 2
    # 2 cm: noise-free scans of one room.
    np.testing.assert_allclose(localizer.trajectory().positions, whole.trajectory().positions, atol=0.02)


def test_odometry_leads_over_the_time_without_a_localizer(grown):
    scans = list(scans_of_drive())
    localizer = Localizer(LocalizationConfig(), MOUNT)
    for scan, odometry in scans[:60]:
        localizer.process(scan, odometry)
    said = localizer.growth(0, 0)
    other = Localizer(LocalizationConfig(), MOUNT)
    other.go_on(localizer.session(), said.scans, said.last)
    # Half a round further: on the other side of the room.
    scan, odometry = scans[125]
    placed = other.process(scan, odometry)
    assert placed.matched
    np.testing.assert_allclose(placed.pose[:2], true_pose(125)[:2], atol=0.02)


def test_telling_changes_nothing(grown):
    localizer, _ = grown
    silent = Localizer(LocalizationConfig(), MOUNT)
    for _ in drive(silent):
        pass
    np.testing.assert_array_equal(silent.trajectory().positions, localizer.trajectory().positions)


def test_scans_that_hang_on_keyframes_that_are_not_there_are_refused(grown):
    localizer, _ = grown
    with pytest.raises(InputError, match="not there"):
        localizer.remember(ScanPoses(np.ones(1), np.array([10**6]), np.zeros((1, 3))))


def test_of_what_has_come_no_more_keyframes_are_told_than_asked_for(grown):
    localizer, _ = grown
    whole = localizer.growth(0, 0)
    count = len(whole.stamps)
    assert count > 8
    for first, most in ((0, 1), (3, 2), (count - 1, 5), (count, 5), (2, count)):
        some = localizer.growth(first, 0, most=most)
        for name in OF_KEYFRAMES:
            np.testing.assert_array_equal(getattr(some, name), getattr(whole, name)[first : first + most])
        np.testing.assert_array_equal(some.poses, whole.poses)
    assert localizer.latest_stamp == whole.last.stamp >= whole.stamps[-1]
    resumed = Localizer(LocalizationConfig(), MOUNT)
    resumed.resume(localizer.session())
    assert resumed.latest_stamp == whole.stamps[-1]
