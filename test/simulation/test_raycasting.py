# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from g2_recon.simulation.building import Building, box, first_floor, room, surfaces
from g2_recon.simulation.raycasting import cast


def cast_in_numpy(rectangles, origins, directions):
    nearest = np.full(len(origins), np.inf)
    for axis, offset, low, high in zip(
        rectangles.axis, rectangles.offset, rectangles.low, rectangles.high, strict=True
    ):
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (offset - origins[:, axis]) / directions[:, axis]
            at = np.delete(origins + distance[:, None] * directions, axis, axis=1)
        hit = (distance > 0) & (at >= low).all(axis=1) & (at <= high).all(axis=1)
        nearest[hit] = np.minimum(nearest[hit], distance[hit])
    return nearest


def random_directions(rng, count):
    directions = rng.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def floor():
    return surfaces(first_floor())


def test_the_kernel_agrees_with_numpy(floor):
    rng = np.random.default_rng(1)
    origins, directions = rng.uniform((0, 0, 0.1), (20, 14, 2.2), (3000, 3)), random_directions(rng, 3000)
    np.testing.assert_allclose(cast(floor, origins, directions), cast_in_numpy(floor, origins, directions), rtol=1e-12)


def test_the_distances_in_a_room_are_those_to_its_walls():
    cell = surfaces(Building(box((0, 5), (0, 4), (-1, 3)), (room((1, 4), (1, 3), 2.5),), ()))
    axes = np.vstack([np.eye(3), -np.eye(3)])
    distances = cast(cell, np.tile([2.0, 1.5, 1.0], (6, 1)), axes)
    np.testing.assert_allclose(distances, [2.0, 1.5, 1.5, 1.0, 0.5, 1.0])


def test_no_ray_leaves_a_closed_room():
    cell = surfaces(Building(box((0, 5), (0, 4), (-1, 3)), (room((1, 4), (1, 3), 2.5),), ()))
    rng = np.random.default_rng(2)
    corners = np.array([[x, y, z] for x in (1, 4) for y in (1, 3) for z in (0, 2.5)])
    origins = np.repeat(rng.uniform((1.1, 1.1, 0.1), (3.9, 2.9, 2.4), (500, 3)), 8, axis=0)
    directions = np.tile(corners, (500, 1)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert np.isfinite(cast(cell, origins, directions)).all()


def test_a_ray_through_a_window_meets_nothing(floor):
    assert np.isinf(cast(floor, np.array([[5.4, 3.0, 1.5]]), np.array([[0.0, -1.0, 0.0]])))[0]
