# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from g2_recon.errors import InputError
from g2_recon.geometry.occupancy_grid import MOST_CELLS
from g2_recon.localization import occupancy
from g2_recon.localization.occupancy import GridBuilder, count_scan

AROUND = np.linspace(-np.pi, np.pi, 720, endpoint=False)


def cells_on_the_way(start, end):
    """Cells that a line crosses: cut it at all lines of the grid, and see where the middle of each piece lies."""
    start, end = np.asarray(start), np.asarray(end)
    shares = [0.0, 1.0]
    for axis in range(2):
        low, high = sorted((start[axis], end[axis]))
        shares += [(line - start[axis]) / (end[axis] - start[axis]) for line in np.arange(np.ceil(low), np.ceil(high))]
    shares = np.sort(shares)
    middles = start + (0.5 * (shares[:-1] + shares[1:]))[:, None] * (end - start)
    return [tuple(cell) for cell in np.floor(middles).astype(int)]


def count_plainly(scans):
    """Hits and passes by cell, the plain way: sets of cells a scan."""
    hits, passes = Counter(), Counter()
    for start, ends, are_hits in scans:
        hit = {tuple(np.floor(end).astype(int)) for end in ends[are_hits]}
        crossed = {cell for end in ends for cell in cells_on_the_way(start, end)}
        hits.update(hit)
        passes.update(crossed - hit)
    return hits, passes


def square_room(pose, *, side=6.0):
    """Ranges (720,) in a square room around the origin."""
    x, y, yaw = pose
    cos, sin = np.cos(AROUND + yaw), np.sin(AROUND + yaw)
    with np.errstate(divide="ignore"):
        along_x, along_y = (
            (np.where(cos > 0, 1, -1) * side / 2 - x) / cos,
            (np.where(sin > 0, 1, -1) * side / 2 - y) / sin,
        )
    return np.minimum(along_x, along_y).astype(np.float32)


def room_grid(**changes):
    builder = GridBuilder(**changes)
    # The walls lie in the middle of a cell.
    for pose in ([0.0, 0.0, 0.3], [1.0, 0.5, -1.0], [-1.5, 2.0, 2.0]):
        builder.add(pose, AROUND, square_room(pose, side=6.05))
    return builder.grid()


def test_the_kernel_counts_as_its_plain_twin_on_random_rays():
    rng = np.random.default_rng(0)
    scans = [
        (rng.uniform(-60, 60, 2), rng.uniform(-64, 64, (12, 2)), rng.random(12) < 0.6) for _ in range(30)
    ]  # two tiles of 64 cells to each side of the origin
    counts = np.zeros((4, 64, 64, 3), np.int32)
    tiles = np.array([[2, 0], [3, 1]], np.int32)
    for number, (start, ends, hits) in enumerate(scans, start=1):
        count_scan(counts, tiles, np.array([-1, -1]), number, start, ends, hits)
    hits, passes = count_plainly(scans)
    whole = np.concatenate([np.concatenate([counts[tile] for tile in row], axis=1) for row in tiles])
    expected = np.zeros((128, 128, 2), int)
    for what, counter in enumerate((hits, passes)):
        for (row, column), count in counter.items():
            expected[row + 64, column + 64, what] = count
    np.testing.assert_array_equal(whole[..., :2], expected)


@pytest.mark.parametrize(
    "end", [(5.5, 0.5), (0.5, 5.5), (-4.5, 0.5), (0.5, -4.5), (5.0, 5.0), (-4.0, -4.0), (0.5, 0.5)]
)
def test_rays_along_an_axis_or_a_diagonal_end_where_they_should(end):
    counts = np.zeros((4, 64, 64, 3), np.int32)
    tiles = np.array([[0, 1], [2, 3]], np.int32)
    count_scan(counts, tiles, np.array([-1, -1]), 1, np.array([0.5, 0.5]), np.array([end]), np.array([True]))
    row, column = np.floor(end).astype(int)
    assert counts[..., 0].sum() == 1
    assert counts[tiles[(row >> 6) + 1, (column >> 6) + 1], row & 63, column & 63, 0] == 1
    assert counts[..., 1].sum() == abs(row) + abs(column)


def test_a_square_room_is_free_inside_has_a_closed_wall_and_is_unknown_outside():
    grid = room_grid()
    inside = np.stack(np.meshgrid(np.arange(-2.9, 2.95, 0.1), np.arange(-2.9, 2.95, 0.1)), axis=-1).reshape(-1, 2)
    assert (grid.at(inside) == 0).all()
    along = np.arange(-3, 3.01, 0.05)
    for wall in (3.025, -3.025):
        assert (grid.at(np.column_stack([np.full_like(along, wall), along])) == 100).all()
        assert (grid.at(np.column_stack([along, np.full_like(along, wall)])) == 100).all()
    assert (grid.at([[3.3, 0], [-3.3, 0], [0, 3.3], [0, -3.3], [50, 50]]) == -1).all()
    assert grid.cells.shape == (122, 122)  # from -3.05 m to 3.05 m by 5 cm, no more than what beams came to
    np.testing.assert_allclose(grid.origin, [-3.05, -3.05, 0], atol=1e-9)  # m; rounding


def test_cells_that_too_few_scans_saw_are_unknown():
    builder = GridBuilder(fewest_scans=2)
    builder.add((0, 0, 0), [0.0, 1.0], [2.0, 2.0])
    assert (builder.grid().cells == -1).all()
    builder.add((0, 0, 0), [0.0], [2.0])
    assert builder.grid().at([[1.0, 0.01], [2.01, 0.01], [0.54, 0.84]]).tolist() == [0, 100, -1]


def test_a_cell_is_occupied_when_the_share_of_hits_is_above_the_limit():
    for limit, expected in ((0.24, 100), (0.26, 0)):
        builder = GridBuilder(occupied_share=limit)
        for length in (1.01, 2.01, 2.01, 2.01):
            builder.add((0, 0.01, 0), [0.0], [length])
        assert builder.grid().at([[1.01, 0.01]]) == expected


def test_beams_that_graze_a_wall_do_not_erase_what_their_neighbors_hit():
    builder = GridBuilder(occupied_share=0.6)
    # All end in or cross the cells of a wall along x at y = 0.52: a hit counts, however many beams of the scan pass.
    bearings = np.arctan2(0.52, np.linspace(2.0, 6.0, 81))
    for _ in range(2):
        builder.add((0.01, 0.0, 0.0), bearings, np.hypot(0.52, np.linspace(2.0, 6.0, 81)))
    assert (builder.grid().at(np.column_stack([np.linspace(2.02, 5.98, 80), np.full(80, 0.525)])) == 100).all()


def test_ranges_mean_what_rep_117_says():
    for length, free_to in (
        (np.inf, 5.0),
        (np.nan, 0),
        (-np.inf, 0),
        (0.0, 0),
        (-1.0, 0),
        (0.05, 0),
        (8.5, 0),
        (7.5, 5.0),
    ):
        builder = GridBuilder(max_range=7.0, free_range=5.0, fewest_scans=1)
        builder.add((0.01, 0.01, 0.0), [0.0], [length], range_min=0.1, range_max=8.0)
        cells = builder.grid().cells
        assert (cells == 0).all(), length
        assert cells.size == (round(free_to / 0.05) + 1 if free_to else 0), length


def test_no_return_clears_no_farther_than_the_laser_can_see():
    builder = GridBuilder(free_range=5.0, fewest_scans=1)
    builder.add((0.01, 0.01, 0.0), [0.0], [np.inf], range_max=2.0)
    assert builder.grid().cells.shape == (1, 41)


def test_all_at_once_or_one_by_one_in_any_order_the_grid_is_the_same():
    rng = np.random.default_rng(1)
    poses = np.column_stack([rng.uniform(-20, 20, (40, 2)), rng.uniform(-np.pi, np.pi, 40)])
    bearings = [np.sort(rng.uniform(-2, 2, 30)) for _ in poses]
    ranges = [rng.choice([np.inf, np.nan, 3.0, 7.5, 12.0], 30) * rng.uniform(0.9, 1.1, 30) for _ in poses]
    batch = GridBuilder()
    batch.add_all(poses, bearings, ranges)
    one_by_one = GridBuilder()
    for index in rng.permutation(len(poses)):
        one_by_one.add(poses[index], bearings[index], ranges[index])
        one_by_one.grid()
    np.testing.assert_array_equal(one_by_one.grid().cells, batch.grid().cells)
    np.testing.assert_array_equal(one_by_one.grid().origin, batch.grid().origin)
    assert {-1, 0} <= set(np.unique(batch.grid().cells))


def test_the_grid_equals_that_of_the_plain_twin():
    rng = np.random.default_rng(2)
    poses = np.column_stack([rng.uniform(-5, 5, (15, 2)), rng.uniform(-np.pi, np.pi, 15)])
    bearings, ranges = rng.uniform(-3, 3, (15, 40)), rng.uniform(0.5, 4, (15, 40))
    builder = GridBuilder(resolution=0.1, occupied_share=0.3)
    builder.add_all(poses, bearings, ranges)
    scans = []
    for (x, y, yaw), angles, lengths in zip(poses, bearings, ranges, strict=True):
        ends = np.column_stack([y + lengths * np.sin(yaw + angles), x + lengths * np.cos(yaw + angles)]) / 0.1
        scans.append((np.array([y, x]) / 0.1, ends, np.ones(40, bool)))
    hits, passes = count_plainly(scans)
    low = np.min(list(hits | passes), axis=0)
    expected = np.full(np.max(list(hits | passes), axis=0) - low + 1, -1)
    for cell in hits | passes:
        seen = hits[cell] + passes[cell]
        if seen >= 2:
            expected[tuple(cell - low)] = 100 if hits[cell] > 0.3 * seen else 0
    np.testing.assert_array_equal(builder.grid().cells, expected)
    np.testing.assert_allclose(builder.grid().origin[:2], 0.1 * low[::-1], atol=1e-12)  # m; rounding


def test_without_scans_there_are_no_cells():
    assert GridBuilder().grid().cells.shape == (0, 0)


@pytest.mark.parametrize("pose", [(np.nan, 0, 0), (0, np.inf, 0), (0, 0, np.nan), (1e300, 0, 0), (0, -1e12, 0), (0, 0)])
def test_a_pose_that_is_no_place_is_refused(pose):
    with pytest.raises(InputError):
        GridBuilder().add(pose, [0.0], [1.0])


@pytest.mark.parametrize(("bearings", "ranges"), [([0.0, 1.0], [1.0]), ([[0.0]], [[1.0]]), ([np.nan], [1.0])])
def test_beams_that_are_not_one_bearing_a_range_are_refused(bearings, ranges):
    with pytest.raises(InputError):
        GridBuilder().add((0, 0, 0), bearings, ranges)


def test_a_scan_too_far_away_is_refused_and_leaves_the_map_as_it_was():
    builder = GridBuilder()
    builder.add_all(np.zeros((2, 3)), [AROUND] * 2, [square_room((0, 0, 0))] * 2)
    before = builder.grid()
    # Together they would span more than all that a grid may have.
    far = 0.05 * np.sqrt(MOST_CELLS)
    with pytest.raises(InputError, match="cells"):
        builder.add((far, far, 0), AROUND, square_room((0, 0, 0)))
    np.testing.assert_array_equal(builder.grid().cells, before.cells)
    builder.add((9.0, 0, 0), AROUND, square_room((0, 0, 0)))
    assert builder.grid().cells.shape[1] > before.cells.shape[1]


@pytest.mark.parametrize(
    "changes",
    [
        {"resolution": 0.0},
        {"resolution": np.nan},
        {"max_range": 0.0},
        {"max_range": np.inf},
        {"free_range": -1.0},
        {"free_range": 31.0},
        {"occupied_share": 1.0},
        {"occupied_share": np.nan},
        {"fewest_scans": 0},
    ],
)
def test_settings_out_of_range_are_refused(changes):
    with pytest.raises(InputError):
        GridBuilder(**changes)


numbers = st.floats(width=64) | st.floats(-100, 100)
beams = st.lists(st.tuples(numbers, numbers), max_size=5)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.tuples(numbers, numbers, numbers), beams), max_size=5))
def test_any_scan_is_added_or_refused_in_one_clear_line(scans):
    builder = GridBuilder(resolution=0.25, max_range=20.0)

    def add(pose, bearings, ranges):
        try:
            builder.add(pose, bearings, ranges)
        except InputError as error:
            return str(error)
        return ""

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(occupancy, "MOST_CELLS", 1_000_000)
        for pose, scan in scans:
            assert "\n" not in add(pose, [bearing for bearing, _ in scan], [length for _, length in scan])
    cells = builder.grid().cells
    assert cells.size <= 1_000_000
    assert len(np.setdiff1d(cells, [-1, 0, 100])) == 0
