# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from g2_recon.errors import InputError
from g2_recon.geometry import se2
from g2_recon.geometry.scan import Scan
from g2_recon.localization.beams import beams
from g2_recon.localization.keyframes import Keyframes
from g2_recon.localization.relocalization import Schedule, WholeMap, fits_as_given, is_sure

FULL = {"first": -math.pi, "beams": 360, "increment": math.radians(1.0)}
ALONE = np.array([0])


def off(pose, truth):
    """Error (m, rad) of a pose."""
    error = se2.relative(truth, pose)
    return math.hypot(error[0], error[1]), abs(error[2])


def one(scan, pose=(0.0, 0.0, 0.0)):
    """Keyframes of a single scan."""
    keyframes = Keyframes()
    keyframes.add(beams(scan, range_min=0.1, range_max=40.0), np.array(pose, float))
    return keyframes


@pytest.fixture(scope="module")
def halls(scan_of_halls, keyframes_of, drive_along, way_around_the_halls):
    way = drive_along(way_around_the_halls, step=0.5, turn=0.3)
    return WholeMap(keyframes_of([scan_of_halls(pose, noise=0.01, seed=i) for i, pose in enumerate(way)], way))


@pytest.mark.parametrize(
    "truth", [(1.2, 6.0, 2.0), (5.0, 0.8, 0.4), (13.2, 7.0, -2.5), (10.0, 9.3, 3.0), (0.8, 1.0, -0.8)], ids=str
)
def test_one_scan_tells_the_place_where_the_map_has_it_once(halls, scan_of_halls, truth):
    place = halls.find(one(scan_of_halls(truth, noise=0.01, seed=99, **FULL)), ALONE)
    metres, radians = off(place.pose, truth)
    # Noise of 1 cm a beam, in the map and in the scan.
    assert metres < 0.03 and radians < 0.01
    sigma = np.sqrt(np.diag(np.linalg.inv(place.information)))
    assert (sigma < [0.05, 0.05, 0.02]).all()


def test_scans_on_the_way_tell_together_what_the_last_alone_does_not(halls, scan_of_halls, keyframes_of, drive_along):
    # Into the wall at the end of a corridor, where little is seen; the frame of the scans is any.
    way = drive_along([(4, 1), (1.0, 1), (1.0, 1.4)], step=0.4, turn=0.4)
    scans = [scan_of_halls(pose, noise=0.01, seed=100 + i) for i, pose in enumerate(way)]
    last = np.array([1.0, 3.1, -math.pi / 2 + 0.1])
    way = np.vstack([way, last])
    scans.append(scan_of_halls(last, noise=0.01, seed=99, reach=1.5))
    collected = keyframes_of(scans, se2.compose([3.0, -7.0, 1.0], way))
    assert halls.find(collected, np.array([len(way) - 1])) is None
    metres, radians = off(halls.find(collected, np.arange(len(way))).pose, last)
    assert metres < 0.03 and radians < 0.01


def test_a_place_that_is_there_twice_is_not_sure(scan_of_room, keyframes_of):
    # The same room, 20 m away and turned.
    poses = [np.array([0.0, 0.0, yaw]) for yaw in (0.0, 1.6, 3.2, 4.8)]
    twins = [se2.compose([20.0, 3.0, 1.0], pose) for pose in poses]
    scans = [scan_of_room(pose, noise=0.01, seed=i) for i, pose in enumerate([*poses, *poses])]
    seen = one(scan_of_room((1.0, 0.5, 0.3), noise=0.01, seed=99, **FULL))
    alone, both = WholeMap(keyframes_of(scans[:4], poses)), WholeMap(keyframes_of(scans, [*poses, *twins]))
    assert off(alone.find(seen, ALONE).pose, (1.0, 0.5, 0.3))[0] < 0.03
    assert both.find(seen, ALONE) is None
    places, whole = both.places(seen, ALONE)
    assert whole
    for truth in ((1.0, 0.5, 0.3), se2.compose([20.0, 3.0, 1.0], [1.0, 0.5, 0.3])):
        assert min(off(place.pose, truth)[0] for place in places) < 0.03


def test_along_a_bare_corridor_nothing_is_sure(scan_of_corridor, keyframes_of):
    way = [np.array([0.5 * step, 0.0, 0.0]) for step in range(40)]
    corridor = WholeMap(
        keyframes_of([scan_of_corridor(pose, noise=0.01, seed=i, reach=20) for i, pose in enumerate(way)], way)
    )
    seen = one(scan_of_corridor((10.0, 0.3, 0.2), noise=0.01, seed=99, reach=8))
    assert corridor.find(seen, ALONE) is None
    places, _ = corridor.places(seen, ALONE)
    assert places


def test_a_place_that_is_not_in_the_map_is_not_sure(halls, scan_of_room):
    for seed, pose in enumerate([(0, 0, 0), (2, -1, 1), (-2, 2, -1), (4, 0, 2)]):
        assert halls.find(one(scan_of_room(pose, noise=0.01, seed=seed)), ALONE) is None


def test_a_scan_that_sees_little_is_not_looked_for(halls, scan_of_halls):
    assert halls.places(one(scan_of_halls((1, 1, 0), reach=1.2, beams=60)), ALONE) == ([], True)
    nothing = Scan(0.0, np.full(90, np.inf, np.float32), -1.5, 0.03)
    assert halls.find(one(nothing), ALONE) is None
    assert halls.around(np.zeros(3), beams(nothing, range_min=0.1, range_max=40), metres=1, radians=0.3) is None
    assert not is_sure([])


@pytest.mark.parametrize("wrong", [(0.9, 0.0, 0.0), (0.0, -0.8, 0.3), (-0.5, 0.5, -0.3), (0.0, 0.0, 0.0)], ids=str)
def test_near_a_pose_that_is_a_little_wrong_the_place_is_found(halls, scan_of_halls, wrong):
    truth = np.array([1.2, 6.0, 2.0])
    seen = beams(scan_of_halls(truth, noise=0.01, seed=99), range_min=0.1, range_max=40)
    place = halls.around(truth + wrong, seen, metres=1.0, radians=0.35)
    assert fits_as_given(place)
    metres, radians = off(place.pose, truth)
    assert metres < 0.03 and radians < 0.01
    assert halls.score(place.pose, seen) > 0.85 > halls.score(truth + (0.5, 0, 0), seen)


def test_the_keyframes_that_see_the_same_come_first(halls, scan_of_halls):
    seen = beams(scan_of_halls((1.0, 5.0, math.pi / 2)), range_min=0.1, range_max=40)
    rows = halls.seen_from(np.array([1.0, 5.0, math.pi / 2]), seen, 5)
    assert len(rows) == 5
    assert (np.hypot(*(halls._keyframes.poses[rows, :2] - (1.0, 5.0)).T) < 5).all()


def test_a_map_that_no_memory_could_hold_is_refused(scan_of_room, keyframes_of):
    poses = [np.zeros(3), np.array([9e4, 9e4, 0.0])]
    with pytest.raises(InputError, match="too large to search"):
        WholeMap(keyframes_of([scan_of_room((0, 0, 0))] * 2, poses))


def test_a_large_map_gets_larger_cells(scan_of_room, keyframes_of):
    poses = [np.zeros(3), np.array([600.0, 500.0, 0.0])]
    large = WholeMap(keyframes_of([scan_of_room((0, 0, 0)), scan_of_room((1, 1, 1))], poses))
    assert large._resolution == pytest.approx(0.2)
    assert large._levels[0].size < 16_000_000


def test_the_longer_it_is_looked_in_vain_the_more_rarely():
    schedule = Schedule()
    due = [step for step in range(1, 201) if schedule.is_due()]
    assert due[:4] == [1, 2, 3, 4]
    assert len(due) < 30
    assert max(np.diff(due)) == 21
