# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from g2_recon.config import ReconstructionConfig
from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud
from g2_recon.reconstruction.reconstructor import reconstruct

PAPER_CUBES = {"clusters": 12, "rows": 10, "columns": 5}


def components(wire):
    """Connected part (V,) of each neuron."""
    count = len(wire.vertices)
    graph = coo_array((np.ones(len(wire.edges)), wire.edges.T), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def parts_by_cube(wire):
    part, left = components(wire), wire.vertices[:, 0] < 1.25
    return set(part[left].tolist()), set(part[~left].tolist())


@pytest.mark.parametrize("training", ["iterative", "batch"])
@pytest.mark.parametrize("seed", range(10))
def test_two_cubes_become_two_connected_graphs_with_no_join_between_them(two_cubes, training, seed):
    # A tenth of the published passes is enough for these 1452 points; the full schedule has a test of its own.
    published = ReconstructionConfig(mode="paper", training=training, passes=1000, seed=seed, **PAPER_CUBES)
    left, right = parts_by_cube(reconstruct(two_cubes, published).wire_mesh)
    assert (len(left), len(right)) == (1, 1)
    assert left != right


def test_two_cubes_with_the_published_schedule(two_cubes):
    result = reconstruct(two_cubes, ReconstructionConfig(mode="paper", **PAPER_CUBES))
    left, right = parts_by_cube(result.wire_mesh)
    assert (len(left), len(right)) == (1, 1)
    assert left != right
    assert result.quantization_error < 0.08


@pytest.mark.parametrize("seed", range(3))
def test_two_cubes_become_two_closed_surfaces(two_cubes, seed):
    mesh = reconstruct(two_cubes, ReconstructionConfig(spacing=0.15, seed=seed)).mesh
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.body_count == 2
    assert solid.is_watertight
    assert solid.is_winding_consistent
    # Two unit cubes, seen from outside.
    assert solid.volume == pytest.approx(2, rel=0.01)


def test_one_single_map_over_both_cubes_cannot_separate_them(two_cubes):
    """The paper's figure 6."""
    single = ReconstructionConfig(mode="paper", passes=1000, clusters=1, rows=20, columns=30, cluster_gap=1000)
    wire = reconstruct(two_cubes, single).wire_mesh
    left, right = parts_by_cube(wire)
    assert left == right
    x = wire.vertices[wire.edges][:, :, 0]
    assert ((x.min(axis=1) < 1.05) & (x.max(axis=1) > 1.45)).any() or ((x > 1.05) & (x < 1.45)).any()


@pytest.mark.parametrize(("mode", "off_m"), [("solid", 0.003), ("paper", 0.05)])
def test_neurons_lie_on_the_surface_and_faces_look_into_the_room(corner, mode, off_m):
    result = reconstruct(corner, ReconstructionConfig(mode=mode, clusters=20, passes=20))
    assert np.abs(result.wire_mesh.vertices).min(axis=1).mean() < off_m
    middle = result.mesh.vertices[result.mesh.faces].mean(axis=1)
    inwards = np.einsum("ij,ij->i", result.mesh.face_normals(), (2.0, 1.5, 1.2) - middle) > 0
    assert inwards.mean() > 0.95


def test_the_edges_of_a_room_are_sharp(corner):
    vertices = reconstruct(corner, ReconstructionConfig()).mesh.vertices
    on_both = (np.abs(vertices) < 0.005).sum(axis=1) >= 2
    # 4 + 3 + 2.5 m of edges at 20 cm.
    assert on_both.sum() > 30
    assert np.linalg.norm(vertices, axis=1).min() < 0.01


def test_a_solid_mesh_is_manifold_and_consistently_oriented(corner):
    faces = reconstruct(corner, ReconstructionConfig()).mesh.faces
    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    assert len(np.unique(directed, axis=0)) == len(directed)
    assert np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)[1].max() <= 2


def test_a_door_stays_open():
    rng = np.random.default_rng(0)
    wall = np.column_stack([np.zeros(9000), 5 * rng.random(9000), 2.5 * rng.random(9000)])
    door = (np.abs(wall[:, 1] - 2.5) < 0.45) & (wall[:, 2] < 2.0)
    points = wall[~door] + rng.normal(0, 0.01, (np.count_nonzero(~door), 3))
    mesh = reconstruct(Cloud(points, np.tile([3.0, 2.5, 1.0], (len(points), 1))), ReconstructionConfig()).mesh
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    assert not ((np.abs(middle[:, 1] - 2.5) < 0.3) & (middle[:, 2] < 1.8)).any()
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.area == pytest.approx(5 * 2.5 - 0.9 * 2.0, rel=0.05)


def test_the_result_does_not_depend_on_the_number_of_workers(corner):
    for mode in ("solid", "paper"):
        one, four = (
            reconstruct(corner, ReconstructionConfig(mode=mode, passes=5, clusters=8, workers=workers)).mesh
            for workers in (1, 4)
        )
        assert one.vertices.tolist() == four.vertices.tolist()
        assert one.faces.tolist() == four.faces.tolist()


@pytest.mark.parametrize("mode", ["solid", "paper"])
def test_the_parts_of_a_result_fit_together(corner, mode):
    result = reconstruct(corner, ReconstructionConfig(mode=mode, clusters=20, passes=5))
    wire, mesh = result.wire_mesh, result.mesh
    assert wire.edges.max() < len(wire.vertices) == len(wire.submap)
    assert (wire.submap[wire.edges[:, 0]] != wire.submap[wire.edges[:, 1]]).tolist() == wire.join.tolist()
    assert mesh.faces.max() < len(mesh.vertices)
    assert len(mesh.submap) == len(mesh.faces)
    assert 0 <= mesh.submap.min() <= mesh.submap.max() < result.clusters
    assert np.isfinite(mesh.vertices).all()


def test_published_submaps_have_the_neurons_that_were_asked_for(corner):
    result = reconstruct(corner, ReconstructionConfig(mode="paper", clusters=20, rows=7, columns=4, passes=5))
    assert len(result.wire_mesh.vertices) == 28 * result.clusters
    assert (result.wire_mesh.submap[result.mesh.faces] == result.mesh.submap[:, None]).all()


@pytest.mark.parametrize(
    ("mode", "expected"),
    [
        ("paper", ["clustering", "training", "joining", "re-optimization", "triangulation"]),
        ("solid", ["normals", "clustering", "training", "joining"]),
    ],
)
def test_progress_runs_through_the_phases_in_order(corner, mode, expected):
    seen = []
    settings_ = ReconstructionConfig(mode=mode, clusters=20, passes=50)
    reconstruct(corner, settings_, progress=lambda stage, done, total: seen.append((stage, done / total)))
    assert list(dict.fromkeys(stage for stage, _ in seen)) == expected
    assert all(max(share for name, share in seen if name == stage) == 1 for stage in expected)


def test_small_clouds_get_fewer_clusters_than_asked(two_cubes):
    result = reconstruct(two_cubes, ReconstructionConfig(mode="paper", passes=5, clusters=1000))
    assert result.clusters <= len(two_cubes) // 50 + 5


def test_without_joins_or_borders_the_maps_stay_as_trained(two_cubes):
    for settings_ in ({"theta": 0.0}, {"border_width": 0}):
        result = reconstruct(two_cubes, ReconstructionConfig(mode="paper", passes=5, clusters=12, **settings_))
        assert np.isfinite(result.wire_mesh.vertices).all()


def test_points_of_the_robot_itself_and_broken_points_are_left_out_and_counted(corner):
    points, sensor = corner.points.copy(), corner.sensor.copy()
    points[:5] = np.nan
    points[5:12] = sensor[5:12] + (0.05, 0, 0)
    result = reconstruct(Cloud(points, sensor), ReconstructionConfig())
    assert result.left_out["not finite"] == 5
    assert result.left_out["nearer to the sensor than min_sensor_distance"] == 7
    assert result.points == len(points) - sum(result.left_out.values())


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (np.empty((0, 3)), "0 distinct usable points"),
        (np.random.default_rng(0).random((3, 3)), "3 distinct usable points"),
        (np.ones((1000, 3)), "1 distinct usable points"),
        (np.full((100, 3), np.nan), "0 distinct usable points"),
        (np.linspace(0, 1, 300).reshape(100, 3) @ np.ones((3, 3)), "one line"),
    ],
    ids=["empty", "three points", "all equal", "all NaN", "collinear"],
)
def test_a_cloud_that_holds_no_surface_is_refused_in_one_line(points, said):
    with pytest.raises(InputError, match=said) as error:
        reconstruct(Cloud(points), ReconstructionConfig())
    assert "\n" not in str(error.value)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    arrays(
        np.float64,
        st.tuples(st.integers(0, 150), st.just(3)),
        elements=st.floats(-1e6, 1e6) | st.sampled_from([0.0, 1.0]),
    ),
    st.integers(1, 6),
    st.sampled_from(["solid", "paper"]),
)
def test_any_cloud_gives_a_finite_mesh_or_an_input_error(points, clusters, mode):
    config = ReconstructionConfig(mode=mode, clusters=clusters, rows=3, columns=2, passes=3)
    try:
        result = reconstruct(Cloud(points, points + 5), config)
    except InputError:
        return
    assert np.isfinite(result.mesh.vertices).all()
    assert np.isfinite(result.quantization_error)
