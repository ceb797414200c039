# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from matplotlib.image import imread

from g2_recon import pictures
from g2_recon.geometry.mesh import Mesh, WireMesh
from g2_recon.geometry.occupancy_grid import OccupancyGrid
from g2_recon.geometry.trajectory import Trajectory

NO_MESH = Mesh(np.empty((0, 3)), np.empty((0, 3), np.int64), np.empty(0, np.int64))
NO_WIRE = WireMesh(np.empty((0, 3)), np.empty((0, 2), np.int64), np.empty(0, np.int64), np.empty(0, bool))
TRIANGLE = Mesh(np.array([[0, 0, 0], [4, 0, 0], [0, 3, 0.0]]), np.array([[0, 1, 2]]), np.zeros(1, np.int64))
WIRE = WireMesh(TRIANGLE.vertices, np.array([[0, 1], [1, 2]]), np.zeros(3, np.int64), np.array([False, True]))


def share_of_ink(file):
    return np.mean(imread(file)[..., :3].min(axis=2) < 0.5)


def test_a_floor_plan_shows_walls(tmp_path):
    wall = np.column_stack([np.linspace(0, 10, 400), np.zeros(400)])
    way = Trajectory.from_se2(np.arange(5.0), np.column_stack([np.arange(5.0), np.ones(5), np.zeros(5)]))
    pictures.draw_floor_plan(tmp_path / "with.png", np.vstack([wall, wall + (0, 4)]), way)
    pictures.draw_floor_plan(tmp_path / "without.png", np.empty((0, 2)), way)
    assert share_of_ink(tmp_path / "with.png") > share_of_ink(tmp_path / "without.png")


@pytest.mark.parametrize("count", [0, 1])
def test_a_floor_plan_of_next_to_nothing_is_drawn(tmp_path, count):
    way = Trajectory.from_se2(np.arange(count), np.zeros((count, 3)))
    pictures.draw_floor_plan(tmp_path / "plan.png", np.zeros((count, 2)), way)
    assert (tmp_path / "plan.png").stat().st_size > 1000


def shares_of_grays(file):
    """Shares of the picture that are black, gray as the unknown is drawn, and white."""
    pixels = imread(file)[..., :3]
    return [np.mean(np.abs(pixels - gray).max(axis=2) < 0.02) for gray in (0.0, 0.8, 1.0)]


def test_a_floor_plan_shows_what_is_occupied_free_and_unknown(tmp_path):
    way = Trajectory.from_se2(np.arange(2.0), np.zeros((2, 3)))
    black, gray, white = {}, {}, {}
    for value in (-1, 0, 100):
        grid = OccupancyGrid(0.05, np.array([-1.0, -2.0, 0.0]), np.full((80, 60), value, np.int8))
        pictures.draw_floor_plan(tmp_path / "plan.png", np.empty((0, 2)), way, grid)
        black[value], gray[value], white[value] = shares_of_grays(tmp_path / "plan.png")
    assert black[100] > 0.5 and gray[-1] > 0.5 and white[0] > 0.5
    assert max(black[0], black[-1], gray[0], gray[100]) < 0.05


@pytest.mark.parametrize("axis", [0, 1])
def test_thin_walls_of_a_large_grid_stay_black_in_a_floor_plan(tmp_path, axis):
    cells = np.zeros((4000, 4000), np.int8)
    cells[(slice(None, None, 100), slice(None))[:: 1 if axis == 0 else -1]] = 100
    grid = OccupancyGrid(0.05, np.zeros(3), cells)
    nowhere = Trajectory.from_se2([], np.empty((0, 3)))
    pictures.draw_floor_plan(tmp_path / "plan.png", np.empty((0, 2)), nowhere, grid)
    # Away from the axes; a wall each 5 m of 200 m.
    middle = imread(tmp_path / "plan.png")[300:800, 300:800, :3].max(axis=2)
    walls = (middle < 0.02).all(axis=1 - axis)
    assert 15 < np.count_nonzero(np.diff(walls.astype(int)) == 1) < 30


def test_a_turned_grid_lies_in_a_floor_plan_where_it_lies_on_the_floor(tmp_path):
    cells = np.full((10, 40), 100, np.int8)
    nowhere = Trajectory.from_se2([], np.empty((0, 3)))
    for name, yaw in (("along", 0.0), ("across", np.pi / 2)):
        grid = OccupancyGrid(0.1, np.array([5.0, 3.0, yaw]), cells)
        pictures.draw_floor_plan(tmp_path / f"{name}.png", np.empty((0, 2)), nowhere, grid)
    for name, shape in (("along", (1, 4)), ("across", (4, 1))):
        black = imread(tmp_path / f"{name}.png")[..., :3].max(axis=2) < 0.02
        # Rows and columns that are black for the most part, as those of an axis are not.
        size = [np.count_nonzero(black.mean(axis=1 - axis) > 0.5 * black.mean(axis=1 - axis).max()) for axis in (0, 1)]
        assert size[0] / size[1] == pytest.approx(shape[0] / shape[1], rel=0.1), name


@pytest.mark.parametrize("shape", [(0, 0), (1, 1)])
def test_a_floor_plan_with_next_to_no_grid_is_drawn(tmp_path, shape):
    grid = OccupancyGrid(0.05, np.zeros(3), np.zeros(shape, np.int8))
    pictures.draw_floor_plan(tmp_path / "plan.png", np.empty((0, 2)), Trajectory.from_se2([], np.empty((0, 3))), grid)
    assert (tmp_path / "plan.png").stat().st_size > 1000


@pytest.mark.parametrize(("mesh", "wire"), [(TRIANGLE, WIRE), (NO_MESH, NO_WIRE), (TRIANGLE, NO_WIRE), (NO_MESH, WIRE)])
def test_a_mesh_is_drawn_even_if_parts_are_empty(tmp_path, mesh, wire):
    pictures.draw_mesh(tmp_path / "mesh.png", mesh, wire)
    assert imread(tmp_path / "mesh.png").ndim == 3


def test_meshes_are_drawn_three_in_a_row(tmp_path):
    for count in (1, 3, 4):
        pictures.draw_meshes(tmp_path / f"{count}.png", [TRIANGLE] * count, ["triangle"] * count)
    one, three, four = (imread(tmp_path / f"{count}.png").shape for count in (1, 3, 4))
    assert three[1] == pytest.approx(3 * one[1], abs=2) and three[0] == one[0]
    assert four[1] == three[1] and four[0] == 2 * three[0]


def test_ceilings_are_cut_away(tmp_path):
    ceiling = Mesh(TRIANGLE.vertices, TRIANGLE.faces[:, ::-1], TRIANGLE.submap)
    pictures.draw_mesh(tmp_path / "floor.png", TRIANGLE, NO_WIRE)
    pictures.draw_mesh(tmp_path / "ceiling.png", ceiling, NO_WIRE)
    assert imread(tmp_path / "floor.png").mean() < imread(tmp_path / "ceiling.png").mean()


@pytest.mark.parametrize("wires", [[WIRE], [WIRE, NO_WIRE, WIRE]])
def test_wire_meshes_are_drawn_side_by_side(tmp_path, wires):
    pictures.draw_wire_meshes(tmp_path / "wires.png", wires, ["one"] * len(wires), elevation=50, height=3)
    assert share_of_ink(tmp_path / "wires.png") > 0
    height, width = imread(tmp_path / "wires.png").shape[:2]
    # Seven inches each, three high.
    assert width / height == pytest.approx(7 * len(wires) / 3, rel=0.01)


def test_floor_plans_stand_side_by_side(tmp_path):
    way = Trajectory.from_se2(np.arange(2.0), np.zeros((2, 3)))
    cells = {name: np.full((80, 60), value, np.int8) for name, value in (("walls", 100), ("free", 0))}
    plans = [
        pictures.FloorPlan(np.empty((0, 2)), way, OccupancyGrid(0.05, np.array([-1.0, -2.0, 0.0]), cells[name]))
        for name in ("walls", "free")
    ]
    pictures.draw_floor_plans(tmp_path / "plans.png", plans, ["walls", "free"])
    left, right = np.array_split(imread(tmp_path / "plans.png")[..., :3], 2, axis=1)
    assert np.mean(left < 0.02) > 0.3 and np.mean(right < 0.02) < 0.05
