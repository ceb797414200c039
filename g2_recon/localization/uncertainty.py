# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""How sure the poses of keyframes are: what each step adds, as the scans themselves show, and what loops take back."""

from __future__ import annotations

import math
from array import array

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.se2_kernels import carried, compose, inverse_3x3, relative, solve_3x3, weakest
from g2_recon.kernels import inner_kernel, kernel
from g2_recon.localization import pose_graph
from g2_recon.localization.keyframes import Keyframes
from g2_recon.localization.pairing import add_turned

Float = NDArray[np.float64]

# Edges to keyframes at least so far back show how much the way from there drifts. Sigma of a pair, m, before any are
# known; no edge says less or more than these; the estimate is a running mean over so many edges, of which the first
# guess counts as some.
_LONG_SPAN = 12
_FIRST_SIGMA_M, _LEAST_SIGMA_M, _LARGEST_SIGMA_M, _GUESSED, _MEMORY = 0.01, 0.002, 0.1, 25, 100
# Errors that are independent from beam to beam average out over the edges of many scans; those that are alike in scans
# side by side do not, and the more scans disagree, the greater a part of that is of this kind: a step errs by the share
# of the variance of an edge that this variance is of the square of this, m (by drives in the simulation and on logs).
_ALIKE_SIGMA_M = 0.045
# Where the scans say nothing: variance of the wheels before it is known, and of going on as before, m^2 a m and rad^2
# a rad. How far wheels err is learned over so many keyframes where scans know better.
_WHEEL_VARIANCE, _INERTIA_VARIANCE = np.array([0.015, 0.015, 0.05]) ** 2, np.array([0.12, 0.12, 0.1]) ** 2
_WHEEL_SPAN, _WHEEL_MEMORY, _LEAST_WHEEL_SIGMA, _LARGEST_WHEEL_SIGMA = 8, 50, 0.001, 0.5
# Sigma by which corners, such as door frames, tell the way where nothing else does, of sigmas of a pair after one m.
_CORNER_SIGMAS = 1.5
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
    common: d^T H d of an edge is compared with its square. wheel_variance: (3,) of what the wheels say, a m of way.
    drift_scale: how many times as large as expected the variance of a step is, by the loops that were closed.
    """

    def __init__(self, keyframes: Keyframes) -> None:
        self._keyframes = keyframes
        self._variance = _FIRST_SIGMA_M**2
        self._learned = float(_GUESSED)
        self.wheel_variance: Float = _WHEEL_VARIANCE.copy()
        # Of the latest keyframes: step (3,) of the wheels, way, and shares (3,) of the scans in what is known of it; so
        # many of them in a row, the latest last.
        self._driven: Float = np.zeros((_WHEEL_SPAN, 7))
        self._in_a_row = 0
        # Covariance (3, 3) of the latest keyframe in the map frame; of the steps to each keyframe, in its own frame.
        self.covariance: Float = np.zeros((3, 3))
        self._steps = array("d")
        self.drift_scale = 1.0

    def fill(self, count: int) -> None:
        """Of so many keyframes that were there before, the poses are what the map is."""
        self.covariance = np.zeros((3, 3))
        self._steps = array("d", bytes(8 * 9 * count))

    @property
    def pair_sigma(self) -> float:
        """See the class."""
        return math.sqrt(self._variance)

    def add(self, edges: pose_graph.Edges | None, *, wheels: Float, broken: bool, corners: Float | None = None) -> None:
        """Take note of the latest keyframe and the edges from it to those before, at their present poses.

        wheels: (3,) their step to it, NaN where unknown. broken: whether track was lost on the way. corners: direction
        (2,) in the map along which corners have told where the keyframe is, if they have.
        """
        poses = self._keyframes.poses
        k = len(poses) - 1
        if not k:
            self._steps.extend(np.zeros(9))
            return
        if broken:
            step = np.diag(_BROKEN_SIGMA**2)
            self._in_a_row = 0
        else:
            step = self._step(edges, relative(poses[k - 1], poses[k]), wheels, corners)
        self._steps.extend(step.ravel())
        self.covariance = self._led_on(self.covariance, k, self.drift_scale)

    def _step(self, edges: pose_graph.Edges | None, moved: Float, wheels: Float, corners: Float | None) -> Float:
        """Covariance (3, 3) that a step (3,) adds, in the frame that it leads to."""
        way = max(_LEAST_WAY_M, math.hypot(moved[0], moved[1]) + WAY_PER_RAD * abs(moved[2]))
        driven = not np.isnan(wheels).any()
        otherwise = np.diag(1 / (way * (self.wheel_variance if driven else _INERTIA_VARIANCE)))
        if corners is not None:
            yaw = self._keyframes.poses[-1, 2]
            along = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]]) @ corners
            otherwise[:2, :2] += np.outer(along, along) / (way * _CORNER_SIGMAS**2 * self._variance)
        if edges is None or not len(edges):
            self._in_a_row = 0
            return np.asarray(inverse_3x3(otherwise))
        self._learn(edges)
        share = self._variance / _ALIKE_SIGMA_M**2
        # A copy, as a column of one row is laid out otherwise than one of several, and would have a kernel of its own.
        yaws = edges.T[:, 2].copy()
        covariance, scans = _added(edges.hessians, yaws, otherwise, share * self._variance)
        if driven:
            self._learn_wheels(wheels, way, scans)
        else:
            self._in_a_row = 0
        return np.asarray(covariance)

    def _learn(self, edges: pose_graph.Edges) -> None:
        """What edges want other than they have got, in units of their own information, tells how far scans err."""
        far = edges.first - edges.second >= _LONG_SPAN
        self._variance, self._learned = _learned(self._variance, self._learned, edges.hessians, edges.gradients, far)

    def _learn_wheels(self, step: Float, way: float, scans: Float) -> None:
        """How far the wheels err is seen along those axes along which it is the scans that know the way."""
        self._driven[:-1] = self._driven[1:]
        self._driven[-1, :3], self._driven[-1, 3], self._driven[-1, 4:] = step, way, scans
        self._in_a_row += 1
        if self._in_a_row >= _WHEEL_SPAN:
            poses = self._keyframes.poses
            _learn_wheels(self._driven, poses[-1 - _WHEEL_SPAN], poses[-1], self.wheel_variance)

    def _led_on(self, covariance: Float, k: int, scale: float) -> Float:
        """The covariance (3, 3) of keyframe k - 1 as that of keyframe k."""
        poses = self._keyframes.poses
        step = np.reshape(self._steps[9 * k : 9 * k + 9], (3, 3))
        return np.asarray(_led_on(covariance, poses[k - 1], poses[k], scale * step))

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

    def of_match(self, pose: Float, information: Float) -> Float:
        """Covariance (3, 3) of a pose (3,) that is matched to the latest keyframe with an information (3, 3)."""
        return np.asarray(_of_match(self.covariance, self._keyframes.poses[-1], pose, information))


@kernel
def _of_match(covariance, latest, pose, information):  # type: ignore[no-untyped-def]
    """Of the match, and of the keyframe as if the pose were rigidly connected to it."""
    return carried(covariance, pose[0] - latest[0], pose[1] - latest[1]) + inverse_3x3(information)


@kernel
def _learn_wheels(driven, first, last, variance):  # type: ignore[no-untyped-def]
    """Lead the variance (3,) of wheels, a m of way, to how far their steps (M, 7) come from the way between two poses.

    A row is a step (3,), its way, and the shares (3,) of scans in what is known of it.
    """
    told = driven[0, :3].copy()
    for m in range(1, len(driven)):
        told = compose(told, driven[m, :3])
    off = relative(relative(first, last), told)
    way = driven[:, 3].sum()
    for u in range(3):
        squared = min(max(off[u] ** 2 / way, _LEAST_WHEEL_SIGMA**2), _LARGEST_WHEEL_SIGMA**2)
        variance[u] += driven[:, 4 + u].min() * (squared - variance[u]) / _WHEEL_MEMORY


@kernel
def _learned(variance, count, hessians, gradients, counting):  # type: ignore[no-untyped-def]
    """The running mean of the squares, a degree of freedom, of what the counting edges (M,) want otherwise.

    count: of how many squares the mean is.
    """
    for m in np.flatnonzero(counting):
        pull = gradients[m]
        squared = (pull * solve_3x3(hessians[m] + np.eye(3), pull)).sum() / 3
        count = min(count + 1.0, _MEMORY)
        variance += (min(max(squared, _LEAST_SIGMA_M**2), _LARGEST_SIGMA_M**2) - variance) / count
    return variance, count


@inner_kernel
def _mean_seen_from_first(hessians, yaws):  # type: ignore[no-untyped-def]
    """Mean (3, 3) of hessians (M, 3, 3) of edges T_j_i with yaws (M,), turned from the frames of j to that of i."""
    total, unused = np.zeros((3, 3)), np.zeros(3)
    for m in range(len(yaws)):
        add_turned(hessians[m], unused, -yaws[m], total, unused)
    return total / len(yaws)


@kernel
def _added(hessians, yaws, otherwise, variance):  # type: ignore[no-untyped-def]
    """Covariance (3, 3) of a step that edges T_j_i with hessians (M, 3, 3) and yaws (M,) of one i hold, in frame i.

    otherwise: information (3, 3) of all else that is known. variance: of a pair of points, m^2. Also the share (3,)
    of the scans in what is known, along each axis.
    """
    held = _mean_seen_from_first(hessians, yaws) / variance
    covariance = inverse_3x3(held + otherwise)
    # Along a direction with no surface, where noise of normals seems to hold a scan, the rest is missing.
    least, direction = weakest(held)
    tilted = min(least, _TILTED * (held[0, 0] + held[1, 1]))
    rest = 0.0
    for u in range(2):
        for v in range(2):
            rest += direction[u] * otherwise[u, v] * direction[v]
    missing = 1 / (least - tilted + rest) - 1 / (least + rest)
    shares = np.empty(3)
    for u in range(3):
        shares[u] = held[u, u]
    for u in range(2):
        shares[u] -= tilted * direction[u] ** 2
        for v in range(2):
            covariance[u, v] += missing * direction[u] * direction[v]
    for u in range(3):
        shares[u] /= shares[u] + otherwise[u, u]
    return covariance, shares


@kernel
def _rotated(covariance, yaw):  # type: ignore[no-untyped-def]
    cos, sin = math.cos(yaw), math.sin(yaw)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return turn @ covariance @ turn.T


@kernel
def _led_on(covariance, before, after, step):  # type: ignore[no-untyped-def]
    """The covariance (3, 3) of a pose (3,) as that of the one after it, with what the step between them adds there."""
    return carried(covariance, after[0] - before[0], after[1] - before[1]) + _rotated(step, after[2])
