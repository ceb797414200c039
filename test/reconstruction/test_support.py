# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np

from g2_recon.geometry.point_grid import point_grid
from g2_recon.reconstruction.support import on_own_data, supported


def test_a_face_over_a_gap_in_the_data_is_not_supported():
    x, y = np.meshgrid(np.arange(0, 3, 0.1), np.arange(0, 1, 0.1))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    points = points[(points[:, 0] < 1) | (points[:, 0] > 2)]
    vertices = np.array([[0.1, 0.1, 0], [0.9, 0.1, 0], [0.5, 0.8, 0], [2.2, 0.1, 0], [2.8, 0.1, 0], [1.5, 0.8, 0]])
    faces = np.array([[0, 1, 2], [1, 3, 5], [3, 4, 2]])
    assert supported(vertices, faces, point_grid(points, cell=0.1), 0.2).tolist() == [True, False, False]


def test_faces_over_the_data_of_another_submap_are_told():
    x, y = (along.ravel() for along in np.meshgrid(np.arange(0, 1, 0.05), np.arange(0, 1, 0.05)))
    points = np.column_stack([x, y, 0 * x])
    label = (x > 0.5).astype(np.int64)
    vertices = np.array([[0.1, 0.1, 0], [0.3, 0.1, 0], [0.2, 0.3, 0], [0.7, 0.1, 0], [0.9, 0.1, 0], [0.8, 0.3, 0]])
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    grid = point_grid(points, cell=0.1)
    for submap, own in (([0, 1], [True, True]), ([0, 0], [True, False]), ([1, 1], [False, True])):
        assert on_own_data(vertices, faces, np.array(submap), grid, label, 0.2).tolist() == own
    assert not on_own_data(vertices + (0, 0, 1.0), faces, np.array([0, 1]), grid, label, 0.2).any()
