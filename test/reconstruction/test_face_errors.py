# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np

from g2_recon.geometry.mesh import Mesh
from g2_recon.reconstruction.face_errors import face_errors

SQUARE = Mesh(
    np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(2, np.int64)
)


def test_the_error_of_a_face_is_the_rms_distance_of_its_points():
    points = np.array([[0.8, 0.2, 0.03], [0.8, 0.3, -0.04], [0.2, 0.8, 0.01]])
    errors = face_errors(SQUARE, points, limit=0.2)
    np.testing.assert_allclose(errors, [np.hypot(0.03, 0.04) / np.sqrt(2), 0.01], atol=1e-12)


def test_a_face_without_points_within_the_limit_has_no_error():
    errors = face_errors(SQUARE, np.array([[0.8, 0.2, 0.0], [0.2, 0.8, 0.5]]), limit=0.2)
    assert errors[0] == 0
    assert np.isnan(errors[1])


def test_a_mesh_without_faces_has_no_errors():
    nothing = Mesh(np.empty((0, 3)), np.empty((0, 3), np.int64), np.empty(0, np.int64))
    assert len(face_errors(nothing, np.zeros((1, 3)), limit=0.2)) == 0
