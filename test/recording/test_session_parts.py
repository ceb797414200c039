# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from g2_recon.errors import InputError
from g2_recon.geometry.session import SessionPart, session_number
from g2_recon.recording.session_parts import pack_part, unpack_part


def part(**changes) -> SessionPart:
    """Two of three keyframes, with three beams each."""
    rng = np.random.default_rng(0)
    values = SessionPart(
        number=7,
        count=3,
        revision=2,
        last_stamp=12.5,
        poses=rng.uniform(-1, 1, (3, 3)),
        first=1,
        stamps=np.array([11.0, 12.0]),
        points=rng.uniform(-1, 1, (2, 3, 2)).astype(np.float32),
        normals=np.zeros((2, 3, 2), np.float32),
        kinds=np.ones((2, 3), np.uint8),
        firsts=np.full(2, -1.5),
        increments=np.full(2, 0.1),
        ways=np.array([1.0, 2.0]),
        wheel_steps=np.full((2, 3), np.nan),
        broken=np.array([False, True]),
        local_maps=np.array([0, 2]),
        loops=np.array([[0, 1]]),
        loop_information=np.eye(3)[None],
    )
    return dataclasses.replace(values, **changes)


def test_a_part_comes_back_as_it_was():
    sent = part()
    back = unpack_part(pack_part(sent))
    for field in dataclasses.fields(SessionPart):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(sent, field.name))


@pytest.mark.parametrize(
    "changes",
    [
        {"count": 2},
        {"first": 2},
        {"first": -1},
        {"poses": np.zeros((2, 3))},
        {"poses": np.zeros((0, 3))},
        {"number": -1},
    ],
)
def test_what_does_not_fit_is_refused(changes):
    with pytest.raises(InputError):
        unpack_part(pack_part(part(**changes)))


@pytest.mark.parametrize("cut", [0, 1, 10, 200, -1])
def test_what_is_cut_off_is_refused(cut):
    with pytest.raises(InputError):
        unpack_part(pack_part(part())[:cut])


def test_the_number_of_a_session_is_that_of_its_first_keyframe_however_many_beams_others_have():
    points, kinds = np.ones((3, 2), np.float32), np.array([1, 0, 2], np.uint8)
    wider = np.zeros((5, 2), np.float32)
    wider[:3] = points
    assert session_number(1.0, points, kinds) == session_number(1.0, wider, np.array([1, 0, 2, 0, 0], np.uint8))
    assert session_number(1.0, points, kinds) != session_number(2.0, points, kinds)
