# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from matplotlib.image import imread

from g2_recon import pictures
from g2_recon.geometry.mesh import Mesh, WireMesh
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
