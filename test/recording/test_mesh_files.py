# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud
from g2_recon.geometry.mesh import Mesh, WireMesh
from g2_recon.recording.clouds import read_cloud, write_cloud
from g2_recon.recording.meshes import MESH_ENDINGS, read_mesh, write_mesh, write_wire_mesh

TETRAHEDRON = Mesh(
    vertices=np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    faces=np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
    submap=np.array([0, 0, 7, 7]),
)
WIRE = WireMesh(
    vertices=np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0.1]]),
    edges=np.array([[0, 1], [1, 2]]),
    submap=np.array([0, 0, 1]),
    join=np.array([False, True]),
)


@pytest.mark.parametrize("ending", MESH_ENDINGS)
def test_triangles_come_back(tmp_path: Path, ending: str) -> None:
    write_mesh(tmp_path / f"m{ending}", TETRAHEDRON)
    vertices, faces = read_mesh(tmp_path / f"m{ending}")
    np.testing.assert_array_equal(vertices[faces], TETRAHEDRON.vertices[TETRAHEDRON.faces])


@pytest.mark.parametrize("ending", MESH_ENDINGS)
def test_a_closed_surface_stays_closed(tmp_path: Path, ending: str) -> None:
    write_mesh(tmp_path / f"m{ending}", TETRAHEDRON)
    vertices, faces = read_mesh(tmp_path / f"m{ending}")
    assert trimesh.Trimesh(vertices, faces, process=False).is_watertight


def test_a_ply_keeps_double_coordinates(tmp_path: Path) -> None:
    far = TETRAHEDRON.vertices * 0.0123456789 + (448_262.1, 5_411_932.7, 120.0)
    write_mesh(tmp_path / "m.ply", Mesh(far, TETRAHEDRON.faces, TETRAHEDRON.submap))
    np.testing.assert_array_equal(read_mesh(tmp_path / "m.ply")[0], far)


@pytest.mark.parametrize("ending", [".ply", ".obj", ".stl", ".glb"])
def test_utm_coordinates_keep_their_millimetres(tmp_path: Path, ending: str) -> None:
    far = Mesh(TETRAHEDRON.vertices * 1.2345 + (448_262.1, 5_411_932.7, 120.0), TETRAHEDRON.faces, TETRAHEDRON.submap)
    write_mesh(tmp_path / f"m{ending}", far)
    vertices, faces = read_mesh(tmp_path / f"m{ending}")
    corners = np.sort(vertices[faces].reshape(-1, 3), axis=0)
    # A float of some metres is exact to a micrometre.
    np.testing.assert_allclose(corners, np.sort(far.vertices[far.faces].reshape(-1, 3), axis=0), rtol=0, atol=1e-5)


def test_a_glb_tells_every_reader_where_it_lies(tmp_path: Path) -> None:
    far = Mesh(TETRAHEDRON.vertices + 5e6, TETRAHEDRON.faces, TETRAHEDRON.submap)
    write_mesh(tmp_path / "m.glb", far)
    bounds = trimesh.load_scene(tmp_path / "m.glb").bounds
    np.testing.assert_allclose(bounds, [far.vertices.min(axis=0), far.vertices.max(axis=0)], rtol=0, atol=1e-5)


def test_an_stl_relative_to_an_origin_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_mesh(tmp_path / "m.stl", Mesh(TETRAHEDRON.vertices + 5e6, TETRAHEDRON.faces, TETRAHEDRON.submap))
    assert "relative to [5000" in caplog.text


def test_a_broken_origin_in_an_stl_is_told(tmp_path: Path) -> None:
    write_mesh(tmp_path / "m.stl", Mesh(TETRAHEDRON.vertices + 5e6, TETRAHEDRON.faces, TETRAHEDRON.submap))
    content = (tmp_path / "m.stl").read_bytes()
    (tmp_path / "m.stl").write_bytes(b"g2_recon origin m: 1 two".ljust(80) + content[80:])
    with pytest.raises(InputError, match="no sound mesh"):
        read_mesh(tmp_path / "m.stl")


def test_the_header_of_a_ply_is_as_other_readers_expect(tmp_path: Path) -> None:
    write_mesh(tmp_path / "m.ply", TETRAHEDRON)
    assert (tmp_path / "m.ply").read_bytes().split(b"end_header")[0].decode().splitlines()[2:] == [
        "element vertex 4",
        *(f"property double {axis}" for axis in "xyz"),
        "element face 4",
        "property list uchar int vertex_indices",
        "property int submap",
    ]


def test_the_vertices_of_a_mesh_are_a_cloud(tmp_path: Path) -> None:
    write_mesh(tmp_path / "m.ply", TETRAHEDRON)
    np.testing.assert_array_equal(read_cloud(tmp_path / "m.ply").points, TETRAHEDRON.vertices)


def test_a_mesh_without_faces_is_written(tmp_path: Path) -> None:
    write_mesh(tmp_path / "m.ply", Mesh(np.empty((0, 3)), np.empty((0, 3), int), np.empty(0, int)))
    assert b"element face 0" in (tmp_path / "m.ply").read_bytes()


def test_a_ply_keeps_the_submap_of_each_face(tmp_path: Path) -> None:
    write_mesh(tmp_path / "m.ply", TETRAHEDRON)
    raw = trimesh.load_mesh(tmp_path / "m.ply", process=False).metadata["_ply_raw"]
    assert raw["face"]["data"]["submap"].tolist() == [0, 0, 7, 7]


def test_the_ending_may_be_in_capitals(tmp_path: Path) -> None:
    write_mesh(tmp_path / "m.STL", TETRAHEDRON)
    assert len(read_mesh(tmp_path / "m.STL")[1]) == 4


def test_an_unknown_ending_is_told_with_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.ply, \.obj, \.stl, \.glb"):
        write_mesh(tmp_path / "m.doc", TETRAHEDRON)


def test_a_face_without_its_vertex_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not there"):
        write_mesh(tmp_path / "m.ply", Mesh(np.zeros((2, 3)), np.array([[0, 1, 2]]), np.zeros(1, int)))


def test_a_cloud_is_no_mesh(tmp_path: Path) -> None:
    write_wire_mesh(tmp_path / "w.ply", WIRE)
    with pytest.raises(InputError):
        read_mesh(tmp_path / "w.ply")


@pytest.mark.parametrize("ending", MESH_ENDINGS)
def test_a_damaged_mesh_is_read_or_told(tmp_path: Path, ending: str) -> None:
    file = tmp_path / f"m{ending}"
    write_mesh(file, TETRAHEDRON)
    content = file.read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(60):
        damaged = bytearray(content[: rng.integers(1, len(content) + 1)])
        damaged[rng.integers(len(damaged))] = rng.integers(256)
        file.write_bytes(damaged)
        try:
            vertices, faces = read_mesh(file)
        except InputError as error:
            assert "\n" not in str(error)
        else:
            assert faces.max() < len(vertices)


@pytest.mark.parametrize("ending", [".ply", ".obj"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_coordinates_of_no_place_are_told(tmp_path: Path, ending: str, value: float) -> None:
    vertices = TETRAHEDRON.vertices.copy()
    vertices[2, 1] = value
    write_mesh(tmp_path / f"m{ending}", Mesh(vertices, TETRAHEDRON.faces, TETRAHEDRON.submap))
    with pytest.raises(InputError, match=rf"m\{ending}.*coordinate is not finite"):
        read_mesh(tmp_path / f"m{ending}")


def test_a_glb_that_claims_more_than_it_has_is_told_before_memory_is_taken(tmp_path: Path) -> None:
    table = json.dumps(
        {
            "asset": {"version": "2.0"},
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            # Without a buffer view it is all zeros.
            "accessors": [{"componentType": 5126, "count": 10**9, "type": "VEC3"}],
        }
    ).encode()
    table += b" " * (-len(table) % 4)
    length = 20 + len(table) + 8
    header = b"glTF" + np.array([2, length, len(table)], "<u4").tobytes() + b"JSON"
    (tmp_path / "m.glb").write_bytes(header + table + np.array([0], "<u4").tobytes() + b"BIN\0")
    with pytest.raises(InputError, match=r"m\.glb: claims 1000000000 items"):
        read_mesh(tmp_path / "m.glb")


@pytest.mark.parametrize(
    "content",
    [
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000\nproperty float x\nproperty float y\n"
        b"property float z\nelement face 1000000000000\nproperty list uchar int vertex_indices\nend_header\n"
        + bytes(99),
        b"ply\nformat ascii 1.0\nelement vertex 1000000000000\nproperty float x\nproperty float y\n"
        b"property float z\nelement face 1000000000000\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n",
    ],
    ids=["binary", "text"],
)
def test_a_ply_that_claims_more_than_it_has_is_told(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "m.ply").write_bytes(content)
    with pytest.raises(InputError, match=r"m\.ply"):
        read_mesh(tmp_path / "m.ply")


def test_an_stl_that_claims_more_than_it_has_is_told(tmp_path: Path) -> None:
    (tmp_path / "m.stl").write_bytes(bytes(80) + b"\xff\xff\xff\xff" + bytes(500))
    with pytest.raises(InputError, match=r"m\.stl"):
        read_mesh(tmp_path / "m.stl")


def test_the_parts_of_a_glb_are_one_mesh_where_they_are(tmp_path: Path) -> None:
    box = trimesh.creation.box((1, 1, 1))
    scene = trimesh.Scene()
    scene.add_geometry(box)
    scene.add_geometry(box.copy(), transform=trimesh.transformations.translation_matrix([5, 0, 0]))
    scene.export(tmp_path / "m.glb")
    vertices, faces = read_mesh(tmp_path / "m.glb")
    assert len(faces) == 24
    assert vertices[:, 0].max() == pytest.approx(5.5)


def test_larger_polygons_are_split(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    assert len(read_mesh(tmp_path / "m.obj")[1]) == 2


def test_points_without_faces_are_told_as_such(tmp_path: Path) -> None:
    write_cloud(tmp_path / "c.ply", Cloud(TETRAHEDRON.vertices))
    with pytest.raises(InputError, match=r"c\.ply: holds no triangle; is it a cloud"):
        read_mesh(tmp_path / "c.ply")


def test_a_wire_mesh_has_the_connections_as_edges(tmp_path: Path) -> None:
    write_wire_mesh(tmp_path / "w.ply", WIRE)
    content = (tmp_path / "w.ply").read_bytes()
    assert np.frombuffer(content[-16:], "<i4").reshape(2, 2).tolist() == WIRE.edges.tolist()


def test_a_wire_mesh_loads_elsewhere(tmp_path: Path) -> None:
    write_wire_mesh(tmp_path / "w.ply", WIRE)
    np.testing.assert_allclose(trimesh.load(tmp_path / "w.ply").vertices, WIRE.vertices)


def test_the_neurons_of_a_wire_mesh_are_a_cloud(tmp_path: Path) -> None:
    write_wire_mesh(tmp_path / "w.ply", WIRE)
    np.testing.assert_array_equal(read_cloud(tmp_path / "w.ply").points, WIRE.vertices)


def test_a_wire_mesh_is_only_written_as_ply(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="PLY"):
        write_wire_mesh(tmp_path / "w.obj", WIRE)
