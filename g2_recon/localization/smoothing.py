# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Fixed-lag smoothing: the latest keyframes laid on one another, all at once, whenever one is added."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry import se2
from g2_recon.localization import pairing, pose_graph
from g2_recon.localization.keyframes import Keyframes
from g2_recon.localization.tracking import PAIR_SIGMA_M

Float = NDArray[np.float64]

# A keyframe is laid on those so many before it; those of the last few are laid anew each time.
_SPANS = (1, 2, 3, 5, 8, 12, 17, 24, 32)
_RELAID = 3
_LAG = 33
_DISTANCE_M, _KERNEL_M = 0.12, 0.045
_LEAST_INLIERS, _FEWEST_INLIERS = 0.35, 30
_ALWAYS = 2
_ODOMETRY_WEIGHT = 5.0


class Smoother:
    """Keeps the edges of the latest keyframes and improves their poses."""

    def __init__(self, keyframes: Keyframes) -> None:
        self._keyframes = keyframes
        # Of each keyframe in the window: edges to earlier ones, as in pose_graph.Edges, and the one of the wheels.
        self._edges: dict[int, list[tuple[int, Float, Float, Float]]] = {}
        self._wheels: dict[int, tuple[int, Float, Float, Float]] = {}

    def add(self, odometry: Float, segment: int) -> None:
        """Smooth after a keyframe was added; odometry: (3,) the step of the wheels to it, NaN where unknown.

        `segment` is the first keyframe that the new one can be laid on.
        """
        k = len(self._keyframes) - 1
        if k == segment:
            return
        poses = self._keyframes.poses
        self._lay(range(max(segment + 1, k + 1 - _RELAID), k + 1), segment)
        step = se2.relative(poses[k - 1], poses[k]) if np.isnan(odometry).any() else odometry
        self._wheels[k] = (k - 1, step, _wheel_information(step), np.zeros(3))
        start = max(segment + 1, k - _LAG)
        for past in [i for i in self._wheels if i < start]:
            del self._edges[past], self._wheels[past]
        rows = [(i, *edge) for i in range(start, k + 1) for edge in (*self._edges[i], self._wheels[i])]
        pose_graph.solve_window(
            poses,
            start,
            np.array([row[0] for row in rows]),
            np.array([row[1] for row in rows]),
            np.array([row[2] for row in rows]),
            np.array([row[3] for row in rows]),
            np.array([row[4] for row in rows]),
            2,
        )

    def _lay(self, latest: range, segment: int) -> None:
        pairs = [(i, i - span) for i in latest for span in _SPANS if i - span >= segment]
        first, second = np.array(pairs).T
        T, hessians, gradients, counts = pairing.few_pairs(
            self._keyframes.poses, first, second, *self._keyframes.arrays, _DISTANCE_M, _KERNEL_M
        )
        fits = (counts[:, 0] > _LEAST_INLIERS * counts[:, 1]) & (counts[:, 0] > _FEWEST_INLIERS)
        self._edges |= {i: [] for i in latest}
        for m, (i, j) in enumerate(pairs):
            if fits[m] or i - j <= _ALWAYS:
                self._edges[i].append((j, T[m], hessians[m], gradients[m]))


def _wheel_information(step: Float) -> Float:
    way, turn = math.hypot(step[0], step[1]), abs(step[2])
    along = _ODOMETRY_WEIGHT * (PAIR_SIGMA_M / (0.02 + 0.1 * way)) ** 2
    return np.diag([along, along, (PAIR_SIGMA_M / (0.05 + 0.3 * turn)) ** 2])
