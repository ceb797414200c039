# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from g2_recon.collaboration.growing_session import GrowingSession
from g2_recon.errors import InputError
from g2_recon.geometry.session import Session


def same(one, other):
    for field in dataclasses.fields(Session):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))


def test_a_session_comes_over_part_by_part(sessions, parts):
    told = list(parts(sessions["one"]))
    growing = GrowingSession(told[0].number)
    for part in told:
        growing.take(part)
        assert len(growing) == part.count and not growing.lacks
    same(growing.session(), sessions["one"])


def test_parts_that_come_twice_change_nothing(sessions, parts):
    told = list(parts(sessions["one"]))
    growing = GrowingSession(told[0].number)
    for part in [told[0], told[0], told[1], told[0], *told[1:], *told]:
        growing.take(part)
    same(growing.session(), sessions["one"])


def test_what_is_lost_is_known_to_be_lacking_and_can_be_told_anew(sessions, parts):
    first, lost, last = parts(sessions["one"], size=40)
    growing = GrowingSession(first.number)
    growing.take(first)
    growing.take(last)
    assert growing.lacks and len(growing) == 40 and growing.told == len(sessions["one"])
    growing.take(dataclasses.replace(lost, count=last.count, revision=last.revision, poses=last.poses))
    growing.take(last)
    assert not growing.lacks
    same(growing.session(), sessions["one"])


def test_without_news_only_the_count_is_told_and_poses_that_were_missed_are_lacking(sessions, parts):
    (part,) = parts(sessions["one"], size=1000)
    growing = GrowingSession(part.number)
    growing.take(part)
    empty = {name: getattr(part, name)[:0] for name in ("poses", "stamps", "points", "normals", "kinds", "firsts")}
    empty |= {name: getattr(part, name)[:0] for name in ("increments", "ways", "wheel_steps", "broken", "local_maps")}
    empty |= {"loops": part.loops[:0], "loop_information": part.loop_information[:0]}
    growing.take(dataclasses.replace(part, first=part.count, **empty))
    assert not growing.lacks
    growing.take(dataclasses.replace(part, first=part.count, revision=part.revision + 1, **empty))
    assert growing.lacks


@pytest.mark.parametrize(
    "changes",
    [
        {"poses": lambda part: part.poses * np.nan},
        {"points": lambda part: part.points * np.inf},
        {"kinds": lambda part: part.kinds + 9},
        {"ways": lambda part: part.ways[::-1].copy()},
        {"last_stamp": lambda part: np.nan},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_what_is_unusable_is_refused_and_nothing_of_it_taken(sessions, parts, changes):
    told = list(parts(sessions["one"]))
    growing = GrowingSession(told[0].number)
    growing.take(told[0])
    with pytest.raises(InputError):
        growing.take(dataclasses.replace(told[1], **{name: make(told[1]) for name, make in changes.items()}))
    assert len(growing) == 10
    for part in told[1:]:
        growing.take(part)
    same(growing.session(), sessions["one"])
