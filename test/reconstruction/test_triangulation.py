# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry.cloud import Cloud
from g2_recon.geometry.mesh import Mesh
from g2_recon.reconstruction.lattice import rectangular
from g2_recon.reconstruction.triangulation import face_towards_sensor, split_cells


def flat(rows=4, columns=3):
    lattice = rectangular(rows, columns)
    return np.column_stack([lattice.coordinates, np.zeros(len(lattice))]), lattice


def test_each_cell_becomes_two_triangles_that_cover_it():
    weights, lattice = flat()
    faces = split_cells(weights, lattice.cells)
    mesh = Mesh(weights, faces, np.zeros(len(faces), np.int64))
    assert len(faces) == 2 * len(lattice.cells)
    assert mesh.face_normals() == pytest.approx(np.tile([0, 0, 1.0], (len(faces), 1)))


def test_a_cell_is_cut_along_its_shorter_diagonal():
    weights = np.array([[0, 0, 0], [1, 0, 0], [3, 3, 0], [0, 1, 0.0]])
    faces = split_cells(weights, np.array([[0, 1, 2, 3]]))
    assert sorted(map(sorted, faces.tolist())) == [[0, 1, 3], [1, 2, 3]]


@pytest.mark.parametrize("height", [1.0, -1.0])
def test_each_submap_is_turned_towards_where_it_was_seen_from(height):
    weights, lattice = flat()
    faces = split_cells(weights, lattice.cells)
    cloud = Cloud(weights, weights + (0, 0, height))
    submap = np.zeros(len(faces), np.int64)
    turned = face_towards_sensor(weights, faces, submap, cloud, np.arange(len(weights)))
    assert (Mesh(weights, turned, submap).face_normals()[:, 2] == height).all()


def test_without_sensor_positions_faces_stay_as_they_are():
    weights, lattice = flat()
    faces = split_cells(weights, lattice.cells)
    assert face_towards_sensor(weights, faces, np.zeros(len(faces), np.int64), Cloud(weights), np.arange(12)) is faces
