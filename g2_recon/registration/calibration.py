# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""How the vertical laser is mounted, from a drive: the planes that it sees must be planes.

A wall that is seen at several headings is thick where the mounting pose is wrong. As in Levinson and Thrun,
"Unsupervised calibration for multi-beam lasers" (2010), the pose is sought at which surfaces are thinnest, here by
least squares with the planes of small patches as further unknowns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import chdtri, fdtri

from g2_recon.config import RegistrationConfig
from g2_recon.errors import InputError
from g2_recon.geometry import se3
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.progress import Progress, silent

Float = NDArray[np.float64]
Int = NDArray[np.int64]

AXES = ("x", "y", "z", "about x", "about y", "about z")
"""Of the robot: forward, left, up, in metres; turns about them in radians."""

# Scans are used where the robot has moved or turned by so much; more would not make it better than the errors of the
# trajectory let it be.
_APART_M, _APART_RAD, _MOST_SCANS = 0.1, math.radians(2.0), 2000
_FEWEST_POINTS = 1000
# Normals come from so many beams to each side and so many points of each scan beside, so near.
_BESIDE, _ACROSS, _NORMAL_REACH_M = 2, 3, 0.5
# So thin is what is flat; cosine between the normals of a point and of its plane at least.
_FLAT_M, _ALIKE = 0.02, 0.97
# Rounds: edge of a patch and scale of the residuals that count, m.
_ROUNDS = [(2.0, 0.5)] * 4 + [(1.5, 0.25)] * 4 + [(1.0, 0.12)] * 4 + [(1.0, 0.06)] * 8
_NEW_NORMALS = 4
_FEWEST_OF_PATCH = 12
# Errors of the trajectory are alike for so long.
_ALIKE_S, _PARTS = 3.0, 20
# Surfaces that face up so near to the height of the robot's frame are the floor.
_FLOOR_M, _FEWEST_OF_FLOOR = 0.25, 200
# Cubes lie askew: where a wall is the border of two, noise would tell to which one a point belongs.
_ASKEW = Rotation.from_rotvec([0.5, 0.7, 0.9]).as_matrix()
# Noise of a range, and how far the trajectory is off from scan to scan, in proportion. A beam so oblique tells nothing.
_RANGE_SIGMA_M, _PLACE_SIGMA_M = 0.01, 0.003
_LEAST_FACING = 0.15
# No room is as exact as this, m and rad.
_AT_BEST = np.array([2e-4, 2e-4, 2e-4, 1e-4, 1e-4, 1e-4])
# What is known worse than this is not observed, m and rad; the start may be off by so many times that.
_OBSERVED = np.array([0.02, 0.02, 0.02, math.radians(0.5), math.radians(0.5), math.radians(0.5)])
_UNKNOWN = 5.0


@dataclass(frozen=True, slots=True)
class Calibration:
    """T_base_laser (4, 4) and its covariance (6, 6) along and about x y z of the robot, at the laser; m and rad.

    start: (4, 4) from where it was sought. thickness: RMS distance in metres of the points from their planes.
    unobserved: in words, what this drive does not tell; there the pose is that of the start. floor: whether the floor
    was seen, which is taken to be at height 0.
    """

    T_base_laser: Float
    start: Float
    covariance: Float
    thickness: float
    unobserved: tuple[str, ...]
    floor: bool

    @property
    def sigma(self) -> Float:
        """Standard deviations (6,), see AXES."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True, slots=True)
class _Beams:
    """in_laser: (N, 3) m. rotations (N, 3, 3), positions (N, 3): T_map_base at their times (N,). scan: (N,) number."""

    in_laser: Float
    rotations: Float
    positions: Float
    times: Float
    scan: Int

    def in_map(self, T_base_laser: Float) -> Float:
        """Points (N, 3)."""
        on_robot = self.in_laser @ T_base_laser[:3, :3].T + T_base_laser[:3, 3]
        return np.asarray(np.einsum("nij,nj->ni", self.rotations, on_robot) + self.positions)


def calibrate(
    scans: Sequence[Scan],
    trajectory: Trajectory,
    T_base_laser: ArrayLike,
    config: RegistrationConfig,
    *,
    progress: Progress = silent,
) -> Calibration:
    """The mounting pose of a vertical laser from its scans, the trajectory (T_map_base) and a start (4, 4) for it.

    The start may be off by some centimetres and degrees. Raises InputError where there is too little to see.
    """
    start = se3.orthonormal(T_base_laser)
    beams = _beams(scans, trajectory, config)
    T = start
    normals: Float = np.empty((0, 3))
    for index, (edge, scale) in enumerate(_ROUNDS):
        if index % _NEW_NORMALS == 0:
            normals, flat = _normals(beams, T)
        T = _moved(T, _Problem(beams, T, normals, flat, edge, scale, start).step())
        progress("calibration", index + 1, len(_ROUNDS))
    problem = _Problem(beams, T, normals, flat, *_ROUNDS[-1], start)
    covariance = problem.covariance()
    return Calibration(T, start, covariance, problem.thickness, _unobserved(covariance), problem.floor)


def _beams(scans: Sequence[Scan], trajectory: Trajectory, config: RegistrationConfig) -> _Beams:
    """The beams of scans between which the robot has moved on."""
    parts = []
    for number, scan in enumerate(_apart(scans, trajectory, config)):
        points, beams = scan.points(range_min=config.min_range, range_max=config.max_range)
        times = scan.stamp + scan.time_increment * beams
        parts.append(np.column_stack([points, np.zeros(len(points)), times, np.full(len(points), number)]))
    rows = np.concatenate(parts) if parts else np.empty((0, 5))
    T_map_base, known = trajectory.interpolate(rows[:, 3], max_gap=config.max_gap)
    if np.count_nonzero(known) < _FEWEST_POINTS:
        raise InputError(
            f"only {np.count_nonzero(known)} beams of {len(scans)} vertical scans can be placed, where it has moved",
            advice=f"calibration needs {_FEWEST_POINTS}: drive farther, or check the clocks of the lasers",
        )
    rows, T_map_base = rows[known], T_map_base[known]
    return _Beams(rows[:, :3], T_map_base[:, :3, :3], T_map_base[:, :3, 3], rows[:, 3], rows[:, 4].astype(np.int64))


def _apart(scans: Sequence[Scan], trajectory: Trajectory, config: RegistrationConfig) -> list[Scan]:
    poses, known = trajectory.interpolate([scan.stamp for scan in scans], max_gap=config.max_gap)
    kept: list[Scan] = []
    last: Float | None = None
    for index in np.flatnonzero(known):
        pose = poses[index]
        turned = 3.0 if last is None else float(np.trace(last[:3, :3].T @ pose[:3, :3]))
        if (
            last is None
            or np.linalg.norm(pose[:3, 3] - last[:3, 3]) > _APART_M
            or turned < 1 + 2 * math.cos(_APART_RAD)
        ):
            kept.append(scans[index])
            last = pose
    return kept[:: max(math.ceil(len(kept) / _MOST_SCANS), 1)]


def _normals(beams: _Beams, T_base_laser: Float) -> tuple[Float, NDArray[np.bool_]]:
    """Unit normals (N, 3) in the laser frame, towards the laser, and which of them (N,) are of flat surroundings.

    They come from points of the same scan and the two beside it, which share the error of the mounting pose.
    """
    points = beams.in_map(T_base_laser)
    count = len(points)
    # Scans far apart, so that neighbors are looked for in one at a time.
    shifted = np.column_stack([points, 1000.0 * beams.scan])
    tree = cKDTree(shifted)
    groups = [np.clip(np.arange(count)[:, None] + np.arange(-_BESIDE, _BESIDE + 1), 0, count - 1)]
    for side in (-1, 1):
        near = tree.query(shifted + (0, 0, 0, 1000.0 * side), _ACROSS, distance_upper_bound=_NORMAL_REACH_M)[1]
        groups.append(np.where(near < count, near, np.arange(count)[:, None]))
    across = [(group != np.arange(count)[:, None]).sum(axis=1) for group in groups[1:]]
    near = np.hstack(groups)
    neighbors = points[near]
    offsets = neighbors - points[:, None]
    weight = (np.linalg.norm(offsets, axis=2) < _NORMAL_REACH_M).astype(float)
    total = weight.sum(axis=1)
    offsets -= (np.einsum("nk,nki->ni", weight, offsets) / total[:, None])[:, None]
    offsets *= np.sqrt(weight / total[:, None])[:, :, None]
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
    flat = (values[:, 0] < _FLAT_M**2) & (values[:, 1] > (2 * _FLAT_M) ** 2) & (np.maximum(*across) > 0)
    to_laser = beams.rotations @ T_base_laser[:3, 3] + beams.positions - points
    normals = vectors[:, :, 0] * np.sign(np.einsum("ni,ni->n", vectors[:, :, 0], to_laser))[:, None]
    in_base = np.einsum("nji,nj->ni", beams.rotations, normals)
    return in_base @ T_base_laser[:3, :3], flat


class _Problem:
    """Least squares at one mounting pose: distances of points from the planes of their patches."""

    def __init__(
        self,
        beams: _Beams,
        T: Float,
        normals: Float,
        flat: NDArray[np.bool_],
        edge: float,
        scale: float,
        start: Float,
    ) -> None:
        points = beams.in_map(T)
        normals = np.einsum("nij,nj->ni", beams.rotations, normals @ T[:3, :3].T)
        patch, count = _patches(points, normals, flat, edge)
        if not count:
            raise InputError("no flat surface was seen well enough", advice="drive past walls, no faster than it scans")
        inside = patch >= 0
        rows, patch = np.flatnonzero(inside), patch[inside]
        points, normals = points[rows], normals[rows]
        rotations: Float = beams.rotations[rows]
        laser = rotations @ T[:3, 3] + beams.positions[rows]
        planes = _planes(points, laser, normals, patch, count, scale)
        # How a point moves: with the laser, and turned about it, in the axes of the robot.
        along = np.einsum("ni,nij->nj", planes.normal[patch], rotations)
        expected = np.einsum("nji,nj->ni", rotations, planes.expected - laser)
        self._raw_J = np.hstack([along, np.cross(expected, along)])
        self._patch, self._moves_of_planes = patch, _moves_of_planes(planes, patch)[0]
        J = _without_planes(self._raw_J, planes, patch)
        self._rest = T, start
        self._J, self._residual, self._weight, self._times = J, planes.residual, planes.weight, beams.times[rows]
        used = max(float((planes.weight > 0).sum()), 1.0)
        self._variance = max(float((planes.weight * planes.residual**2).sum()) / used, 1e-6)
        self.thickness = math.sqrt(float((planes.robust * planes.residual**2).sum() / max(planes.robust.sum(), 1e-9)))
        self._add_floor(beams, T, points, normals, rows, points - laser)

    def _add_floor(self, beams: _Beams, T: Float, points: Float, normals: Float, rows: Int, arm: Float) -> None:
        floor = (normals[:, 2] > math.cos(math.radians(15))) & (np.abs(points[:, 2]) < _FLOOR_M)
        self.floor = int(floor.sum()) >= _FEWEST_OF_FLOOR
        if not self.floor:
            return
        along = beams.rotations[rows[floor], 2]
        arm = np.einsum("nji,nj->ni", beams.rotations[rows[floor]], arm[floor])
        J = np.hstack([along, np.cross(arm, along)])
        height = points[floor, 2]
        weight = 1 / (1 + (height / 0.05) ** 2) ** 2 / _RANGE_SIGMA_M**2
        self._J = np.concatenate([self._J, J])
        self._raw_J = np.concatenate([self._raw_J, J])
        self._moves_of_planes = np.concatenate([self._moves_of_planes, np.zeros((len(J), 3))])
        self._patch = np.concatenate([self._patch, np.full(len(J), self._patch.max() + 1)])
        self._residual = np.concatenate([self._residual, height])
        self._weight = np.concatenate([self._weight, weight])
        self._times = np.concatenate([self._times, beams.times[rows[floor]]])

    def _observed(self) -> tuple[Float, Float]:
        """Directions (6, k) that are observed, in units of _OBSERVED, and the information (k,) there is on each."""
        weighted = self._J * (self._weight / self._variance)[:, None]
        information, directions = np.linalg.eigh(_OBSERVED[:, None] * (weighted.T @ self._J) * _OBSERVED)
        seen = information > 1.0
        return directions[:, seen], information[seen]

    def step(self) -> Float:
        """The Gauss-Newton step (6,) where something is observed; elsewhere back to the start."""
        T, start = self._rest
        turn = Rotation.from_matrix(T[:3, :3] @ start[:3, :3].T).as_rotvec()
        away = np.concatenate([T[:3, 3] - start[:3, 3], turn]) / _OBSERVED
        directions, information = self._observed()
        gradient = _OBSERVED * (self._J.T @ (self._weight / self._variance * self._residual))
        step = -directions @ ((directions.T @ gradient) / information)
        return np.asarray(_OBSERVED * (step - away + directions @ (directions.T @ away)))

    def covariance(self) -> Float:
        """Covariance (6, 6) by the jackknife: how far the pose moves, planes and all, without parts of the drive.

        Points of the same time err together, by the error of the trajectory, and so go together (delete-a-group
        jackknife; Kott, "The delete-a-group jackknife", Journal of Official Statistics 17(4), 2001). It is as wide as
        it takes for a region of 95 % by the normal distribution to be one.
        """
        directions, _ = self._observed()
        block = ((self._times - self._times.min()) / _ALIKE_S).astype(np.int64)
        parts = min(_PARTS, int(block.max()) + 1)
        J = self._raw_J * _OBSERVED @ directions
        columns = np.column_stack([self._moves_of_planes, J, self._residual])
        number = self._patch * parts + block % parts
        moments = _sums(columns, columns, self._weight, number, (int(self._patch.max()) + 1) * parts)
        moments = moments.reshape(-1, parts, *moments.shape[1:])
        total = moments.sum(axis=1)
        poses = np.array([_solution(total - moments[:, part]) for part in range(parts)])
        off = (poses - poses.mean(axis=0)) @ directions.T
        spread = off.T @ off * ((parts - 1) / parts * _widened(parts, poses.shape[1]))
        spread += _UNKNOWN**2 * (np.eye(6) - directions @ directions.T)
        return np.asarray(_OBSERVED[:, None] * spread * _OBSERVED + np.diag(_AT_BEST**2))


def _widened(parts: int, axes: int) -> float:
    """By what a covariance from so few parts must be multiplied to be used as if it was known (Hotelling's T^2)."""
    if axes == 0 or parts <= axes + 1:
        return 1.0
    hotelling = axes * (parts - 1) / (parts - axes) * fdtri(axes, parts - axes, 0.95)
    return float(hotelling / chdtri(axes, 0.05))


def _solution(moments: Float) -> Float:
    """The pose (P,) of least squares from moments (G, 4 + P, 4 + P) of planes, pose and residual of each patch."""
    AA, AB = moments[:, :3, :3], moments[:, :3, 3:]
    rest = moments[:, 3:, 3:] - AB.transpose(0, 2, 1) @ np.linalg.solve(AA + 1e-6 * np.eye(3), AB)
    H = rest.sum(axis=0)
    return np.asarray(-np.linalg.solve(H[:-1, :-1] + 1e-9 * np.eye(len(H) - 1), H[:-1, -1]))


def _patches(points: Float, normals: Float, flat: NDArray[np.bool_], edge: float) -> tuple[Int, int]:
    """The patch (N,) of each point, -1 for none, and how many there are: points of a cube that face the same way."""
    directions = np.array([(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if i or j or k], float)
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    facing = np.argmax(normals @ directions.T, axis=1)
    cell = np.floor(points @ _ASKEW / edge).astype(np.int64)
    cell -= cell.min(axis=0)
    size = cell.max(axis=0) + 1
    key = ((cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]) * len(directions) + facing
    _, patch, counts = np.unique(key, return_inverse=True, return_counts=True)
    patch = patch.reshape(-1)
    used = counts >= _FEWEST_OF_PATCH
    number = np.where(used, np.cumsum(used) - 1, -1)[patch]
    number[~flat] = -1
    return number, int(used.sum())


@dataclass(frozen=True, slots=True)
class _Planes:
    """Planes: center, normal (G, 3). Of the points (N, ...), each with its plane, the others.

    expected: (N, 3) m, where the beam meets the plane. residual: (N,) m, distance from the plane. robust: (N,) from 0
    to 1, whether it belongs to it. weight: (N,) 1/m^2.
    """

    center: Float
    normal: Float
    expected: Float
    residual: Float
    robust: Float
    weight: Float


def _planes(points: Float, laser: Float, normals: Float, patch: Int, count: int, scale: float) -> _Planes:
    """The planes of patches, by what beams measure: noise is along the beam, and so oblique ones count the less.

    Where a point is thought to be must not depend on its noise: it would turn the planes, and the laser with them.
    """
    ranges = np.linalg.norm(points - laser, axis=1)
    beam = (points - laser) / ranges[:, None]
    center, normal, robust = _thin_planes(points, normals, patch, count, scale)
    for _ in range(3):
        facing = np.einsum("ni,ni->n", normal[patch], beam)
        residual = np.einsum("ni,ni->n", normal[patch], points - center[patch])
        off = np.abs(facing) < _LEAST_FACING
        expected = points - np.where(off, 0.0, residual / np.where(off, 1.0, facing))[:, None] * beam
        robust = np.where(off, 0.0, robust)
        weight = robust / ((facing * _RANGE_SIGMA_M) ** 2 + _PLACE_SIGMA_M**2)
        planes = _Planes(center, normal, expected, residual, robust, weight * _trust(residual, robust, patch, count))
        weight = planes.weight
        A, axes = _moves_of_planes(planes, patch)
        AA, Ar = _sums(A, A, weight, patch, count), _sums(A, residual[:, None], weight, patch, count)[:, :, 0]
        shift = np.linalg.solve(AA + 1e-6 * np.eye(3), Ar[:, :, None])[:, :, 0]
        center = center + shift[:, :1] * normal
        normal = normal - shift[:, 1:2] * axes[0] - shift[:, 2:] * axes[1]
        normal /= np.linalg.norm(normal, axis=1)[:, None]
    return planes


def _trust(residual: Float, robust: Float, patch: Int, count: int) -> Float:
    """How far (N,), from 0 to 1, the patches of points are to be trusted: less where they are thicker than most."""
    total = np.bincount(patch, robust, count)
    thickness = np.bincount(patch, robust * residual**2, count) / np.maximum(total, 1e-9)
    usual = np.median(thickness[total > 0]) if (total > 0).any() else 1.0
    return np.asarray(np.minimum(1.0, (2 * usual + 1e-9) / np.maximum(thickness, 1e-12))[patch] ** 4)


def _thin_planes(points: Float, normals: Float, patch: Int, count: int, scale: float) -> tuple[Float, Float, Float]:
    """Centers and normals (G, 3) of the planes, and weights (N,) of the points (Geman and McClure's kernel)."""
    weight: Float = np.ones(len(points))
    center: Float = np.zeros((count, 3))
    normal: Float = center
    for _ in range(4):
        total = np.maximum(np.bincount(patch, weight, count), 1e-12)
        center = np.column_stack([np.bincount(patch, weight * column, count) for column in points.T]) / total[:, None]
        offset = points - center[patch]
        normal = np.linalg.eigh(_sums(offset, offset, weight, patch, count))[1][:, :, 0]
        distance = np.einsum("ni,ni->n", normal[patch], offset)
        agree = np.abs(np.einsum("ni,ni->n", normal[patch], normals)) > _ALIKE
        weight = np.where(agree, 1 / (1 + (distance / scale) ** 2) ** 2, 0.0)
    return center, normal, weight


def _moves_of_planes(planes: _Planes, patch: Int) -> tuple[Float, tuple[Float, Float]]:
    """How residuals (N, 3) change with the offset and two tilts of the planes, about axes along these two (G, 3)."""
    normal = planes.normal
    tangent = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal), axis=1)])
    tangent = np.asarray(tangent / np.linalg.norm(tangent, axis=1)[:, None], float)
    second = np.asarray(np.cross(normal, tangent), float)
    offset = planes.expected - planes.center[patch]
    moves = np.ones((len(offset), 3))
    for column, axis in enumerate((tangent, second), start=1):
        moves[:, column] = np.einsum("ni,ni->n", offset, axis[patch])
    return moves, (tangent, second)


def _sums(left: Float, right: Float, weight: Float, patch: Int, count: int) -> Float:
    """Weighted sums (G, A, B) of the products of columns (N, A) and (N, B) over each patch."""
    result = np.empty((count, left.shape[1], right.shape[1]))
    for i, one in enumerate(left.T):
        for j, other in enumerate(right.T):
            result[:, i, j] = np.bincount(patch, weight * one * other, count)
    return result


def _without_planes(J: Float, planes: _Planes, patch: Int) -> Float:
    """J (N, P) without what the planes can take up: their offsets and tilts are unknown, too."""
    A, _ = _moves_of_planes(planes, patch)
    count = len(planes.center)
    AA, AJ = (_sums(A, columns, planes.weight, patch, count) for columns in (A, J))
    taken = np.linalg.solve(AA + 1e-6 * np.eye(3), AJ)
    return np.asarray(J - np.einsum("ni,nij->nj", A, taken[patch]))


def _moved(T: Float, step: Float) -> Float:
    result = T.copy()
    result[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ T[:3, :3]
    result[:3, 3] += step[:3]
    return result


def _unobserved(covariance: Float) -> tuple[str, ...]:
    sigma = np.sqrt(np.diag(covariance))
    why = (
        "x, forward: no wall was seen at headings that differ enough",
        "y, to the left: no wall was seen from both sides of the robot, or at headings that differ enough",
        "z, the height: the floor was not seen, and all other surfaces fit at any height",
        "the turn about x, to the side: no surface was seen from both sides of the robot",
        "the turn about y, forward: no wall was seen at headings that differ enough",
        "the turn about z, the heading: no wall was seen at headings that differ enough",
    )
    return tuple(text for text, s, limit in zip(why, sigma, _OBSERVED, strict=True) if s > limit)
