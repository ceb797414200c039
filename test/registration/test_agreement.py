# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry import se3
from g2_recon.registration.agreement import agreement


def test_where_a_sweep_lies_right_nearly_all_agrees(room):
    seen = agreement(room.moving, room.fixed, room.T)
    assert seen.inlier_share > 0.99
    assert seen.overlap > 0.9
    assert seen.residual < 0.01  # m: the noise of the laser


@pytest.mark.parametrize("step", [(0.2, 0, 0), (0, 0.2, 0), (0, 0, 0.2)])
def test_where_a_sweep_lies_beside_its_place_much_disagrees(room, step):
    assert agreement(room.moving, room.fixed, room.T @ se3.from_xyz_rpy([*step, 0, 0, 0])).inlier_share < 0.8


def test_where_nothing_is_near_nothing_agrees(room):
    seen = agreement(room.moving, room.fixed, se3.from_xyz_rpy([500.0, 0, 0, 0, 0, 0]))
    assert (seen.overlap, seen.inlier_share, seen.residual) == (0.0, 0.0, np.inf)
    assert not seen.hessian.any()


def test_floors_and_ceilings_alone_do_not_make_agreement(room):
    turned = room.T @ se3.from_xyz_rpy([0, 0, 0, 0, 0, 0.6])
    assert agreement(room.moving, room.fixed, turned).inlier_share < 0.6


def test_a_corridor_is_open_along_its_axis_and_a_room_is_not(room, corridor):
    weak = agreement(corridor.moving, corridor.fixed, corridor.T)
    assert weak.shares[0] < 0.005 < weak.shares[1]
    axis = [np.cos(np.radians(20)), -np.sin(np.radians(20)), 0]
    assert abs(weak.directions[:3, 0] @ axis) > 0.99
    assert agreement(room.moving, room.fixed, room.T).shares[0] > 0.02


def test_hessian_and_gradient_are_those_of_the_distances(room):
    apart = np.array([0.004, -0.003, 0.002, 0.001, -0.001, 0.002])

    def moved(step):
        T = se3.from_xyz_rpy([0, 0, 0, *step[3:]]) @ room.T
        T[:3, 3] = room.T[:3, 3] + step[:3]
        return T

    seen = agreement(room.moving, room.fixed, moved(apart))
    step = -np.linalg.solve(seen.hessian, seen.gradient)
    # One step of Gauss-Newton is back but for noise and pairs that change: mm and mrad.
    assert step == pytest.approx(-apart, abs=0.0015)
