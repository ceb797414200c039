# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from g2_recon.geometry import se2
from g2_recon.localization import branch_and_bound
from g2_recon.localization.beams import beams

RESOLUTION = 0.1
POSE = np.array([0.5, 0.3, 0.4])
TURNS = np.radians([0.0, -3.0, 3.0, -6.0, 6.0])
# Blocks of the coarsest level, in cells.
BLOCK = 16


def points_of(scan):
    b = beams(scan, range_min=0.1, range_max=40.0)
    return b.points[b.kinds > 0]


def pyramid_of(scan, pose):
    points = se2.transform_points(pose, points_of(scan))
    return branch_and_bound.pyramid(points, resolution=RESOLUTION, sigma=0.1)


def find(pyramid, points, guess, window, turns=TURNS, least=0.0):
    guess = np.asarray(guess, float)
    found, score = branch_and_bound.find(
        pyramid.levels, pyramid.corner, pyramid.resolution, points, guess, window, turns, least
    )
    return found, score


def test_a_pyramid_is_raised_from_its_lowest_level():
    points = np.random.default_rng(3).uniform(-4, 9, (200, 2))
    whole = branch_and_bound.pyramid(points, resolution=RESOLUTION, sigma=0.1)
    raised = whole.ground().raised()
    assert np.array_equal(raised.levels, whole.levels)
    assert raised.corner.tolist() == whole.corner.tolist() and raised.resolution == whole.resolution


def scores(pyramid, points, guess, reach, beyond):
    """Scores of all shifts from -reach to `beyond` cells at each turn, and of no grid beyond its border."""
    grid = np.pad(pyramid.levels[0].astype(int), 1)
    result = []
    for turn in TURNS:
        at = se2.transform_points(guess + np.array([0, 0, turn]), points) - pyramid.corner
        cells = np.floor(at / RESOLUTION).astype(int)
        for u in range(-reach, beyond + 1):
            for v in range(-reach, beyond + 1):
                x, y = np.clip(cells + (u, v), -1, np.array(grid.shape) - 2).T + 1
                result.append(grid[x, y].sum())
    return np.array(result) / (255 * len(points))


def test_each_level_holds_the_maximum_over_the_cells_from_each_cell_on(scan_of_room):
    pyramid = pyramid_of(scan_of_room(POSE), POSE)
    bottom = pyramid.levels[0]
    assert bottom.max() > 200
    for level, grid in enumerate(pyramid.levels):
        size = 1 << level
        padded = np.pad(bottom, ((0, size - 1), (0, size - 1)))
        windows = np.lib.stride_tricks.sliding_window_view(padded, (size, size))
        assert (grid == windows.max(axis=(2, 3))).all()


def test_the_bottom_of_the_pyramid_is_the_likelihood_of_the_nearest_point(scan_of_room):
    points = np.array([[0.0, 0.0], [0.33, 0.21]])
    pyramid = branch_and_bound.pyramid(points, resolution=RESOLUTION, sigma=0.1)
    middles = pyramid.corner + RESOLUTION * (np.indices(pyramid.levels[0].shape).transpose(1, 2, 0) + 0.5)
    squared = ((middles[:, :, None] - points) ** 2).sum(axis=-1).min(axis=-1)
    expected = 255 * np.exp(-0.5 * squared / 0.1**2)
    near = np.sqrt(squared) < 0.2
    # Rounded down, and of a point not much farther than two cells.
    assert np.abs(pyramid.levels[0] - expected)[near].max() <= 1
    assert pyramid.levels[0][np.sqrt(squared) > 0.4].max() == 0


@pytest.mark.parametrize(
    "off", [(0, 0, 0), (0.6, -0.4, 0.1), (-1.0, 1.0, -0.05), (4.0, 3.0, 0), (-6.0, 0, 0.05), (0, -5.0, 0), (5, 5, 1)]
)
def test_branch_and_bound_finds_the_best_of_all_shifts_and_turns(scan_of_room, off):
    pyramid, points = pyramid_of(scan_of_room(POSE), POSE), points_of(scan_of_room(POSE))[::4]
    guess, reach = POSE + off, 12
    # The blocks of the coarsest level do not end where the window does.
    beyond = -reach + ((2 * reach) // BLOCK + 1) * BLOCK - 1
    expected = scores(pyramid, points, guess, reach, beyond).max()
    found, score = find(pyramid, points, guess, reach * RESOLUTION + 0.01)
    assert score == expected or (score, expected) == (-1, 0)
    assert score >= scores(pyramid, points, guess, reach, reach).max() or score == -1
    at = np.floor((se2.transform_points(found, points) - pyramid.corner) / RESOLUTION + 1e-9).astype(int)
    inside = ((at >= 0) & (at < pyramid.levels[0].shape)).all(axis=1)
    # Points on the edge of a cell may fall to either side.
    reached = pyramid.levels[0][tuple(at[inside].T)].astype(int).sum() / (255 * len(points))
    assert score == -1 or reached == pytest.approx(score, abs=0.02)


def test_a_scan_far_off_is_found_in_a_wide_window(scan_of_room):
    pyramid, points = pyramid_of(scan_of_room(POSE, beams=361), POSE), points_of(scan_of_room(POSE))
    turns = np.arange(-40, 41) * math.radians(0.75)
    found, score = find(pyramid, points, POSE + (5.3, -4.2, 0.3), 8.0, turns, 0.5)
    # Half a cell, and half a step of turning; a bell of 0.1 m around points in the middle of a cell.
    assert np.abs(found - POSE)[:2].max() < 0.08
    assert abs(found[2] - POSE[2]) < math.radians(0.75)
    assert score > 0.7


def test_below_the_least_score_there_is_no_answer(scan_of_room):
    pyramid, points = pyramid_of(scan_of_room(POSE), POSE), points_of(scan_of_room(POSE))
    best = find(pyramid, points, POSE, 1.0)[1]
    assert find(pyramid, points, POSE, 1.0, least=best - 0.01)[1] == best
    found, score = find(pyramid, points, POSE, 1.0, least=best + 0.01)
    assert score == -1
    assert found.tolist() == POSE.tolist()
    assert find(pyramid, points, POSE + (100, 0, 0), 1.0, least=0.3)[1] == -1


def test_a_corridor_repeats_itself_along_it_and_a_room_does_not(scan_of_corridor, scan_of_room):
    def rival(scan, pose, direction):
        pyramid, points = pyramid_of(scan, np.asarray(pose, float)), points_of(scan)
        return branch_and_bound.rival(
            pyramid.levels, pyramid.corner, pyramid.resolution, points, np.array(pose, float),
            np.array(direction, float), 4.0,
        )  # fmt: skip

    corridor = scan_of_corridor((0, 0.2, 0), beams=361, reach=12)
    assert rival(corridor, (0, 0.2, 0), (1, 0)) > 0.85
    # Across the corridor one wall at most meets the other.
    assert rival(corridor, (0, 0.2, 0), (0, 1)) < 0.6
    room = scan_of_room(POSE, beams=361)
    assert rival(room, POSE, (1, 0)) < 0.85
    assert rival(room, POSE, (0, 1)) < 0.85


def everywhere(pyramid, points, turns):
    """Scores (A, W, H) at each turn and of each cell for the origin of the points, and of no grid beyond its border."""
    grid = np.pad(pyramid.levels[0].astype(int), 1)
    width, height = pyramid.levels[0].shape
    result = np.empty((len(turns), width, height))
    for a, turn in enumerate(turns):
        cells = np.floor(se2.transform_points([0, 0, turn], points) / RESOLUTION).astype(int)
        for u in range(width):
            for v in range(height):
                x, y = np.clip(cells + (u, v), -1, np.array(grid.shape) - 2).T + 1
                result[a, u, v] = grid[x, y].sum()
    return result / (255 * len(points))


def test_all_over_the_map_the_best_places_are_found_that_are_no_neighbors_of_better_ones(scan_of_room):
    pyramid = pyramid_of(scan_of_room(POSE, beams=91), POSE)
    points = points_of(scan_of_room((1.0, 0.5, 1.3), beams=61))[::3]
    turns = np.arange(24) * (2 * math.pi / 24)
    free = np.zeros_like(pyramid.levels)
    free[0, 10:-10, 10:-10] = 1
    branch_and_bound.raise_maxima(free)
    near = np.array([4, 1])
    poses, scores, whole = branch_and_bound.find_places(
        pyramid.levels, free, pyramid.corner, RESOLUTION, points, turns, 0.2, 0.5, near, 8
    )
    assert whole
    exact = everywhere(pyramid, points, turns) * free[0]
    assert scores[0] == pytest.approx(exact.max(), abs=1e-6)
    assert (np.diff(scores) <= 0).all()
    assert (scores > 0.5 * scores[0]).all()
    at = np.column_stack(
        [np.round((poses[:, :2] - pyramid.corner) / RESOLUTION), np.round(poses[:, 2] / turns[1])]
    ).astype(int)
    for k, (u, v, a) in enumerate(at):
        assert exact[a, u, v] == pytest.approx(scores[k], abs=1e-6)
        for other in at[:k]:
            turned = abs(other[2] - a)
            assert np.hypot(*(other[:2] - (u, v))) > near[0] or min(turned, 24 - turned) > near[1]
    # What scores better than the last of them is a neighbor of a better one.
    for a, u, v in zip(*np.nonzero(exact > scores[-1] + 1e-6), strict=True):
        turned = np.abs(at[:, 2] - a)
        beside = (np.hypot(*(at[:, :2] - (u, v)).T) <= near[0]) & (np.minimum(turned, 24 - turned) <= near[1])
        assert (scores[beside] >= exact[a, u, v] - 1e-6).any()


def test_where_nothing_fits_no_place_is_found(scan_of_room):
    pyramid = pyramid_of(scan_of_room(POSE), POSE)
    free = np.ones_like(pyramid.levels)
    points = np.array([[50.0 * k, 0.0] for k in range(1, 40)])
    turns = np.arange(8) * (math.pi / 4)
    poses, scores, whole = branch_and_bound.find_places(
        pyramid.levels, free, pyramid.corner, RESOLUTION, points, turns, 0.5, 0.5, np.array([4, 1]), 8
    )
    assert poses.shape == (0, 3) and scores.shape == (0,) and whole
