# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from g2_recon.localization import likelihood
from g2_recon.localization.beams import beams
from g2_recon.localization.drawn_keyframes import DrawnKeyframes

PLACES = np.array([(0.3 * i, 0.1 * i, 0.2 * i) for i in range(6)])


@pytest.fixture
def keyframes(scan_of_room, keyframes_of):
    return keyframes_of([scan_of_room(pose) for pose in PLACES], PLACES)


def drawn_of(keyframes):
    return DrawnKeyframes(keyframes, cells=300, resolution=0.1, sigma=0.12, reach=2)


def anew(keyframes, segment):
    """The grid and its corner, drawn from nothing."""
    grid = np.zeros((300, 300), np.uint8)
    points, _, kinds, _, _ = (array[segment:] for array in keyframes.arrays)
    corner = keyframes.poses[-1, :2] - 15.0
    likelihood.splat(grid, points, kinds, keyframes.poses[segment:], *corner, 0.1, likelihood.bell(0.1, 0.12))
    return grid, corner


@pytest.mark.parametrize("segment", [0, 4])
def test_the_keyframes_of_the_segment_are_drawn_around_the_last_one(keyframes, segment):
    drawn = drawn_of(keyframes)
    drawn.update(segment)
    grid, corner = anew(keyframes, segment)
    assert grid.any()
    assert drawn.grid.tolist() == grid.tolist()
    assert drawn.corner.tolist() == corner.tolist()
    assert drawn.wide.tolist() == maximum_filter(grid, 5, mode="constant").tolist()


def test_what_was_drawn_before_is_gone_once_keyframes_have_moved(keyframes, scan_of_room):
    drawn = drawn_of(keyframes)
    drawn.update(0)
    before = drawn.grid.copy()
    keyframes.add(beams(scan_of_room((1, 1, 1)), range_min=0.1, range_max=40.0), np.array([4.0, 0.0, 1.0]))
    keyframes.poses[:3] += (0.5, -0.5, 0.0)
    drawn.update(0)
    assert drawn.grid.tolist() == before.tolist()
    drawn.moved()
    drawn.update(3)
    grid, _ = anew(keyframes, 3)
    assert drawn.grid.tolist() == grid.tolist() != before.tolist()
    assert drawn.wide.tolist() == maximum_filter(grid, 5, mode="constant").tolist()


def test_without_a_reach_nothing_is_widened(keyframes):
    drawn = DrawnKeyframes(keyframes, cells=300, resolution=0.1, sigma=0.12)
    drawn.update(0)
    assert drawn.wide.size == 0
    assert drawn.grid.any()
