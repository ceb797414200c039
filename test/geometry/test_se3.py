# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.errors import InputError
from g2_recon.geometry import se3


def random_transforms(count, seed=0):
    rng = np.random.default_rng(seed)
    return se3.from_quaternion(rng.normal(size=(count, 3)), normalized(rng.normal(size=(count, 4))))


def normalized(rows):
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_a_transform_and_its_inverse_cancel():
    transforms = random_transforms(20)
    assert transforms @ se3.inverse(transforms) == pytest.approx(np.broadcast_to(np.eye(4), (20, 4, 4)), abs=1e-12)


def test_quaternions_survive_the_way_there_and_back():
    transforms = random_transforms(20)
    assert se3.from_quaternion(transforms[:, :3, 3], se3.to_quaternion(transforms)) == pytest.approx(transforms)


def test_roll_pitch_yaw_turn_about_fixed_axes():
    # REP-103: first roll about X, then pitch about Y, then yaw about Z of the parent.
    T = se3.from_xyz_rpy([1, 2, 3, 0, -np.pi / 2, 0])
    assert se3.transform_points(T, [[1.0, 0, 0], [0, 1.0, 0]]) == pytest.approx(np.array([[1, 2, 4], [1, 3, 3]]))


def test_one_transform_a_point_moves_each_by_its_own():
    transforms = random_transforms(5)
    points = np.random.default_rng(1).normal(size=(5, 3))
    one_by_one = [se3.transform_points(T, point[None])[0] for T, point in zip(transforms, points, strict=True)]
    assert se3.transform_points(transforms, points) == pytest.approx(np.array(one_by_one))


@pytest.mark.parametrize("quaternion", [[0, 0, 0, 0], [0, 0, 0, 3], [np.nan, 0, 0, 1], [0, 0, 0, np.inf]])
def test_a_quaternion_that_is_no_rotation_is_refused(quaternion):
    with pytest.raises(InputError, match="quaternion"):
        se3.from_quaternion([0, 0, 0], quaternion)


@pytest.mark.parametrize("pose", [[], [1, 2, 3], [0, 0, 0, 0, 0, np.nan]])
def test_a_pose_without_six_finite_numbers_is_refused(pose):
    with pytest.raises(InputError, match="six finite numbers"):
        se3.from_xyz_rpy(pose)


def test_rounding_errors_of_a_rotation_go_and_what_is_no_rotation_is_refused():
    T = se3.from_xyz_rpy([1, 2, 3, 0.1, 0.2, 0.3])
    bent = T.copy()
    bent[:3, :3] += np.random.default_rng(0).normal(0, 1e-3, (3, 3))
    straight = se3.orthonormal(bent)
    assert straight[:3, :3] @ straight[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
    assert straight == pytest.approx(T, abs=0.01)
    for wrong in (np.full((4, 4), np.nan), np.diag([1.0, 1, -1, 1]), 2 * np.eye(4), np.eye(3), 1e9 * np.ones((4, 4))):
        with pytest.raises(InputError, match="transform"):
            se3.orthonormal(wrong)


@pytest.mark.parametrize("pitch", [0.3, -1.2, np.pi / 2, -np.pi / 2, -np.pi / 2 + 1e-6, 2.0])
def test_a_transform_survives_its_angles(pitch):
    matrix = se3.from_xyz_rpy([1, 2, 3, 0.4, pitch, -2.5])
    assert se3.from_xyz_rpy(se3.to_xyz_rpy(matrix)) == pytest.approx(matrix, abs=1e-9)
