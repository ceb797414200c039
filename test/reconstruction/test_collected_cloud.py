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


def wall(count=20, *, x=0.1, seen_from=3.0, seed=0):
    """Points in one cube of 0.2 m, all seen from one side."""
    yz = np.random.default_rng(seed).uniform(0, 0.2, (count, 2))
    points = np.column_stack([np.full(count, x), yz])
    return Cloud(points, np.full((count, 3), (seen_from, 3.0, 3.0)))


def filled(*, pieces=31, enough=5):
    """A collected cloud in which the first piece counts, as 30 others have come since from elsewhere."""
    collected = CollectedCloud(0.2, enough)
    for number in range(pieces):
        collected.add(wall(x=0.1 + number), Piece(7, number))
    return collected


def test_where_there_are_enough_points_of_earlier_pieces_others_are_not_kept():
    collected = filled()
    assert collected.add(wall(seed=1), Piece(7, 50)) == ""
    assert len(collected) == 31 * 20
    assert collected.redundant == 20


def test_the_latest_pieces_do_not_count():
    collected = filled(pieces=30)
    collected.add(wall(x=29.1), Piece(7, 50))
    assert len(collected) == 31 * 20
    assert collected.redundant == 0


def test_where_there_are_too_few_points_all_of_the_next_piece_are_kept():
    collected = filled(enough=21)
    collected.add(wall(), Piece(7, 50))
    assert len(collected) == 32 * 20
    assert collected.redundant == 0


def test_the_other_side_of_a_thin_wall_is_kept():
    collected = filled()
    collected.add(wall(seen_from=-3.0), Piece(7, 50))
    assert len(collected) == 32 * 20


def test_what_is_seen_on_the_way_back_is_known_from_the_way_there():
    collected = filled()
    back = wall(seed=1)
    back.sensor[:, 1] = -0.5
    collected.add(back, Piece(7, 50))
    assert collected.redundant == 20


def test_what_is_moved_to_where_nothing_is_comes_back_and_makes_room_where_it_was():
    collected = filled()
    collected.add(wall(), Piece(7, 50))
    collected.add(wall(x=0.1 + 70), Piece(7, 0, 1))
    collected.add(wall(), Piece(7, 50, 1))
    assert len(collected) == 32 * 20
    assert collected.redundant == 0
    assert np.array_equal(collected.parts()[("", 7), 50].cloud.points, wall().points)


def test_a_piece_that_is_moved_a_little_does_not_count_against_itself():
    collected = filled()
    collected.add(wall(x=0.11), Piece(7, 0, 1))
    assert len(collected) == 31 * 20
    assert collected.redundant == 0


def test_messages_without_a_piece_count_each_for_itself():
    collected = CollectedCloud(0.2, 5)
    for number in range(100):
        collected.add(wall(seed=number))
    assert len(collected) == 30 * 20
    assert collected.redundant == 70 * 20


def test_in_known_rooms_the_cloud_stays_as_large_as_it_is():
    collected = filled(pieces=60)
    for number in range(60, 180):
        collected.add(wall(x=0.1 + number % 30, seed=number), Piece(7, number))
    assert len(collected) == 60 * 20


def test_what_was_forgotten_does_not_count():
    collected = filled()
    collected.add(cloud(), Piece(7, ALL_PIECES))
    collected.add(wall(), Piece(8, 0))
    assert len(collected) == 20
    collected.clear()
    collected.add(wall(), Piece(8, 1))
    assert len(collected) == 20
    assert collected.redundant == 0
