# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.reconstruction.clustering.connectivity import split_disconnected
from g2_recon.reconstruction.clustering.k_means import centers, k_means
from g2_recon.reconstruction.clustering.neural_gas import _present, neural_gas


def blobs(places, count=200, seed=0):
    rng = np.random.default_rng(seed)
    return np.concatenate([place + rng.normal(0, 0.1, (count, 3)) for place in np.array(places, float)])


def test_every_point_is_in_the_cluster_with_the_nearest_center():
    points = np.random.default_rng(0).random((3000, 3))
    label = k_means(points, 20, seed=0)
    distance = np.linalg.norm(points[:, None] - centers(points, label)[None], axis=2)
    # Lloyd's iteration stops after a fixed number of rounds, so a few points on the borders may be late.
    assert np.mean(distance.argmin(axis=1) == label) > 0.99


def test_k_means_finds_separate_groups_from_good_starts():
    places = [(0, 0, 0), (5, 0, 0), (0, 5, 0)]
    label = k_means(blobs(places), 3, seed=0, start=np.array(places, float))
    assert [len(set(part)) for part in label.reshape(3, -1)] == [1, 1, 1]
    assert len(set(label)) == 3


def test_labels_have_no_gaps_where_points_coincide():
    points = np.repeat(np.eye(3), 10, axis=0)
    assert sorted(set(k_means(points, 8, seed=0))) == [0, 1, 2]


def test_the_same_seed_gives_the_same_clusters():
    points = np.random.default_rng(0).random((1000, 3))
    assert k_means(points, 10, seed=3).tolist() == k_means(points, 10, seed=3).tolist()


def test_a_cluster_across_free_space_is_parted():
    points = blobs([(0, 0, 0), (3, 0, 0)])
    pieces = split_disconnected(points, np.zeros(len(points), np.int64), gap=0.5, min_points=5)
    assert [set(part) for part in pieces.reshape(2, -1)] == [{pieces[0]}, {pieces[-1]}]
    assert pieces[0] != pieces[-1]


def test_a_cluster_that_hangs_together_stays_whole():
    line = np.column_stack([np.arange(100) * 0.3, np.zeros(100), np.zeros(100)])
    assert not split_disconnected(line, np.zeros(100, np.int64), gap=0.4, min_points=5).any()


def test_a_few_stray_points_join_the_nearest_piece_whatever_its_cluster():
    points = np.concatenate([blobs([(0, 0, 0), (3, 0, 0)]), [[2.4, 0, 0]] * 2])
    label = np.r_[np.zeros(200), np.ones(200), np.zeros(2)].astype(np.int64)
    pieces = split_disconnected(points, label, gap=0.3, min_points=50)
    assert set(pieces[-2:]) <= set(pieces[200:400])


def test_with_nothing_but_strays_nothing_is_lost():
    points = np.arange(12.0).reshape(4, 3)
    assert len(split_disconnected(points, np.zeros(4, np.int64), gap=0.1, min_points=10)) == 4


def test_the_kernel_of_neural_gas_follows_the_rule_of_martinetz():
    """A plain twin that sorts all units and moves all of them."""
    rng = np.random.default_rng(0)
    points, start = rng.random((50, 3)), rng.random((30, 3))
    presented, rates, ranges = rng.integers(0, 50, 400), np.geomspace(0.5, 0.005, 400), np.geomspace(10, 0.01, 400)
    expected = start.copy()
    for number, rate, width in zip(presented, rates, ranges, strict=True):
        rank = np.argsort(np.argsort(np.linalg.norm(expected - points[number], axis=1)))
        expected += rate * np.exp(-rank / width)[:, None] * (points[number] - expected)
    units = start.copy()
    _present(points, presented, units, rates, ranges)
    # Ranks that are left out would move a unit by 400 * 0.5 * 2e-9 of a metre at most.
    assert units == pytest.approx(expected, abs=4e-7)


def test_neural_gas_finds_separate_groups():
    label = neural_gas(blobs([(0, 0, 0), (5, 0, 0), (0, 5, 0), (5, 5, 0)]), 4, seed=0, presentations=4000)
    assert [len(set(part)) for part in label.reshape(4, -1)] == [1, 1, 1, 1]
    assert len(set(label)) == 4


def test_neural_gas_and_k_means_quantize_equally_well():
    """The paper: "There is virtually no difference between clusters obtained with NG and KM algorithm"."""
    points = np.random.default_rng(0).random((5000, 3)) * (4, 3, 0)
    gas, means = neural_gas(points, 30, seed=0, presentations=40_000), k_means(points, 30, seed=0)
    error = [np.linalg.norm(points - centers(points, label)[label], axis=1).mean() for label in (gas, means)]
    assert error[0] == pytest.approx(error[1], rel=0.03)


def test_labels_of_neural_gas_have_no_gaps_where_points_coincide():
    label = neural_gas(np.repeat(np.eye(3), 10, axis=0), 8, seed=0, presentations=500)
    assert sorted(set(label)) == list(range(len(set(label))))
    assert len(set(label)) <= 8


def test_neural_gas_takes_more_clusters_than_points():
    points = np.arange(12.0).reshape(4, 3)
    assert set(neural_gas(points, 9, seed=0, presentations=50)) <= {0, 1, 2, 3}


def test_the_same_seed_gives_the_same_gas_wherever_on_earth():
    points = np.random.default_rng(0).random((500, 3))
    # So far out a metre is still good to 1e-9.
    here, there = (neural_gas(points + far, 10, seed=3, presentations=2000) for far in (0.0, 2.0**20))
    assert here.tolist() == neural_gas(points, 10, seed=3, presentations=2000).tolist()
    assert np.mean(here == there) > 0.99


def test_neural_gas_keeps_a_start_that_is_in_order():
    places = np.array([(0, 0, 0), (5, 0, 0), (0, 5, 0)], float)
    label = neural_gas(blobs(places), 3, seed=0, presentations=600, start=places)
    assert label.reshape(3, -1).tolist() == [[0] * 200, [1] * 200, [2] * 200]
