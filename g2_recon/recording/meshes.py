# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Meshes in and out, mostly by trimesh; coordinates stay in the map frame, metres, z up, in every kind of file."""

from __future__ import annotations

import json
import logging
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.mesh import Mesh, WireMesh
from g2_recon.recording.files import atomic_write, read_bytes
from g2_recon.recording.ply import ply_header

_log = logging.getLogger(__name__)

MESH_ENDINGS = (".ply", ".obj", ".stl", ".glb")

_FLOAT_ENDINGS = ("stl", "glb")
_FLOAT_LIMIT = 1e4
"""Metres; above, neighboring float32 numbers are a millimetre apart."""

FARTHEST_M = 1e9
"""What is farther away was not measured by a robot on Earth."""

_STL_ORIGIN = b"g2_recon origin m: "

_COORDINATES = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]


def _trimesh() -> Any:
    """The library, where it is needed: a node that starts has no half second for it."""
    return import_module("trimesh")


def write_mesh(path: str | Path, mesh: Mesh) -> None:
    """Write triangles; the ending says how: .ply, .obj, .stl or .glb.

    A PLY file has double coordinates and also the submap of each face, as the face property `submap`. STL and GLB
    files have float coordinates: far from the origin these are relative to one near the mesh. A GLB file holds it as
    the place of its node, for every reader; an STL file in its header, which `read_mesh` knows and the log tells.
    Raises InputError if the ending is not known, a face names a vertex that is not there, or the file cannot be
    written.
    """
    ending = _ending(path)
    if len(mesh.faces) and not (mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices)):
        raise InputError("a face names a vertex that is not there", where=path, advice="this mesh is broken")
    if ending == "ply":
        content: Any = _ply_of_mesh(mesh)
    elif ending in _FLOAT_ENDINGS and np.abs(mesh.vertices).max(initial=0.0) > _FLOAT_LIMIT:
        content = _relative_to_origin(path, ending, mesh)
    else:
        content = _trimesh().Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type=ending)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)


def _relative_to_origin(path: str | Path, ending: str, mesh: Mesh) -> bytes:
    """A GLB or STL file with coordinates relative to an origin of whole metres, which the file holds."""
    origin = np.nan_to_num(np.round(np.median(mesh.vertices, axis=0)))
    trimesh = _trimesh()
    near = trimesh.Trimesh(mesh.vertices - origin, mesh.faces, process=False)
    if ending == "glb":
        placed = trimesh.Scene()
        placed.add_geometry(near, transform=trimesh.transformations.translation_matrix(origin))
        return bytes(placed.export(file_type="glb"))
    header = _STL_ORIGIN + " ".join(f"{value:.0f}" for value in origin).encode()
    _log.warning("%s: coordinates are relative to %s m; use .ply or .glb for absolute ones", path, origin.tolist())
    return bytes(header.ljust(80)[:80] + near.export(file_type="stl")[80:])


def _origin_of_stl(content: bytes) -> NDArray[np.float64]:
    """The origin (3,) m in the header of an STL file; zero where none is told."""
    if not content.startswith(_STL_ORIGIN):
        return np.zeros(3)
    return np.array([float(word) for word in content[len(_STL_ORIGIN) : 80].split()[:3]], float)


def write_wire_mesh(path: str | Path, wire: WireMesh) -> None:
    """Write neurons and connections as a binary PLY file with the elements `vertex` and `edge`.

    Vertices have the property `submap`, edges `vertex1` and `vertex2` only, as other readers expect: an edge is a join
    where the submaps of its ends differ. Raises InputError if the ending is not .ply or the file cannot be written.
    """
    if _ending(path) != "ply":
        raise InputError("a wire mesh is written as PLY", where=path, advice="use the ending .ply")
    vertices = np.empty(len(wire.vertices), [*_COORDINATES, ("submap", "<i4")])
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
    malformed, holds no triangle, or a coordinate is not finite or above a million kilometres.
    """
    ending = _ending(path)
    content = read_bytes(path)
    if ending == "glb":
        _check_glb(content, path)
    try:
        loaded: Any = _trimesh().load_mesh(BytesIO(content), file_type=ending, process=False)
        if ending == "stl":
            loaded.merge_vertices()
        vertices: NDArray[np.float64] = np.asarray(loaded.vertices, np.float64).reshape(-1, 3)
        if ending == "stl":
            vertices = vertices + _origin_of_stl(content)
        # A cloud has none.
        faces = np.asarray(getattr(loaded, "faces", ()), np.int64).reshape(-1, 3)
    except Exception as error:  # trimesh lets whatever its parsers meet through: KeyError, struct.error, IndexError ...
        raise InputError(f"is no sound mesh: {error}", where=path, advice="the file is damaged") from None
    return check_triangles(vertices, faces, path)


def check_triangles(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], path: str | Path
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The triangles of a file, vertices (V, 3) and faces (F, 3), as they are. Raises InputError as read_mesh does."""
    if len(faces) == 0:
        raise InputError("holds no triangle", where=path, advice="is it a cloud?")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError("a face names a vertex that is not there", where=path, advice="the file is damaged")
    if not (np.abs(vertices) <= FARTHEST_M).all():
        raise InputError(
            f"a coordinate is not finite or above {FARTHEST_M:g} m", where=path, advice="is the file damaged?"
        )
    return vertices, faces


def _check_glb(content: bytes, path: str | Path) -> None:
    """Raises InputError where a GLB file claims more items than it has bytes: trimesh would take memory for them."""
    try:
        length = int.from_bytes(content[12:16], "little")
        accessors = json.loads(content[20 : 20 + length]).get("accessors", [])
        largest = max((int(accessor["count"]) for accessor in accessors), default=0)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        raise InputError(
            "is no sound mesh: its table of contents is broken", where=path, advice="the file is damaged"
        ) from None
    if largest > len(content):
        raise InputError(f"claims {largest} items in {len(content)} bytes", where=path, advice="the file is damaged")


def _ply_of_mesh(mesh: Mesh) -> bytes:
    """A binary PLY file; trimesh would write coordinates as float, which is half a metre in UTM coordinates."""
    vertices = np.empty(len(mesh.vertices), _COORDINATES)
    vertices["x"], vertices["y"], vertices["z"] = mesh.vertices.T
    faces = np.empty(len(mesh.faces), [("corners", "u1"), ("vertex_indices", "<i4", 3), ("submap", "<i4")])
    faces["corners"], faces["vertex_indices"], faces["submap"] = 3, mesh.faces, mesh.submap
    header = ply_header([("vertex", vertices), ("face", faces)], {"corners": "vertex_indices"})
    return header + vertices.tobytes() + faces.tobytes()


def _ending(path: str | Path) -> str:
    ending = Path(path).suffix.lower()
    if ending not in MESH_ENDINGS:
        raise InputError(
            "has no ending that a mesh can have", where=path, advice=f"use one of {', '.join(MESH_ENDINGS)}"
        )
    return ending[1:]
