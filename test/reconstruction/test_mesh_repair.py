# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from g2_recon.geometry.intersections import crossing_pairs
from g2_recon.geometry.point_grid import point_grid
from g2_recon.reconstruction.mesh_repair import (
    _next_along,
    _take_half_edges,
    border_half_edges,
    bridge_pinches,
    extend_borders,
    fill_small_loops,
    large_pieces,
    remove_crossings,
    split_pinched,
)


def sheet(columns=6, rows=6, step=0.2):
    """A flat sheet of triangles; vertex i * columns + j lies at (j, i) steps."""
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    vertices = step * np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    below = np.column_stack([corner, corner + 1, corner + columns + 1])
    above = np.column_stack([corner, corner + columns + 1, corner + columns])
    return vertices, np.concatenate([below, above])


def half_edges(faces):
    return np.stack([faces.ravel(), np.roll(faces, -1, axis=1).ravel()], axis=1)


def is_oriented_manifold(faces):
    return len(np.unique(half_edges(faces), axis=0)) == faces.size


def fans_per_vertex(faces):
    """How many fans of faces each vertex has, counted by walking from face to face across shared edges."""
    result = {}
    for vertex in np.unique(faces):
        # Each face at the vertex leads from one neighbor to the next one.
        leads = {
            face[(list(face).index(vertex) + 1) % 3]: face[list(face).index(vertex) - 1]
            for face in faces.tolist()
            if vertex in face
        }
        parts = 0
        while leads:
            waiting = [next(iter(leads))]
            parts += 1
            while waiting:
                one = waiting.pop()
                if one in leads:
                    other = leads.pop(one)
                    waiting += [other] + [begin for begin, end in leads.items() if end in (one, other)]
        result[int(vertex)] = parts
    return result


def two_triangles_at_a_point():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [-1, 0, 0], [-1, -1, 0.0]])
    return vertices, np.array([[0, 1, 2], [0, 3, 4]])


class TestPinchedVertices:
    def test_each_fan_gets_its_own_vertex(self):
        vertices, faces = two_triangles_at_a_point()
        _, split, origin = split_pinched(vertices, faces)
        assert not set(split[0]) & set(split[1])
        assert (origin[split] == faces).all()

    def test_the_copies_lie_near_the_vertex_but_apart(self):
        vertices, faces = two_triangles_at_a_point()
        placed, split, origin = split_pinched(vertices, faces)
        moved = np.linalg.norm(placed - vertices[origin], axis=1)
        assert moved.max() < 0.01
        assert np.linalg.norm(placed[split[0, 0]] - placed[split[1, 0]]) > 0.005

    def test_a_mesh_without_pinches_stays_as_it_is(self):
        vertices, faces = sheet()
        placed, split, origin = split_pinched(vertices, faces)
        assert (placed == vertices).all()
        assert (split == faces).all()
        assert (origin == np.arange(len(vertices))).all()

    def test_a_mesh_without_faces_stays_as_it_is(self):
        vertices, _ = sheet()
        placed, split, _ = split_pinched(vertices, np.empty((0, 3), np.int64))
        assert (placed == vertices).all()
        assert split.shape == (0, 3)

    @settings(max_examples=40, deadline=None, derandomize=True)
    @given(st.integers(0, 2**32 - 1))
    def test_any_part_of_a_sheet_becomes_vertex_manifold(self, seed):
        vertices, faces = sheet()
        rng = np.random.default_rng(seed)
        faces = faces[rng.random(len(faces)) < rng.uniform(0.1, 1)]
        placed, split, origin = split_pinched(vertices, faces)
        assert is_oriented_manifold(split)
        assert set(fans_per_vertex(split).values()) <= {1}
        assert (origin[split] == faces).all()
        assert np.isfinite(placed).all()
        assert not len(crossing_pairs(placed, split))


def pieces(faces):
    """How many pieces hang together by edges."""
    edges = np.sort(half_edges(faces), axis=1)
    _, edge = np.unique(edges, axis=0, return_inverse=True)
    # Faces and edges are the nodes, a link for each side.
    face = np.repeat(np.arange(len(faces)), 3)
    size = len(faces) + edge.max() + 1
    links = coo_array((np.ones(len(face)), (face, len(faces) + edge.ravel())), shape=(size, size))
    return connected_components(links, directed=False)[0]


class TestPiecesThatTouch:
    def bridge(self, vertices, faces, points=None):
        grid = point_grid(vertices if points is None else points, cell=0.1)
        return bridge_pinches(vertices, faces, grid, support_distance=0.2)

    def test_two_pieces_at_a_vertex_become_one_by_one_triangle(self):
        vertices, faces = two_triangles_at_a_point()
        new = self.bridge(0.2 * vertices, faces)
        assert len(new) == 1
        whole = np.concatenate([faces, new])
        assert is_oriented_manifold(whole)
        assert pieces(whole) == 1
        assert set(fans_per_vertex(whole).values()) == {1}

    def test_without_data_they_stay_apart(self):
        vertices, faces = two_triangles_at_a_point()
        assert not len(self.bridge(0.2 * vertices, faces, 0.2 * vertices + (0, 0, 1)))

    def test_pieces_that_face_opposite_ways_stay_apart(self):
        vertices, faces = two_triangles_at_a_point()
        faces[1] = faces[1, ::-1]
        assert not len(self.bridge(0.2 * vertices, faces))

    def test_a_pinch_within_one_piece_is_left_alone(self):
        vertices, faces = sheet()
        at_14 = [face for face in faces.tolist() if 14 in face]
        kept = [at_14[0], next(face for face in at_14 if not set(face) & (set(at_14[0]) - {14}))]
        faces = np.array([face for face in faces.tolist() if 14 not in face or face in kept])
        assert pieces(faces) == 1
        assert fans_per_vertex(faces)[14] == 2
        assert not len(self.bridge(vertices, faces))

    @settings(max_examples=40, deadline=None, derandomize=True)
    @given(st.integers(0, 2**32 - 1))
    def test_each_triangle_makes_one_of_two_pieces_or_more_and_crosses_none(self, seed):
        vertices, faces = sheet()
        rng = np.random.default_rng(seed)
        faces = faces[rng.random(len(faces)) < rng.uniform(0.1, 0.6)]
        new = self.bridge(vertices, faces)
        whole = np.concatenate([faces, new])
        assert is_oriented_manifold(whole)
        # The third side of a triangle may be the border of another piece.
        assert pieces(whole) <= pieces(faces) - len(new)
        assert not len(crossing_pairs(vertices, whole))


class TestSmallLoops:
    def fill(self, vertices, faces, points=None, **options):
        grid = point_grid(vertices if points is None else points, cell=0.1)
        return fill_small_loops(vertices, faces, grid, support_distance=0.2, **options)

    def test_a_small_hole_with_data_is_closed(self):
        vertices, faces = sheet()
        holed = faces[~(faces == 14).any(axis=1)]
        whole = np.concatenate([holed, self.fill(vertices, holed)])
        assert is_oriented_manifold(whole)
        assert len(border_half_edges(whole, len(vertices))) == 20

    def test_the_new_faces_look_the_way_of_their_neighbors(self):
        vertices, faces = sheet()
        new = self.fill(vertices, faces[~(faces == 14).any(axis=1)])
        a, b, c = (vertices[new[:, corner]] for corner in range(3))
        assert len(new)
        assert (np.cross(b - a, c - a)[:, 2] > 0).all()

    def test_a_hole_without_data_stays_open(self):
        vertices, faces = sheet(step=0.5)
        holed = faces[~(faces == 14).any(axis=1)]
        assert len(self.fill(vertices, holed, vertices[np.unique(holed)])) == 0

    def test_a_hole_with_too_many_edges_stays_open(self):
        vertices, faces = sheet()
        holed = faces[~(faces == 14).any(axis=1)]
        assert len(self.fill(vertices, holed, max_edges=5)) == 0

    def test_a_face_alone_gets_no_back(self):
        vertices = np.array([[0, 0, 0], [0.2, 0, 0], [0, 0.2, 0.0]])
        assert len(self.fill(vertices, np.array([[0, 1, 2]]))) == 0

    def test_a_bulge_with_many_edges_around_it_gets_no_back(self):
        def ring(count, radius, height):
            angle = np.arange(count) * 2 * np.pi / count
            return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)])

        vertices = np.concatenate([ring(16, 0.4, 0.0), ring(8, 0.2, 0.1), [[0, 0, 0.15]]])
        faces = [
            triangle
            for i, j in zip(range(8), [*range(1, 8), 0], strict=True)
            for triangle in (
                [2 * i, 2 * i + 1, 16 + i],
                [2 * i + 1, 2 * j, 16 + j],
                [2 * i + 1, 16 + j, 16 + i],
                [16 + i, 16 + j, 24],
            )
        ]
        on_the_back = np.concatenate([ring(16, radius, 0.0) for radius in (0.0, 0.1, 0.2, 0.3, 0.4)])
        assert len(self.fill(vertices, np.array(faces), on_the_back, max_edges=16)) == 0

    def test_the_end_of_a_column_gets_no_lid(self):
        angle = np.arange(6) * np.pi / 3
        ring = 0.1 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
        vertices = np.concatenate([ring, ring + (0, 0, 0.2)])
        a, b = np.arange(6), (np.arange(6) + 1) % 6
        faces = np.concatenate([np.stack([a, b, b + 6], axis=1), np.stack([a, b + 6, a + 6], axis=1)])
        assert len(self.fill(vertices, faces)) == 0

    def test_a_hole_with_a_flap_is_closed_to_the_flap_and_not_on_its_back(self):
        vertices, faces = sheet()
        vertices = vertices.copy()
        vertices[14, 2] = 0.2
        flap = faces[(faces == 14).any(axis=1)][:1]
        holed = np.concatenate([faces[~(faces == 14).any(axis=1)], flap])
        new = self.fill(vertices, holed)
        assert not any(set(face) == set(flap[0]) for face in new.tolist())
        whole = np.concatenate([holed, new])
        assert is_oriented_manifold(whole)
        assert len(border_half_edges(whole, len(vertices))) == 20

    def test_a_slit_is_closed_whichever_way_its_surroundings_look(self):
        vertices, faces = sheet()
        # The edge from 14 to 15 becomes a step down.
        beyond = vertices[faces].mean(axis=1)[:, 1] > vertices[14, 1]
        slit = faces.copy()
        slit[beyond] = np.where(faces == 14, 36, np.where(faces == 15, 37, faces))[beyond]
        vertices = np.concatenate([vertices, vertices[[14, 15]] - [0, 0, 0.004]])
        assert len(border_half_edges(slit, len(vertices))) == 26
        whole = np.concatenate([slit, self.fill(vertices, slit)])
        assert is_oriented_manifold(whole)
        assert len(border_half_edges(whole, len(vertices))) == 20

    def test_two_holes_that_touch_in_a_vertex_are_both_closed(self):
        vertices, faces = sheet()
        holes = [[14, 15, 21], [21, 22, 28], [21, 28, 27]]
        holed = np.array([face for face in faces.tolist() if face not in holes])
        whole = np.concatenate([holed, self.fill(vertices, holed)])
        assert is_oriented_manifold(whole)
        assert len(whole) == len(faces)

    def test_a_hole_with_something_in_it_is_not_closed_across_it(self):
        vertices, faces = sheet()
        holed = faces[~(faces == 14).any(axis=1)]
        through = np.array([[0.4, 0.4, -0.3], [0.41, 0.43, 0.3], [0.44, 0.41, 0.3]])
        both = np.concatenate([vertices, through])
        mesh = np.concatenate([holed, [[36, 37, 38]]])
        assert not (self.fill(both, mesh) < 36).all(axis=1).any()

    @settings(max_examples=40, deadline=None, derandomize=True)
    @given(st.integers(0, 2**32 - 1))
    def test_any_holes_leave_an_oriented_manifold_without_crossings(self, seed):
        rng = np.random.default_rng(seed)
        vertices, faces = sheet()
        vertices = vertices + rng.normal(0, 0.01, vertices.shape)
        holed = faces[rng.random(len(faces)) < rng.uniform(0.5, 1)]
        whole = np.concatenate([holed, self.fill(vertices, holed)])
        assert is_oriented_manifold(whole)
        assert len(whole) >= len(holed)
        assert not len(crossing_pairs(vertices, whole))


class TestCrossings:
    def two_sheets(self):
        """A floor, and a wall that has grown 10 cm through it; home is where the wall ends 5 cm above it."""
        floor, faces = sheet()
        wall, wall_faces = sheet()
        wall = wall[:, [0, 2, 1]] + (0.03, 0.51, 0.05)
        home = np.concatenate([floor, wall])
        moved = home.copy()
        moved[36:42, 2] = -0.1
        return moved, np.concatenate([faces, wall_faces + 36]), home

    def test_vertices_that_went_too_far_go_back_and_no_face_is_lost(self):
        vertices, faces, home = self.two_sheets()
        assert len(crossing_pairs(vertices, faces))
        mended, keep = remove_crossings(vertices, faces, home)
        assert keep.all()
        assert not len(crossing_pairs(mended, faces))
        assert (mended[:36] == home[:36]).all()

    def test_faces_that_cross_at_home_too_are_dropped(self):
        vertices, faces, _ = self.two_sheets()
        mended, keep = remove_crossings(vertices, faces, vertices)
        assert (mended == vertices).all()
        assert 0 < (~keep).sum() <= 11
        assert not len(crossing_pairs(vertices, faces[keep]))

    def test_one_face_through_many_is_dropped_and_not_the_many(self):
        vertices, faces = sheet()
        through = np.array([[0.1, 0.31, -0.2], [0.9, 0.31, -0.2], [0.5, 0.33, 0.3]])
        both = np.concatenate([vertices, through])
        _, keep = remove_crossings(both, np.concatenate([faces, [[36, 37, 38]]]), both)
        assert np.flatnonzero(~keep).tolist() == [len(faces)]


class TestBorders:
    def data(self, low, high, step=0.02):
        along = np.arange(low, high + 1e-9, step)
        x, y = np.meshgrid(along, along)
        return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])

    def extend(self, vertices, faces, points):
        normals = np.tile([0, 0, 1.0], (len(vertices), 1))
        owner = np.argmin(np.linalg.norm(points[:, None] - vertices, axis=2), axis=1)
        neighbors = cKDTree(points).query(points, k=9)[1].astype(np.int32)
        return extend_borders(vertices, faces, normals, points, neighbors, owner, limit=0.18)

    @pytest.mark.parametrize("step", [0.02, 0.04])
    def test_the_border_moves_out_to_its_data_and_one_gap_of_it(self, step):
        vertices, faces = sheet()
        moved = self.extend(vertices, faces, self.data(-0.1, 1.1, step))
        # The last row of data lies at 0.1 m, the 98 % quantile of it and the rows before less than half a step below.
        assert (-0.1 - step <= moved[1:5, 1]).all()
        assert (moved[1:5, 1] <= -0.1 - step / 2).all()

    def test_beyond_the_data_the_border_moves_at_most_by_a_third_of_the_limit(self):
        vertices, faces = sheet()
        data = self.data(-0.05, 1.05, 0.18)
        moved = self.extend(vertices, faces, data)
        assert (np.linalg.norm(moved - vertices, axis=1) < 0.05 + 0.35 * 0.18 + 1e-9).all()

    def test_the_inside_stays(self):
        vertices, faces = sheet()
        moved = self.extend(vertices, faces, self.data(-0.1, 1.1))
        inside = np.setdiff1d(np.arange(36), border_half_edges(faces, 36))
        assert (moved[inside] == vertices[inside]).all()

    def test_the_border_moves_at_most_by_the_limit(self):
        vertices, faces = sheet()
        moved = self.extend(vertices, faces, self.data(-0.6, 1.6))
        assert np.linalg.norm(moved - vertices, axis=1).max() == pytest.approx(0.18)

    def test_a_border_vertex_without_data_stays(self):
        vertices, faces = sheet()
        far, owner, none = np.zeros((5, 3)), np.full(5, -1), np.zeros((5, 8), np.int32)
        moved = extend_borders(vertices, faces, np.tile([0, 0, 1.0], (36, 1)), far, none, owner, limit=0.18)
        assert (moved == vertices).all()

    def test_a_crease_vertex_goes_along_its_crease_with_its_neighbors(self):
        flat, faces = sheet(columns=3, rows=3)
        folded = flat.copy()
        folded[[2, 5, 8]] = folded[[1, 4, 7]] + (0, 0, 0.2)
        normals = np.zeros((9, 3))
        normals[[0, 3, 6]], normals[[2, 5, 8]] = (0, 0, 1), (-1, 0, 0)
        points = np.repeat(folded[[0, 2]], 3, axis=0) - (0, 0.1, 0)
        alone = np.arange(6, dtype=np.int32)[:, None]
        moved = extend_borders(folded, faces, normals, points, alone, np.repeat([0, 2], 3), limit=0.18)
        step = (moved - folded)[[0, 1, 2]]
        assert step[1, [0, 2]] == pytest.approx([0, 0], abs=1e-12)
        assert step[1, 1] == pytest.approx(0.5 * (step[0, 1] + step[2, 1]))
        assert step[1, 1] < -0.04


def test_the_next_point_along_a_direction_is_within_45_deg_of_it():
    rng = np.random.default_rng(0)
    points, neighbors = rng.random((200, 3)), rng.integers(0, 200, (200, 8)).astype(np.int32)
    rows, direction = np.arange(0, 200, 3), rng.normal(size=(5, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    owner = rng.integers(0, 5, len(rows))
    step = points[neighbors[rows]] - points[rows, None]
    along = np.abs(np.einsum("nki,ni->nk", step, direction[owner]))
    ahead = along * np.sqrt(2) > np.linalg.norm(step, axis=2)
    expected = np.where(ahead, along, np.inf).min(axis=1)
    assert _next_along(points, neighbors, rows, owner, direction) == pytest.approx(expected)


def test_small_pieces_are_told_from_large_ones():
    vertices, faces = sheet()
    small = np.array([[3, 0, 0], [3.1, 0, 0], [3, 0.1, 0]])
    both = np.concatenate([vertices, small])
    large = large_pieces(both, np.concatenate([faces, [[36, 37, 38]]]), least_area=0.1)
    assert large.tolist() == [True] * len(faces) + [False]


def test_a_face_alone_is_no_large_piece_where_two_are_asked_for():
    vertices, faces = sheet()
    both = np.concatenate([vertices, np.array([[3, 0, 0], [4, 0, 0], [3, 1, 0]])])
    large = large_pieces(both, np.concatenate([faces, [[36, 37, 38]]]), least_area=0.1, least_faces=2)
    assert large.tolist() == [True] * len(faces) + [False]


def test_pieces_that_touch_in_a_vertex_are_two():
    vertices, faces = two_triangles_at_a_point()
    vertices[3:] *= 0.1
    assert large_pieces(vertices, faces, least_area=0.1).tolist() == [True, False]


def some_pieces(seed):
    """Parts of a sheet and of a copy of it that lies apart, and how much area each piece has by scipy's components."""
    vertices, faces = sheet(columns=9, rows=9)
    rng = np.random.default_rng(seed)
    faces = np.concatenate([faces, faces + len(vertices)])
    faces = faces[rng.random(len(faces)) < 0.5]
    half = {tuple(half_edge): i // 3 for i, half_edge in enumerate(half_edges(faces).tolist())}
    links = np.array([(face, half[end, begin]) for (begin, end), face in half.items() if (end, begin) in half])
    graph = coo_array((np.ones(len(links)), links.T), shape=(len(faces), len(faces)))
    return np.concatenate([vertices, vertices + (0, 0, 1)]), faces, connected_components(graph, directed=False)[1]


@pytest.mark.parametrize("seed", range(5))
def test_a_piece_is_what_hangs_together_by_edges(seed):
    vertices, faces, piece = some_pieces(seed)
    expected = np.bincount(piece)[piece] >= 5
    assert 0 < expected.sum() < len(faces)
    # Each face has 0.02 square metres.
    assert large_pieces(vertices, faces, least_area=0.09).tolist() == expected.tolist()


@pytest.mark.parametrize("seed", range(5))
def test_loops_take_their_half_edges_one_after_the_other(seed):
    rng = np.random.default_rng(seed)
    begin = np.cumsum(np.concatenate([[0], rng.integers(1, 5, 20)]))
    wanted, accepted = rng.integers(0, 80, begin[-1]), rng.random(20) < 0.8
    used = rng.random(80) < 0.1
    taken, expected = set(np.flatnonzero(used).tolist()), []
    for loop in range(20):
        mine = wanted[begin[loop] : begin[loop + 1]].tolist()
        good = bool(accepted[loop]) and len(set(mine)) == len(mine) and taken.isdisjoint(mine)
        taken.update(mine if good else [])
        expected.append(good)
    assert 0 < sum(expected) < accepted.sum()
    assert _take_half_edges(wanted, begin, accepted, used).tolist() == expected
