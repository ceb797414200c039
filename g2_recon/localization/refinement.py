# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Multi-view refinement: all keyframes laid on all that saw the same place, at once."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from g2_recon.geometry import se2
from g2_recon.geometry.se2_kernels import wrap
from g2_recon.kernels import kernel
from g2_recon.localization import pairing, pose_graph
from g2_recon.localization.beams import CORNER, LOOSE
from g2_recon.localization.keyframes import Arrays, Keyframes
from g2_recon.localization.pairing import PAIR_SIGMA_M
from g2_recon.progress import Progress, silent

Float = NDArray[np.float64]
Int = NDArray[np.int64]

_SPANS = (1, 2, 3, 5, 8)
_REACH_M = 4.0
_MOST_NEIGHBORS = 10
_APART = 2
_LEAST_WAY_M = 3.0
_ROUNDS = 5
# So many more are begun with, as long as the way between two keyframes still changes by more than this, m: noise tilts
# the normals of a bare corridor's walls, which then resist a slide along it, the more the nearer partners have to be.
_MOST_WIDE_ROUNDS, _AT_REST_M = 6, 0.05
# While partners are far, every so manieth beam will do, and all kinds of beams count. Once they are near, those that
# may lie on a wall or not, as where a beam is split by an edge, would bend the map: in simulation by 0.1 deg in 100 m.
_COARSE_STEP, _COARSE_ROUNDS = 3, 2
_COARSE_LOOSE, _FINE_LOOSE = LOOSE, CORNER
_DISTANCE_M = (0.8, 0.08)
_SIGMA_M = (0.2, 0.03)
_LEAST_INLIERS, _FEWEST_INLIERS = 0.4, 30
_WHEEL_WEIGHT, _WHEEL_KERNEL = 25.0, 9.0
_BROKEN = 1e-6


class _Partners(NamedTuple):
    """Which beams of two keyframes count as seeing the same in one round.

    distance: m, that they lie apart at most. sigma: m, of the robust kernel. loose: kinds of beams on no surface that
    count. step: every so manieth beam does.
    """

    distance: float
    sigma: float
    loose: np.uint8
    step: int


def refine(
    keyframes: Keyframes, ways: Float, odometry: Float, broken: NDArray[np.bool_], *, progress: Progress = silent
) -> Float:
    """The poses (N, 3) of the keyframes after refinement.

    ways: (N,) m driven until there. odometry: (N, 3) the step of the wheels from the keyframe before, NaN: unknown.
    broken: (N,) where track was lost on the way to a keyframe.
    """
    poses, arrays = keyframes.poses.copy(), keyframes.arrays
    smoothed = se2.relative(poses[:-1], poses[1:])
    wheels = _wheel_edges(smoothed, odometry[1:], broken[1:])
    first: Int = np.empty(0, np.int64)
    second: Int = first
    wide = done = 0
    while done < _ROUNDS:
        if (wide + done) % 3 == 0:
            first, second = neighbors(poses, ways)
        before = poses
        poses = _improved(poses, arrays, wheels, first, second, _partners(done))
        if done == 0 and wide < _MOST_WIDE_ROUNDS and _most_changed(before, poses) > _AT_REST_M:
            wide += 1
        else:
            done += 1
            progress("refinement", done, _ROUNDS)
    return poses


def _partners(done: int) -> _Partners:
    """Of the next round after so many."""
    share = min(1.0, done / (_ROUNDS - 3))
    distance = _DISTANCE_M[0] * (_DISTANCE_M[1] / _DISTANCE_M[0]) ** share
    sigma = _SIGMA_M[0] * (_SIGMA_M[1] / _SIGMA_M[0]) ** share
    if done < _COARSE_ROUNDS:
        return _Partners(distance, sigma, _COARSE_LOOSE, _COARSE_STEP)
    return _Partners(distance, sigma, _FINE_LOOSE, 1)


def _improved(
    poses: Float, arrays: Arrays, wheels: pose_graph.Edges, first: Int, second: Int, partners: _Partners
) -> Float:
    """The poses (N, 3) after one round: pairs of keyframes (M,) laid on each other, and the graph of them solved."""
    step = partners.step
    T, hessians, gradients, counts = pairing.pairs(
        poses, first, second, *arrays, partners.distance, partners.sigma, partners.loose, step
    )
    # As of all beams.
    hessians, gradients, counts = step * hessians, step * gradients, step * counts
    used = (counts[:, 0] > _LEAST_INLIERS * counts[:, 1]) & (counts[:, 0] > _FEWEST_INLIERS)
    seen = pose_graph.Edges(first, second, T, hessians, gradients)[used]
    edges = pose_graph.joined(seen, wheels)
    weights = np.ones(len(edges))
    squared = pose_graph.deviations(poses, wheels)
    # Wheels that slip or come late are doubted.
    weights[len(seen) :] = 1 / (1 + squared / (_WHEEL_WEIGHT * _WHEEL_KERNEL))
    return pose_graph.solve(poses, edges, weights=weights)[0]


def _most_changed(before: Float, poses: Float) -> float:
    """By how much, m, the way from one keyframe (N, 3) to the next has changed at most."""
    changed = se2.relative(before[:-1], before[1:]) - se2.relative(poses[:-1], poses[1:])
    return float(np.hypot(changed[:, 0], changed[:, 1]).max())


def _wheel_edges(smoothed: Float, odometry: Float, broken: NDArray[np.bool_]) -> pose_graph.Edges:
    """What the wheels say of the way, and the front end of the turn, between keyframes."""
    known = np.isfinite(odometry).all(axis=1)
    T = smoothed.copy()
    T[known, :2] = odometry[known, :2]
    length, turn = np.hypot(smoothed[:, 0], smoothed[:, 1]), np.abs(smoothed[:, 2])
    information = np.zeros((len(T), 3, 3))
    along = np.where(known, _WHEEL_WEIGHT, 1.0) * (PAIR_SIGMA_M / (0.02 + 0.1 * length)) ** 2
    information[:, 0, 0] = information[:, 1, 1] = along
    information[:, 2, 2] = (PAIR_SIGMA_M / (0.02 + 0.2 * turn)) ** 2
    information[broken] *= _BROKEN
    k = np.arange(1, len(T) + 1)
    return pose_graph.measured(k, k - 1, T, information)


def neighbors(poses: Float, ways: Float) -> tuple[Int, Int]:
    """Pairs of keyframes worth comparing: along the way, and at places visited again."""
    count = len(poses)
    first = [np.arange(span, count) for span in _SPANS]
    second = [np.arange(count - span) for span in _SPANS if span < count]
    first = [f for f in first if len(f)]
    pairs = cKDTree(poses[:, :2]).query_pairs(_REACH_M, output_type="ndarray")
    later, earlier = pairs.max(axis=1), pairs.min(axis=1)
    again = (later - earlier > max(_SPANS)) & (ways[later] - ways[earlier] > _LEAST_WAY_M)
    later, earlier = later[again], earlier[again]
    cost = np.hypot(*(poses[later, :2] - poses[earlier, :2]).T) + np.abs(
        se2.wrap_angle(poses[later, 2] - poses[earlier, 2])
    )
    order = np.lexsort((earlier, cost, later))
    later, earlier = later[order].astype(np.int64), earlier[order].astype(np.int64)
    picked = _spread(later, earlier, _MOST_NEIGHBORS, _APART)
    return np.concatenate([*first, later[picked]]), np.concatenate([*second, earlier[picked]])


@kernel
def _spread(later, earlier, most, apart):  # type: ignore[no-untyped-def]
    """Mask of at most `most` pairs for each `later`, in order, whose earlier ones are more than `apart` apart."""
    picked = np.zeros(len(later), np.bool_)
    chosen = np.empty(most, np.int64)
    count = 0
    for m in range(len(later)):
        if m == 0 or later[m] != later[m - 1]:
            count = 0
        if count >= most:
            continue
        fits = True
        for c in range(count):
            if abs(chosen[c] - earlier[m]) <= apart:
                fits = False
                break
        if fits:
            chosen[count] = earlier[m]
            count += 1
            picked[m] = True
    return picked


@kernel(parallel=True)
def place(  # type: ignore[no-untyped-def]
    guesses, owners, near, scan_points, scan_normals, scan_kinds, poses, points, normals, kinds, firsts, increments
):
    """Poses (S, 3) of scans matched to fixed keyframes: those around the owner in time, and near (S, K) in space."""
    result = guesses.copy()
    count = len(poses)
    prior = np.diag(np.array([0.8, 0.8, 4.0]))
    for s in numba.prange(len(guesses)):
        chosen = np.empty(12, np.int64)
        m = 0
        for step in (0, 1, -1, -3, 3):
            k = owners[s] + step
            if 0 <= k < count:
                chosen[m] = k
                m += 1
        for k in near[s]:
            if m >= 12:
                break
            if abs(k - owners[s]) <= 3 or abs(wrap(poses[k, 2] - guesses[s, 2])) > 1.6:
                continue
            chosen[m] = k
            m += 1
        pose, _, _, _ = pairing.match(
            guesses[s],
            guesses[s],
            scan_points[s],
            scan_normals[s],
            scan_kinds[s],
            chosen[:m],
            poses,
            points,
            normals,
            kinds,
            firsts,
            increments,
            0.2,
            0.12,
            0.05,
            0.045,
            5,
            prior,
        )
        result[s] = pose
    return result
