# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import itertools

import numpy as np
import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from g2_recon.config import ReconstructionConfig
from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud
from g2_recon.reconstruction.paper import build_submaps, initial_clustering
from g2_recon.reconstruction.reconstructor import reconstruct
from g2_recon.reconstruction.som import topographic_error

CLUSTERINGS = ["k_means", "neural_gas"]
LATTICES = ["rectangular", "hexagonal", "triangular"]


def paper(**values):
    return ReconstructionConfig(mode="paper", **values)


def check(result):
    """What holds for any result."""
    wire, mesh = result.wire_mesh, result.mesh
    assert np.isfinite(wire.vertices).all()
    assert np.isfinite(result.quantization_error)
    assert (wire.submap[wire.edges[:, 0]] != wire.submap[wire.edges[:, 1]]).tolist() == wire.join.tolist()
    assert (wire.submap[mesh.faces] == mesh.submap[:, None]).all()
    assert len(np.unique(np.sort(wire.edges, axis=1), axis=0)) == len(wire.edges)


@pytest.mark.parametrize(("clustering", "lattice"), list(itertools.product(CLUSTERINGS, LATTICES)))
def test_no_variant_joins_the_two_cubes(two_cubes, clustering, lattice):
    result = reconstruct(two_cubes, paper(clusters=12, clustering=clustering, lattice=lattice, passes=100))
    check(result)
    # The free space between the cubes is from 1 m to 1.5 m.
    left = result.wire_mesh.vertices[result.wire_mesh.edges][:, :, 0] < 1.25
    assert (left[:, 0] == left[:, 1]).all()
    assert result.wire_mesh.join.any()


@pytest.mark.parametrize("clustering", CLUSTERINGS)
def test_no_cluster_spans_the_two_cubes(two_cubes, clustering):
    label = initial_clustering(two_cubes.points, paper(clusters=12, clustering=clustering))
    left = two_cubes.points[:, 0] < 1.25
    assert not set(label[left]) & set(label[~left])
    assert len(set(label)) == 12


@pytest.mark.parametrize("lattice", LATTICES)
def test_a_submap_has_the_meshes_of_its_lattice(corner, lattice):
    result = reconstruct(corner, paper(clusters=8, lattice=lattice, rows=6, columns=4, passes=5))
    check(result)
    assert len(result.mesh.faces) == 2 * 5 * 3 * result.clusters
    within = ~result.wire_mesh.join
    edges = 5 * 4 + 6 * 3 + (0 if lattice == "rectangular" else 5 * 3)
    assert np.count_nonzero(within) == edges * result.clusters
    submap = result.wire_mesh.submap[result.wire_mesh.edges[within]]
    assert (submap[:, 0] == submap[:, 1]).all()


@pytest.mark.parametrize("lattice", LATTICES)
def test_trained_submaps_keep_the_order_of_their_lattice(corner, lattice):
    config = paper(clusters=4, lattice=lattice, passes=200)
    label = initial_clustering(corner.points, config)
    submaps = build_submaps(corner.points, label, config)
    # In a rectangular lattice the second nearest neuron may be the one across a cell, which is no neighbor.
    assert topographic_error(corner.points, submaps.weights, submaps.edges) < (
        0.35 if lattice == "rectangular" else 0.15
    )


def test_the_border_gets_as_many_passes_as_the_submaps_unless_told_otherwise(two_cubes):
    same, equal, more = (
        reconstruct(two_cubes, paper(clusters=12, passes=100, border_passes=border)).wire_mesh.vertices
        for border in (0, 100, 150)
    )
    assert same.tolist() == equal.tolist()
    assert same.tolist() != more.tolist()


def test_the_quantization_error_is_that_of_the_final_neurons(two_cubes):
    result = reconstruct(two_cubes, paper(clusters=12, passes=20))
    nearest = np.linalg.norm(two_cubes.points[:, None] - result.wire_mesh.vertices[None], axis=2).min(axis=1)
    assert result.quantization_error == pytest.approx(nearest.mean())


def sheet(count, *, seed=0):
    return np.random.default_rng(seed).random((count, 3)) * (2, 1, 0.01)


@pytest.mark.parametrize("clustering", CLUSTERINGS)
@pytest.mark.parametrize("lattice", LATTICES)
@pytest.mark.parametrize(
    "cloud",
    [
        Cloud(sheet(20)),
        Cloud(np.repeat(sheet(15), 40, axis=0)),
        Cloud(sheet(500)),
        Cloud(sheet(500) * (1, 1, 0)),
        Cloud(sheet(2000) + 1e6),
        Cloud(sheet(2000) - 1e6, np.full((2000, 3), -1e6)),
        Cloud(np.concatenate([sheet(500), [[1e5, 1e5, 1e5]]])),
    ],
    ids=["fewer than neurons", "duplicated", "without sensor", "flat", "far off", "far off, seen", "a stray"],
)
def test_odd_clouds_are_reconstructed(cloud, lattice, clustering):
    config = paper(lattice=lattice, clustering=clustering, passes=5, presentations=500, min_sensor_distance=0)
    result = reconstruct(cloud, config)
    check(result)
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    # Single precision over 100 km is good to a centimetre.
    assert (result.wire_mesh.vertices > low - 0.02).all()
    assert (result.wire_mesh.vertices < high + 0.02).all()


def test_one_cluster_has_nothing_to_join():
    result = reconstruct(Cloud(sheet(500)), paper(clusters=1, passes=5))
    assert result.clusters == 1
    assert not result.wire_mesh.join.any()
    check(result)


@pytest.mark.parametrize("offset", [0, 1e6])
def test_points_on_a_line_are_refused(offset):
    line = np.linspace(0, 1, 300)[:, None] * (1, 2, 3) + offset
    with pytest.raises(InputError, match="one line"):
        reconstruct(Cloud(line), paper(passes=1))


@st.composite
def clouds(draw):
    """Points anywhere, or on few places, a plane or nearly a line, at home or far off; seen from somewhere or not."""
    count = draw(st.integers(0, 120))
    far = draw(st.sampled_from([1.0, 100.0, 1e6]))
    elements = st.floats(-far, far) | st.sampled_from([0.0, 1.0, -1.0])
    if draw(st.booleans()):
        points = draw(arrays(np.float64, (count, 3), elements=elements))
    else:
        points = far * np.random.default_rng(draw(st.integers(0, 9))).random((count, 3))
    points = points * draw(st.sampled_from([(1, 1, 1), (1, 1, 0), (1, 1e-3, 0), (1, 0, 0)]))
    points = np.repeat(points, draw(st.sampled_from([1, 1, 5])), axis=0) + draw(st.sampled_from([0.0, 1e6]))
    return Cloud(points, points + 5 if draw(st.booleans()) else None)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    clouds(),
    st.fixed_dictionaries(
        {
            "clustering": st.sampled_from(CLUSTERINGS),
            "lattice": st.sampled_from(LATTICES),
            "training": st.sampled_from(["iterative", "batch"]),
            "clusters": st.integers(1, 8),
            "rows": st.integers(2, 4),
            "columns": st.integers(2, 4),
            "passes": st.integers(1, 3),
            "epochs": st.integers(1, 3),
            "presentations": st.integers(1, 300),
            "theta": st.sampled_from([0.0, 1.8, 10.0]),
            "border_width": st.integers(0, 3),
            "cluster_gap": st.sampled_from([0.001, 0.4, 1000.0]),
            "seed": st.integers(0, 3),
        }
    ),
)
def test_any_cloud_gives_a_sound_result_or_an_input_error(cloud, values):
    try:
        result = reconstruct(cloud, paper(**values))
    except InputError as error:
        assert "\n" not in str(error)
        event("refused")
        return
    event("with joins" if result.wire_mesh.join.any() else "without joins")
    check(result)
