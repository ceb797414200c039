# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Creases and corners: where joined submaps meet at an angle, the mesh gets vertices where their planes meet.

Neurons average over data and never sit on an edge between walls, so a join alone would chamfer every edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.edges import edges_of
from g2_recon.geometry.triangles import area_vectors

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

# How strongly a crease vertex is held to where its edge was, against the planes: only along the crease does it count.
_HOLD = 0.001
# A crease vertex stays this near to its edge, as a share of the length of the edge; planes that are almost parallel
# meet far away.
_FARTHEST = 0.75
# Twice the area of a face over the square of its longest side; below it the direction of a face means nothing.
_LEAST_SHAPE = 1e-2
# What the cosine of an angle may be off.
_COSINE_ROUNDING = 1e-12


@dataclass(frozen=True, slots=True)
class CreasedSurface:
    """A mesh with crease vertices. vertices: (V + C, 3) m, the given V first. faces: (F', 3).

    origin: (F',) the face of the given mesh that each face is a part of.
    """

    vertices: Float
    faces: Int
    origin: Int


def insert_creases(
    vertices: Float, faces: Int, normals: Float, centers: Float, cluster: Int, *, angle: float = math.radians(25.0)
) -> CreasedSurface:
    """Divide the faces between clusters whose planes differ by more than `angle` (rad) along the crease.

    vertices: (V, 3) m. faces: (F, 3), edge-manifold and consistently oriented; so is the result. normals, centers:
    (V, 3) the plane of the surface at each vertex, unit normal and a point of it in metres. cluster: (V,).

    Each edge across a crease gets the point that the two planes are nearest to (Garland and Heckbert, "Surface
    simplification using quadric error metrics", 1997, section 4), a face with three such edges also the point of its
    three planes. No part of a face is turned over: where one would be, the edges of that face stay undivided.
    """
    # Most faces lie within a cluster and stay as they are.
    chosen = np.flatnonzero(_may_crease(faces, normals, cluster, math.cos(angle)))
    edges, face_edges = edges_of(faces[chosen], len(vertices))
    middle = vertices[edges].mean(axis=1)
    place = _nearest_to_planes(centers[edges], normals[edges], middle)
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    divided = (
        (cluster[edges[:, 0]] != cluster[edges[:, 1]])
        & (np.einsum("ei,ei->e", normals[edges[:, 0]], normals[edges[:, 1]]) < math.cos(angle))
        & (np.linalg.norm(place - middle, axis=1) < _FARTHEST * length)
    )
    corner_place = _corners(vertices, faces[chosen], normals, centers, place[face_edges])
    # Each round divides fewer edges than the one before, so this ends; without divided edges no face is turned.
    while True:
        surface = _divide(vertices, faces[chosen], face_edges, place, corner_place, divided)
        turned = surface.origin[_turned_over(vertices, faces[chosen], surface)]
        if not divided[face_edges[turned]].any():
            return _with_whole(vertices, faces, chosen, surface)
        divided[face_edges[turned]] = False


def _may_crease(faces: Int, normals: Float, cluster: Int, cosine: float) -> Mask:
    """Mask (F,) of the faces with an edge between clusters that differ by an angle of at least about this cosine."""
    following = faces[:, [1, 2, 0]]
    between = cluster[faces] != cluster[following]
    face, corner = np.nonzero(between)
    along = np.einsum("ni,ni->n", normals[faces[face, corner]], normals[following[face, corner]])
    mask = np.zeros(len(faces), bool)
    mask[face[along < cosine + _COSINE_ROUNDING]] = True
    return mask


def _with_whole(vertices: Float, faces: Int, chosen: Int, surface: CreasedSurface) -> CreasedSurface:
    """The mesh with its chosen faces (n,) replaced by the surface that these became; whole faces come first."""
    # Each part of a face has a new vertex.
    part = (surface.faces >= len(vertices)).any(axis=1)
    origin = chosen[surface.origin[part]]
    whole = np.ones(len(faces), bool)
    whole[origin] = False
    return CreasedSurface(
        surface.vertices,
        np.concatenate([faces[whole], surface.faces[part]]),
        np.concatenate([np.flatnonzero(whole), origin]),
    )


def _nearest_to_planes(centers: Float, normals: Float, hold: Float) -> Float:
    """The points (E, 3) nearest to k planes each, of centers and normals (E, k, 3), while lightly held to a place."""
    matrix = np.einsum("eki,ekj->eij", normals, normals) + _HOLD * np.eye(3)
    # Relative to the place, so that large coordinates cost no precision.
    height = np.einsum("eki,eki->ek", normals, centers - hold[:, None])
    right = np.einsum("eki,ek->ei", normals, height)
    return np.asarray(hold + np.linalg.solve(matrix, right[:, :, None])[:, :, 0])


def _corners(vertices: Float, faces: Int, normals: Float, centers: Float, edge_places: Float) -> Float:
    """Where each face (F, 3) would get its corner vertex: on its three planes, or else amid its crease vertices.

    In a right-angled corner it lies 0.8 of a side off the face; farther than a side is not the corner of this face.
    """
    middle = vertices[faces].mean(axis=1)
    place = _nearest_to_planes(centers[faces], normals[faces], middle)
    side = np.linalg.norm(vertices[faces] - vertices[np.roll(faces, -1, axis=1)], axis=2).max(axis=1)
    far = np.linalg.norm(place - middle, axis=1) > side
    return np.where(far[:, None], edge_places.mean(axis=1), place)


def _divide(
    vertices: Float, faces: Int, face_edges: Int, place: Float, corner_place: Float, divided: Mask
) -> CreasedSurface:
    """The mesh with its divided edges (E,) replaced by two each, and each face replaced by its parts."""
    on_edge = np.where(divided, len(vertices) + np.cumsum(divided) - 1, -1)
    count = divided[face_edges].sum(axis=1)
    cornered = np.flatnonzero(count == 3)
    corner = len(vertices) + int(divided.sum()) + np.arange(len(cornered))
    whole, once, twice = (np.flatnonzero(count == number) for number in range(3))
    all_vertices = np.concatenate([vertices, place[divided], corner_place[cornered]])
    # Corner 0 of a face with one divided edge is turned to begin that edge; of one with two, to begin the undivided.
    one = _turned_to(faces, face_edges, on_edge, once, np.argmax(divided[face_edges[once]], axis=1))
    two = _turned_to(faces, face_edges, on_edge, twice, np.argmin(divided[face_edges[twice]], axis=1))
    three = _turned_to(faces, face_edges, on_edge, cornered, np.zeros(len(cornered), np.int64))
    parts = [faces[whole], _halves(*one), _thirds(all_vertices, *two), _sixths(*three, corner)]
    origin = [whole, np.repeat(once, 2), np.repeat(twice, 3), np.repeat(cornered, 6)]
    return CreasedSurface(all_vertices, np.concatenate(parts), np.concatenate(origin))


def _turned_to(faces: Int, face_edges: Int, on_edge: Int, chosen: Int, first: Int) -> tuple[Int, Int]:
    """Corners (3, n) of the chosen faces from corner `first` (n,) on, and the new vertex (3, n) after each."""
    columns = (first[:, None] + np.arange(3)) % 3
    return (
        np.take_along_axis(faces[chosen], columns, axis=1).T,
        on_edge[np.take_along_axis(face_edges[chosen], columns, axis=1)].T,
    )


def _halves(corners: Int, between: Int) -> Int:
    a, b, c = corners
    ab = between[0]
    return _interleaved([a, ab, c], [ab, b, c])


def _thirds(vertices: Float, corners: Int, between: Int) -> Int:
    """The tip at the third corner, and the quadrangle below it cut along its shorter diagonal."""
    a, b, c = corners
    _, bc, ca = between
    along_a = np.linalg.norm(vertices[a] - vertices[bc], axis=1) < np.linalg.norm(vertices[b] - vertices[ca], axis=1)
    last, first = np.where(along_a, bc, ca), np.where(along_a, a, b)
    return _interleaved([ca, bc, c], [a, b, last], [first, bc, ca])


def _sixths(corners: Int, between: Int, corner: Int) -> Int:
    (a, b, c), (ab, bc, ca) = corners, between
    sides = [[a, ab], [ab, b], [b, bc], [bc, c], [c, ca], [ca, a]]
    return _interleaved(*([*side, corner] for side in sides))


def _interleaved(*parts: list[Int]) -> Int:
    """Faces (k n, 3) of k parts with corners (n,) each; the parts of one face follow each other."""
    return np.stack([np.stack(part, axis=1) for part in parts], axis=1).reshape(-1, 3)


def _turned_over(vertices: Float, faces: Int, surface: CreasedSurface) -> Mask:
    """Mask (F',) of the parts that look away from the face that they are a part of, or are needles; not whole faces."""
    before = area_vectors(vertices, faces)[surface.origin]
    after = area_vectors(surface.vertices, surface.faces)
    corners = surface.vertices[surface.faces]
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
    needle = np.linalg.norm(after, axis=1) < _LEAST_SHAPE * longest**2
    whole = (surface.faces < len(vertices)).all(axis=1)
    return ((np.einsum("fi,fi->f", before, after) <= 0) | needle) & ~whole
