# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud, concatenate
from g2_recon.geometry.mesh import Mesh


def test_points_that_are_not_finite_go_with_their_sensor_positions():
    points = np.arange(12.0).reshape(4, 3)
    sensor = points + 100
    points[1, 0], sensor[2, 1] = np.nan, np.inf
    left = Cloud(points, sensor).finite()
    assert left.points.tolist() == points[[0, 3]].tolist()
    assert left.sensor.tolist() == sensor[[0, 3]].tolist()


def test_clouds_join_and_keep_sensor_positions_only_if_all_have_them():
    seen, unseen = Cloud(np.zeros((2, 3)), np.ones((2, 3))), Cloud(np.zeros((1, 3)))
    assert concatenate([seen, seen]).sensor.shape == (4, 3)
    assert concatenate([seen, unseen]).sensor is None
    assert len(concatenate([])) == 0


@pytest.mark.parametrize(("points", "sensor"), [((3, 2), None), ((3,), None), ((3, 3), (2, 3))])
def test_arrays_of_the_wrong_shape_are_refused(points, sensor):
    with pytest.raises(InputError):
        Cloud(np.zeros(points), None if sensor is None else np.zeros(sensor))


def test_face_normals_are_unit_and_zero_without_area():
    vertices = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0.0]])
    mesh = Mesh(vertices, np.array([[0, 1, 2], [0, 2, 1], [0, 0, 1]]), np.zeros(3, np.int64))
    assert mesh.face_normals() == pytest.approx(np.array([[0, 0, 1], [0, 0, -1], [0, 0, 0]]))
