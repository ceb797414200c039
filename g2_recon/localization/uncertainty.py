# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""How sure the poses of keyframes are: what each step adds, as the scans themselves show, and what loops take back."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.se2_kernels import carried, inverse_3x3, relative, solve_3x3, weakest
from g2_recon.localization import pose_graph
from g2_recon.localization.keyframes import Keyframes
from g2_recon.localization.pairing import add_turned

Float = NDArray[np.float64]

# Edges to keyframes at least so far back show how much the way from there drifts. Sigma of a pair, m, before any are
# known; no edge says more than the largest; the estimate is a running mean over so many edges.
_LONG_SPAN = 8
_FIRST_SIGMA_M, _LARGEST_SIGMA_M, _MEMORY = 0.02, 0.1, 100
# A step errs by this share of the variance of one edge, as errors of scans side by side are alike.
_DRIFT_SHARE = 0.025
# Where the scans say nothing: variance of the wheels, and of going on as before, m^2 a m and rad^2 a rad.
_WHEEL_VARIANCE, _INERTIA_VARIANCE = np.array([0.015, 0.015, 0.05]) ** 2, np.array([0.12, 0.12, 0.1]) ** 2
WAY_PER_RAD = 0.3
"""A turn counts as so many metres of way a radian: it lets drift grow as driving does."""
# So much of the pairs of a bare wall seem to hold a scan along it, as noise tilts their normals.
_TILTED = 0.01
_LEAST_WAY_M = 0.01
# Where track was lost, m, m, rad.
_BROKEN_SIGMA = np.array([5.0, 5.0, 0.5])


class Uncertainty:
    """Covariances of keyframes.

    pair_sigma: m, by which the place of a wall in one scan and in another differs, with what beams side by side have in
    common: d^T H d of an edge is compared with its square. drift_scale: how many times as large as expected the
    variance of a step is, by the loops that were closed.
    """

    def __init__(self, keyframes: Keyframes) -> None:
        self._keyframes = keyframes
        self._variance = _FIRST_SIGMA_M**2
        # Covariance (3, 3) of the latest keyframe in the map frame; of the steps to each keyframe, in its own frame.
        self.covariance: Float = np.zeros((3, 3))
        self._steps: list[Float] = []
        self.drift_scale = 1.0

    def fill(self, count: int) -> None:
        """Of so many keyframes that were there before, the poses are what the map is."""
        self.covariance = np.zeros((3, 3))
        self._steps = [np.zeros((3, 3))] * count

    @property
    def pair_sigma(self) -> float:
        """See the class."""
        return math.sqrt(self._variance)

    def add(self, edges: pose_graph.Edges | None, *, wheels: bool, broken: bool) -> None:
        """Take note of the latest keyframe and the edges from it to those before, at their present poses.

        wheels: whether the wheels told the step to it. broken: whether track was lost on the way.
        """
        poses = self._keyframes.poses
        k = len(poses) - 1
        if not k:
            self._steps.append(np.zeros((3, 3)))
            return
        if broken:
            step = np.diag(_BROKEN_SIGMA**2)
        else:
            step = self._step(edges, relative(poses[k - 1], poses[k]), wheels=wheels)
        self._steps.append(step)
        self.covariance = self._led_on(self.covariance, k, self.drift_scale)

    def _step(self, edges: pose_graph.Edges | None, moved: Float, *, wheels: bool) -> Float:
        """Covariance (3, 3) that a step (3,) adds, in the frame that it leads to."""
        way = max(_LEAST_WAY_M, math.hypot(moved[0], moved[1]) + WAY_PER_RAD * abs(moved[2]))
        variance = way * (_WHEEL_VARIANCE if wheels else _INERTIA_VARIANCE)
        if edges is None or not len(edges):
            return np.diag(variance)
        self._learn(edges)
        return np.asarray(_added(edges.hessians, edges.T[:, 2], variance, _DRIFT_SHARE * self._variance))

    def _learn(self, edges: pose_graph.Edges) -> None:
        """What edges want other than they have got, in units of their own information, tells how far scans err."""
        far = edges.first - edges.second >= _LONG_SPAN
        self._variance = _learned(self._variance, edges.hessians, edges.gradients, far)

    def _led_on(self, covariance: Float, k: int, scale: float) -> Float:
        """The covariance (3, 3) of keyframe k - 1 as that of keyframe k."""
        poses = self._keyframes.poses
        return np.asarray(_led_on(covariance, poses[k - 1], poses[k], scale * self._steps[k]))

    def between(self, a: int, b: int) -> Float:
        """Covariance (3, 3) of keyframe b > a as seen from a, in the frame of a, before it is scaled."""
        covariance: Float = np.zeros((3, 3))
        for k in range(a + 1, b + 1):
            covariance = self._led_on(covariance, k, 1.0)
        return np.asarray(_rotated(covariance, -self._keyframes.poses[a, 2]))

    def take_back(self, k: int, covariance: Float) -> None:
        """Keyframe k is now known this well in the map, and the latest one with it."""
        for following in range(k + 1, len(self._keyframes)):
            covariance = self._led_on(covariance, following, self.drift_scale)
        self.covariance = covariance

    def seen_from_latest(self, pose: Float) -> Float:
        """Covariance (3, 3) that a pose (3,) has from the latest keyframe, were it rigidly connected."""
        x, y, _ = pose - self._keyframes.poses[-1]
        return np.asarray(carried(self.covariance, x, y))


@numba.njit(cache=True, nogil=True)
def _learned(variance, hessians, gradients, counting):  # type: ignore[no-untyped-def]
    """The running mean of the squares, a degree of freedom, of what the counting edges (M,) want otherwise."""
    for m in np.flatnonzero(counting):
        pull = gradients[m]
        squared = (pull * solve_3x3(hessians[m] + np.eye(3), pull)).sum() / 3
        variance += (min(squared, _LARGEST_SIGMA_M**2) - variance) / _MEMORY
    return variance


@numba.njit(cache=True, nogil=True)
def _mean_seen_from_first(hessians, yaws):  # type: ignore[no-untyped-def]
    """Mean (3, 3) of hessians (M, 3, 3) of edges T_j_i with yaws (M,), turned from the frames of j to that of i."""
    total, unused = np.zeros((3, 3)), np.zeros(3)
    for m in range(len(yaws)):
        add_turned(hessians[m], unused, -yaws[m], total, unused)
    return total / len(yaws)


@numba.njit(cache=True, nogil=True)
def _added(hessians, yaws, otherwise, variance):  # type: ignore[no-untyped-def]
    """Covariance (3, 3) of a step that edges T_j_i with hessians (M, 3, 3) and yaws (M,) of one i hold, in frame i.

    otherwise: (3,) variances of all else that is known. variance: of a pair of points, m^2.
    """
    held = _mean_seen_from_first(hessians, yaws) / variance
    total = held.copy()
    for u in range(3):
        total[u, u] += 1 / otherwise[u]
    covariance = inverse_3x3(total)
    # Along a direction with no surface, where noise of normals seems to hold a scan, the rest is missing.
    least, direction = weakest(held)
    rest = direction[0] ** 2 / otherwise[0] + direction[1] ** 2 / otherwise[1]
    honest = max(0.0, least - _TILTED * (held[0, 0] + held[1, 1]))
    missing = 1 / (honest + rest) - 1 / (least + rest)
    for u in range(2):
        for v in range(2):
            covariance[u, v] += missing * direction[u] * direction[v]
    return covariance


@numba.njit(cache=True, nogil=True)
def _rotated(covariance, yaw):  # type: ignore[no-untyped-def]
    cos, sin = math.cos(yaw), math.sin(yaw)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return turn @ covariance @ turn.T


@numba.njit(cache=True, nogil=True)
def _led_on(covariance, before, after, step):  # type: ignore[no-untyped-def]
    """The covariance (3, 3) of a pose (3,) as that of the one after it, with what the step between them adds there."""
    return carried(covariance, after[0] - before[0], after[1] - before[1]) + _rotated(step, after[2])
