# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import itertools

import numpy as np
import pytest

from g2_recon.geometry.cloud import ALL_PIECES, Cloud, Piece
from g2_recon.reconstruction.collected_cloud import CollectedCloud


def cloud(*xs):
    return Cloud(np.array([(x, 0.0, 0.0) for x in xs]).reshape(-1, 3))


def xs(collected):
    found = collected.cloud().points[:, 0].tolist()
    assert len(found) == len(collected)
    return found


def test_points_of_no_piece_are_added():
    collected = CollectedCloud()
    collected.add(cloud(1))
    collected.add(cloud(2, 3))
    assert xs(collected) == [1, 2, 3]


def test_points_of_the_same_revision_are_added_and_a_newer_one_replaces_them():
    collected = CollectedCloud()
    collected.add(cloud(1), Piece(7, 0))
    collected.add(cloud(2), Piece(7, 0))
    collected.add(cloud(3), Piece(7, 1))
    assert xs(collected) == [1, 2, 3]
    collected.add(cloud(10, 20), Piece(7, 0, 1))
    assert xs(collected) == [10, 20, 3]


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_in_any_order_the_newest_revision_is_left(order):
    messages = [(cloud(1), Piece(7, 0, 0)), (cloud(2), Piece(7, 0, 1)), (cloud(3), Piece(7, 0, 2))]
    collected = CollectedCloud()
    refused = [collected.add(*messages[index]) for index in order]
    assert xs(collected) == [3]
    assert set(refused) <= {"", "of an older revision"}


def test_a_piece_that_was_missed_comes_with_its_next_revision():
    collected = CollectedCloud()
    collected.add(cloud(5), Piece(7, 3, 4))
    assert xs(collected) == [5]


def test_a_newer_revision_without_points_takes_them_away():
    collected = CollectedCloud()
    collected.add(cloud(1), Piece(7, 0))
    collected.add(cloud(), Piece(7, 0, 1))
    assert xs(collected) == []


def test_sources_and_topics_do_not_replace_each_other():
    collected = CollectedCloud()
    for source, topic in itertools.product((1, 2), ("a", "b")):
        collected.add(cloud(source), Piece(source, 0), topic=topic)
    collected.add(cloud(9), Piece(1, 0, 1), topic="a")
    assert sorted(xs(collected)) == [1, 2, 2, 9]


def test_a_source_that_takes_all_back_leaves_nothing_also_of_what_comes_late():
    collected = CollectedCloud()
    collected.add(cloud(1), Piece(1, 0))
    collected.add(cloud(2), Piece(2, 0))
    assert collected.add(cloud(), Piece(1, ALL_PIECES)) == ""
    assert collected.add(cloud(3), Piece(1, 5, 1)) == "of a piece that was forgotten"
    assert xs(collected) == [2]


def test_what_was_cleared_does_not_come_back_and_what_is_measured_since_counts():
    collected = CollectedCloud()
    collected.add(cloud(1), Piece(7, 3))
    collected.add(cloud(2), Piece(7, 4))
    collected.clear()
    assert xs(collected) == []
    assert collected.add(cloud(1), Piece(7, 3, 1)) == "of a piece that was forgotten"
    collected.add(cloud(4), Piece(7, 4))
    collected.add(cloud(5), Piece(7, 5))
    assert xs(collected) == [4, 5]


def test_what_is_left_out_stays_out_while_what_is_there_is_replaced():
    collected = CollectedCloud()
    collected.add(cloud(1), Piece(7, 0))
    assert collected.add(cloud(2), leave_out=True) == "left out"
    assert collected.add(cloud(3), Piece(7, 0), leave_out=True) == "left out"
    assert collected.add(cloud(4), Piece(7, 1), leave_out=True) == "left out"
    assert collected.add(cloud(10), Piece(7, 0, 1), leave_out=True) == ""
    assert collected.add(cloud(5), Piece(7, 1, 1)) == "left out"
    assert collected.add(cloud(6), Piece(7, 2)) == ""
    assert xs(collected) == [10, 6]
