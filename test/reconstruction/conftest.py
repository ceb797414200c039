# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry.cloud import Cloud


def cube_surface(corner, steps=11):
    """Points on the surface of a unit cube, a regular grid on each side; 6 * 121 = 726 as in the paper."""
    u, v = np.meshgrid(np.linspace(0, 1, steps), np.linspace(0, 1, steps))
    sides = []
    for axis in range(3):
        for end in (0.0, 1.0):
            side = np.empty((steps * steps, 3))
            side[:, axis] = end
            side[:, (axis + 1) % 3], side[:, (axis + 2) % 3] = u.ravel(), v.ravel()
            sides.append(side)
    return np.concatenate(sides) + corner


@pytest.fixture(scope="session")
def two_cubes():
    """The paper's artificial data: two cubes of 726 points each, half a metre apart."""
    return Cloud(np.concatenate([cube_surface((0, 0, 0)), cube_surface((1.5, 0, 0))]))


@pytest.fixture(scope="session")
def corner():
    """Three sides of a room of 4 x 3 x 2.5 m with 1 cm noise, seen from inside: 6000 points."""
    rng = np.random.default_rng(0)
    u, v = rng.random((2, 2000, 1))
    zero = np.zeros_like(u)
    points = np.concatenate(
        [np.hstack([4 * u, 3 * v, zero]), np.hstack([4 * u, zero, 2.5 * v]), np.hstack([zero, 3 * u, 2.5 * v])]
    )
    return Cloud(points + rng.normal(0, 0.01, points.shape), np.tile([2.0, 1.5, 1.2], (len(points), 1)))
