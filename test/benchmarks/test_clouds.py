# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks.clouds import (
    BUILDINGS,
    FREE,
    SOLID,
    Survey,
    box,
    built,
    cast,
    circle,
    drive,
    make,
    prism,
    scan,
    solids,
    surface,
    tiled,
    two_cubes,
)
from g2_recon.simulation.building import first_floor, surfaces, triangles

COARSE = Survey(noise=0.0, step=0.4, rotated=False)


@pytest.fixture(scope="module", params=list(BUILDINGS))
def building(request):
    vertices, faces, way = built(request.param)
    return scan(vertices, faces, way, COARSE), way


def normals_of(vertices, faces):
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    normal = np.cross(second - first, third - first)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def area_of(vertices, faces):
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    return float(np.linalg.norm(np.cross(second - first, third - first), axis=1).sum() / 2)


def first_hit(vertices, faces, origin, direction):
    """Distance to the first triangle along a ray, and which it is (Moeller and Trumbore, 1997)."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    across = np.cross(direction, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / np.einsum("fi,fi->f", b - a, across)
        u = scale * np.einsum("fi,fi->f", origin - a, across)
        other = np.cross(origin - a, b - a)
        v = scale * (other @ direction)
        distance = scale * np.einsum("fi,fi->f", other, c - a)
        # A hair's breadth over the edges, where no ray may slip through.
        distance[~((u > -1e-9) & (v > -1e-9) & (u + v < 1 + 1e-9) & (distance > 0))] = np.inf
    return distance.min(), int(distance.argmin())


def test_beams_end_on_the_truth_and_see_its_front(building):
    cloud, _ = building
    normals = normals_of(cloud.vertices, cloud.faces)
    for index in np.random.default_rng(0).choice(len(cloud.points), 150, replace=False):
        beam = cloud.clean[index] - cloud.sensor[index]
        length = np.linalg.norm(beam)
        distance, face = first_hit(cloud.vertices, cloud.faces, cloud.sensor[index], beam / length)
        assert distance == pytest.approx(length, abs=1e-6)  # m, of rounding
        assert normals[face] @ beam < 0


def test_the_laser_keeps_clear_of_the_walls(building):
    cloud, way = building
    low = cloud.clean[np.abs(cloud.clean[:, 2] - COARSE.height) < 0.3, :2]
    assert cKDTree(low).query(drive(way, 0.05, 0.0)[:, :2, 3])[0].min() > 0.25


def test_boxes_give_the_surface_that_the_simulated_building_has():
    floor = first_floor()
    boxes = [(floor.block, SOLID), *((b, FREE) for b in floor.carved), *((b, SOLID) for b in floor.placed)]
    parts = [(box(*zip(b.low, b.high, strict=True)), state) for b, state in boxes]
    ours, theirs = surface(parts), triangles(surfaces(floor))
    assert area_of(*ours) == pytest.approx(area_of(*theirs), rel=1e-9)
    volume = [np.einsum("fi,fi->", v[f[:, 0]], np.cross(v[f[:, 1]], v[f[:, 2]])) / 6 for v, f in (ours, theirs)]
    assert volume[0] == pytest.approx(volume[1], rel=1e-9)


def test_a_column_hides_floor_and_ceiling():
    outline = circle((2.0, 2.0), 0.5)
    room = [(box((-1, 5), (-1, 5), (-1, 4)), SOLID), (box((0, 4), (0, 4), (0, 3)), FREE)]
    vertices, faces = surface([*room, (prism(outline, (0.0, 3.0)), SOLID)])
    x, y = np.array(outline).T
    disk = abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2
    around = np.linalg.norm(np.diff([*outline, outline[0]], axis=0), axis=1).sum()
    assert area_of(vertices, faces) == pytest.approx(2 * 16 + 4 * 12 - 2 * disk + 3 * around, rel=1e-9)


def test_a_beam_that_meets_nothing_has_no_distance():
    triangle = np.array([[2.0, -1, -1], [2, 1, -1], [2, 0, 1]]), np.array([[0, 1, 2]])
    distances = cast(*triangle, np.eye(4)[None], np.radians([-90.0, 0.0, 90.0]))
    np.testing.assert_allclose(distances, [[np.inf, 2.0, np.inf]])


def test_ranges_have_the_noise_that_was_asked_for():
    cloud = make("corridor_s3")
    errors = np.linalg.norm(cloud.points - cloud.sensor, axis=1) - np.linalg.norm(cloud.clean - cloud.sensor, axis=1)
    assert errors.std() == pytest.approx(0.03, rel=5 / math.sqrt(2 * len(errors)))  # five standard errors
    assert errors.mean() == pytest.approx(0.0, abs=5 * 0.03 / math.sqrt(len(errors)))


def test_a_seed_changes_the_noise_and_nothing_else():
    one, same, other = make("corridor_half"), make("corridor_half"), make("corridor_half", seed=1)
    np.testing.assert_array_equal(one.points, same.points)
    np.testing.assert_array_equal(one.vertices, other.vertices)
    assert not np.array_equal(one.points[:100], other.points[:100])


def test_poses_that_drift_are_off_by_no_more_than_was_asked_for():
    vertices, faces, way = built("corridor")
    drifting = scan(vertices, faces, way, Survey(noise=0.0, step=0.4, drift=0.05, rotated=False))
    exact = scan(vertices, faces, way, COARSE)
    off = np.linalg.norm(np.unique(drifting.sensor, axis=0)[:, None] - np.unique(exact.sensor, axis=0), axis=2)
    assert 0.02 < off.min(axis=1).max() <= 0.05
    turned_by = np.linalg.norm(drifting.points - drifting.sensor - (drifting.clean - exact.sensor), axis=1)
    assert (turned_by <= math.radians(0.5) * 8.2 + 0.001).all()  # m, at the largest range, and a count


def test_a_name_lists_what_is_different():
    plain, changed = make("corridor_half"), make("corridor_half_level_nosensor_out")
    assert changed.sensor is None
    assert plain.vertices[:, 2].min() < -0.2 <= changed.vertices[:, 2].min()
    beyond_noise = np.linalg.norm(changed.points - changed.clean, axis=1) > 0.06
    assert 0.005 < beyond_noise.mean() < 0.03


def test_solids_are_closed_and_look_outwards():
    for cloud, volume in ((two_cubes(), 2.0), (solids(), 4 / 3 * math.pi + 2 * math.pi**2 * 0.35**2)):
        corners = cloud.vertices[cloud.faces]
        enclosed = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
        assert enclosed == pytest.approx(volume, rel=2e-3)  # of the chords of 120 to 360 sides
    assert len(two_cubes().points) == 1452


def test_tiles_do_not_overlap():
    cloud = two_cubes().cloud()
    many = tiled(cloud, 5)
    assert len(many) == 5 * len(cloud)
    assert len(np.unique(many.points.round(6), axis=0)) == 5 * len(np.unique(cloud.points.round(6), axis=0))
