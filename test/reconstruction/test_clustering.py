# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np

from g2_recon.reconstruction.clustering.connectivity import split_disconnected
from g2_recon.reconstruction.clustering.k_means import centers, k_means


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
