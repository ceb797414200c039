# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
from itertools import count

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from g2_recon.collaboration.live_merger import LiveMerger
from g2_recon.collaboration.map_merger import merge
from g2_recon.geometry import se2
from g2_recon.geometry.cloud import Cloud, Piece


def merger(**starts):
    sources = count(1)
    return LiveMerger({robot: np.array(start) for robot, start in starts.items()}, lambda: next(sources))


def brought_up_to_date(live, *, settled=True):
    while (work := live.work(settled=settled)) is not None:
        live.take_merged(work, work.merged())
    return live


def told(live, robot, session, parts, **how):
    for part in parts(session, **how):
        live.take_part(robot, part)
    return live


@pytest.fixture(scope="module")
def whole(sessions):
    """The map of all, made at once."""
    return merge(sessions)


def test_robots_are_aligned_and_their_clouds_lie_where_they_belong(sessions, parts, whole):
    live = merger()
    for name, session in sessions.items():
        assert live.place(name).state == "waiting"
        told(live, name, session, parts)
        # A point at the laser of each tenth keyframe, in the map of its robot.
        for k in range(0, len(session), 10):
            at = np.array([[*session.poses[k, :2], 0.0]])
            assert live.take_cloud(name, float(session.stamps[k]), Cloud(at, at), Piece(5, k)) == ""
        told(live, name, session, parts, size=100)
    brought_up_to_date(live)
    assert [live.place(name).state for name in sessions] == ["aligned"] * 3
    placed = np.array([cloud.points[0] for _, cloud, _ in live.cloud.sent()])
    wanted = np.concatenate([whole.poses(name)[::10, :2] for name in sessions])
    assert len(placed) == len(wanted)
    # m: of float32.
    off = np.linalg.norm(placed[:, None, :2] - wanted[None], axis=2)
    assert off.min(axis=1).max() < 1e-4 and off.min(axis=0).max() < 1e-4


@pytest.fixture(scope="module")
def short_whole(short_sessions):
    """The map of all, made at once."""
    return merge(short_sessions)


def answered(live, name, session, parts):
    """What a robot sends as long as something of its session is lacking."""
    *_, last = parts(session, size=20)
    while (growing := live.session(name, last.number)).lacks:
        rows = slice(len(growing), len(growing) + 20)
        live.take_part(name, dataclasses.replace(last, first=rows.start, **session.of_rows(rows)))


@settings(max_examples=15, deadline=None, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(data=st.data())
def test_in_whatever_order_and_at_whatever_times_all_comes_the_map_is_the_same(
    short_sessions, parts, short_whole, data
):
    """Parts and clouds of all robots are mixed, those of one robot, too; maps are begun and finished at any time."""
    events = []
    for name, session in short_sessions.items():
        events += [(name, part) for part in parts(session, size=20)]
        events += [(name, k) for k in range(0, len(session), 10)]
    live, begun = merger(), None
    merges = data.draw(st.dictionaries(st.integers(0, len(events) - 1), st.integers(0, 10), max_size=2), "merges")
    for step, number in enumerate(data.draw(st.permutations(range(len(events))), "order")):
        name, event = events[number]
        if isinstance(event, int):
            # A point at the laser of a keyframe, in the map of its robot.
            session = short_sessions[name]
            at = np.array([[*session.poses[event, :2], 0.0]])
            live.take_cloud(name, float(session.stamps[event]), Cloud(at, at), Piece(5, event))
        else:
            live.take_part(name, event)
        if step in merges and begun is None:
            work = live.work(settled=merges[step] % 2 == 0)
            begun = None if work is None else (step + merges[step], work, work.merged())
        if begun is not None and step >= begun[0]:
            live.take_merged(*begun[1:])
            begun = None
    if begun is not None:
        live.take_merged(*begun[1:])
    for name, session in short_sessions.items():
        answered(live, name, session, parts)
    brought_up_to_date(live)
    rows = {key.split()[0]: rows for key, rows in live.map.rows.items()}
    for name in short_sessions:
        off = se2.relative(short_whole.poses(name), live.map.session.poses[rows[name]])
        assert np.hypot(off[:, 0], off[:, 1]).max() < 0.01  # m
    wanted = np.concatenate([short_whole.poses(name)[::10, :2] for name in short_sessions])
    placed = live.cloud.cloud().points[:, :2]
    assert len(placed) == len(wanted)
    assert np.linalg.norm(placed[:, None] - wanted[None], axis=2).min(axis=1).max() < 0.01  # m


def test_a_robot_whose_last_part_comes_first_is_known_to_lack_the_others(sessions, parts):
    first, *_, last = parts(sessions["one"])
    live = merger()
    for part in (last, first):
        growing = live.take_part("one", part)
    assert growing.lacks
    assert growing.told == len(sessions["one"])


def test_nothing_is_merged_twice(sessions, parts):
    live = told(merger(), "one", sessions["one"], parts)
    work = live.work(settled=False)
    live.take_merged(work, work.merged())
    assert live.work(settled=False) is None
    assert live.work(settled=True) is None


def test_what_was_found_is_not_looked_for_again_while_it_holds(sessions, parts, monkeypatch):
    live = told(merger(), "one", sessions["one"], parts)
    *earlier, last = parts(sessions["two"])
    for part in earlier:
        live.take_part("two", part)
    brought_up_to_date(live)
    assert live.place("two").state == "aligned"
    monkeypatch.setattr("g2_recon.collaboration.map_merger.align", lambda *_, **__: pytest.fail("looked for again"))
    live.take_part("two", last)
    brought_up_to_date(live, settled=False)
    assert live.place("two").state == "aligned"
    assert live.place("two").keyframes == len(sessions["two"])


def test_a_place_that_turns_out_wrong_is_given_up_and_the_cloud_follows(sessions, parts):
    live = told(told(merger(), "one", sessions["one"], parts), "two", sessions["two"], parts)
    session = sessions["two"]
    live.take_cloud("two", float(session.stamps[5]), Cloud(np.ones((1, 3))), Piece(5, 0))
    told(live, "two", session, parts, size=1000)
    work = live.work(settled=False)
    right = work.merged()
    # As if it had been found 2 m from where it is.
    rows = right.rows[next(key for key in right.rows if key.startswith("two"))]
    poses = right.session.poses.copy()
    poses[rows] = se2.compose(np.array([2.0, 0.0, 0.0]), poses[rows])
    wrong = dataclasses.replace(right, session=dataclasses.replace(right.session, poses=poses))
    live.take_merged(work, wrong)
    ((_, misplaced, _),) = live.cloud.sent()
    live.take_part("one", dataclasses.replace(next(parts(sessions["one"], size=1000)), revision=-1))
    brought_up_to_date(live, settled=False)
    assert live.place("two").state == "aligned"
    ((_, placed, piece),) = live.cloud.sent()
    assert piece.revision == 1
    # m: what was wrong, and within what both maps are bent.
    np.testing.assert_allclose(misplaced.points - placed.points, [[2.0, 0.0, 0.0]], atol=0.02)


def test_a_place_that_does_not_hold_any_more_is_withdrawn(sessions, parts, monkeypatch):
    live = told(told(merger(), "one", sessions["one"], parts), "two", sessions["two"], parts)
    session = sessions["two"]
    live.take_cloud("two", float(session.stamps[5]), Cloud(np.ones((1, 3))), Piece(5, 0))
    told(live, "two", session, parts, size=1000)
    brought_up_to_date(live)
    assert len(list(live.cloud.sent())) == 1
    monkeypatch.setattr("g2_recon.collaboration.alignment._LEAST_AGREEMENT", 1.1)
    live.take_part("one", dataclasses.replace(next(parts(sessions["one"], size=1000)), revision=-1))
    brought_up_to_date(live, settled=False)
    assert live.place("two").state == "rejected"
    assert live.place("two").T_world_map is None
    assert len(live.cloud.take_gone()) == 1


def test_a_robot_that_begins_a_new_map_is_aligned_anew_and_keeps_the_old_one(sessions, parts):
    live = told(told(merger(), "one", sessions["one"], parts), "two", sessions["two"], parts)
    before = brought_up_to_date(live).place("two")
    told(live, "two", sessions["three"], parts)
    assert live.place("two").state == "waiting"
    after = brought_up_to_date(live).place("two")
    assert after.state == "aligned"
    assert before.session != after.session
    assert len(live.map.session) == sum(map(len, sessions.values()))


def test_a_start_that_is_known_is_that_of_the_first_session(sessions, parts):
    live = merger(one=(10.0, 0.0, 0.0))
    told(told(live, "one", sessions["one"], parts), "one", sessions["two"], parts)
    brought_up_to_date(live)
    first = next(iter(live.map.rows.values()))
    # m, rad: refinement moves the first keyframe a little.
    np.testing.assert_allclose(live.map.session.poses[first][0], (10.0, 0.0, 0.0), atol=0.02)
    assert len(live.map.rows) == 2
