# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Meshes in and out, by trimesh; coordinates stay in the map frame, metres, z up, in every kind of file."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.mesh import Mesh, WireMesh
from g2_recon.recording.files import atomic_write, read_bytes
from g2_recon.recording.ply import ply_header

MESH_ENDINGS = (".ply", ".obj", ".stl", ".glb")


def write_mesh(path: str | Path, mesh: Mesh) -> None:
    """Write triangles; the ending says how: .ply, .obj, .stl or .glb.

    A PLY file also has the submap of each face, as the face property `submap`. Raises InputError if the ending is
    not known, a face names a vertex that is not there, or the file cannot be written.
    """
    ending = _ending(path)
    if len(mesh.faces) and not (mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices)):
        raise InputError("a face names a vertex that is not there", where=path, advice="this mesh is broken")
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    if ending == "ply":
        solid.face_attributes["submap"] = mesh.submap.astype(np.int32)
    content: Any = solid.export(file_type=ending)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)


def write_wire_mesh(path: str | Path, wire: WireMesh) -> None:
    """Write neurons and connections as a binary PLY file with the elements `vertex` and `edge`.

    Vertices have the property `submap`, edges `vertex1` and `vertex2` only, as other readers expect: an edge is a join
    where the submaps of its ends differ. Raises InputError if the ending is not .ply or the file cannot be written.
    """
    if _ending(path) != "ply":
        raise InputError("a wire mesh is written as PLY", where=path, advice="use the ending .ply")
    vertices = np.empty(len(wire.vertices), [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("submap", "<i4")])
    vertices["x"], vertices["y"], vertices["z"] = wire.vertices.T
    vertices["submap"] = wire.submap
    edges = np.empty(len(wire.edges), [("vertex1", "<i4"), ("vertex2", "<i4")])
    edges["vertex1"], edges["vertex2"] = wire.edges.T
    header = ply_header([("vertex", vertices), ("edge", edges)])
    with atomic_write(path) as temporary:
        temporary.write_bytes(header + vertices.tobytes() + edges.tobytes())


def read_mesh(path: str | Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (V, 3) in metres and faces (F, 3) of a .ply, .obj, .stl or .glb file; larger polygons are split.

    The corners of an STL file that coincide become one vertex. Raises InputError if the file cannot be read, is
    malformed, or holds no triangle.
    """
    ending = _ending(path)
    content = read_bytes(path)
    try:
        loaded: Any = trimesh.load_mesh(BytesIO(content), file_type=ending, process=False)
        if ending == "stl":
            loaded.merge_vertices()
        vertices, faces = np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces, np.int64)
    except Exception as error:  # trimesh lets whatever its parsers meet through: KeyError, struct.error, IndexError ...
        raise InputError(f"is no sound mesh: {error}", where=path, advice="the file is damaged") from None
    if len(faces) == 0:
        raise InputError("holds no triangle", where=path, advice="is it a cloud?")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError("a face names a vertex that is not there", where=path, advice="the file is damaged")
    return vertices, faces


def _ending(path: str | Path) -> str:
    ending = Path(path).suffix.lower()
    if ending not in MESH_ENDINGS:
        raise InputError(
            "has no ending that a mesh can have", where=path, advice=f"use one of {', '.join(MESH_ENDINGS)}"
        )
    return ending[1:]
