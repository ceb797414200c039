# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry import se2
from g2_recon.localization import pose_graph
from g2_recon.localization.pose_graph import Edges

COUNT = 24
_ANGLES = 2 * np.pi * np.arange(COUNT) / COUNT
RING = np.column_stack([5 * np.cos(_ANGLES), 5 * np.sin(_ANGLES), se2.wrap_angle(_ANGLES + np.pi / 2)])
CHAIN = (np.arange(1, COUNT), np.arange(COUNT - 1))
INFORMATION = np.diag([100.0, 100.0, 400.0])


def exact_edges(first, second, truth=RING):
    """Edges that measure what is true."""
    first, second = np.asarray(first), np.asarray(second)
    T = se2.relative(truth[second], truth[first])
    return pose_graph.measured(first, second, T, np.tile(INFORMATION, (len(first), 1, 1)))


def ring_with_a_loop():
    return pose_graph.joined(exact_edges(*CHAIN), exact_edges([COUNT - 1], [0]))


def noisy(sigma=0.1, seed=0):
    poses = RING + np.random.default_rng(seed).normal(0, sigma, RING.shape)
    poses[0] = RING[0]
    return poses


def off(poses, truth=RING):
    return np.abs(np.column_stack([(poses - truth)[:, :2], se2.wrap_angle(poses[:, 2] - truth[:, 2])])).max()


def test_jacobians_and_pulls_are_those_by_differences():
    rng = np.random.default_rng(0)
    poses = rng.uniform(-3, 3, (4, 3))
    first, second = np.array([1, 3, 2]), np.array([0, 1, 3])
    T = se2.relative(poses[second], poses[first]) + rng.normal(0, 0.1, (3, 3))
    factors = rng.normal(size=(3, 3, 3))
    hessians, gradients, weights = factors @ factors.transpose(0, 2, 1), rng.normal(size=(3, 3)), rng.uniform(1, 2, 3)
    blocks, pulls, squared = pose_graph.linearize(poses, first, second, T, hessians, gradients, weights)
    for m in range(3):

        def deviation(x, m=m):
            d = se2.relative(x[3:], x[:3]) - T[m]
            return np.array([d[0], d[1], se2.wrap_angle(d[2])])

        at = np.concatenate([poses[first[m]], poses[second[m]]])
        J = np.column_stack([(deviation(at + h) - deviation(at - h)) / 2e-6 for h in 1e-6 * np.eye(6)])
        d = deviation(at)
        assert blocks[m] == pytest.approx(weights[m] * J.T @ hessians[m] @ J, abs=1e-6)
        assert pulls[m] == pytest.approx(weights[m] * J.T @ (hessians[m] @ d + gradients[m]), abs=1e-6)
        assert squared[m] == pytest.approx(d @ hessians[m] @ d)


def test_a_noisy_ring_becomes_the_true_one():
    poses, edges = noisy(), ring_with_a_loop()
    costs = []
    for _ in range(6):
        poses, squared = pose_graph.solve(poses, edges)
        costs.append(squared.sum())
    assert off(poses) < 1e-6
    assert costs[0] > 100
    assert costs[-1] < 1e-6


def test_a_loop_edge_closes_a_ring_that_has_drifted_apart():
    edges = exact_edges(*CHAIN)
    drifting = edges.T + np.random.default_rng(1).normal(0, 0.02, edges.T.shape) + (0.02, 0, 0.01)
    poses = [RING[0]]
    for step in drifting:
        poses.append(se2.compose(poses[-1], step))
    poses = np.array(poses)
    gap = se2.relative(RING[0], RING[-1])
    before = off(se2.relative(poses[:1], poses[-1:]), gap[None])
    sequence = pose_graph.measured(*CHAIN, drifting, edges.hessians)
    loop = exact_edges([COUNT - 1], [0])
    loop = Edges(loop.first, loop.second, loop.T, 1e4 * loop.hessians, loop.gradients)
    closed = poses
    for _ in range(8):
        closed, _ = pose_graph.solve(closed, pose_graph.joined(sequence, loop))
    assert before > 0.5
    assert off(se2.relative(closed[:1], closed[-1:]), gap[None]) < 0.01
    assert off(closed) < 0.5 * off(poses)


@pytest.mark.parametrize("held", [0, 7])
def test_the_held_pose_stays_and_all_others_come_to_it(held):
    poses = noisy()
    poses[held] = RING[held]
    edges = ring_with_a_loop()
    for _ in range(6):
        poses, _ = pose_graph.solve(poses, edges, held=held)
    assert poses[held] == pytest.approx(RING[held], abs=1e-6)
    assert off(poses) < 1e-5


def test_a_gradient_pulls_to_where_a_quadratic_cost_is_least():
    poses = np.zeros((2, 3))
    edge = Edges(np.array([1]), np.array([0]), np.zeros((1, 3)), INFORMATION[None], np.array([[-10.0, 20.0, 4.0]]))
    moved, squared = pose_graph.solve(poses, edge)
    assert squared == 0
    assert moved[1] == pytest.approx(np.linalg.solve(INFORMATION, [10, -20, -4]), rel=1e-6)


def test_a_direction_without_information_stays_where_it_is():
    poses = np.array([[0, 0, 0], [1.0, 0.5, 0.1]])
    information = np.diag([0.0, 100.0, 100.0])
    edge = pose_graph.measured(np.array([1]), np.array([0]), np.array([[7.0, 0.2, 0.0]]), information[None])
    for _ in range(3):
        poses, _ = pose_graph.solve(poses, edge)
    assert poses[1] == pytest.approx([1.0, 0.2, 0.0], abs=1e-5)


def test_a_pose_that_no_edge_holds_stays_where_it_is():
    poses = np.array([[0, 0, 0], [3.0, 4.0, 1.0], [1.1, 0, 0]])
    edge = pose_graph.measured(np.array([2]), np.array([0]), np.array([[1.0, 0, 0]]), INFORMATION[None])
    moved, _ = pose_graph.solve(poses, edge)
    assert moved[1] == pytest.approx([3, 4, 1])
    assert moved[2] == pytest.approx([1, 0, 0], abs=1e-5)


def test_an_edge_of_little_weight_hardly_counts():
    true, false = exact_edges([1], [0]), exact_edges([1], [0])
    false = Edges(false.first, false.second, false.T + (1, 0, 0), false.hessians, false.gradients)
    moved, _ = pose_graph.solve(RING[:2], pose_graph.joined(true, false), weights=np.array([1.0, 0.25]))
    step = se2.relative(moved[0], moved[1])
    assert step - true.T[0] == pytest.approx([0.2, 0, 0], abs=1e-6)


def test_edges_can_be_picked_and_joined():
    edges = ring_with_a_loop()
    assert len(edges) == COUNT
    again = pose_graph.joined(edges[:5], edges[np.arange(COUNT) >= 5])
    assert again.first.tolist() == edges.first.tolist()
    assert again.T.tolist() == edges.T.tolist()


def solve_window(poses, start, edges, rounds):
    pose_graph.solve_window(poses, start, edges.first, edges.second, edges.T, edges.hessians, edges.gradients, rounds)


def test_a_window_comes_to_what_is_held_before_it():
    poses = noisy()
    poses[:10] = RING[:10]
    held = poses[:10].copy()
    solve_window(poses, 10, ring_with_a_loop(), 6)
    assert poses[:10].tolist() == held.tolist()
    assert off(poses) < 1e-6


def test_edges_wholly_before_a_window_say_nothing():
    poses, edges = noisy(), exact_edges(*CHAIN)
    one, other = poses.copy(), poses.copy()
    solve_window(one, 10, edges, 3)
    solve_window(other, 10, edges[edges.first >= 10], 3)
    assert one.tolist() == other.tolist()
    assert one[:10].tolist() == poses[:10].tolist()
    # What is held was wrong, and the window follows it.
    assert se2.relative(one[9], one[-1]) == pytest.approx(se2.relative(RING[9], RING[-1]), abs=1e-5)


def test_a_window_of_all_but_the_first_solves_as_the_sparse_solver_does():
    poses, edges = noisy(), ring_with_a_loop()
    dense = poses.copy()
    solve_window(dense, 1, edges, 2)
    for _ in range(2):
        poses, _ = pose_graph.solve(poses, edges)
    assert dense == pytest.approx(poses, abs=1e-6)


def test_in_a_window_a_direction_without_information_stays_where_it_is():
    poses = np.array([[0, 0, 0], [1.0, 0.5, 0.1]])
    information = np.diag([0.0, 100.0, 100.0])
    edge = pose_graph.measured(np.array([1]), np.array([0]), np.array([[7.0, 0.2, 0.0]]), information[None])
    solve_window(poses, 1, edge, 3)
    assert poses[1] == pytest.approx([1.0, 0.2, 0.0], abs=1e-5)


def test_along_a_chain_the_next_pose_is_as_sure_as_its_edge_and_the_far_ones_less():
    edges = exact_edges(*CHAIN)
    joint = pose_graph.covariance(RING, edges, np.ones(len(edges)), [9, 8])
    assert pose_graph.covariance_between(joint, RING[8], RING[9]) == pytest.approx(np.linalg.inv(INFORMATION), abs=1e-6)
    spreads = [np.trace(pose_graph.covariance(RING, edges, np.ones(len(edges)), [k])) for k in range(1, COUNT // 2)]
    assert (np.diff(spreads) > 0).all()


def test_a_loop_makes_the_end_of_a_chain_as_sure_as_the_loop():
    chain, ring = exact_edges(*CHAIN), ring_with_a_loop()
    open_end = pose_graph.covariance(RING, chain, np.ones(len(chain)), [COUNT - 1])
    closed = pose_graph.covariance(RING, ring, np.ones(len(ring)), [COUNT - 1])
    of_the_loop = pose_graph.covariance_between(np.pad(closed, (0, 3)), RING[0], RING[-1])
    assert (np.linalg.eigvalsh(np.linalg.inv(INFORMATION) - of_the_loop) > 0).all()
    assert np.trace(closed) < 0.1 * np.trace(open_end)


def test_edges_at_other_poses_say_the_same():
    poses = noisy()
    edges = ring_with_a_loop()
    moved = pose_graph.at_poses(poses, edges)
    assert pytest.approx(se2.relative(poses[edges.second], poses[edges.first])) == moved.T
    one, _ = pose_graph.solve(poses, edges)
    other, _ = pose_graph.solve(poses, moved)
    assert one == pytest.approx(other, abs=1e-9)
