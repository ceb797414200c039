# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Where in a whole map is a robot that does not know its place? From one scan, or from some that belong together.

Branch and bound over the map and all headings (Hess et al., ICRA 2016) finds the places where the points fit best. Each
is refined by ICP on the keyframes that see the most of it, and judged by what both see and by what one sees where the
other looked through. A place is sure if it is good, if no other one is nearly as good, and if the scans hold it in all
directions: twin rooms and bare corridors are not sure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry import se2
from g2_recon.geometry.se2_kernels import compose, relative, solve_3x3, wrap
from g2_recon.kernels import kernel
from g2_recon.localization import branch_and_bound, likelihood
from g2_recon.localization.beams import ANY_KIND, CORNER, INVALID, Beams
from g2_recon.localization.keyframes import Keyframes
from g2_recon.localization.pairing import (
    PAIR_SIGMA_M,
    add_levered,
    agreement,
    agreements_each_way,
    lay,
    parted,
    picked,
    room,
)
from g2_recon.localization.point_map import first_in_each_cell

Float = NDArray[np.float64]
Int = NDArray[np.int64]

# The map: cells, their blur, how far from a keyframe its points count, and how many cells there may be; a larger map
# gets larger cells.
_RESOLUTION_M, _SIGMA_M, _MAP_RANGE_M = 0.1, 0.1, 30.0
_LEVELS, _MOST_CELLS, _COARSEST_M = 5, 16_000_000, 0.4
# Free space is kept in blocks of cells, which beams mark from step to step.
_FREE_BLOCK, _FREE_STEP_M = 4, 0.2

# The query: so many points from so near, thinned to such cells.
_QUERY_POINTS, _QUERY_RANGE_M, _QUERY_CELL_M, _FEWEST_POINTS = 200, 20.0, 0.1, 40
_TURNS = 480
# Candidates: least score, share of the best, how many; within this distance and angle only the best counts.
_LEAST_SCORE, _LEAST_SHARE, _MOST_CANDIDATES = 0.5, 0.8, 12
_NEAR_M, _NEAR_TURNS = 0.4, 12

# Keyframes within this distance are asked what they see of a scan; so many of them, of which these see the most.
_TOGETHER_M, _ASKED, _REFERENCES, _ASK_STEP = 8.0, 64, 8, 3
_DISTANCE_M, _KERNEL_M, _ITERATIONS = (0.3, 0.12), (0.1, 0.045), 12
# Before, the best place is looked for between the cells; after, it must not score less by this.
_TURN, _CLIMBS, _SLID_SCORE, _UNHELD = 2 * math.pi / _TURNS, 4, 0.02, 1e-3

# A place is sure with at least these, as walls do not go away, if no other one has more than this share of its value,
# within so much sigma.
_SURE_QUALITY, _SURE_STANDING, _SURE_SHARE = 0.9, 0.97, 0.9
# Much that fits for the most part is as good as little that fits well: m of wall, and the value that goes with it.
_SURE_WALL_M, _SURE_VALUE = (8.0, 16.0, 40.0), (0.88, 0.84, 0.8)
_SURE_SIGMA_M, _SURE_SIGMA_RAD = 0.05, 0.02
# Nearer than this, places are the same.
_SAME_M, _SAME_RAD = 0.1, 0.05

# A pose that somebody gives is wrong by no more than this; how good the place must be.
GIVEN_M, GIVEN_RAD = 1.0, math.radians(20.0)
_GIVEN_SCORE, _GIVEN_QUALITY = 0.5, 0.8
# A place is looked for after one more keyframe, after a quarter more of them, and at least after so many.
_SHARE_MORE, _MOST_MORE = 4, 20


@dataclass(frozen=True, slots=True)
class Place:
    """Where the last of some scans may lie.

    pose: (3,) T_map_laser. information: (3, 3) of the pose. score: mean likelihood of the points, 0 to 1. quality:
    share of agreement, as of a Placement. standing: share of the points of the map in view that are still there; the
    scans look through the others. inliers: share of the beams in view that have a partner. wall: m of surface
    that the scans saw.
    """

    pose: Float
    information: Float
    score: float
    quality: float
    standing: float
    inliers: float
    wall: float

    @property
    def value(self) -> float:
        """How good the place is, 0 to 1."""
        return self.score * self.quality * self.standing


class WholeMap:
    """The keyframes of a map that stays as it is, and its likelihoods and free space on all levels."""

    def __init__(self, keyframes: Keyframes) -> None:
        """Raises InputError where the keyframes lie so far apart that there is no memory to search between them."""
        self._keyframes = keyframes
        # Where normals were not kept, they are made once.
        self._arrays = keyframes.arrays
        points, _, kinds, _, _ = self._arrays
        poses = keyframes.poses
        scans = []
        for k in range(len(keyframes)):
            near = (kinds[k] != INVALID) & (np.hypot(points[k, :, 0], points[k, :, 1]) < _MAP_RANGE_M)
            scans.append(se2.transform_points(poses[k], points[k][near]))
        # Where the laser was is in the map, too.
        cloud = np.concatenate([poses[:, :2], *scans])
        extent = np.prod(np.ptp(cloud, axis=0) + 5.0)
        resolution = _RESOLUTION_M
        while extent / resolution**2 > _MOST_CELLS:
            resolution *= 2
            if resolution > _COARSEST_M:
                raise InputError(f"a map of {extent:.3g} m^2 is too large to search for a place", advice="map in parts")
        cloud = cloud[len(poses) :]
        cloud = cloud[first_in_each_cell(cloud, 0.5 * resolution)] if len(cloud) else poses[:1, :2]
        made = branch_and_bound.pyramid(np.concatenate([poses[:, :2], cloud]), resolution=resolution, sigma=resolution)
        self._levels, self._corner, self._resolution = made.levels, made.corner, resolution
        self._free = np.zeros_like(self._levels)
        block = _FREE_BLOCK * resolution
        coarse = np.zeros(-(-np.array(self._levels.shape[1:]) // _FREE_BLOCK), np.uint8)
        _mark_free(coarse, poses, points, kinds, self._corner, block, _FREE_STEP_M)
        fine = coarse.repeat(_FREE_BLOCK, axis=0).repeat(_FREE_BLOCK, axis=1)
        self._free[0] = fine[: self._free.shape[1], : self._free.shape[2]]
        branch_and_bound.raise_maxima(self._free)

    def find(self, scans: Keyframes, rows: Int) -> Place | None:
        """Where the last of some scans (M,) lies, None where that is not sure; see `places`."""
        places, whole = self.places(scans, rows)
        return places[0] if whole and is_sure(places) else None

    def places(self, scans: Keyframes, rows: Int) -> tuple[list[Place], bool]:
        """Where the last of some scans (M,) may lie, the best first, and whether the search went to its end.

        The poses of the scans tell how they lie to one another.
        """
        query, wall = self._query(scans, rows)
        if len(query) < _FEWEST_POINTS:
            return [], True
        turns = np.arange(_TURNS) * (2 * math.pi / _TURNS)
        near = np.array([round(_NEAR_M / self._resolution), _NEAR_TURNS])
        starts, _, whole = branch_and_bound.find_places(
            self._levels, self._free, self._corner, self._resolution, query, turns, _LEAST_SCORE, _LEAST_SHARE, near,
            _MOST_CANDIDATES,
        )  # fmt: skip
        found = [self._refined(start, scans, rows, query, wall) for start in starts]
        return sorted(found, key=lambda place: -place.value), whole

    @staticmethod
    def _query(scans: Keyframes, rows: Int) -> tuple[Float, float]:
        """Points (N, 2) of scans (M,), not too many, as seen from the last of them, and m of wall that they cover."""
        points, kinds = scans.points, scans.kinds
        parts = []
        for k in rows:
            near = (kinds[k] != INVALID) & (np.hypot(points[k, :, 0], points[k, :, 1]) < _QUERY_RANGE_M)
            parts.append(se2.transform_points(se2.relative(scans.poses[rows[-1]], scans.poses[k]), points[k][near]))
        cloud = np.concatenate(parts)
        cloud = cloud[first_in_each_cell(cloud, _QUERY_CELL_M)]
        order = np.random.default_rng(0).permutation(len(cloud))
        return cloud[order[:_QUERY_POINTS]], _QUERY_CELL_M * len(cloud)

    def around(self, pose: Float, scan: Beams, *, metres: float, radians: float) -> Place | None:
        """The best place of a scan within a distance and an angle from a pose (3,), None where it fits nowhere."""
        scans = Keyframes()
        scans.add(scan, pose)
        query, wall = self._query(scans, np.array([0]))
        if len(query) < _FEWEST_POINTS:
            return None
        half = np.arange(0.0, radians + 1e-9, 2 * math.pi / _TURNS)
        turns = np.concatenate([[0.0], *[[-turn, turn] for turn in half[1:]]])
        start, score = branch_and_bound.find(
            self._levels, self._corner, self._resolution, query, pose, metres, turns, _LEAST_SCORE
        )
        return self._refined(start, scans, np.array([0]), query, wall) if score > 0 else None

    def score(self, pose: Float, scan: Beams) -> float:
        """Mean likelihood of the points of a scan at a pose (3,), 0 to 1."""
        x, y = self._corner
        return float(likelihood.score(self._levels[0], scan.points, scan.kinds, pose, x, y, self._resolution))

    def seen_from(self, pose: Float, scan: Beams, most: int) -> Int:
        """The keyframes, so many at most, that see the most of what a scan at a pose (3,) sees, most of it first."""
        found = most_overlap(
            pose, scan.points, scan.normals, scan.kinds, scan.first, scan.increment,
            self._around(pose), self._keyframes.poses, *self._arrays,
        )  # fmt: skip
        return np.asarray(found[:most])

    def _refined(self, start: Float, scans: Keyframes, rows: Int, query: Float, wall: float) -> Place:
        """The place near a start (3,) where the scans fit best."""
        group = se2.relative(scans.poses[rows[-1]], scans.poses[rows])
        everywhere = np.ones(len(query), np.uint8)
        x, y = self._corner
        start = likelihood.climb(self._levels[0], query, everywhere, start, x, y, self._resolution, _TURN, _CLIMBS)
        start[2] = wrap(start[2])
        asked = self._around(start)
        mine = scans.of_rows(rows)
        references = np.full((len(rows), _REFERENCES), -1)
        for m in range(len(rows)):
            one = tuple(array[m] for array in mine)
            chosen = most_overlap(compose(start, group[m]), *(*one, asked, self._keyframes.poses, *self._arrays))
            references[m, : min(len(chosen), _REFERENCES)] = chosen[:_REFERENCES]
        against_map = (*mine, references, self._keyframes.poses, *self._arrays)
        pose, hessian, inliers = lay_group(start, group, *against_map)
        # Where few lines hold it, it may have slid away: then it is held too little to be believed.
        if self._score(query, pose) < self._score(query, start) - _SLID_SCORE:
            pose, hessian = start, _UNHELD * np.eye(3)
        same, against, still, gone = judge_group(pose, group, *against_map)
        return Place(
            pose,
            hessian / PAIR_SIGMA_M**2,
            self._score(query, pose),
            (same + still) / max(1, same + still + 2 * (against + gone)),
            still / max(1, still + gone),
            inliers,
            wall,
        )

    def _around(self, pose: Float) -> Int:
        """Keyframes around a pose, not too many."""
        distance = np.hypot(*(self._keyframes.poses[:, :2] - pose[:2]).T)
        near = np.flatnonzero(distance < _TOGETHER_M)
        return near[:: max(1, len(near) // _ASKED)]

    def _score(self, query: Float, pose: Float) -> float:
        cells = np.floor((se2.transform_points(pose, query) - self._corner) / self._resolution).astype(np.int64)
        inside = ((cells >= 0) & (cells < self._levels.shape[1:])).all(axis=1)
        values = self._levels[0][cells[inside, 0], cells[inside, 1]]
        return float(values.sum() / (branch_and_bound.FULL * len(query)))


def is_sure(places: list[Place]) -> bool:
    """Whether the first of places, the best first, can be believed."""
    if not places:
        return False
    best = places[0]
    least = np.interp(best.wall, _SURE_WALL_M, _SURE_VALUE)
    if best.wall < _SURE_WALL_M[0] or best.value < least:
        return False
    if best.quality < _SURE_QUALITY or best.standing < _SURE_STANDING:
        return False
    covariance = np.linalg.inv(best.information)
    if np.linalg.eigvalsh(covariance[:2, :2])[1] > _SURE_SIGMA_M**2 or covariance[2, 2] > _SURE_SIGMA_RAD**2:
        return False
    return all(other.value < _SURE_SHARE * best.value or _same(best.pose, other.pose) for other in places[1:])


def fits_as_given(place: Place) -> bool:
    """Whether a place near a pose that was given can be believed."""
    return place.score > _GIVEN_SCORE and place.quality > _GIVEN_QUALITY


class Schedule:
    """When to look for a place: more rarely the more keyframes were looked for in vain."""

    def __init__(self) -> None:
        self._keyframes = self._due = 0

    def is_due(self) -> bool:
        """Whether to look for it now, asked once a keyframe."""
        self._keyframes += 1
        if self._keyframes <= self._due:
            return False
        self._due = self._keyframes + min(self._keyframes // _SHARE_MORE, _MOST_MORE)
        return True


def _same(one: Float, other: Float) -> bool:
    off = relative(one, other)
    return math.hypot(off[0], off[1]) < _SAME_M and abs(off[2]) < _SAME_RAD


@kernel
def _mark_free(blocks, poses, points, kinds, corner, size, step):  # type: ignore[no-untyped-def]
    """Mark the blocks (W, H) of `size` m in which lasers were and through which their beams went."""
    width, height = blocks.shape
    for k in range(len(poses)):
        cos, sin = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        x0, y0 = poses[k, 0] - corner[0], poses[k, 1] - corner[1]
        for b in range(points.shape[1]):
            if kinds[k, b] == 0:
                continue
            dx = cos * points[k, b, 0] - sin * points[k, b, 1]
            dy = sin * points[k, b, 0] + cos * points[k, b, 1]
            steps = int(math.hypot(dx, dy) / step) + 1
            for s in range(steps):
                u, v = int((x0 + dx * s / steps) / size), int((y0 + dy * s / steps) / size)
                if 0 <= u < width and 0 <= v < height:
                    blocks[u, v] = 1


@kernel
def most_overlap(  # type: ignore[no-untyped-def]
    pose,
    scan_points,
    scan_normals,
    scan_kinds,
    first,
    increment,
    asked,
    poses,
    points,
    normals,
    kinds,
    firsts,
    increments,
):
    """Those of the keyframes asked that see the same as a scan at a pose, most of it first."""
    memory = room(len(scan_kinds))
    rows = picked(scan_points, scan_normals, scan_kinds, ANY_KIND, _ASK_STEP)
    seen = np.empty(len(asked), np.int64)
    for c in range(len(asked)):
        k = asked[c]
        seen[c] = agreement(relative(poses[k], pose), rows, points[k], kinds[k], firsts[k], increments[k], memory)[0]
    order = np.argsort(-seen, kind="mergesort")
    return asked[order[: np.count_nonzero(seen)]]


@kernel
def lay_group(  # type: ignore[no-untyped-def]
    start, group, scan_points, scan_normals, scan_kinds, scan_firsts, scan_increments,
    references, poses, points, normals, kinds, firsts, increments,
):  # fmt: skip
    """ICP of scans that keep their places (M, 3) in the frame of a pose (3,), from a start of that pose on.

    references: (M, R) keyframes that each scan is laid on, -1: none. Returns the pose, the hessian (3, 3) of one
    keyframe and all scans, and the share of inliers.
    """
    pose = start.copy()
    hessian, one = np.zeros((3, 3)), np.zeros((3, 3))
    gradient, pull = np.zeros(3), np.zeros(3)
    memory = room(max(kinds.shape[1], scan_kinds.shape[1]))
    inliers = seen = 0
    for iteration in range(_ITERATIONS):
        share = min(1.0, iteration / (_ITERATIONS - 3))
        distance = _DISTANCE_M[0] * (_DISTANCE_M[1] / _DISTANCE_M[0]) ** share
        sigma = _KERNEL_M[0] * (_KERNEL_M[1] / _KERNEL_M[0]) ** share
        hessian[:] = 0.0
        gradient[:] = 0.0
        inliers = seen = 0
        for m in range(len(group)):
            at = compose(pose, group[m])
            chosen = references[m][references[m] >= 0]
            if len(chosen) == 0:
                continue
            one[:] = 0.0
            pull[:] = 0.0
            more, viewed = lay(
                at, parted(scan_points[m], scan_normals[m], scan_kinds[m], CORNER, 1), chosen, poses,
                points, normals, kinds, firsts, increments, distance, sigma, one, pull, memory,
            )  # fmt: skip
            inliers += more
            seen += viewed
            one /= len(chosen)
            pull /= len(chosen)
            add_levered(one, pull, at[0] - pose[0], at[1] - pose[1], hessian, gradient)
        for u in range(3):
            hessian[u, u] += 1e-3
        pose -= solve_3x3(hessian, gradient)
        pose[2] = wrap(pose[2])
    return pose, hessian, inliers / max(1, seen)


@kernel
def judge_group(  # type: ignore[no-untyped-def]
    pose, group, scan_points, scan_normals, scan_kinds, scan_firsts, scan_increments,
    references, poses, points, normals, kinds, firsts, increments,
):  # fmt: skip
    """How many points of scans, laid as by `lay_group`, agree with keyframes, how many contradict them; and back."""
    same = against = still = gone = 0
    for m in range(len(group)):
        one = agreements_each_way(
            compose(pose, group[m]), scan_points[m], scan_normals[m], scan_kinds[m], scan_firsts[m],
            scan_increments[m], references[m][references[m] >= 0], poses, points, normals, kinds, firsts, increments, 2,
        )  # fmt: skip
        same += one[0]
        against += one[1]
        still += one[2]
        gone += one[3]
    return same, against, still, gone
