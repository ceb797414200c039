# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Fixed-lag smoothing: the latest keyframes laid on one another, all at once, whenever one is added."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.se2_kernels import relative
from g2_recon.localization import pairing, pose_graph
from g2_recon.localization.beams import CORNER
from g2_recon.localization.keyframes import Keyframes
from g2_recon.localization.tracking import PAIR_SIGMA_M

Float = NDArray[np.float64]

# A keyframe is laid on those so many before it; those of the last few are laid anew each time.
_SPANS = np.array([1, 2, 3, 5, 8, 12, 17, 24, 32])
_RELAID = 3
_LAG = 33
_DISTANCE_M, _KERNEL_M = 0.12, 0.045
_LEAST_INLIERS, _FEWEST_INLIERS = 0.35, 30
_ALWAYS = 2
_ODOMETRY_WEIGHT = 5.0
_ROUNDS = 2


class Smoother:
    """Keeps the edges of the latest keyframes and improves their poses."""

    def __init__(self, keyframes: Keyframes) -> None:
        self._keyframes = keyframes
        # Of each keyframe in the window: edges to earlier ones, and the one of the wheels.
        self._scans: dict[int, pose_graph.Edges] = {}
        self._wheels: dict[int, pose_graph.Edges] = {}

    def add(self, odometry: Float, segment: int) -> None:
        """Smooth after a keyframe was added; odometry: (3,) the step of the wheels to it, NaN where unknown.

        `segment` is the first keyframe that the new one can be laid on.
        """
        k = len(self._keyframes) - 1
        if k == segment:
            return
        poses = self._keyframes.poses
        for i in range(max(segment + 1, k + 1 - _RELAID), k + 1):
            self._scans[i] = self._laid(i, segment)
        step = relative(poses[k - 1], poses[k]) if np.isnan(odometry).any() else odometry
        last = np.array([k])
        self._wheels[k] = pose_graph.measured(last, last - 1, step[None], _wheel_information(step)[None])
        start = max(segment + 1, k - _LAG)
        for past in [i for i in self._wheels if i < start]:
            del self._scans[past], self._wheels[past]
        edges = pose_graph.joined(*self._scans.values(), *self._wheels.values())
        pose_graph.solve_window(
            poses, start, edges.first, edges.second, edges.T, edges.hessians, edges.gradients, _ROUNDS
        )

    def latest(self) -> pose_graph.Edges | None:
        """The edges of the latest keyframe, at the present poses; None where there is none before it."""
        laid = self._scans.get(len(self._keyframes) - 1)
        return None if laid is None else pose_graph.at_poses(self._keyframes.poses, laid)

    def _laid(self, i: int, segment: int) -> pose_graph.Edges:
        """Edges of a keyframe to those before it that it fits on."""
        second = i - _SPANS[i - segment >= _SPANS]
        first = np.full(len(second), i)
        T, hessians, gradients, counts = pairing.few_pairs(
            self._keyframes.poses, first, second, *self._keyframes.arrays, _DISTANCE_M, _KERNEL_M, CORNER
        )
        fits = (counts[:, 0] > _LEAST_INLIERS * counts[:, 1]) & (counts[:, 0] > _FEWEST_INLIERS)
        return pose_graph.Edges(first, second, T, hessians, gradients)[fits | (i - second <= _ALWAYS)]


def _wheel_information(step: Float) -> Float:
    way, turn = math.hypot(step[0], step[1]), abs(step[2])
    along = _ODOMETRY_WEIGHT * (PAIR_SIGMA_M / (0.02 + 0.1 * way)) ** 2
    return np.diag([along, along, (PAIR_SIGMA_M / (0.05 + 0.3 * turn)) ** 2])
