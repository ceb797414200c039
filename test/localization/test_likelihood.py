# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import itertools
import math

import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from g2_recon.geometry import se2
from g2_recon.localization import beams as beam_kinds
from g2_recon.localization import likelihood
from g2_recon.localization.beams import beams

RESOLUTION = 0.1
POSE = np.array([0.5, 0.3, 0.4])
CORNER = np.array([-6.0, -6.0])
TURN = math.radians(1)


def seen(scan):
    return beams(scan, range_min=0.1, range_max=40.0)


def drawn(scan, pose, cells=140):
    grid = np.zeros((cells, cells), np.uint8)
    b = seen(scan)
    likelihood.splat(
        grid,
        b.points[None],
        b.kinds[None],
        np.asarray(pose)[None],
        *CORNER,
        RESOLUTION,
        likelihood.bell(RESOLUTION, 0.12),
    )
    return grid


def plain_score(grid, points, pose):
    cells = ((se2.transform_points(pose, points) - CORNER) / RESOLUTION).astype(int)
    inside = ((cells >= 0) & (cells < grid.shape)).all(axis=1)
    return grid[tuple(cells[inside].T)].astype(int).sum() / (255 * len(points))


def test_the_bell_is_full_in_the_middle_and_falls_off_as_a_normal_distribution():
    bell = likelihood.bell(0.1, 0.12)
    assert bell[2, 2] == 255
    assert bell[2, 3] == bell[1, 2] == int(255 * math.exp(-0.5 * (0.1 / 0.12) ** 2))
    assert (bell == bell.T).all()
    assert (bell == bell[::-1]).all()


def test_a_grid_holds_the_largest_likelihood_of_all_points_and_ends_before_its_border(scan_of_room):
    bell = likelihood.bell(RESOLUTION, 0.12)
    points = np.array([[0.05, 0.05], [0.15, 0.05], [-5.85, 0.0], [7.9, 0.0], [-99.0, 0.0], [1.0, 1.0]])
    kinds = np.array([1, 2, 1, 1, 1, 0], np.uint8)
    grid = np.zeros((140, 140), np.uint8)
    box = likelihood.splat(grid, points[None], kinds[None], np.zeros((1, 3)), *CORNER, RESOLUTION, bell)
    expected = np.zeros((140, 140), np.uint8)
    for x in (60, 61):
        patch = expected[x - 2 : x + 3, 58:63]
        patch[:] = np.maximum(patch, bell)
    assert grid.tolist() == expected.tolist()
    assert box.tolist() == [58, 64, 58, 63]
    likelihood.clear(grid, box, 0)
    assert not grid.any()


def test_nothing_drawn_is_an_empty_box():
    grid = np.zeros((140, 140), np.uint8)
    nothing = np.zeros((1, 3, 2)), np.zeros((1, 3), np.uint8), np.zeros((1, 3))
    left, right, bottom, top = likelihood.splat(grid, *nothing, *CORNER, RESOLUTION, likelihood.bell(RESOLUTION, 0.12))
    assert (left, bottom) == (right, top)


def test_the_score_is_the_mean_likelihood_of_the_points(scan_of_room):
    scan = scan_of_room(POSE, noise=0.02)
    scan.ranges[::7] = np.nan
    grid, b = drawn(scan, POSE), seen(scan)
    assert likelihood.score(grid, b.points, b.kinds, POSE, *CORNER, RESOLUTION) == 1.0
    for off in ((0.1, 0, 0), (0, -0.3, 0.05), (3, 3, 0), (6, 6, 1)):
        score = likelihood.score(grid, b.points, b.kinds, POSE + off, *CORNER, RESOLUTION)
        assert score == pytest.approx(plain_score(grid, b.points[b.kinds > 0], POSE + off))


def whole(grid):
    return np.array([0, grid.shape[0], 0, grid.shape[1]])


def search(grid, b, guess, turns=6, shifts=2, step=1):
    wide = np.empty_like(grid)
    likelihood.widen(grid, whole(grid), shifts, wide)
    return likelihood.search(
        grid, wide, b.points, b.kinds, np.array(guess, float), *CORNER, RESOLUTION, turns, TURN, shifts, step
    )


@pytest.mark.parametrize("reach", [0, 1, 2])
def test_a_widened_grid_has_the_largest_likelihood_around_each_cell(reach):
    grid = np.random.default_rng(0).integers(0, 256, (17, 23)).astype(np.uint8)
    wide = np.empty_like(grid)
    likelihood.widen(grid, whole(grid), reach, wide)
    assert wide.tolist() == maximum_filter(grid, 2 * reach + 1, mode="constant").tolist()


@pytest.mark.parametrize("box", [[5, 12, 3, 20], [0, 4, 0, 23], [7, 7, 9, 9]], ids=str)
def test_widening_a_box_reaches_beyond_it_as_far_as_there_is_a_grid(box):
    grid = np.zeros((17, 23), np.uint8)
    left, right, bottom, top = box
    drawn = grid[left:right, bottom:top]
    drawn[:] = np.random.default_rng(0).integers(0, 256, drawn.shape)
    wide = np.zeros_like(grid)
    likelihood.widen(grid, np.array(box), 2, wide)
    assert wide.tolist() == maximum_filter(grid, 5, mode="constant").tolist()
    likelihood.clear(wide, np.array(box), 2)
    assert not wide.any()


@pytest.mark.parametrize("step", [1, 3])
@pytest.mark.parametrize("off", [(0, 0, 0), (0.13, -0.2, 0.05), (-0.2, 0.1, -0.1)])
def test_the_search_finds_what_trying_all_finds(scan_of_room, off, step):
    grid, b = drawn(scan_of_room(POSE), POSE), seen(scan_of_room(POSE))
    guess = POSE + off
    best = -1.0
    used = b.points[::step][b.kinds[::step] > 0]
    for a, u, v in itertools.product(range(-6, 7), range(-2, 3), range(-2, 3)):
        pose = guess + (u * RESOLUTION, v * RESOLUTION, a * TURN)
        favor = 1 - 0.003 * abs(a) - 0.02 * math.hypot(u, v)
        best = max(best, plain_score(grid, used, pose) * favor)
    found, score = search(grid, b, guess, step=step)
    assert score == pytest.approx(best, abs=1e-12)
    away = np.abs(found - POSE)
    # A cell and a step of turning.
    assert away[:2].max() <= RESOLUTION
    assert away[2] <= 1.5 * TURN


def test_a_guess_is_kept_where_nothing_speaks_against_it(scan_of_room):
    scan = scan_of_room(POSE)
    found, score = search(np.zeros((140, 140), np.uint8), seen(scan), POSE)
    assert (found.tolist(), score) == (POSE.tolist(), 0.0)
    found, score = search(drawn(scan, POSE), seen(scan), POSE)
    assert found.tolist() == POSE.tolist()
    assert score == 1.0


@pytest.mark.parametrize("far", [(7.0, 0, 0), (-6.0, -6.0, 0), (500, 0, 0), (0, -1e6, 2)])
def test_a_search_beyond_the_grid_finds_little_and_stays_in_its_window(scan_of_room, far):
    guess = POSE + far
    found, score = search(drawn(scan_of_room(POSE), POSE), seen(scan_of_room(POSE)), guess)
    assert 0 <= score < 0.5
    assert np.abs(found - guess)[:2].max() <= 0.2 + 1e-9
    assert abs(found[2] - guess[2]) <= 6 * TURN + 1e-9


@pytest.mark.parametrize("off", [-0.17, 0.0, 0.06, 0.3])
def test_a_scan_slides_along_a_line_to_where_it_fits(scan_of_room, off):
    scan = scan_of_room(POSE, beams=361)
    grid, b = drawn(scan, POSE), seen(scan)
    direction = np.array([math.cos(1.0), math.sin(1.0)])
    start = POSE - (*(off * direction), 0)
    settings = 0.4, 0.025, off, 0.0, *CORNER, RESOLUTION
    found, contrast = likelihood.slide(grid, b.points, b.kinds, start, direction, *settings)
    # A cell.
    assert found == pytest.approx(off, abs=RESOLUTION)
    assert contrast > 0.3


def test_where_nothing_fits_better_a_scan_slides_to_where_it_is_expected(scan_of_room):
    b = seen(scan_of_room(POSE))
    nothing = np.zeros((50, 50), np.uint8)
    settings = 0.4, 0.025, 0.15, 1.0, *CORNER, RESOLUTION
    found, contrast = likelihood.slide(nothing, b.points, b.kinds, POSE, np.array([1.0, 0.0]), *settings)
    assert found == pytest.approx(0.15, abs=1e-9)
    assert contrast == 0.0


def test_far_apart_beams_on_a_wall_along_the_way_do_not_tell_how_far_one_is(scan_of_room):
    b = seen(scan_of_room(POSE, beams=361))
    direction = np.array([math.cos(0.3), math.sin(0.3)])
    kinds = likelihood.telling(b.points, b.normals, b.kinds, b.increment, direction, 0.1, 0.5)
    x, y = b.points.T.astype(float)
    nx, ny = b.normals.T.astype(float)
    apart = np.hypot(x, y) ** 2 * b.increment > 0.1 * np.abs(x * nx + y * ny)
    bare = apart & (np.abs(b.normals @ direction) < 0.5)
    assert (
        kinds.tolist()
        == np.where((b.kinds == beam_kinds.CORNER) | ((b.kinds == beam_kinds.SURFACE) & ~bare), b.kinds, 0).tolist()
    )
    assert 0 < np.count_nonzero(kinds) < np.count_nonzero(b.kinds)
