# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Loop closures: places that the robot has come back to, found by their look and checked before they are believed.

The way of the robot is cut into local maps of some metres each. Whenever one is complete, it is looked for in the
earlier ones: branch and bound over the window that the drift so far allows, then ICP of all its scans. A closure must
have enough inliers, must not place points where the other local map saw free space, keeps no information along a
direction in which the place repeats itself, and must agree with the graph of all others in a trial solution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry import se2
from g2_recon.geometry.se2_kernels import compose, relative, solve_3x3, wrap
from g2_recon.kernels import kernel
from g2_recon.localization import branch_and_bound, pose_graph
from g2_recon.localization.beams import CORNER, INVALID
from g2_recon.localization.branch_and_bound import Ground, Pyramid
from g2_recon.localization.keyframes import Keyframes
from g2_recon.localization.pairing import add_levered, add_turned, agreements, lay, parted, room
from g2_recon.localization.point_map import first_in_each_cell

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]

_RESOLUTION_M, _SIGMA_M = 0.1, 0.1
# Of so many the lowest level is kept; those above it, four times as much, are soon made again.
_MOST_PYRAMIDS = 64
# A local map is looked for with this many of its points, from so near, thinned to such cells.
_QUERY_POINTS, _QUERY_RANGE_M, _QUERY_CELL_M = 500, 15.0, 0.15
_MAP_RANGE_M, _MAP_CELL_M = 20.0, 0.05
_TURN_STEP = math.radians(0.75)

# The window grows with the way along the graph, in m and rad, and ends somewhere.
_WINDOW_M, _WINDOW_SHARE, _WIDEST_WINDOW_M = 2.0, 0.04, 25.0
_WINDOW_RAD, _WINDOW_RAD_PER_M, _WIDEST_WINDOW_RAD = math.radians(6), math.radians(0.15), math.radians(40)
_LOOP_WAY_M = 0.5
_LEAST_WAY_M = 15.0
_MOST_TRIED, _ENOUGH_FOUND = 40, 2

_LEAST_SCORE = 0.55
# Share of inliers, and of points that the other local map does not contradict. Fewer inliers do where nearly nothing is
# contradicted: something has changed, or one saw less of the place.
_LEAST_INLIERS, _FEW_INLIERS = 0.6, 0.45
_LEAST_AGREEMENT, _FULL_AGREEMENT = 0.8, 0.95
_FARTHEST_ICP_M = 0.6
# ICP of a local map on another: every other keyframe, every third beam, where keyframes are so near to each other;
# search distance and width of the robust kernel, first to last iteration, m.
_TOGETHER_M, _BEAM_STEP, _ITERATIONS, _FEWEST_SEEN = 6.0, 3, 10, 50
_FIRST_DISTANCE_M, _LAST_DISTANCE_M = 0.4, 0.2
_FIRST_SIGMA_M, _LAST_SIGMA_M = 0.15, 0.06
_RIVAL = 0.85
_AMBIGUOUS = 1e-5

_LOOP_SIGMA_M, _LOOP_SIGMA_RAD = 0.05, 0.01
# In covariances a loop errs by so many times what a pair of points does.
_LOOP_SIGMAS = 1.2
# What the first loops show of the drift, and of how far loops err, is one voice beside as much as so many measurements;
# one says no more than so many times what was expected, and makes nothing smaller than by so much.
_SHOWN_BEFORE, _MOST_SHOWN, _LEAST_CHANGE = 2.0, 25.0, 0.2
# By such a share the variance of the drift is varied to see how much of a covariance comes from it.
_VARIED = 0.01
# How sure a place in the map of an earlier session is.
_KNOWN_SIGMA_M, _KNOWN_SIGMA_RAD = 0.1, 0.02
_KERNEL = 16.0
_MOST_COST = 25.0
_MOST_DEVIATION = 16.0


@dataclass(frozen=True, slots=True)
class LocalMap:
    """The keyframes from `first` to before `last`; its frame is that of keyframe `reference`.

    way: m driven until there. query: (N, 2) points in its frame to look for it with.
    """

    first: int
    last: int
    reference: int
    way: float
    query: Float32


class LoopCloser:
    """Local maps, the graph of them, and their poses in the map."""

    def __init__(self) -> None:
        self._keyframes = Keyframes()
        self.maps: list[LocalMap] = []
        self.poses: Float = np.empty((0, 3))
        self._sequence: list[tuple[Float, Float]] = []
        # Covariance (3, 3) of each step of the sequence, as far as it is known; the graph itself trusts it less.
        self._drifts: list[Float] = []
        # How many times larger than told the variances of drifts and of loops are, and how much has told that (2, 2).
        self._scales, self._shown = np.ones(2), _SHOWN_BEFORE * np.eye(2)
        self._pair_sigma = 0.0
        self.loops: list[tuple[int, int, Float, Float]] = []
        # The same as arrays, as far as they have been asked for.
        self._steps_known = self._loops_known = _measured([])
        # Pyramids of local maps, of their lowest level only.
        self._grounds: dict[int, Ground] = {}
        self._cost = 0.0
        # No loop is looked for between earlier local maps and those from this one on: how they lie is not known.
        self.apart = 0
        self.rejected = self.ambiguous = self.tried = 0

    def handle(
        self, keyframes: Keyframes, first: int, last: int, way: float, drift: Float | None, pair_sigma: float
    ) -> tuple[Float, Float] | None:
        """Add a local map and look for it among the earlier ones; see `add` and `covariance`.

        If that has moved the local maps, their poses (C, 3) before, and the covariance (3, 3) of this one now.
        """
        self._pair_sigma = pair_sigma
        new = self.add(keyframes, first, last, way, drift)
        before = self.poses.copy()
        if not self.close(new):
            return None
        self.optimize()
        return before, self._covariance(new, drift_scale=self.drift_scale, loop_scale=self.loop_scale)

    def add(self, keyframes: Keyframes, first: int, last: int, way: float, drift: Float | None = None) -> int:
        """Add a local map of the keyframes from `first` to before `last`, way m after the start; its index.

        drift: covariance (3, 3) of its reference keyframe as seen from that of the local map before. All poses used
        from now on are those of `keyframes`.
        """
        self.take_poses(keyframes)
        poses = self._keyframes.poses
        reference = (first + last) // 2
        query = self._cloud(first, last, poses[reference], _QUERY_RANGE_M, _QUERY_CELL_M)
        order = np.random.default_rng(0).permutation(len(query))
        new = LocalMap(first, last, reference, way, query[order[:_QUERY_POINTS]].astype(np.float32))
        if self.maps:
            before = self.maps[-1]
            length = max(way - before.way, 1e-3)
            # In the frame of the one before.
            T = se2.relative(poses[before.reference], poses[reference])
            sigma = np.array([0.02 + 0.02 * length] * 2 + [0.03 * math.sqrt(length / 5 + 0.05)])
            self._sequence.append((T, np.diag(1 / sigma**2)))
            self._drifts.append(np.diag(sigma**2) if drift is None else drift)
        self.maps.append(new)
        self.poses = np.vstack([self.poses, poses[reference]])
        return len(self.maps) - 1

    def take_poses(self, keyframes: Keyframes) -> None:
        """Local maps are where their keyframes are now, which have been smoothed since loops moved them."""
        self._keyframes = keyframes
        self.poses = keyframes.poses[[local.reference for local in self.maps]]

    def resume(
        self,
        keyframes: Keyframes,
        begins: NDArray[np.int64],
        ways: Float,
        loops: NDArray[np.int64],
        information: Float,
    ) -> None:
        """Take up the local maps (C,) and loops (L, 2) of a saved session, with all where its keyframes are now."""
        ends = [*begins[1:].tolist(), len(keyframes)]
        for first, last in zip(begins.tolist(), ends, strict=True):
            self.add(keyframes, first, last, float(ways[(first + last) // 2]))
        for (a, b), known in zip(loops.tolist(), information, strict=True):
            self.loops.append((a, b, se2.relative(self.poses[a], self.poses[b]), known.copy()))

    def settle(self, keyframes: Keyframes) -> None:
        """Take the poses of keyframes for right: steps and loops are as these say; loops that did not fit are gone."""
        pairs, information = self.credible()
        self.take_poses(keyframes)
        steps = se2.relative(self.poses[:-1], self.poses[1:])
        self._sequence = [(T, known) for T, (_, known) in zip(steps, self._sequence, strict=True)]
        self.loops = [
            (a, b, se2.relative(self.poses[a], self.poses[b]), known)
            for (a, b), known in zip(pairs.tolist(), information, strict=True)
        ]
        self._steps_known = self._loops_known = _measured([])
        self._cost = 0.0

    def carry(self, first: int, step: Float) -> None:
        """Move the local maps of keyframes from `first` on by a step (3,) in the map, where their place is known."""
        for c, local in enumerate(self.maps):
            if local.first >= first:
                self.poses[c] = se2.compose(step, self.poses[c])
            if local.first == first and c:
                information = np.diag([1 / _KNOWN_SIGMA_M**2] * 2 + [1 / _KNOWN_SIGMA_RAD**2])
                self._sequence[c - 1] = (se2.relative(self.poses[c - 1], self.poses[c]), information)
                self._drifts[c - 1] = np.linalg.inv(information)
        self._steps_known = _measured([])

    def carried_along(self, poses: Float, before: Float, broken: NDArray[np.bool_]) -> Float:
        """Poses (N, 3) of all keyframes, moved as the local maps were from their poses (C, 3) before.

        From the reference of one local map to that of the next, keyframes move less and less with the one and more and
        more with the other, so that the way does not tear between them; unless it is broken (N,): where track was lost
        on the way to a keyframe.
        """
        steps = se2.compose(self.poses, se2.inverse(before))
        firsts, references = np.array([(local.first, local.reference) for local in self.maps]).T
        k = np.arange(len(poses))
        left = np.clip(np.searchsorted(references, k, side="right") - 1, 0, None)
        right = np.clip(np.searchsorted(references, k, side="right"), None, len(references) - 1)
        segments = np.cumsum(broken)
        apart = segments[references[left]] != segments[references[right]]
        own = np.searchsorted(firsts, k, side="right") - 1
        left, right = np.where(apart, own, left), np.where(apart, own, right)
        share = (k - references[left]) / np.maximum(references[right] - references[left], 1)
        moved = se2.compose(steps[left], poses)
        farther = se2.compose(steps[right], poses) - moved
        farther[:, 2] = se2.wrap_angle(farther[:, 2])
        return moved + np.where(left < right, share, 0.0)[:, None] * farther

    def credible(self) -> tuple[NDArray[np.int64], Float]:
        """The loops (L, 2) that fit with all the others, and their information (L, 3, 3)."""
        loops = self._edges([])[len(self._sequence) :]
        fits = pose_graph.deviations(self.poses, loops) < _KERNEL
        kept = [loop for loop, credible in zip(self.loops, fits, strict=True) if credible]
        return (
            np.array([loop[:2] for loop in kept], np.int64).reshape(-1, 2),
            np.array([loop[3] for loop in kept]).reshape(-1, 3, 3),
        )

    def _cloud(self, first: int, last: int, base: Float, farthest: float, cell: float) -> Float:
        """Points (N, 2) of keyframes in the frame of `base` (3,), seen from at most so far (m), one a cell (m)."""
        keyframes = self._keyframes
        cloud = _points_from(first, last, base, farthest, keyframes.poses, keyframes.points, keyframes.kinds)
        return cloud[first_in_each_cell(cloud, cell)]

    def _pyramid(self, c: int) -> Pyramid:
        """That of a local map; the latest ones are kept, as those near by are asked for again and again."""
        known = self._grounds.pop(c, None)
        if known is not None:
            self._grounds[c] = known
            return known.raised()
        first, last = self.maps[max(0, c - 1)].first, self.maps[min(len(self.maps) - 1, c + 1)].last
        cloud = self._cloud(first, last, self._keyframes.poses[self.maps[c].reference], _MAP_RANGE_M, _MAP_CELL_M)
        made = branch_and_bound.pyramid(cloud, resolution=_RESOLUTION_M, sigma=_SIGMA_M)
        if c + 1 < len(self.maps):
            self._grounds[c] = made.ground()
            if len(self._grounds) > _MOST_PYRAMIDS:
                del self._grounds[next(iter(self._grounds))]
        return made

    def _ways(self, c: int) -> Float:
        """Shortest way (C,) in m along the graph from local map c to the earlier ones."""
        loops = self._edges([])[len(self._sequence) :]
        return np.asarray(_shortest_ways(np.array([m.way for m in self.maps]), loops.first, loops.second, c))

    def close(self, c: int, *, wide: bool = True) -> int:
        """Look for local map c among the earlier ones; how many loops were closed."""
        ways = np.array([m.way for m in self.maps])
        if wide:
            drift = self._ways(c)
            window = np.clip(_WINDOW_M + _WINDOW_SHARE * drift, 0, _WIDEST_WINDOW_M)
            turn = np.clip(_WINDOW_RAD + _WINDOW_RAD_PER_M * drift, 0, _WIDEST_WINDOW_RAD)
        else:
            window = np.full(len(self.maps), 1.5)
            turn = np.full(len(self.maps), math.radians(5))
        distance = np.hypot(*(self.poses[:, :2] - self.poses[c, :2]).T)
        known = {(a, b) for a, b, _, _ in self.loops}
        candidates = [
            j
            for j in range(c - 2)
            if (j < self.apart) == (c < self.apart)
            and ways[c] - ways[j] > _LEAST_WAY_M
            and distance[j] < window[j] + 4.0
            and (j, c) not in known
        ]
        candidates.sort(key=lambda j: distance[j] / (window[j] + 5.0))
        found = 0
        used: list[int] = []
        for j in candidates[: _MOST_TRIED if wide else 4]:
            if any(abs(j - u) <= 1 for u in used):
                continue
            used.append(j)
            self.tried += 1
            loop = self._register(c, j, window[j], turn[j])
            if loop is not None and self._accept(j, c, *loop, learn=wide):
                found += 1
                if found >= _ENOUGH_FOUND:
                    break
        return found

    def _register(self, c: int, j: int, window: float, turn: float) -> tuple[Float, Float] | None:
        """T_j_c and its information, or None where c does not fit on j."""
        target = self._pyramid(j)
        guess = se2.relative(self.poses[j], self.poses[c])
        half = np.arange(0, turn + 1e-9, _TURN_STEP)
        turns = np.concatenate([[0.0], *[[-t, t] for t in half[1:]]])
        query = self.maps[c].query.astype(float)
        if len(query) < 50:
            return None
        start, score = branch_and_bound.find(
            target.levels, target.corner, target.resolution, query, guess, window, turns, _LEAST_SCORE
        )
        if score < 0:
            return None
        one, other = self.maps[c], self.maps[j]
        moving = np.arange(one.first, one.last, 2)
        fixed = np.arange(self.maps[max(0, j - 1)].first, self.maps[min(len(self.maps) - 1, j + 1)].last, 2)
        poses = self._keyframes.poses
        base = poses[other.reference]
        both = np.concatenate([moving, fixed])
        m, f = np.split(np.arange(len(both)), [len(moving)])
        pose, inliers, hessian, same, against = register(
            compose(base, start), m, se2.relative(poses[one.reference], poses[moving]),
            f, poses[both], *self._keyframes.of_rows(both), _BEAM_STEP,
        )  # fmt: skip
        T = relative(base, pose)
        if inliers < _FEW_INLIERS or math.hypot(*(T - start)[:2]) > _FARTHEST_ICP_M:
            return None
        if inliers < _LEAST_INLIERS and same < _FULL_AGREEMENT * (same + against):
            return None
        if same < _LEAST_AGREEMENT * (same + against):
            self.rejected += 1
            return None
        turned = np.zeros((3, 3))
        add_turned(hessian, np.zeros(3), -base[2], turned, np.zeros(3))
        values, vectors = np.linalg.eigh(turned[:2, :2])
        shape = turned[:2, :2] / max(values[1], 1e-9)
        weak = np.ascontiguousarray(vectors[:, 0])
        if (
            branch_and_bound.rival(target.levels, target.corner, target.resolution, query, T, weak, max(4.0, window))
            > _RIVAL
        ):
            self.ambiguous += 1
            shape = vectors @ np.diag([_AMBIGUOUS, 1.0]) @ vectors.T
        information = np.zeros((3, 3))
        information[:2, :2] = shape / _LOOP_SIGMA_M**2
        information[2, 2] = 1 / _LOOP_SIGMA_RAD**2
        return T, information

    def _edges(self, extra: list[tuple[int, int, Float, Float]]) -> pose_graph.Edges:
        """Those of the sequence, of the loops, and extra ones."""
        steps, loops = len(self._steps_known), len(self._loops_known)
        if steps < len(self._sequence):
            new = [(k, k + 1, *step) for k, step in enumerate(self._sequence[steps:], start=steps)]
            self._steps_known = pose_graph.joined(self._steps_known, _measured(new))
        if loops < len(self.loops):
            self._loops_known = pose_graph.joined(self._loops_known, _measured(self.loops[loops:]))
        return pose_graph.joined(self._steps_known, self._loops_known, _measured(extra))

    def _accept(self, j: int, c: int, T: Float, information: Float, *, learn: bool = True) -> bool:
        """Believe a loop if the graph with it, the loop itself not doubted, costs little more than without.

        learn: whether it tells how far the robot drifted and how far loops err, as it does where the place has not just
        been put right.
        """
        new = (j, c, T, information)
        poses, cost, squared = self._solved([new], trust_last=True, rounds=8)
        if cost - self._cost < _MOST_COST and squared[-1] < _MOST_DEVIATION:
            if learn:
                self._learn_scales(j, c, T, information)
            self.poses = poses
            self._cost = cost
            self.loops.append(new)
            return True
        self.rejected += 1
        return False

    def _solved(self, extra, *, trust_last: bool, rounds: int) -> tuple[Float, float, Float]:  # type: ignore[no-untyped-def]
        edges = self._edges(extra)
        robust = np.arange(len(edges)) >= len(self._sequence)
        if trust_last:
            robust[-1] = False
        poses = self.poses
        weights: Float = np.ones(len(edges))
        for _ in range(rounds):
            squared = pose_graph.deviations(poses, edges)
            weights = _doubted(squared, robust)
            before = poses
            poses, _ = pose_graph.solve(poses, edges, weights=weights)
            if np.abs(poses - before).max() < 1e-4:
                break
        squared = pose_graph.deviations(poses, edges)
        cost = np.where(robust, _KERNEL * squared / (_KERNEL + squared), squared).sum()
        return poses, float(cost), squared

    def optimize(self) -> None:
        """Solve the graph with all loops doubted alike."""
        if self.loops:
            self.poses, self._cost, _ = self._solved([], trust_last=False, rounds=20)

    @property
    def drift_scale(self) -> float:
        """How many times larger than told the variances of drifts are, by the loops that were closed."""
        return float(self._scales[0])

    @property
    def loop_scale(self) -> float:
        """How many times larger than told the variances of loops are, as they show beside each other."""
        return float(self._scales[1])

    def _learn_scales(self, j: int, c: int, T: Float, information: Float) -> None:
        """Compare how far a new loop T_j_c is from where the graph has it with how far it was expected to be.

        What was expected comes in part from the drift, in part from this loop and those before: of the parts S_p of the
        sum S each shows off^T S^-1 S_p S^-1 off, where the sum over q of tr(S^-1 S_p S^-1 S_q) was expected; a step of
        scoring for the greatest likelihood makes them more alike (Harville, JASA 72(358), 1977).
        """
        if not self._pair_sigma:
            return
        drift_scale, loop_scale = self._scales
        known = self._between(j, c, drift_scale, loop_scale)
        drift = (self._between(j, c, drift_scale * (1 + _VARIED), loop_scale) - known) / _VARIED
        expected = known + np.linalg.inv(self._of_loops(information, loop_scale))
        off = relative(self.poses[j], self.poses[c]) - T
        off[2] = wrap(off[2])
        pulled = np.linalg.solve(expected, off)
        parts = np.array([drift, expected - drift])
        shares = np.linalg.solve(expected, parts)
        alike = np.einsum("pij,qji->pq", shares, shares)
        told = alike.sum(axis=1)
        self._shown += alike
        change = np.linalg.solve(self._shown, np.minimum(pulled @ parts @ pulled, _MOST_SHOWN * told) - told)
        self._scales *= np.maximum(1 + change, _LEAST_CHANGE)

    def _of_loops(self, information: Float, scale: float) -> Float:
        return information * (_LOOP_SIGMA_M / (_LOOP_SIGMAS * self._pair_sigma)) ** 2 / scale

    def _between(self, j: int, c: int, drift_scale: float, loop_scale: float) -> Float:
        """Covariance (3, 3) of T_j_c of two local maps."""
        joint = self._covariance(c, j, drift_scale=drift_scale, loop_scale=loop_scale)
        return pose_graph.covariance_between(joint, self.poses[j], self.poses[c])

    def _covariance(self, *wanted: int, drift_scale: float, loop_scale: float) -> Float:
        """Joint covariance (3 W, 3 W) of the poses of local maps in the map."""
        edges = self._edges([])
        count = len(self._sequence)
        weights = _doubted(pose_graph.deviations(self.poses, edges), np.arange(len(edges)) >= count)
        edges.hessians[:count] = np.linalg.inv(drift_scale * np.reshape(self._drifts, (-1, 3, 3)))
        edges.hessians[count:] = self._of_loops(edges.hessians[count:], loop_scale)
        return pose_graph.covariance(self.poses, edges, weights, wanted)


def _measured(edges: list[tuple[int, int, Float, Float]]) -> pose_graph.Edges:
    """Edges T_a_b with their information, given as a, b, T_a_b (3,), and the latter (3, 3)."""
    return pose_graph.measured(
        np.array([b for _, b, _, _ in edges], np.int64),
        np.array([a for a, _, _, _ in edges], np.int64),
        np.array([T for _, _, T, _ in edges]).reshape(-1, 3),
        np.array([information for _, _, _, information in edges]).reshape(-1, 3, 3),
    )


def _doubted(squared: Float, robust: NDArray[np.bool_]) -> Float:
    """Weights (M,) of edges with squared deviations (M,): less than 1 where they are robust, by Geman and McClure."""
    return np.where(robust, (_KERNEL / (_KERNEL + squared)) ** 2, 1.0)


@kernel
def _shortest_ways(ways, first, second, c):  # type: ignore[no-untyped-def]
    """Shortest way (C,) in m from local map c to the earlier ones, of which ways (C,) m had been driven, over loops.

    Back and forth along the way, then over all loops, until nothing gets shorter (Bellman and Ford).
    """
    far = np.full(len(ways), np.inf)
    far[c] = 0.0
    shorter = True
    while shorter:
        shorter = False
        for k in range(c, 0, -1):
            far[k - 1] = min(far[k - 1], far[k] + (ways[k] - ways[k - 1]))
        for k in range(1, c + 1):
            far[k] = min(far[k], far[k - 1] + (ways[k] - ways[k - 1]))
        for m in range(len(first)):
            one, other = first[m], second[m]
            if max(one, other) > c:
                continue
            if far[one] + _LOOP_WAY_M < far[other]:
                far[other] = far[one] + _LOOP_WAY_M
                shorter = True
            elif far[other] + _LOOP_WAY_M < far[one]:
                far[one] = far[other] + _LOOP_WAY_M
                shorter = True
    return far


@kernel
def _points_from(first, last, base, farthest, poses, points, kinds):  # type: ignore[no-untyped-def]
    cloud = np.empty(((last - first) * kinds.shape[1], 2))
    count = 0
    for k in range(first, last):
        at = relative(base, poses[k])
        cos, sin = math.cos(at[2]), math.sin(at[2])
        for b in range(kinds.shape[1]):
            x, y = points[k, b, 0], points[k, b, 1]
            if kinds[k, b] != INVALID and math.hypot(x, y) < farthest:
                cloud[count, 0] = at[0] + cos * x - sin * y
                cloud[count, 1] = at[1] + sin * x + cos * y
                count += 1
    return cloud[:count]


@kernel
def register(  # type: ignore[no-untyped-def]
    start, moving, T_group_moving, fixed, poses, points, normals, kinds, firsts, increments, step
):
    """ICP of one rigid group of keyframes, at a start (3,), on others that stay where they are.

    Returns the pose (3,) of the group, the share of inliers, the hessian (3, 3), and how many points agree and
    contradict. Every `step`-th beam is used.
    """
    pose = start.copy()
    hessian, one = np.zeros((3, 3)), np.zeros((3, 3))
    gradient, pull = np.zeros(3), np.zeros(3)
    memory = room(kinds.shape[1])
    inliers = seen = 0
    for iteration in range(_ITERATIONS):
        share = min(1.0, iteration / (_ITERATIONS - 3))
        distance = _FIRST_DISTANCE_M * (_LAST_DISTANCE_M / _FIRST_DISTANCE_M) ** share
        sigma = _FIRST_SIGMA_M * (_LAST_SIGMA_M / _FIRST_SIGMA_M) ** share
        hessian[:] = 0.0
        gradient[:] = 0.0
        inliers = seen = 0
        for m in range(len(moving)):
            at = compose(pose, T_group_moving[m])
            k = moving[m]
            one[:] = 0.0
            pull[:] = 0.0
            more, viewed = lay(
                at, parted(points[k], normals[k], kinds[k], CORNER, step), _near(fixed, poses, at), poses,
                points, normals, kinds, firsts, increments, distance, sigma, one, pull, memory,
            )  # fmt: skip
            inliers += more
            seen += viewed
            add_levered(one, pull, at[0] - pose[0], at[1] - pose[1], hessian, gradient)
        if seen < _FEWEST_SEEN:
            return pose, 0.0, hessian, 0, 0
        for u in range(3):
            hessian[u, u] += 1e-3
        pose -= solve_3x3(hessian, gradient)
        pose[2] = wrap(pose[2])
    same = against = 0
    for m in range(0, len(moving), 2):
        at = compose(pose, T_group_moving[m])
        k = moving[m]
        more, less = agreements(
            at, points[k], normals[k], kinds[k], firsts[k], increments[k],
            _near(fixed[::2], poses, at), poses, points, normals, kinds, firsts, increments, step,
        )  # fmt: skip
        same += more
        against += less
    return pose, inliers / seen, hessian, same, against


@kernel
def _near(keyframes, poses, at):  # type: ignore[no-untyped-def]
    """Those of the keyframes that are close enough to a pose (3,) to be compared with one there."""
    near = np.empty(len(keyframes), np.int64)
    count = 0
    for k in keyframes:
        if math.hypot(at[0] - poses[k, 0], at[1] - poses[k, 1]) <= _TOGETHER_M:
            near[count] = k
            count += 1
    return near[:count]
