# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry import se3
from g2_recon.registration import sweep_graph
from g2_recon.registration.sweep_graph import Edge, covariances, deviation, odometry_edge, optimize

SURE = np.diag([1e6] * 3 + [1e6] * 3)


def some_poses(count=6, seed=0):
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ se3.from_xyz_rpy([*rng.normal(0, 2, 3), *rng.normal(0, 0.5, 3)]))
    return np.array(poses)


def chain(poses, information=SURE):
    return [Edge(i, i + 1, sweep_graph.relative(poses[i], poses[i + 1]), information) for i in range(len(poses) - 1)]


def test_poses_follow_their_edges_from_a_poor_start():
    truth = some_poses()
    rng = np.random.default_rng(1)
    start = np.array([pose @ se3.from_xyz_rpy(rng.normal(0, 0.2, 6)) for pose in truth])
    start[0] = truth[0]
    assert optimize(start, chain(truth)) == pytest.approx(truth, abs=1e-6)


def test_the_pose_that_is_held_stays():
    truth = some_poses()
    start = np.array([se3.from_xyz_rpy([1, 2, 3, 0.1, 0.2, 0.3]) @ pose for pose in truth])
    assert optimize(start, chain(truth), held=2)[2] == pytest.approx(start[2], abs=1e-9)


def test_derivatives_are_those_of_the_error():
    first, second = some_poses(3, seed=2)[1:]
    T = sweep_graph.relative(first, second)
    _, J = sweep_graph._linearized(first, second, T)

    def stepped(pose, step):
        result = se3.from_xyz_rpy([0, 0, 0, *step[3:]]) @ pose
        result[:3, 3] = pose[:3, 3] + step[:3]
        return result

    for column in range(12):
        step = np.zeros(12)
        step[column] = 1e-6
        error, _ = sweep_graph._linearized(stepped(first, step[:6]), stepped(second, step[6:]), T)
        assert error / 1e-6 == pytest.approx(J[:, column], abs=1e-4)


def test_a_loop_spreads_what_does_not_fit_over_its_edges():
    truth = np.array([se3.from_se2([x, 0, 0]) for x in range(5)])
    edges = chain(truth)
    closing = sweep_graph.relative(truth[0], truth[4])
    closing[1, 3] += 0.005
    poses = optimize(truth, [*edges, Edge(0, 4, closing, SURE)])
    gaps = np.diff(poses[:, 1, 3])
    assert 0.002 < poses[4, 1, 3] < 0.005
    assert gaps.max() < 0.003


def test_one_wrong_loop_does_not_break_a_chain_of_many():
    truth = np.array([se3.from_se2([x, 0, 0]) for x in range(5)])
    right = [Edge(0, 4, sweep_graph.relative(truth[0], truth[4]), SURE)] * 3
    wrong = Edge(0, 3, se3.from_se2([0.5, 2.0, 0.4]), SURE)
    poses = optimize(truth, [*chain(truth), *right, wrong])
    # Its pull is bounded: 5 standard deviations of a millimetre, over a stiff chain.
    assert np.abs(poses - truth).max() < 0.02


def test_a_direction_without_information_is_left_to_odometry():
    blind = np.diag([0.0, 1e6, 1e6, 1e6, 1e6, 1e6])
    matched = Edge(0, 1, se3.from_se2([9.0, 0.2, 0.0]), blind)
    driven = odometry_edge(0, 1, se3.from_se2([3.0, 0.0, 0.0]), per_metre=0.1, angle=0.1)
    poses = optimize(np.array([np.eye(4), np.eye(4)]), [matched, driven])
    assert poses[1, :2, 3] == pytest.approx([3.0, 0.2], abs=1e-3)


def test_covariances_grow_along_a_chain_and_are_zero_where_it_is_held():
    poses = np.array([se3.from_se2([x, 0, 0]) for x in range(4)])
    grown = covariances(poses, chain(poses), range(4))
    assert np.abs(grown[0]).max() < 1e-9
    assert (np.diff([np.trace(each[:3, :3]) for each in grown]) > 0).all()
    assert np.sqrt(grown[1][0, 0]) == pytest.approx(0.001, rel=0.01)


def test_the_deviation_counts_in_standard_deviations():
    poses = np.array([np.eye(4), se3.from_se2([1.003, 0, 0])])
    assert deviation(poses, Edge(0, 1, se3.from_se2([1.0, 0, 0]), SURE)) == pytest.approx(3.0)
