# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np

from g2_recon.localization.beams import INVALID, Beams, surface_normals
from g2_recon.localization.keyframes import Keyframes


def some_beams(count, seed):
    rng = np.random.default_rng(seed)
    kinds = (rng.random(count) < 0.9).astype(np.uint8)
    # Walls, some of whose points are off.
    bearings = np.linspace(-2, 2, count)
    ranges = np.where(rng.random(count) < 0.2, 3.0, 1.0) / np.maximum(np.abs(np.cos(bearings)), 0.3)
    points = (ranges * (np.cos(bearings), np.sin(bearings))).T.astype(np.float32)
    return Beams(points, surface_normals(points, kinds), kinds, rng.normal(), rng.uniform(0.01, 0.1))


def test_keyframes_keep_what_was_added_while_they_grow_in_number_and_in_width():
    keyframes = Keyframes()
    added = [some_beams(count, seed) for seed, count in enumerate(np.random.default_rng(0).integers(0, 60, 600))]
    for index, each in enumerate(added):
        assert keyframes.add(each, np.full(3, float(index))) == index
    assert len(keyframes) == 600
    assert keyframes.poses.tolist() == [[i] * 3 for i in range(600)]
    points, normals, kinds, firsts, increments = keyframes.arrays
    for index, each in enumerate(added):
        count = len(each.points)
        assert points[index, :count].tolist() == each.points.tolist()
        assert normals[index, :count].tolist() == each.normals.tolist()
        assert kinds[index, :count].tolist() == each.kinds.tolist()
        assert (kinds[index, count:] == INVALID).all()
        assert (firsts[index], increments[index]) == (each.first, each.increment)


def test_normals_of_any_keyframes_are_those_that_they_were_added_with():
    keyframes, added = Keyframes(), [some_beams(60, seed) for seed in range(700)]
    for index, each in enumerate(added):
        keyframes.add(each, np.zeros(3))
        assert keyframes.latest <= max(0, index - 127)
    assert sum(np.count_nonzero(each.normals) for each in added) > 10_000
    # Of so many rows only: the others are made anew.
    assert keyframes.latest > 400
    for first in (0, 300, keyframes.latest, 690, 700):
        for most in (0, 1, 50, 500):
            np.testing.assert_array_equal(keyframes.since(first, most)[1], keyframes.since(first)[1][:most])
        points, normals, kinds, firsts, increments = keyframes.since(first)
        assert len(points) == len(normals) == len(kinds) == len(firsts) == len(increments) == 700 - first
        for row, each in zip(range(700 - first), added[first:], strict=True):
            np.testing.assert_array_equal(normals[row], each.normals)
            np.testing.assert_array_equal(points[row], each.points)
    some = keyframes.of_rows(np.array([699, 3, 3, 500]))
    for row, index in enumerate((699, 3, 3, 500)):
        np.testing.assert_array_equal(some[1][row], added[index].normals)
        assert (some[3][row], some[4][row]) == (added[index].first, added[index].increment)


def test_normals_that_all_were_replaced_by_are_kept_until_some_are_added():
    some, other = Keyframes(), Keyframes()
    for seed in range(400):
        some.add(some_beams(30, seed), np.zeros(3))
    other.fill(some.poses, some.arrays)
    assert other.latest == 0
    other.add(some_beams(30, 7), np.zeros(3))
    assert other.latest == 400 - 128
    for one, same in zip(some.arrays, other.arrays, strict=True):
        np.testing.assert_array_equal(one, same[:400])


def test_nothing_shows_of_what_was_in_the_memory_before(monkeypatch):
    monkeypatch.setattr(np, "empty", lambda shape, dtype=float: np.full(shape, 77, dtype))
    keyframes = Keyframes()
    for count in (3, 9, 5):
        keyframes.add(some_beams(count, count), np.zeros(3))
    points, normals, kinds, _, _ = keyframes.arrays
    for index, count in ((0, 3), (2, 5)):
        assert not points[index, count:].any() and not normals[index, count:].any() and not kinds[index, count:].any()


def test_poses_can_be_improved_in_place():
    keyframes = Keyframes()
    keyframes.add(some_beams(5, 0), np.zeros(3))
    keyframes.poses[:] = 7.0
    keyframes.add(some_beams(9, 1), np.ones(3))
    assert keyframes.poses.tolist() == [[7, 7, 7], [1, 1, 1]]


def test_a_snapshot_stays_as_it_is_while_the_keyframes_move_and_grow():
    keyframes = Keyframes()
    for i in range(3):
        keyframes.add(some_beams(5, i), np.full(3, float(i)))
    snapshot = keyframes.snapshot()
    points = snapshot.arrays[0].tolist()
    keyframes.poses[:] = 7.0
    for i in range(600):
        keyframes.add(some_beams(9, i), np.zeros(3))
    assert len(snapshot) == 3
    assert snapshot.poses.tolist() == [[0] * 3, [1] * 3, [2] * 3]
    assert snapshot.arrays[0].tolist() == points


def test_all_keyframes_can_be_replaced():
    some, other = Keyframes(), Keyframes()
    for seed in range(3):
        some.add(some_beams(10, seed), np.full(3, float(seed)))
    other.add(some_beams(20, 7), np.zeros(3))
    other.fill(some.poses, some.arrays)
    assert len(other) == 3
    np.testing.assert_array_equal(other.poses, some.poses)
    for one, same in zip(other.arrays, some.arrays, strict=True):
        np.testing.assert_array_equal(one, same)
    other.poses[0] = 7
    assert some.poses[0].tolist() == [0, 0, 0]
    other.add(some_beams(20, 8), np.zeros(3))
    assert other.arrays[2].shape == (4, 20)
