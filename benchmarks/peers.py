# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Ours and what else makes a mesh of a cloud, each run in a process of its own, so that its memory can be told.

Open3D and pymeshlab are optional; they may be in an environment of their own, whose Python needs NumPy and SciPy, too.

Usage, by surface.py: python benchmarks/peers.py METHOD CLOUD.npz MESH.npz [--repeats N] [--spacing M] [--seed N].
Prints seconds and memory as JSON. METHOD may be `crossings`: how many faces of MESH.npz cross others, says MeshLab.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from report import peak_mb

Float = NDArray[np.float64]
Triangles = tuple[NDArray[Any], NDArray[Any]]

_NORMAL_NEIGHBORS = 30
_NORMAL_RADIUS = 0.2  # m
_FARTHEST_M = 0.15
_WARM_UP_POINTS = 3000


@dataclass(frozen=True, slots=True)
class Method:
    """A way from points (N, 3) and where they were seen from, if known, to a mesh. needs: the package it is in."""

    name: str
    needs: str
    run: Callable[[Float, Float | None, float, int], Triangles]


def _ours(points: Float, sensor: Float | None, spacing: float, seed: int) -> Triangles:
    from g2_recon.config import ReconstructionConfig
    from g2_recon.geometry.cloud import Cloud
    from g2_recon.reconstruction.reconstructor import reconstruct

    mesh = reconstruct(Cloud(points, sensor), ReconstructionConfig(spacing=spacing, seed=seed)).mesh
    return mesh.vertices, mesh.faces


def _open3d_cloud(points: Float, sensor: Float | None) -> Any:
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(_NORMAL_RADIUS, _NORMAL_NEIGHBORS))
    if sensor is None:
        cloud.orient_normals_consistent_tangent_plane(15)
    else:
        normals = np.asarray(cloud.normals)
        away = np.einsum("ij,ij->i", normals, sensor - points) < 0
        normals[away] *= -1
        cloud.normals = open3d.utility.Vector3dVector(normals)
    return cloud


def _triangles(mesh: Any) -> Triangles:
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles)


def _open3d_poisson(points: Float, sensor: Float | None, spacing: float, seed: int) -> Triangles:
    import open3d

    cloud = _open3d_cloud(points, sensor)
    mesh, density = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=9, n_threads=-1)
    density = np.asarray(density)
    mesh.remove_vertices_by_mask(density < np.quantile(density, 0.05))
    return _triangles(mesh)


def _open3d_ball_pivoting(points: Float, sensor: Float | None, spacing: float, seed: int) -> Triangles:
    import open3d

    radii = open3d.utility.DoubleVector([0.05, 0.10, 0.20])
    cloud = _open3d_cloud(points, sensor)
    return _triangles(open3d.geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(cloud, radii))


def _open3d_alpha(points: Float, sensor: Float | None, spacing: float, seed: int) -> Triangles:
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    return _triangles(open3d.geometry.TriangleMesh.create_from_point_cloud_alpha_shape(cloud, 0.2))


def _meshlab_set(points: Float, sensor: Float | None) -> Any:
    import pymeshlab

    meshes = pymeshlab.MeshSet(verbose=False)
    if sensor is None:
        meshes.add_mesh(pymeshlab.Mesh(points))
        meshes.compute_normal_for_point_clouds(k=_NORMAL_NEIGHBORS)
    else:
        meshes.add_mesh(pymeshlab.Mesh(points, v_normals_matrix=_normals(points, sensor)))
    return meshes


def _normals(points: Float, sensor: Float) -> Float:
    """Normals (N, 3) of the planes through the nearest neighbors, towards the sensor."""
    from scipy.spatial import cKDTree

    near = cKDTree(points).query(points, min(_NORMAL_NEIGHBORS, len(points)), workers=-1)[1]
    local = points[near] - points[near].mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))[1][:, :, 0]
    normals[np.einsum("ij,ij->i", normals, sensor - points) < 0] *= -1
    return normals


def _meshlab_poisson(points: Float, sensor: Float | None, spacing: float, seed: int) -> Triangles:
    from scipy.spatial import cKDTree

    meshes = _meshlab_set(points, sensor)
    meshes.generate_surface_reconstruction_screened_poisson(depth=9)
    vertices, faces = meshes.current_mesh().vertex_matrix(), meshes.current_mesh().face_matrix()
    near = cKDTree(points).query(vertices, distance_upper_bound=_FARTHEST_M, workers=-1)[0] < _FARTHEST_M
    return vertices, faces[near[faces].all(axis=1)]


def _meshlab_ball_pivoting(points: Float, sensor: Float | None, spacing: float, seed: int) -> Triangles:
    import pymeshlab

    meshes = _meshlab_set(points, sensor)
    meshes.generate_surface_reconstruction_ball_pivoting(ballradius=pymeshlab.PureValue(0.12))
    return meshes.current_mesh().vertex_matrix(), meshes.current_mesh().face_matrix()


OURS = "g2_recon"

METHODS = {
    method.name: method
    for method in (
        Method(OURS, "g2_recon", _ours),
        Method("MeshLab screened Poisson, depth 9, cut at 15 cm", "pymeshlab", _meshlab_poisson),
        Method("MeshLab ball pivoting, 12 cm", "pymeshlab", _meshlab_ball_pivoting),
        Method("Open3D Poisson, depth 9, sparsest 5 % cut", "open3d", _open3d_poisson),
        Method("Open3D ball pivoting, 5, 10, 20 cm", "open3d", _open3d_ball_pivoting),
        Method("Open3D alpha shape, 20 cm", "open3d", _open3d_alpha),
    )
}


def crossings(mesh: Path) -> dict[str, Any]:
    """How many faces MeshLab finds to cross others."""
    import pymeshlab

    data = np.load(mesh)
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(data["vertices"].astype(float), data["faces"].astype(np.int32)))
    meshes.meshing_merge_close_vertices(threshold=pymeshlab.PureValue(1e-6))
    meshes.compute_selection_by_self_intersections_per_face()
    return {"crossings": meshes.current_mesh().selected_face_number()}


def measure(method: Method, cloud: Path, mesh: Path, repeats: int, spacing: float, seed: int) -> dict[str, Any]:
    """Mesh a cloud, after a few of its points to load and compile what there is, and say what it took."""
    data = np.load(cloud)
    points = data["points"].astype(float)
    sensor = data["sensor"].astype(float) if "sensor" in data else None
    few = np.argsort(np.linalg.norm(points - points[0], axis=1))[:_WARM_UP_POINTS]
    method.run(points[few], None if sensor is None else sensor[few], spacing, seed)
    seconds, cpu_seconds = [], []
    for _ in range(repeats):
        started = time.perf_counter(), time.process_time()
        vertices, faces = method.run(points, sensor, spacing, seed)
        seconds.append(time.perf_counter() - started[0])
        cpu_seconds.append(time.process_time() - started[1])
    cost = {"seconds": min(seconds), "cpu_seconds": min(cpu_seconds), "peak_mb": peak_mb(), "points": len(points)}
    np.savez(mesh, vertices=vertices, faces=faces)
    return cost


def call(python: str, *arguments: object) -> dict[str, Any]:
    """Run this file in a process of its own; raises RuntimeError with its last words if it fails."""
    root = Path(__file__).resolve().parents[1]
    done = subprocess.run(
        [python, __file__, *map(str, arguments)],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(root)},
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"{arguments[0]}: {(done.stderr.strip() or str(done.returncode)).splitlines()[-1]}")
    return dict(json.loads(done.stdout.splitlines()[-1]))


def main() -> None:
    """Measure one method; see above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("method", choices=[*METHODS, "crossings", "installed"])
    parser.add_argument("cloud", nargs="?", type=Path)
    parser.add_argument("mesh", nargs="?", type=Path)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--spacing", type=float, default=0.2)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    if given.method == "installed":
        answer: dict[str, Any] = {name: importlib.util.find_spec(name) is not None for name in ("open3d", "pymeshlab")}
    elif given.method == "crossings":
        answer = crossings(given.mesh)
    else:
        answer = measure(METHODS[given.method], given.cloud, given.mesh, given.repeats, given.spacing, given.seed)
    sys.stdout.write("\n" + json.dumps(answer) + "\n")


if __name__ == "__main__":
    main()
