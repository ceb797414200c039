# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from g2_recon.errors import InputError
from g2_recon.geometry.intersections import crossing_pairs
from g2_recon.geometry.point_grid import point_grid
from g2_recon.reconstruction.advancing_front import join_submaps
from g2_recon.reconstruction.lattice import rectangular
from g2_recon.reconstruction.triangulation import split_cells

SPACING = 0.2


def patch(corner, right, up, rows, columns):
    """Vertices, normals and faces of a flat submap of `columns` x `rows` steps of 20 cm from a corner."""
    lattice = rectangular(columns, rows)
    right, up = np.asarray(right, float), np.asarray(up, float)
    vertices = corner + SPACING * (lattice.coordinates[:, :1] * right + lattice.coordinates[:, 1:] * up)
    return vertices, np.tile(np.cross(right, up), (len(vertices), 1)), split_cells(vertices, lattice.cells)


def together(*patches):
    offset = np.cumsum([0] + [len(vertices) for vertices, _, _ in patches])
    return (
        np.concatenate([vertices for vertices, _, _ in patches]),
        np.concatenate([normals for _, normals, _ in patches]),
        np.concatenate([faces + begin for (_, _, faces), begin in zip(patches, offset, strict=False)]),
    )


def plane_of_points(width, height, step=0.05):
    x, y = np.meshgrid(np.arange(-0.1, width + 0.1, step), np.arange(-0.1, height + 0.1, step))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def join(vertices, normals, faces, points):
    grid = point_grid(points, cell=0.1)
    return join_submaps(vertices, normals, faces, grid, reach=0.45, spacing=SPACING, support_distance=0.2)


def half_edges(faces):
    return np.stack([faces.ravel(), np.roll(faces, -1, axis=1).ravel()], axis=1)


def is_oriented_manifold(faces):
    """Each half-edge occurs once: so each edge is in at most two faces, and in opposite directions."""
    return len(np.unique(half_edges(faces), axis=0)) == faces.size


def border_loops(faces):
    """The number of closed border polygons, where no vertex is pinched."""
    edges = set(map(tuple, half_edges(faces).tolist()))
    following = {begin: end for begin, end in edges if (end, begin) not in edges}
    loops = 0
    while following:
        vertex = next(iter(following))
        while vertex in following:
            vertex = following.pop(vertex)
        loops += 1
    return loops


def area(vertices, faces):
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


@pytest.mark.parametrize("shift", [0.0, 0.07, 0.1])
def test_two_facing_borders_become_one_closed_strip(shift):
    one = patch((0, 0, 0), (1, 0, 0), (0, 1, 0), 6, 4)
    other = patch((0.85, shift, 0), (1, 0, 0), (0, 1, 0), 6, 4)
    vertices, normals, faces = together(one, other)
    whole = np.concatenate([faces, join(vertices, normals, faces, plane_of_points(1.5, 1.2))])
    assert is_oriented_manifold(whole)
    assert border_loops(whole) == 1
    assert area(vertices, whole) - area(vertices, faces) == pytest.approx(0.25 * (1.0 - shift), abs=0.25 * SPACING)


def test_borders_of_different_spacing_are_joined():
    one = patch((0, 0, 0), (1, 0, 0), (0, 1, 0), 6, 4)
    other = patch((0.8, 0, 0), (1, 0, 0), (0, 0.7, 0), 8, 4)
    vertices, normals, faces = together(one, other)
    # The cross product of the second one's steps is shorter than one.
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    whole = np.concatenate([faces, join(vertices, normals, faces, plane_of_points(1.5, 1.2))])
    assert is_oriented_manifold(whole)
    assert border_loops(whole) == 1


def test_three_submaps_meet_without_a_hole():
    corners = [((0, 0, 0), 5, 4), ((0.85, 0, 0), 5, 4), ((0, 1.05, 0), 4, 8)]
    vertices, normals, faces = together(*(patch(c, (1, 0, 0), (0, 1, 0), r, k) for c, r, k in corners))
    whole = np.concatenate([faces, join(vertices, normals, faces, plane_of_points(1.5, 1.8))])
    assert border_loops(whole) == 1


def test_a_door_without_data_stays_open():
    one = patch((0, 0, 0), (1, 0, 0), (0, 1, 0), 6, 4)
    other = patch((1.5, 0, 0), (1, 0, 0), (0, 1, 0), 6, 4)
    points = plane_of_points(2.1, 1.0)
    points = points[(points[:, 0] < 0.65) | (points[:, 0] > 1.45)]
    assert len(join(*together(one, other), points)) == 0


def test_a_gap_within_reach_but_without_data_stays_open():
    one = patch((0, 0, 0), (1, 0, 0), (0, 1, 0), 6, 4)
    other = patch((0.95, 0, 0), (1, 0, 0), (0, 1, 0), 6, 4)
    vertices, normals, faces = together(one, other)
    far_from_gap = vertices + (0, 0, 0.17)
    assert len(join(vertices, normals, faces, far_from_gap)) == 0


def test_the_two_sides_of_a_thin_wall_are_not_joined():
    front = patch((0, 0, 0), (1, 0, 0), (0, 1, 0), 6, 6)
    back = patch((1.0, 0, -0.1), (-1, 0, 0), (0, 1, 0), 6, 6)
    vertices, normals, faces = together(front, back)
    points = np.concatenate([plane_of_points(1.0, 1.0), plane_of_points(1.0, 1.0) - (0, 0, 0.1)])
    new = join(vertices, normals, faces, points)
    assert (normals[new][:, :, 2].min(axis=1) == normals[new][:, :, 2].max(axis=1)).all()


def cube(corner, steps=5):
    """The six sides of a cube, each a submap that ends 10 cm before the edges of the cube, normals outwards."""
    sides = []
    size = SPACING * (steps - 1) + 0.2
    for axis in range(3):
        along, across = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        inset = 0.1 * (along + across)
        sides.append(patch(corner + inset + size * np.eye(3)[axis], along, across, steps, steps))
        sides.append(patch(corner + inset, across, along, steps, steps))
    return sides


def test_the_sides_of_two_cubes_become_two_closed_surfaces():
    vertices, normals, faces = together(*cube(np.zeros(3)), *cube(np.array([1.5, 0, 0])))
    whole = np.concatenate([faces, join(vertices, normals, faces, vertices)])
    edges = half_edges(whole)
    assert is_oriented_manifold(whole)
    assert set(map(tuple, edges.tolist())) == set(map(tuple, edges[:, ::-1].tolist()))
    # Euler: V - E + F = 2 for each of two spheres.
    assert len(vertices) - len(edges) // 2 + len(whole) == 4
    assert ((whole < len(vertices) // 2).all(axis=1) | (whole >= len(vertices) // 2).all(axis=1)).all()


def test_free_vertices_are_taken_into_the_mesh():
    vertices, _, faces = patch((0, 0, 0), (1, 0, 0), (0, 1, 0), 4, 4)
    vertices = np.concatenate([vertices, [[0.75, 0.2, 0], [0.75, 0.4, 0]]])
    new = join(vertices, np.tile([0, 0, 1.0], (len(vertices), 1)), faces, plane_of_points(1.0, 0.6))
    assert {16, 17} <= set(new.ravel().tolist())


def test_faces_that_are_not_manifold_are_refused():
    vertices, normals, faces = patch((0, 0, 0), (1, 0, 0), (0, 1, 0), 3, 3)
    with pytest.raises(InputError, match="used twice"):
        join(vertices, normals, np.concatenate([faces, faces[:1]]), vertices)


def test_nothing_joined_is_an_empty_list_of_faces():
    nothing = np.empty((0, 3))
    assert join(nothing, nothing, np.empty((0, 3), np.int64), nothing).shape == (0, 3)


def test_a_large_mesh_needs_more_room_than_was_set_aside():
    rng = np.random.default_rng(0)
    vertices = rng.uniform(0, 3, (1500, 3)) * (1, 1, 0)
    normals = np.tile([0, 0, 1.0], (len(vertices), 1))
    start = np.array([[0, 1, 2]])
    vertices[:3] = [[1, 1, 0], [1.2, 1, 0], [1, 1.2, 0]]
    new = join(vertices, normals, start, vertices)
    assert is_oriented_manifold(np.concatenate([start, new]))
    assert len(new) > 2000


@st.composite
def scenes(draw):
    """Submaps of any size, place and direction, some over each other, and the points that they stand for."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    patches = []
    for _ in range(draw(st.integers(1, 5))):
        right, up, _ = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        rows, columns = rng.integers(2, 6, 2)
        vertices, normals, faces = patch(rng.uniform(0, 0.8, 3), right, up, rows, columns)
        vertices = vertices + rng.normal(0, draw(st.sampled_from([0.0, 0.02, 0.1])), vertices.shape)
        patches.append((vertices, normals, faces))
    vertices, normals, faces = together(*patches)
    free = rng.uniform(0, 1, (draw(st.integers(0, 20)), 3))
    vertices = np.concatenate([vertices, free])
    normals = np.concatenate([normals, np.tile([0, 0, 1.0], (len(free), 1))])
    return vertices, normals, faces, np.concatenate([vertices, rng.uniform(-0.5, 1.5, (300, 3))])


@settings(max_examples=60, deadline=None, derandomize=True)
@given(scenes())
def test_any_submaps_become_an_oriented_manifold_without_new_crossings(scene):
    vertices, normals, faces, points = scene
    new = join(vertices, normals, faces, points)
    whole = np.concatenate([faces, new])
    assert is_oriented_manifold(whole)
    crossing = crossing_pairs(vertices, whole)
    assert (crossing < len(faces)).all()


@settings(max_examples=20, deadline=None, derandomize=True)
@given(scenes())
def test_the_same_submaps_are_joined_the_same_way_each_time(scene):
    assert (join(*scene) == join(*scene)).all()
