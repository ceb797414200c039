# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from g2_recon.reconstruction.flat_submaps import FlatSubmaps, train_submaps
from g2_recon.reconstruction.lattice import Kind

KINDS: list[Kind] = ["rectangular", "hexagonal", "triangular"]
UP = np.array([[0.0, 0.0, 1.0]])


def wall(width: float, height: float, noise: float = 0.01, seed: int = 0) -> np.ndarray:
    """Points (N, 3) on a wall in the plane z = 0 around the origin, 500 a square metre."""
    rng = np.random.default_rng(seed)
    count = int(500 * width * height)
    place = (rng.random((count, 2)) - 0.5) * (width, height)
    return np.column_stack([place, rng.normal(0, noise, count)])


def map_of(
    points: np.ndarray, lattice: Kind = "rectangular", *, thickness: float = 0.01, noise: float = 0.01
) -> FlatSubmaps:
    """The map of one cluster whose plane is z = 0."""
    return train_submaps(
        points,
        np.full(len(points), 1 / 500),
        np.zeros(len(points), np.int64),
        np.zeros((1, 3)),
        UP,
        np.array([thickness]),
        spacing=0.2,
        noise=noise,
        epochs=30,
        lattice=lattice,
    )


def maps_of(parts: list[np.ndarray], normals: np.ndarray, *, workers: int = 1) -> FlatSubmaps:
    """The maps of clusters, each around its own mean; points in random order."""
    points, label = np.concatenate(parts), np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    order = np.random.default_rng(0).permutation(len(points))
    centers = np.array([part.mean(axis=0) for part in parts])
    weights, thickness = np.full(len(points), 1 / 500), np.full(len(parts), 0.01)
    submaps = train_submaps(
        points[order],
        weights,
        label[order],
        centers,
        normals,
        thickness,
        spacing=0.2,
        noise=0.01,
        epochs=30,
        workers=workers,
    )
    assert (submaps.submap[submaps.bmu] == label[order]).all()
    return submaps


def area_vectors(submaps: FlatSubmaps) -> np.ndarray:
    a, b, c = (submaps.vertices[submaps.faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a) / 2


@pytest.mark.parametrize("lattice", KINDS)
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03])
def test_neurons_of_a_noisy_plane_lie_on_the_plane(lattice: Kind, noise: float) -> None:
    submaps = map_of(wall(2, 1, noise), lattice, thickness=noise, noise=noise)
    assert not submaps.bent.any()
    assert submaps.vertices[:, 2] == pytest.approx(0, abs=1e-12)
    assert submaps.normals == pytest.approx(np.tile(UP, (len(submaps.normals), 1)))


@pytest.mark.parametrize("lattice", KINDS)
def test_triangles_cover_the_rectangle_but_for_half_a_cell_and_see_the_free_side(lattice: Kind) -> None:
    submaps = map_of(wall(3, 2), lattice)
    areas = area_vectors(submaps)
    assert (areas[:, 2] > 0).all()
    # Half a cell less at each side is 2.8 m by 1.8 m; zigzag sides of a hexagonal lattice take another quarter.
    assert areas[:, 2].sum() == pytest.approx(2.8 * (1.7 if lattice == "hexagonal" else 1.8), rel=0.04)


@pytest.mark.parametrize(
    ("lattice", "along", "across"),
    [("rectangular", 15 * 10, 10 * 15), ("triangular", 15 * 10, 10 * 15), ("hexagonal", 17 * 10, 11 * 15)],
)
@pytest.mark.parametrize("angle", [0.0, 1.0, 2.0, 3.0])
def test_a_lattice_is_sized_to_the_rectangle_of_its_cluster(
    lattice: Kind, along: int, across: int, angle: float
) -> None:
    """3 m by 2 m at 20 cm: 15 by 10 neurons; rows of a hexagonal lattice are 17.3 cm apart, along either side."""
    points = Rotation.from_rotvec((0, 0, angle)).apply(wall(3, 2))
    assert len(map_of(points, lattice).vertices) in (along, across)


def test_all_neighbors_in_a_hexagonal_lattice_are_about_a_step_off() -> None:
    submaps = map_of(wall(3, 2), "hexagonal")
    sides = submaps.vertices[submaps.faces] - submaps.vertices[np.roll(submaps.faces, 1, axis=1)]
    length = np.linalg.norm(sides, axis=2)
    assert np.median(length) == pytest.approx(0.2, abs=0.01)
    # A diagonal of a square cell would be 28 cm; borders give, as they have data at one side only.
    assert np.quantile(length, 0.9) < 0.24


def test_neurons_of_a_hexagonal_lattice_stay_within_the_rectangle() -> None:
    place = np.abs(map_of(wall(3, 2), "hexagonal").vertices)
    assert (place[:, 0] < 1.5).all()
    assert (place[:, 1] < 1.0).all()


def test_cells_of_a_triangular_lattice_are_cut_one_way_those_of_a_rectangular_one_where_it_is_shorter() -> None:
    points = wall(3, 2)
    points[:, 0] += 0.25 * points[:, 1] ** 2
    cut = {kind: map_of(points, kind) for kind in ("rectangular", "triangular")}
    assert cut["rectangular"].vertices == pytest.approx(cut["triangular"].vertices, abs=1e-9)
    longest = {
        kind: np.linalg.norm(each.vertices[each.faces] - each.vertices[np.roll(each.faces, 1, axis=1)], axis=2).max(
            axis=1
        )
        for kind, each in cut.items()
    }
    assert longest["rectangular"].sum() < longest["triangular"].sum()


@pytest.mark.parametrize("seed", range(3))
def test_neurons_of_a_column_lie_on_its_cylinder(seed: int) -> None:
    """A third of a column of 1 m radius, 1.5 m high, with 5 mm of noise."""
    rng = np.random.default_rng(seed)
    angle, height = rng.uniform(-0.5, 0.5, 1000), rng.uniform(-0.75, 0.75, 1000)
    radius = 1 + rng.normal(0, 0.005, 1000)
    points = np.column_stack([radius * np.sin(angle), height, radius * np.cos(angle)])
    middle = points[:, 2].mean()
    submaps = map_of(points - (0, 0, middle), noise=0.005, thickness=0.03)
    assert submaps.bent.all()
    place = submaps.vertices + (0, 0, middle)
    # What a parabola leaves of a circle over a radian is 2 mm.
    assert np.linalg.norm(place[:, [0, 2]], axis=1) == pytest.approx(1, abs=0.004)
    outwards = place * (1, 0, 1) / np.linalg.norm(place[:, [0, 2]], axis=1)[:, None]
    # cos 4 deg
    assert (np.einsum("vi,vi->v", submaps.normals, outwards) > 0.9976).all()


@pytest.mark.parametrize("lattice", KINDS)
def test_where_a_cluster_is_neither_flat_nor_a_bend_neurons_follow_the_data(lattice: Kind) -> None:
    """A wave of 4 cm with a length of 2 m, thicker than noise explains."""
    points = wall(3, 2, noise=0.002)
    points[:, 2] += 0.04 * np.sin(np.pi * points[:, 0])
    submaps = map_of(points, lattice, thickness=0.03, noise=0.002)
    assert not submaps.bent.any()
    off = submaps.vertices[:, 2] - 0.04 * np.sin(np.pi * submaps.vertices[:, 0])
    # A plane through 60 cm of the wave is off by up to 5 mm at its crests, more at the borders, where it has one side.
    assert np.sqrt(np.mean(off**2)) < 0.006
    slope = -0.04 * np.pi * np.cos(np.pi * submaps.vertices[:, 0])
    assert submaps.normals[:, 0] / submaps.normals[:, 2] == pytest.approx(slope, abs=0.08)


def test_every_point_is_counted_once_and_belongs_to_a_neuron_of_its_cluster() -> None:
    parts = [wall(1, 1) + (0, 0, 5), wall(2, 1, seed=1), wall(0.5, 0.4, seed=2) - (3, 0, 0)]
    submaps = maps_of(parts, np.tile(UP, (3, 1)))
    assert submaps.hits.sum() == sum(len(part) for part in parts)
    assert submaps.hits.tolist() == np.bincount(submaps.bmu, minlength=len(submaps.vertices)).tolist()
    assert (submaps.submap[submaps.faces] == submaps.submap[submaps.faces[:, :1]]).all()


def test_clusters_in_any_attitude_get_maps_in_their_planes() -> None:
    turns = Rotation.random(12, rng=0)
    parts = [turn.apply(wall(1.4, 1, seed=k)) + 10 * k for k, turn in enumerate(turns)]
    normals = turns.apply(UP[0])
    submaps = maps_of(parts, normals)
    off = submaps.vertices - np.array([part.mean(axis=0) for part in parts])[submaps.submap]
    assert np.einsum("vi,vi->v", off, normals[submaps.submap]) == pytest.approx(0, abs=1e-9)
    assert (np.einsum("fi,fi->f", area_vectors(submaps), normals[submaps.submap[submaps.faces[:, 0]]]) > 0).all()


def test_the_result_does_not_depend_on_the_workers() -> None:
    parts = [wall(0.4 + 0.1 * k, 1, seed=k) + 10 * k for k in range(20)]
    one, three = (maps_of(parts, np.tile(UP, (20, 1)), workers=workers) for workers in (1, 3))
    for name in ("vertices", "normals", "center", "faces", "hits", "bmu"):
        np.testing.assert_array_equal(getattr(one, name), getattr(three, name))


def test_coordinates_of_a_million_metres_change_nothing() -> None:
    parts = [wall(1, 2)]
    near, far = maps_of(parts, UP), maps_of([parts[0] + 1e6], UP)
    # Double precision has 0.1 nm left at a million metres; single precision would have 6 cm.
    assert far.vertices - 1e6 == pytest.approx(near.vertices, abs=1e-5)


@pytest.mark.parametrize("lattice", KINDS)
@pytest.mark.parametrize("shape", ["one", "two", "duplicates", "line", "lattice"])
def test_degenerate_clusters_get_maps_of_finite_numbers(lattice: Kind, shape: str) -> None:
    points = {
        "one": np.zeros((1, 3)),
        "two": np.array([[0.0, 0, 0], [1, 0, 0]]),
        "duplicates": np.tile([0.1, 0.2, 0.0], (50, 1)),
        "line": np.linspace(0, 1, 40)[:, None] * (1.0, 1.0, 0.0),
        "lattice": np.stack(np.meshgrid([0, 0.1, 0.2], [0, 0.1, 0.2], [0]), axis=-1).reshape(-1, 3),
    }[shape]
    for thickness in (0.0, 1.0):
        submaps = map_of(points, lattice, thickness=thickness)
        assert np.isfinite(submaps.vertices).all()
        assert np.linalg.norm(submaps.normals, axis=1) == pytest.approx(1)
        assert submaps.hits.sum() == len(points)
        assert submaps.vertices[:, 2] == pytest.approx(0, abs=1e-9)


def test_progress_ends_with_all_clusters() -> None:
    calls = []
    points = np.concatenate([wall(1, 1), wall(1, 1) + (5, 0, 0)])
    label = np.repeat([0, 1], 500)
    train_submaps(
        points,
        np.ones(1000),
        label,
        np.array([[0, 0, 0], [5, 0, 0.0]]),
        np.tile(UP, (2, 1)),
        np.zeros(2),
        spacing=0.2,
        noise=0.01,
        epochs=2,
        progress=lambda *call: calls.append(call),
    )
    assert calls == [("training", 1, 2), ("training", 2, 2)]


@pytest.mark.parametrize("lattice", KINDS)
@pytest.mark.parametrize("turned", [False, True])
def test_the_map_of_a_line_is_half_a_cell_wide_and_covered_on_both_sides(lattice: Kind, turned: bool) -> None:
    rng = np.random.default_rng(0)
    line = np.column_stack([np.linspace(0, 2, 60), np.zeros(60), 0.01 * rng.normal(size=60)])
    submaps = map_of(line[:, [1, 0, 2]] if turned else line, lattice)
    across = submaps.vertices[:, 0 if turned else 1]
    assert np.sort(np.unique(across.round(6))) == pytest.approx([-0.05, 0.05], abs=1e-6)
    assert submaps.covered.all()
    assert submaps.hits.sum() == 60
