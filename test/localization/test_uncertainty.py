# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry import se2
from g2_recon.localization import pose_graph
from g2_recon.localization.keyframes import Keyframes
from g2_recon.localization.uncertainty import Uncertainty

STEP = np.array([0.3, 0.0, 0.1])
# A scan in a room: as many pairs in each direction, and 2 m away on average.
ROOM = np.diag([50.0, 50.0, 200.0])
# Along a bare corridor noise tilts the normals of walls by some degrees.
CORRIDOR = np.diag([0.5, 100.0, 200.0])


@pytest.fixture
def keyframes():
    """Twenty keyframes along an arc."""
    return along_an_arc(20)


def along_an_arc(count):
    poses = [np.array([1.0, -2.0, 0.5])]
    for _ in range(count - 1):
        poses.append(se2.compose(poses[-1], STEP))
    made = Keyframes()
    made.fill(np.array(poses), empty(count))
    return made


def straight_on(count):
    made = Keyframes()
    made.fill(np.array([(0.3 * k, 0, 0) for k in range(count)]), empty(count))
    return made


def empty(count):
    points = np.zeros((count, 4, 2), np.float32)
    return points, points.copy(), np.zeros((count, 4), np.uint8), np.zeros(count), np.full(count, 0.1)


def edges_to(poses, k, hessian, *, pulls=None):
    second = np.array([k - span for span in (1, 2, 3, 5, 8, 12) if span <= k])
    first = np.full(len(second), k)
    hessians = np.repeat(hessian[None], len(second), axis=0)
    gradients = np.zeros((len(second), 3)) if pulls is None else pulls
    return pose_graph.Edges(first, second, se2.relative(poses[second], poses[first]), hessians, gradients)


UNKNOWN = np.full(3, np.nan)


def driven(keyframes, hessian, *, wheels=True, rng=None, sigma=0.0, corners=None):
    """Uncertainty after all keyframes came one by one, whose edges disagree by a sigma, m for each pair.

    wheels: whether they tell the steps, off by (3,) if it is an array, or not at all.
    """
    arriving = Keyframes()
    uncertainty = Uncertainty(arriving)
    for k in range(len(keyframes)):
        arriving.fill(keyframes.poses[: k + 1], tuple(a[: k + 1] for a in keyframes.arrays))
        edges = edges_to(keyframes.poses, k, hessian) if k else None
        if rng is not None and k:
            edges.gradients[:] = sigma * rng.normal(size=(len(edges), 3)) * np.sqrt(np.diag(hessian))
        told = UNKNOWN
        if k and wheels is not False:
            told = se2.relative(keyframes.poses[k - 1], keyframes.poses[k]) + (0.0 if wheels is True else wheels)
        uncertainty.add(edges, wheels=told, broken=False, corners=corners)
    return uncertainty


def test_the_first_keyframe_is_where_the_map_is(keyframes):
    alone = Keyframes()
    alone.fill(keyframes.poses[:1], empty(1))
    uncertainty = Uncertainty(alone)
    uncertainty.add(None, wheels=UNKNOWN, broken=False)
    assert (uncertainty.covariance == 0).all()


def test_what_edges_want_otherwise_is_how_far_scans_err(keyframes):
    rng = np.random.default_rng(0)
    uncertainty = Uncertainty(Keyframes())
    for _ in range(400):
        wanted = 0.008 * rng.normal(size=(6, 3)) * np.sqrt(np.diag(ROOM))
        uncertainty._learn(edges_to(keyframes.poses, 12, ROOM, pulls=wanted))
    # A running mean over a hundred, with three degrees of freedom each.
    assert uncertainty.pair_sigma == pytest.approx(0.008, rel=0.15)


def test_one_wild_edge_is_not_all_that_counts(keyframes):
    uncertainty = Uncertainty(Keyframes())
    uncertainty._learn(edges_to(keyframes.poses, 12, ROOM, pulls=np.full((6, 3), 1e6)))
    assert uncertainty.pair_sigma < 0.03


@pytest.mark.parametrize("wheels", [True, False], ids=["wheels", "no wheels"])
def test_covariances_grow_along_the_way_and_stay_positive(keyframes, wheels):
    uncertainty = driven(keyframes, ROOM, wheels=wheels)
    values = [np.linalg.eigvalsh(uncertainty.between(0, k)) for k in range(1, 20)]
    assert (np.array(values) > 0).all()
    assert (np.diff([v.sum() for v in values]) > 0).all()


def test_the_more_scans_disagree_the_greater_a_part_of_that_adds_up(keyframes):
    steps = []
    for sigma in (0.01, 0.02):
        rng, uncertainty = np.random.default_rng(0), driven(keyframes, ROOM)
        for _ in range(400):
            edges = edges_to(keyframes.poses, 15, ROOM, pulls=sigma * rng.normal(size=(6, 3)) * np.sqrt(np.diag(ROOM)))
            uncertainty._learn(edges)
        steps.append(uncertainty._step(edges, STEP, UNKNOWN, None))
    # Twice as far, squared, and four times as great a part of it; without wheels inertia says nearly nothing.
    assert steps[1] == pytest.approx(16 * steps[0], rel=0.03)


def test_scans_that_agree_exactly_are_not_known_exactly():
    uncertainty = Uncertainty(Keyframes())
    edges = edges_to(along_an_arc(20).poses, 15, ROOM)
    for _ in range(5000):
        uncertainty._learn(edges)
    assert uncertainty.pair_sigma == pytest.approx(0.002)


def test_along_a_bare_corridor_the_wheels_are_what_is_known():
    # Along x.
    straight = straight_on(20)
    room, corridor = driven(straight, ROOM).covariance, driven(straight, CORRIDOR).covariance
    # 1.5 cm after one metre, as the root of the way: 5.7 m.
    assert np.sqrt(corridor[0, 0]) == pytest.approx(0.015 * np.sqrt(5.7), rel=0.01)
    assert corridor[0, 0] > 20 * room[0, 0]
    without = driven(straight, CORRIDOR, wheels=False).covariance
    assert without[0, 0] > 20 * corridor[0, 0]


def test_corners_tell_the_way_along_a_corridor_where_there_are_no_wheels():
    rng = np.random.default_rng(0)
    told = driven(straight_on(20), CORRIDOR, wheels=False, corners=np.array([1.0, 0.0]), rng=rng, sigma=0.01)
    # The first guess, about which the scans say the same: 1 cm. Inertia, 12 cm, adds next to nothing.
    assert np.sqrt(told.covariance[0, 0]) == pytest.approx(1.5 * 0.01 * np.sqrt(5.7), rel=0.1)


def test_how_far_wheels_err_is_learned_where_scans_know_the_way():
    wrong = driven(straight_on(200), ROOM, wheels=np.array([0.01, 0, 0]))
    # 1 cm a step, eight times, on eight steps of 0.3 m; 192 of them are four times what is remembered.
    assert np.sqrt(wrong.wheel_variance[0]) == pytest.approx(0.08 / np.sqrt(8 * 0.3), rel=0.05)
    right = driven(along_an_arc(200), ROOM)
    assert np.sqrt(right.wheel_variance) == pytest.approx(np.zeros(3), abs=0.01)


def test_wheels_say_nothing_about_themselves_along_a_corridor():
    uncertainty = driven(straight_on(100), CORRIDOR, wheels=np.array([0.01, 0.01, 0]))
    assert np.sqrt(uncertainty.wheel_variance[0]) == pytest.approx(0.015)
    assert np.sqrt(uncertainty.wheel_variance[1]) > 0.03


def test_a_loop_takes_back_what_the_way_has_added(keyframes):
    uncertainty = driven(keyframes, ROOM)
    before = uncertainty.covariance
    uncertainty.take_back(15, np.zeros((3, 3)))
    after = uncertainty.covariance
    # What was added since stays.
    assert (np.linalg.eigvalsh(after) > 0).all()
    assert (np.linalg.eigvalsh(before - after) > 0).all()


def test_steps_count_as_much_as_loops_have_shown(keyframes):
    uncertainty = driven(keyframes, ROOM)
    uncertainty.take_back(18, np.zeros((3, 3)))
    as_expected = uncertainty.covariance
    uncertainty.drift_scale = 4.0
    uncertainty.take_back(18, np.zeros((3, 3)))
    assert uncertainty.covariance == pytest.approx(4 * as_expected)


def test_where_track_was_lost_metres_are_unknown(keyframes):
    lost = Uncertainty(keyframes)
    lost.fill(len(keyframes) - 1)
    lost.add(None, wheels=np.zeros(3), broken=True)
    assert np.sqrt(np.diag(np.reshape(lost._steps[-9:], (3, 3)))) == pytest.approx([5, 5, 0.5])


def test_between_is_seen_from_the_earlier_one_wherever_the_map_begins(keyframes):
    moved = Keyframes()
    moved.fill(se2.compose(np.array([5.0, 3.0, 2.0]), keyframes.poses), empty(20))
    here, there = driven(keyframes, CORRIDOR), driven(moved, CORRIDOR)
    assert here.between(3, 17) == pytest.approx(there.between(3, 17), rel=1e-6)
