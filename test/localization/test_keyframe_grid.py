# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import tracemalloc
import weakref
from dataclasses import replace

import numpy as np
import pytest

from g2_recon.config import LocalizationConfig
from g2_recon.geometry import se2, se3
from g2_recon.localization.keyframe_grid import KeyframeGrid
from g2_recon.localization.localizer import Localizer
from g2_recon.localization.occupancy import GridBuilder

WAY = np.array([(0.1 * i, 0.02 * i, 0.1 * i) for i in range(12)])


@pytest.fixture
def grid_of(scan_of_room):
    """The grid of keyframes that see the room from WAY, nothing counted yet."""

    def make(mount=(0, 0, 0, 0, 0, 0), *, upside_down=False, **settings):
        T_base_laser = se3.from_xyz_rpy(mount)
        grid = KeyframeGrid(LocalizationConfig(**settings), T_base_laser)
        for pose in WAY:
            grid.add(scan_of_room(se2.compose(pose, se2.from_se3(T_base_laser)), upside_down=upside_down))
        return grid

    return make


def same(one, other):
    return one.origin.tolist() == other.origin.tolist() and np.array_equal(one.cells, other.cells)


def test_the_grid_is_that_of_the_scans_at_their_poses(grid_of, scan_of_room):
    grid = grid_of(grid_resolution=0.1)
    assert grid.update(WAY)
    plain = GridBuilder(resolution=0.1, max_range=40.0, free_range=5.0)
    for pose in WAY:
        scan = scan_of_room(pose)
        plain.add(pose, scan.angles(), scan.ranges.astype(np.float16), range_min=0.1, range_max=80.0)
    assert same(grid.grid(), plain.grid())


def test_a_few_at_a_time_come_to_the_same_grid(grid_of):
    whole, parts = grid_of(), grid_of()
    whole.update(WAY)
    assert [parts.update(WAY, most=5) for _ in range(3)] == [False, False, True]
    assert same(parts.grid(), whole.grid())


def test_the_poses_of_an_update_are_not_kept(grid_of):
    # There is one array more each second, of all keyframes so far.
    grid, poses = grid_of(), WAY.copy()
    given = weakref.ref(poses)
    grid.update(poses, most=5)
    del poses
    assert given() is None


def test_keyframes_that_moved_are_counted_anew(grid_of):
    grid, fresh = grid_of(), grid_of()
    moved = se2.compose((0.3, 0.1, 0.2), WAY)
    grid.update(WAY)
    assert grid.is_current(WAY) and not grid.is_current(moved)
    grid.update(moved)
    fresh.update(moved)
    assert grid.is_current(moved)
    assert same(grid.grid(), fresh.grid())


def test_a_motion_within_a_cell_is_no_reason_to_count_anew(grid_of):
    grid = grid_of(grid_resolution=0.1)
    grid.update(WAY)
    assert grid.is_current(se2.compose((0.05, 0.0, 0.005), WAY))


def test_a_count_in_parts_comes_to_an_end_though_keyframes_keep_moving(grid_of):
    grid = grid_of()
    ends = [grid.update(se2.compose((0.2 * call, 0.0, 0.0), WAY), most=5) for call in range(6)]
    assert ends == [False, False, True] * 2


def test_a_laser_off_the_center_of_the_robot_sees_the_same_room(grid_of):
    grid = grid_of((0.2, 0.1, 0.4, 0, 0, 0.3))
    grid.update(WAY)
    assert_is_room(grid.grid())


def test_a_laser_mounted_upside_down_sees_the_same_room(grid_of):
    grid = grid_of((0.2, 0.1, 0.4, np.pi, 0, 0.3), upside_down=True)
    grid.update(WAY)
    assert_is_room(grid.grid())


def assert_is_room(grid):
    """The walls of the room that are seen from WAY are occupied, within a cell; before them it is free."""
    along = np.arange(0.5, 4.5, 0.05)
    wall = np.column_stack([np.full(40, 5.0), np.arange(-1.5, 0.5, 0.05)])
    near_wall = [grid.at(wall + (shift, 0)) for shift in (-0.05, 0.0, 0.05)]
    assert (np.max(near_wall, axis=0) == 100).mean() > 0.9
    assert (grid.at(np.column_stack([along, np.zeros_like(along)])) == 0).all()


def test_a_keyframe_absurdly_far_away_is_left_out_and_counted(grid_of):
    grid, without = grid_of(), grid_of()
    poses = WAY.copy()
    poses[-1, :2] = 1e5
    assert grid.update(poses)
    without.update(WAY, most=11)
    assert (grid.left_out, without.left_out) == (1, 0)
    assert "cells" in grid.why_left_out
    assert same(grid.grid(), without.grid())


def test_a_cleared_grid_is_empty(grid_of):
    grid = grid_of()
    grid.update(WAY)
    grid.clear()
    assert len(grid) == 0
    assert grid.update(np.empty((0, 3)))
    assert not grid.grid().cells.size


def test_returns_outside_the_set_ranges_make_no_wall(scan_of_room):
    grid = KeyframeGrid(LocalizationConfig(min_range=1.0, max_range=2.0), np.eye(4))
    scan = scan_of_room((0, 0, 0))
    scan.ranges[:] = np.tile([0.5, 1.5, 2.5], 61)[: len(scan.ranges)]
    for _ in range(2):
        grid.add(scan)
    grid.update(np.zeros((2, 3)))
    cells = grid.grid()
    rows, columns = np.nonzero(cells.cells == 100)
    distances = np.hypot(*(cells.origin[:2, None] + cells.resolution * (np.stack([columns, rows]) + 0.5)))
    # Half the diagonal of a cell.
    assert distances == pytest.approx(np.full(len(distances), 1.5), abs=0.036)


def test_a_range_just_beyond_that_of_the_laser_makes_no_wall(scan_of_room):
    # Some lasers code a beam without a return so; the ranges that are kept are rounded.
    grid = KeyframeGrid(LocalizationConfig(), np.eye(4))
    scan = replace(scan_of_room((0, 0, 0)), range_max=8.0)
    for shift in (0.0, 0.001):
        scan.ranges[:] = 8.0 + shift
        grid.clear()
        grid.add(scan)
        grid.add(scan)
        grid.update(np.zeros((2, 3)))
        cells = grid.grid().cells
        assert (cells == 100).any() == (shift == 0)
        assert (cells.size > 0) == (shift == 0)


def test_many_keyframes_take_little_memory(scan_of_room):
    grid = KeyframeGrid(LocalizationConfig(), np.eye(4))
    scan = scan_of_room((0, 0, 0))
    tracemalloc.start()
    for _ in range(1000):
        grid.add(replace(scan, ranges=scan.ranges.copy()))
    used, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert used / 1000 < 3 * len(scan.ranges) + 100


@pytest.mark.parametrize("roll", [0.0, np.pi])
def test_a_session_has_the_walls_where_its_scans_have_them(grid_of, scan_of_room, roll):
    mount = se3.from_xyz_rpy([0.2, 0.1, 0.4, roll, 0, 0.3])
    localizer = Localizer(LocalizationConfig(keyframe_distance=0.01), mount)
    localizer.reset(WAY[0])
    for pose in WAY:
        seen = scan_of_room(se2.compose(pose, se2.from_se3(mount)), upside_down=roll > 0)
        localizer.process(seen, se2.relative(WAY[0], pose))
    settings = LocalizationConfig(grid_resolution=0.1)
    grid, loaded = KeyframeGrid(settings, mount), KeyframeGrid(settings, mount)
    for pose in WAY:
        grid.add(scan_of_room(se2.compose(pose, se2.from_se3(mount)), upside_down=roll > 0))
    loaded.add_session(localizer.session())
    poses = localizer.keyframes().planar()
    assert len(loaded) == len(WAY)
    assert grid.update(poses) and loaded.update(poses)
    # Ranges in a session have been points in single precision.
    ours, theirs = loaded.grid(), grid.grid()
    assert ours.cells.shape == theirs.cells.shape
    assert np.mean(ours.cells != theirs.cells) < 0.01
