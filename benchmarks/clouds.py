# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Clouds of the benchmark: buildings that are known exactly, scanned by an upright LMS200 that drives through them.

A building is a list of convex parts, each solid or free; a later part replaces what was in its place. So walls may have
any direction, roofs pitch, ceilings vault and columns be round, which the boxes of g2_recon.simulation cannot.

Usage: python benchmarks/clouds.py NAME [FILE.npz] with a name such as `offices` or `hall_s3`. Writes points, sensor,
the noise-free hits and the true surface.
"""

from __future__ import annotations

import functools
import itertools
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from g2_recon.geometry.cloud import Cloud, concatenate
from g2_recon.simulation.lms200 import Lms200

Float = NDArray[np.float64]
Int = NDArray[np.int64]

OUTSIDE, SOLID, FREE = 0, 1, 2

_TOLERANCE = 1e-9
_PROBE = 1e-6  # m beside a face, to see what is there
_SLIVER = 1e-9  # m^2 of surface that no one misses
_DRIFT_ANGLE = math.radians(10)  # a metre
_SIDES = 48  # of a polygon that stands for a circle


@dataclass(frozen=True, slots=True)
class Convex:
    """A convex polyhedron. planes: (K, 4) with normal x + offset <= 0 inside. faces: K polygons (., 3), normals out."""

    planes: Float
    faces: tuple[Float, ...]
    low: Float
    high: Float


Parts = list[tuple[Convex, int]]
Point = tuple[float, float]
Span = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Scanned:
    """A cloud with its truth, all in one frame and metres.

    points, clean: (N, 3) as measured, and where the beams really met a surface. sensor: (N, 3) or None.
    vertices: (V, 3), faces: (T, 3) the true surface, counterclockwise seen from the free side.
    """

    points: Float
    sensor: Float | None
    clean: Float
    vertices: Float
    faces: Int

    def cloud(self) -> Cloud:
        """What a reconstruction gets."""
        return Cloud(self.points, self.sensor)

    def arrays(self) -> dict[str, NDArray]:
        """What goes into an NPZ file."""
        known = {} if self.sensor is None else {"sensor": self.sensor.astype(np.float32)}
        return known | {
            "points": self.points.astype(np.float32),
            "clean": self.clean.astype(np.float32),
            "truth_vertices": self.vertices.astype(np.float32),
            "truth_faces": self.faces.astype(np.int32),
        }


@dataclass(frozen=True, slots=True)
class Survey:
    """How a building is scanned.

    noise: standard deviation of a range, m. step: way between two scans, m. beam_spacing: deg. height: of the laser, m.
    outliers: share of beams that something in the air cuts short; with any, edges split beams, too (Lms200).
    drift: largest smooth error of the poses, m, and 0.1 deg a centimetre. all_round: two lasers, back to back.
    rotated: whether the building lies generically in space. known_sensor: whether sensor positions are kept.
    """

    noise: float = 0.01
    step: float = 0.065
    beam_spacing: float = 1.0
    height: float = 0.35
    outliers: float = 0.0
    drift: float = 0.0
    all_round: bool = False
    rotated: bool = True
    known_sensor: bool = True
    seed: int = 0


# Shapes


def convex(points: Float) -> Convex:
    """The convex hull of points (N, 3)."""
    points = np.asarray(points, float)
    planes = ConvexHull(points).equations
    planes = planes[np.unique(planes.round(7), axis=0, return_index=True)[1]]
    corners = points[ConvexHull(points).vertices]
    polygons = []
    for plane in planes:
        polygon = corners[np.abs(corners @ plane[:3] + plane[3]) < 1e-7]
        across = polygon - polygon.mean(axis=0)
        u = across[0] / np.linalg.norm(across[0])
        polygons.append(polygon[np.argsort(np.arctan2(across @ np.cross(plane[:3], u), across @ u))])
    return Convex(planes, tuple(polygons), points.min(axis=0), points.max(axis=0))


def prism(outline: Sequence[Point], span: Span, axis: int = 2) -> Convex:
    """A convex outline drawn out along an axis; its points are on the two other axes, in their order."""
    ends = [np.insert(np.asarray(outline, float), axis, end, axis=1) for end in span]
    return convex(np.concatenate(ends))


def box(x: Span, y: Span, z: Span) -> Convex:
    """An axis-aligned box."""
    return convex(np.array(list(itertools.product(x, y, z)), float))


def circle(center: Point, radius: float, sides: int = _SIDES) -> list[Point]:
    """A regular polygon on a circle."""
    angles = 2 * math.pi * np.arange(sides) / sides
    return [(center[0] + radius * math.cos(angle), center[1] + radius * math.sin(angle)) for angle in angles]


def arch(across: Span, springing: float) -> list[Point]:
    """The outline of an opening from the ground up, with a half circle above the height of springing."""
    radius, middle = (across[1] - across[0]) / 2, (across[0] + across[1]) / 2
    angles = np.linspace(0, math.pi, _SIDES // 2 + 1)
    round_top = [(middle + radius * math.cos(angle), springing + radius * math.sin(angle)) for angle in angles]
    return [(across[0], 0.0), (across[1], 0.0), *round_top]


def turned(center: Point, profile: Sequence[Point]) -> Convex:
    """A convex profile (radius, height) turned about the vertical axis through `center`."""
    return convex(np.array([(*point, height) for radius, height in profile for point in circle(center, radius)]))


def below(shape: Convex, normal: Sequence[float], point: Sequence[float]) -> Convex:
    """The part of a shape on the side of the plane through `point` that its normal turns away from."""
    unit = np.asarray(normal, float) / np.linalg.norm(normal)
    kept = [_cut(face, unit, -float(unit @ np.asarray(point)))[0] for face in shape.faces]
    return convex(np.unique(np.concatenate([face for face in kept if len(face)]).round(12), axis=0))


def placed_at(origin: Point, degrees: float, outline: Sequence[Point]) -> list[Point]:
    """An outline in a frame that is turned and moved in the plan."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return [(origin[0] + cos * x - sin * y, origin[1] + sin * x + cos * y) for x, y in outline]


# The surface of what is solid


def surface(parts: Parts) -> tuple[Float, Int]:
    """Vertices (V, 3) and faces (T, 3) between what is solid and what is free, each piece once.

    Faces are cut along all parts they meet; then what lies on their two sides tells whether they are surface.
    """
    polygons = []
    for index, (part, _) in enumerate(parts):
        near = [number for number, (other, _) in enumerate(parts) if number != index and _touch(part, other)]
        for plane, face in zip(part.planes, part.faces, strict=True):
            pieces = [face]
            for number in near:
                pieces = [kept for piece in pieces for kept in _divide(piece, parts[number][0])]
            for piece in pieces:
                center = piece.mean(axis=0)
                # Where faces of two parts coincide, the later part has the piece, too.
                if any(_on_boundary(center, parts[number][0]) for number in near if number > index):
                    continue
                behind, before = (_state(center + side * _PROBE * plane[:3], parts) for side in (-1, 1))
                if {behind, before} == {SOLID, FREE}:
                    polygons.append(piece if before == FREE else piece[::-1])
    vertices = np.concatenate(polygons)
    first = np.cumsum([0, *(len(polygon) for polygon in polygons[:-1])])
    faces = [
        (start, start + k, start + k + 1)
        for start, polygon in zip(first, polygons, strict=True)
        for k in range(1, len(polygon) - 1)
    ]
    return vertices, np.array(faces, np.int64)


def refined(vertices: Float, faces: Int, longest: float = 1.0) -> tuple[Float, Int]:
    """The same surface with no edge longer than this, in metres: single precision finds no closest point on slivers."""
    corners, done = vertices[faces], []
    while len(corners):
        lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        long = lengths.max(axis=1) > longest
        done.append(corners[~long])
        edge = lengths[long].argmax(axis=1)[:, None]
        a, b, c = (corners[long][np.arange(len(edge))[:, None], (edge + k) % 3][:, 0] for k in range(3))
        middle = (a + b) / 2
        corners = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    corners = np.concatenate(done)
    return corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)


def _touch(one: Convex, other: Convex) -> bool:
    return bool((one.low <= other.high + _TOLERANCE).all() and (other.low <= one.high + _TOLERANCE).all())


def _cut(polygon: Float, normal: Float, offset: float) -> tuple[Float, Float]:
    """The parts of a convex polygon behind and before a plane; a part without area is empty."""
    distance = polygon @ normal + offset
    if (distance <= _TOLERANCE).all():
        return polygon, np.empty((0, 3))
    if (distance >= -_TOLERANCE).all():
        return np.empty((0, 3)), polygon
    sides: tuple[list[Float], list[Float]] = ([], [])
    for point, d, following, e in zip(
        polygon, distance, np.roll(polygon, -1, axis=0), np.roll(distance, -1), strict=True
    ):
        for side, sign in zip(sides, (1, -1), strict=True):
            if sign * d <= _TOLERANCE:
                side.append(point)
        if min(d, e) < -_TOLERANCE and max(d, e) > _TOLERANCE:
            crossing = point + d / (d - e) * (following - point)
            for side in sides:
                side.append(crossing)
    behind, before = (np.array(side) if _area(side) > _SLIVER else np.empty((0, 3)) for side in sides)
    return behind, before


def _area(polygon: Sequence[Float]) -> float:
    if len(polygon) < 3:
        return 0.0
    corners = np.array(polygon)
    return float(np.linalg.norm(np.cross(corners[1:-1] - corners[0], corners[2:] - corners[0]).sum(axis=0)) / 2)


def _divide(polygon: Float, by: Convex) -> Iterator[Float]:
    """The pieces of a convex polygon outside and inside of a part."""
    distances = polygon @ by.planes[:, :3].T + by.planes[:, 3]
    beyond = distances.max(axis=0) > _TOLERANCE
    if (beyond & (distances.min(axis=0) >= -_TOLERANCE)).any():
        yield polygon
        return
    for plane in by.planes[beyond]:
        polygon, outside = _cut(polygon, plane[:3], plane[3])
        if len(outside):
            yield outside
        if not len(polygon):
            return
    yield polygon


def _on_boundary(point: Float, part: Convex) -> bool:
    return abs(float((part.planes[:, :3] @ point + part.planes[:, 3]).max())) < 1e-7


def _state(point: Float, parts: Parts) -> int:
    """What is at a point: what the last part there says."""
    for part, state in reversed(parts):
        near = (part.low < point).all() and (point < part.high).all()
        if near and (part.planes[:, :3] @ point + part.planes[:, 3] < 0).all():
            return state
    return OUTSIDE


# The laser


def cast(vertices: Float, faces: Int, T_world_laser: Float, angles: Float) -> Float:
    """Distances (S, B) to the first triangle along beams at angles (B,) from the x axis to the y axis of S lasers."""
    distances = np.full((len(T_world_laser), len(angles)), np.inf)
    _cast(vertices[faces], np.ascontiguousarray(T_world_laser), angles, distances)
    return distances


@numba.njit(cache=True, nogil=True)
def _cast(corners: Float, poses: Float, angles: Float, distances: Float) -> None:  # pragma: no cover
    """A scan is a slice: the plane of the beams cuts a triangle in a segment, which covers an interval of angles."""
    across, u, v = np.empty(3), np.empty(2), np.empty(2)
    spacing = angles[1] - angles[0]
    turn = round(2 * np.pi / spacing)
    for scan in range(len(poses)):
        x, y, z, origin = poses[scan, :3, 0], poses[scan, :3, 1], poses[scan, :3, 2], poses[scan, :3, 3]
        for face in range(len(corners)):
            for k in range(3):
                across[k] = 0.0
                for axis in range(3):
                    across[k] += (corners[face, k, axis] - origin[axis]) * z[axis]
            found = 0
            for k in range(3):
                following = (k + 1) % 3
                if (across[k] < 0.0) != (across[following] < 0.0):
                    share = across[k] / (across[k] - across[following])
                    u[found], v[found] = 0.0, 0.0
                    for axis in range(3):
                        here = corners[face, k, axis]
                        there = here + share * (corners[face, following, axis] - here) - origin[axis]
                        u[found] += there * x[axis]
                        v[found] += there * y[axis]
                    found += 1
            if found < 2:
                continue
            begin, end = np.arctan2(v[0], u[0]), np.arctan2(v[1], u[1])
            sweep = (end - begin + np.pi) % (2 * np.pi) - np.pi
            low = min(begin, begin + sweep)
            first = int(np.floor((low - angles[0]) / spacing))
            for step in range(int(np.ceil(abs(sweep) / spacing)) + 2):
                beam = (first + step) % turn
                if beam >= len(angles):
                    continue
                c, s = np.cos(angles[beam]), np.sin(angles[beam])
                left, right = c * v[0] - s * u[0], c * v[1] - s * u[1]
                if left * right > 0.0 or left == right:
                    continue
                share = left / (left - right)
                distance = c * (u[0] + share * (u[1] - u[0])) + s * (v[0] + share * (v[1] - v[0]))
                if 0.0 < distance < distances[scan, beam]:
                    distances[scan, beam] = distance


def drive(way: Sequence[Point], step: float, height: float) -> Float:
    """Poses (S, 4, 4) of an upright laser on a way with rounded corners: x up, y left, every `step` metres."""
    points = np.asarray(way, float)
    dense = [points[:1]]
    for before, corner, after in zip(points[:-2], points[1:-1], points[2:], strict=True):
        to, on = before - corner, after - corner
        to, on = (leg * min(0.45 / np.linalg.norm(leg), 0.5) for leg in (to, on))
        t = np.linspace(0, 1, 33)[:, None]
        dense.append(corner + (1 - t) ** 2 * to + t**2 * on)
    curve = np.concatenate([*dense, points[-1:]])
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    at = np.arange(0.0, lengths[-1], step)
    here, ahead, behind = (
        np.column_stack([np.interp(np.clip(at + d, 0, lengths[-1]), lengths, curve[:, axis]) for axis in range(2)])
        for d in (0.0, 0.02, -0.02)
    )
    forward = (ahead - behind) / np.linalg.norm(ahead - behind, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(at), 1, 1))
    poses[:, :3, :3] = 0.0
    poses[:, 2, 0] = 1.0
    poses[:, 0, 1], poses[:, 1, 1] = -forward[:, 1], forward[:, 0]
    poses[:, :2, 2] = -forward
    poses[:, :2, 3], poses[:, 2, 3] = here, height
    return poses


def scan(vertices: Float, faces: Int, way: Sequence[Point], survey: Survey) -> Scanned:
    """Drive through a building and scan it. The same survey gives the same cloud."""
    rng = np.random.default_rng(survey.seed)
    laser = Lms200(survey.beam_spacing, 8, survey.noise, survey.outliers > 0)
    angles = laser.angles()
    if survey.all_round:
        angles = math.radians(survey.beam_spacing) * np.arange(round(360 / survey.beam_spacing)) - math.pi
    poses = drive(way, survey.step, survey.height)
    distances = cast(vertices, faces, poses, angles)
    vertices, faces = refined(vertices, faces)
    ranges = laser.measure(distances, rng).astype(float)
    cut_short = rng.random(ranges.shape) < survey.outliers
    ranges = np.where(cut_short, ranges * rng.random(ranges.shape), ranges)
    valid = np.isfinite(ranges) & np.isfinite(distances) & (ranges > 0.2)
    believed = _drifted(poses, survey.drift, rng)
    points, clean = _along(believed, angles, ranges)[valid], _along(poses, angles, distances)[valid]
    sensor = np.broadcast_to(believed[:, None, :3, 3], (*valid.shape, 3))[valid]
    if survey.rotated:
        turn = Rotation.from_euler("xyz", [25, -40, 65], degrees=True)
        points, clean, sensor, vertices = (turn.apply(array) for array in (points, clean, sensor, vertices))
    return Scanned(points, sensor if survey.known_sensor else None, clean, vertices, faces)


def _along(poses: Float, angles: Float, ranges: Float) -> Float:
    """Points (S, B, 3) at ranges (S, B) along the beams."""
    beams = np.column_stack([np.cos(angles), np.sin(angles)])
    with np.errstate(invalid="ignore"):
        return poses[:, None, :3, 3] + ranges[:, :, None] * np.einsum("sij,bj->sbi", poses[:, :3, :2], beams)


def _drifted(poses: Float, size: float, rng: np.random.Generator) -> Float:
    """Poses (S, 4, 4) with an error of place and direction that grows and shrinks smoothly on the way."""
    waves = np.arange(1, 7)[:, None] / 2 * np.linspace(0, 2 * math.pi, len(poses))
    errors = size / math.sqrt(3) * np.sin(waves + rng.uniform(0, 2 * math.pi, (6, 1))).T
    believed = poses.copy()
    believed[:, :3, 3] += errors[:, :3]
    turns = Rotation.from_rotvec(_DRIFT_ANGLE * errors[:, 3:]).as_matrix()
    believed[:, :3, :3] = turns @ poses[:, :3, :3]
    return believed


# The buildings


def _room(x: Span, y: Span, height: float) -> tuple[Convex, int]:
    return box(x, y, (0.0, height)), FREE


def _free(x: Span, y: Span, z: Span = (0.0, 2.0)) -> tuple[Convex, int]:
    return box(x, y, z), FREE


def _solid(x: Span, y: Span, z: Span) -> tuple[Convex, int]:
    return box(x, y, z), SOLID


def offices() -> tuple[Parts, list[Point]]:
    """Six small rooms along a corridor, parted by walls 10 cm thick; doors, windows, niches, furniture."""
    height = 2.7
    north, south, corridor = (5.1, 8.6), (0.0, 3.5), (3.6, 5.0)
    parts = [
        _solid((-0.3, 12.3), (-0.3, 8.9), (-0.2, 3.0)),
        _room((0.0, 12.0), corridor, height),
        *(_room(x, north, height) for x in ((0.0, 3.9), (4.0, 7.4), (7.5, 12.0))),
        *(_room(x, south, height) for x in ((0.0, 3.1), (3.2, 7.0), (7.1, 12.0))),
        *(_free(x, (5.0, 5.1)) for x in ((10.4, 11.3), (0.8, 1.7))),  # doors
        *(_free(x, (3.5, 3.6)) for x in ((1.6, 2.5), (9.6, 10.5))),
        _free((7.4, 7.5), (7.3, 8.2)),
        _free((3.9, 4.0), (5.6, 6.5)),
        _free((3.1, 3.2), (0.5, 1.4)),
        _free((7.0, 7.1), (2.2, 3.1)),
        *(_free((x, x + 1.2), (8.6, 8.9), (0.9, 2.2)) for x in (1.0, 5.2)),  # windows
        *(_free((x, x + 1.4), (-0.3, 0.0), (0.9, 2.2)) for x in (4.0, 8.0)),
        _free((12.0, 12.3), (3.8, 4.8), (0.9, 2.2)),
        _free((8.0, 9.6), (8.6, 8.8), (0.9, 2.2)),  # niches
        _free((-0.2, 0.0), (6.6, 7.6), (0.8, 2.0)),
        _free((-0.25, 0.0), (3.9, 4.7), (0.0, 2.1)),
        _free((12.0, 12.25), (0.8, 2.0), (0.0, 2.2)),
        *(_solid((12.0, 12.25), (0.8, 2.0), (z, z + 0.04)) for z in (0.9, 1.5)),  # shelves
        _solid((3.3, 3.9), (7.2, 8.6), (0.0, 1.9)),  # cabinets
        _solid((11.4, 12.0), (5.1, 7.0), (0.0, 2.1)),
        _solid((0.0, 0.45), (0.4, 2.4), (0.0, 1.8)),
        _solid((6.4, 7.0), (0.0, 1.2), (0.0, 1.2)),
        _solid((4.0, 4.8), (6.9, 8.5), (0.70, 0.74)),  # a desk
        *(_solid((4.0, 4.8), (y, y + 0.03), (0.0, 0.70)) for y in (6.9, 8.47)),
        _solid((8.6, 8.95), (5.1, 5.45), (0.0, height)),  # columns
        (prism(circle((11.3, 2.7), 0.18), (0.0, height)), SOLID),
        _solid((8.9, 9.15), south, (2.4, height)),  # a beam
        _solid((3.2, 7.0), (2.5, 3.5), (2.35, height)),  # a lowered ceiling
    ]
    way = [
        *((2.5, 4.3), (10.85, 4.3), (10.85, 7.75), (5.7, 7.75), (5.7, 6.05), (2.6, 6.05), (2.6, 7.7), (1.25, 7.7)),
        *((1.25, 4.3), (2.05, 4.3), (2.05, 0.95), (5.1, 0.95), (5.1, 2.65), (8.2, 2.65), (8.2, 0.9), (10.05, 0.9)),
        *((10.05, 4.3), (11.4, 4.3)),
    ]
    return parts, way


def hall() -> tuple[Parts, list[Point]]:
    """A hall of 15 m x 10 m x 4 m with columns, beams, a gallery, a ledge, pilasters and large windows."""
    height = 4.0
    parts = [
        _solid((-0.4, 15.4), (-0.4, 10.4), (-0.2, 4.3)),
        _room((0.0, 15.0), (0.0, 10.0), height),
        *(_free((x, x + 2.0), (-0.4, 0.0), (0.8, 3.2)) for x in (1.0, 5.0, 9.0)),  # windows
        _free((2.0, 6.5), (10.0, 10.4), (0.9, 3.0)),
        _free((8.6, 11.0), (10.0, 10.2), (0.9, 3.0)),
        _free((-0.4, 0.0), (7.6, 9.2), (0.9, 2.4)),
        *(
            (prism(circle(center, radius), (0.0, height)), SOLID)
            for center, radius in (((4, 3.3), 0.25), ((4, 6.7), 0.25))
        ),
        (prism(circle((11.5, 3.3), 0.15), (0.0, height)), SOLID),
        _solid((7.8, 8.2), (3.1, 3.5), (0.0, height)),
        (prism(circle((8.0, 6.7), 0.28, 4), (0.0, height)), SOLID),
        *(_solid((x - 0.15, x + 0.15), (0.0, 10.0), (3.6, height)) for x in (4.0, 8.0, 11.5)),  # beams
        _solid((0.0, 15.0), (4.9, 5.1), (3.75, height)),
        _solid((13.0, 15.0), (0.0, 10.0), (2.5, 2.7)),  # a gallery
        _solid((13.0, 13.1), (0.0, 10.0), (2.7, 3.5)),
        *(_solid((13.05, 13.3), (y, y + 0.25), (0.0, 2.5)) for y in (2.9, 6.9)),
        _solid((0.0, 0.25), (0.0, 7.0), (2.2, 2.3)),  # a ledge
        *(_solid((x, x + 0.4), (9.85, 10.0), (0.0, height)) for x in (1.0, 7.2, 12.0)),  # pilasters
        _solid((0.0, 1.9), (3.0, 6.4), (0.0, 0.8)),  # a stage
    ]
    way = [
        *((1.2, 1.6), (6.0, 1.6), (6.0, 8.4), (2.8, 8.4), (2.8, 5.0), (10.0, 5.0), (10.0, 8.4), (14.0, 8.4)),
        *((14.0, 1.6), (9.5, 1.6)),
    ]
    return parts, way


def corridor() -> tuple[Parts, list[Point]]:
    """A corridor with a T and an L, a bay behind a parapet, niches, steps, boxes, a duct and a lowered ceiling."""
    height = 3.0
    parts = [
        _solid((-0.4, 18.4), (-6.4, 9.4), (-0.2, 3.3)),
        _room((0.0, 18.0), (0.0, 2.0), height),
        _room((8.0, 10.0), (2.0, 9.0), height),
        _room((0.0, 1.8), (-6.0, 0.0), height),
        _room((12.0, 15.0), (2.0, 4.1), height),
        *(_free((x, x + width), (-0.3, 0.0), z) for x, width, z in ((2.6, 0.6, (0.0, 2.1)), (4.2, 1.2, (0.9, 1.8)))),
        *(_free((x, x + width), (-0.15, 0.0), (0.0, 2.1)) for x, width in ((6.3, 0.9), (11.0, 0.9), (13.6, 0.9))),
        _free((3.0, 4.2), (2.0, 2.25), (0.0, 2.0)),
        _free((5.0, 5.5), (2.0, 2.4), (0.8, 1.6)),
        _free((7.7, 8.0), (4.0, 5.2), (0.6, 2.2)),
        _free((10.0, 10.2), (5.0, 6.6), (0.0, 2.4)),
        _free((18.0, 18.4), (0.5, 1.5), (0.9, 2.3)),  # windows
        _free((0.4, 1.4), (-6.4, -6.0), (0.9, 2.3)),
        _free((12.6, 14.4), (4.1, 4.4), (0.9, 2.3)),
        _solid((12.0, 13.9), (2.0, 2.1), (0.0, 1.1)),  # a parapet
        _solid((2.0, 7.0), (0.0, 2.0), (2.45, height)),  # a lowered ceiling
        _solid((0.0, 1.8), (-3.2, -2.9), (2.6, height)),  # beams
        _solid((8.0, 10.0), (2.0, 2.25), (2.5, height)),
        _solid((15.6, 15.9), (0.0, 2.0), (2.6, height)),
        *(_solid((8.0, 10.0), (y, 9.0), (0.0, z)) for y, z in ((7.9, 0.5), (8.2, 0.67), (8.5, 0.84))),  # steps
        _solid((17.3, 18.0), (0.0, 0.6), (0.0, 1.2)),  # boxes
        _solid((1.3, 1.8), (-5.0, -3.8), (0.0, 0.9)),
        _solid((0.0, 0.35), (-2.2, -0.8), (0.0, 1.9)),
        _solid((10.4, 11.6), (1.6, 2.0), (0.0, 0.75)),
        (prism(circle((0.3, 2.7), 0.12, 32), (7.0, 15.6), axis=0), SOLID),  # a duct under the ceiling
    ]
    way = [
        *((0.9, -5.4), (0.9, 1.0), (8.7, 1.0), (8.7, 7.2), (9.4, 7.2), (9.4, 0.9), (17.0, 0.9), (17.0, 1.4)),
        *((14.4, 1.4), (14.4, 3.2), (12.7, 3.2)),
    ]
    return parts, way


def slanted() -> tuple[Parts, list[Point]]:
    """Three rooms whose walls meet at 30, 45 and 60 deg, under pitched roofs."""
    outline = [(0.0, 0.0), (7.0, 0.0), (8.5, 2.598), (6.0, 5.098), (2.0, 5.098), (0.0, 3.943)]
    large = prism(outline, (0.0, 5.0))
    for side in (-1, 1):  # 35 deg, eaves at 2.4 m and more
        large = below(large, (0.0, side * math.sin(math.radians(35)), math.cos(math.radians(35))), (0.0, 2.5, 4.2))
    to_east, to_north = ((7.75, 1.299), -30.0), ((7.25, 3.848), 45.0)  # frames of two walls, x through them
    east = prism(placed_at(*to_east, [(0.1, -1.75), (5.1, -1.75), (5.1, 1.75), (0.1, 1.75)]), (0.0, 5.0))
    east = below(east, (0.2, -0.35, 1.0), (10.0, 0.0, 3.1))
    north = prism(placed_at(*to_north, [(0.1, -1.2), (3.0, -1.2), (4.0, 2.2), (0.1, 1.7)]), (0.0, 2.6))
    door = [(-0.05, -0.45), (0.15, -0.45), (0.15, 0.45), (-0.05, 0.45)]
    strut = [(0.3, 4.1, 0.0), (0.3, 2.6, 0.0), (0.0, 3.4, 2.2), (1.0, 3.4, 0.0), (1.0, 4.2, 0.0), (0.0, 4.2, 2.2)]
    parts = [
        _solid((-0.4, 14.0), (-4.5, 9.5), (-0.2, 5.2)),
        *((shape, FREE) for shape in (large, east, north)),
        (prism(placed_at(*to_east, door), (0.0, 2.0)), FREE),
        (prism(placed_at(*to_north, door), (0.0, 2.0)), FREE),
        _free((2.6, 3.6), (0.6, 1.4), (2.2, 5.2)),  # a skylight
        _free((2.4, 4.4), (-0.4, 0.0), (0.9, 1.9)),  # a window
        _free((-0.2, 0.0), (1.2, 2.4), (0.8, 2.0)),  # a niche
        (prism(placed_at(*to_east, [(5.1, -0.7), (6.0, -0.7), (6.0, 0.7), (5.1, 0.7)]), (0.9, 2.1)), FREE),
        (convex(np.array(strut)), SOLID),
        *(_solid((x, x + 0.18), (0.0, 5.2), (2.55, 2.75)) for x in (1.8, 5.0)),  # tie beams
        (prism(circle((5.0, 2.6), 0.2, 3), (0.0, 5.0)), SOLID),  # a column with three sides, up into the roof
        (prism(placed_at(*to_north, [(2.2, 0.9), (2.9, 0.7), (3.1, 1.4), (2.4, 1.6)]), (0.0, 1.4)), SOLID),
        (prism(placed_at(*to_east, [(3.9, -1.75), (5.1, -1.75), (5.1, -1.1)]), (0.0, 1.7)), SOLID),
    ]

    # Solid parts that reach into walls and roofs leave no trace there, but those above the roof must not be hit.
    def along(frame: tuple[Point, float], *points: Point) -> list[Point]:
        return placed_at(*frame, points)

    way = [
        *((5.9, 0.8), (1.0, 0.8), (1.0, 2.2), (2.9, 2.2), (2.9, 4.3), (6.0, 4.3), (6.0, 2.7), (4.0, 1.5)),
        *((5.6, 1.3), (6.6, 1.96)),
        *along(to_east, (0.0, 0.0), (4.4, 0.0), (4.4, 1.0), (1.6, 1.0), (1.6, -1.0), (3.2, -1.0), (3.2, 0.0)),
        *along(to_east, (0.0, 0.0), (-1.1, 0.1)),
        *along(to_north, (-1.1, 0.0), (0.0, 0.0), (2.5, 0.0), (2.5, -0.6), (1.0, -0.6), (1.0, 1.1), (1.7, 1.1)),
    ]
    return parts, way


def vaulted() -> tuple[Parts, list[Point]]:
    """A vaulted nave with a transept, round niches and columns, and a round tower under a dome."""
    dome = [(2.6, 0.0), (2.6, 2.2), *((2.6 * math.cos(a), 2.2 + 2.2 * math.sin(a)) for a in np.linspace(0.1, 1.5, 12))]
    column = [(0.28, 0.0), (0.2, 4.8)]
    parts = [
        _solid((-0.4, 18.2), (-2.0, 7.0), (-0.2, 5.2)),
        (prism(arch((0.0, 5.0), 2.0), (0.0, 12.0), axis=0), FREE),
        (prism(arch((4.4, 7.6), 1.6), (-1.5, 6.5), axis=1), FREE),
        (turned((15.2, 2.5), dome), FREE),
        (prism(arch((1.9, 3.1), 1.5), (11.9, 13.2), axis=0), FREE),
        *((prism(circle(center, 0.6), (0.0, 2.0)), FREE) for center in ((2.2, 0.0), (2.2, 5.0), (9.8, 0.0))),
        (prism(circle((9.8, 1.6), 0.5), (5.0, 5.3), axis=1), FREE),  # a round blind window
        (prism(circle((2.5, 2.4), 0.8), (-0.4, 0.0), axis=0), FREE),  # a rose window
        *((turned(center, column), SOLID) for center in ((3.3, 2.5), (9.0, 2.3))),
        (prism(circle((16.9, 2.4), 0.3), (0.0, 1.1)), SOLID),
    ]
    way = [
        *((1.0, 3.9), (1.0, 1.2), (6.5, 1.2), (6.5, -0.6), (5.5, -0.6), (5.5, 5.6), (6.5, 5.6), (6.5, 3.8)),
        *((10.6, 3.8), (10.6, 2.5), (14.4, 2.5), (15.4, 4.2), (16.4, 3.6), (16.0, 1.2), (14.2, 0.9), (13.6, 2.0)),
    ]
    return parts, way


@functools.cache
def built(name: str) -> tuple[Float, Int, tuple[Point, ...]]:
    """Vertices and faces of a building, and the way through it."""
    parts, way = BUILDINGS[name]()
    return *surface(parts), tuple(way)


BUILDINGS: dict[str, Callable[[], tuple[Parts, list[Point]]]] = {
    building.__name__: building for building in (offices, hall, corridor, slanted, vaulted)
}

VARIANTS: dict[str, dict[str, float | bool]] = {
    "s05": {"noise": 0.005},
    "s2": {"noise": 0.02},
    "s3": {"noise": 0.03},
    "out": {"outliers": 0.01},
    "drift": {"drift": 0.05},
    "half": {"step": 0.13},
    "double": {"step": 0.0325},
    "fine": {"beam_spacing": 0.5},
    "round": {"all_round": True, "height": 1.2, "step": 0.13},
    "level": {"rotated": False},
    "nosensor": {"known_sensor": False},
}


def make(name: str, seed: int = 0) -> Scanned:
    """The cloud of a name: a building, and variants of the survey after underscores, as in `hall_s3_nosensor`."""
    building, *variants = name.split("_")
    changes: dict[str, float | bool] = {}
    for variant in variants:
        changes |= VARIANTS[variant]
    return scan(*built(building), Survey(**changes, seed=seed))  # type: ignore[arg-type]


def two_cubes(spacing: float = 0.1) -> Scanned:
    """The paper's two unit cubes, 0.5 m apart, free of noise: 11 x 11 points on each of their sides (section 4)."""
    grid = np.linspace(0, 1, round(1 / spacing) + 1)
    u, v = (along.ravel() for along in np.meshgrid(grid, grid))
    sides = [
        np.roll(np.column_stack([np.full(u.size, end), u, v]), axis, axis=1) for axis in range(3) for end in (0.0, 1.0)
    ]
    one = np.concatenate(sides)
    parts = [(box((-1, 4), (-1, 2), (-1, 2)), FREE), *((box((x, x + 1), (0, 1), (0, 1)), SOLID) for x in (0.0, 1.5))]
    points = np.concatenate([one, one + [1.5, 0, 0]])
    return Scanned(points, None, points, *surface(parts))


def solids(noise: float = 0.01, count: int = 40_000, seed: int = 0) -> Scanned:
    """A sphere (radius 1 m) beside a torus (1 m and 0.35 m), evenly sampled and seen from 2 m before the surface."""
    rng = np.random.default_rng(seed)
    pieces = [_grid(_sphere, 120, 240), _grid(_torus, 120, 360)]
    vertices = np.concatenate([piece[0] for piece in pieces])
    faces = np.concatenate([pieces[0][1], pieces[1][1] + len(pieces[0][0])])
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    face = rng.choice(len(faces), count, p=area / area.sum())
    uv = rng.random((count, 2))
    uv[uv.sum(axis=1) > 1] = 1 - uv[uv.sum(axis=1) > 1]
    clean = a[face] + uv[:, :1] * (b - a)[face] + uv[:, 1:] * (c - a)[face]
    outward = normal[face] / area[face, None]
    return Scanned(clean + rng.normal(0, noise, (count, 1)) * outward, clean + 2 * outward, clean, vertices, faces)


def _grid(shape: Callable[[Float, Float], Float], rows: int, columns: int) -> tuple[Float, Int]:
    """Triangles over a shape of two parameters from 0 to 1, the outside to the front."""
    u, v = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    vertices = shape(u.ravel(), v.ravel())
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    right, below_it = corner + 1, corner + columns + 1
    faces = np.concatenate(
        [np.column_stack([corner, below_it, right]), np.column_stack([right, below_it, below_it + 1])]
    )
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return vertices, faces[np.linalg.norm(np.cross(b - a, c - a), axis=1) > _SLIVER]


def _sphere(u: Float, v: Float) -> Float:
    polar, around = math.pi * u, 2 * math.pi * v
    return np.column_stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)])


def _torus(u: Float, v: Float) -> Float:
    tube, around = -2 * math.pi * u, 2 * math.pi * v
    out = 1 + 0.35 * np.cos(tube)
    return np.column_stack([3 + out * np.cos(around), out * np.sin(around), 0.35 * np.sin(tube)])


def tiled(cloud: Cloud, copies: int, gap: float = 1.0) -> Cloud:
    """Copies of a cloud side by side, `gap` metres apart, on a square as far as they go."""
    across = math.ceil(math.sqrt(copies))
    size = np.ptp(cloud.points, axis=0) + gap
    shifts = [(*divmod(copy, across), 0) * size for copy in range(copies)]
    return concatenate([Cloud(cloud.points + s, None if cloud.sensor is None else cloud.sensor + s) for s in shifts])


if __name__ == "__main__":
    np.savez_compressed(sys.argv[2] if len(sys.argv) > 2 else f"{sys.argv[1]}.npz", **make(sys.argv[1]).arrays())
