# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Rooms that are all alike along a corridor: no guess where a robot is, until something tells them apart."""

import math

import numpy as np
import pytest

from g2_recon.collaboration.alignment import align

ROOMS, WIDTH = 4, 6.0


def walls(*, box_in=None):
    """Segments (S, 4) of a corridor with equal rooms on one side, and a box in one of them."""
    end = ROOMS * WIDTH
    segments = [(0, -1, end, -1), (0, -1, 0, 1), (end, -1, end, 1)]
    for x in WIDTH * np.arange(ROOMS):
        segments += [(x, 1, x + 2.5, 1), (x + 3.5, 1, x + 6, 1), (x + 0.5, 1, x + 0.5, 6), (x + 5.5, 1, x + 5.5, 6)]
        segments += [(x + 0.5, 6, x + 5.5, 6), (x + 0.5, 4, x + 1.5, 4), (x + 1.5, 4, x + 1.5, 6)]
    if box_in is not None:
        x = WIDTH * box_in + 4
        segments += [(x, 2.2, x + 0.6, 2.2), (x, 2.2, x, 2.9), (x + 0.6, 2.2, x + 0.6, 2.9)]
    return np.array(segments, float)


def visit(k):
    x = WIDTH * k + 3
    return [(x, 0), (x, 2.5), (x + 1.2, 3.4), (x + 1.2, 5), (x, 5.2), (x, 2.5), (x, 0)]


@pytest.mark.parametrize(("box_in", "state"), [(None, "ambiguous"), (2, "aligned")])
def test_equal_rooms_are_ambiguous_until_something_tells_them_apart(drive, box_in, state):
    segments = walls(box_in=box_in)
    whole = drive(segments, [(1, 0), *(corner for k in range(ROOMS) for corner in visit(k)), (23, 0)], seed=0)
    part = drive(segments, [*visit(2)[1:-1], *visit(2)[1:3]], seed=1)
    found = align(whole, part)
    assert found.state == state, found.reason
    if state == "aligned":
        # Both maps have the same origin, but that the long one may be stretched along the corridor, m.
        assert math.hypot(*found.T_fixed_moving[:2]) < 1.0
