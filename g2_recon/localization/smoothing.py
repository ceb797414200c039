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
_ROUNDS = 1
# Rows for the edges of a window, and then some.
_ROOM = 4 * (_LAG + _RELAID) * (len(_SPANS) + 1)


class Smoother:
    """Keeps the edges of the latest keyframes and improves their poses."""

    def __init__(self, keyframes: Keyframes) -> None:
        self._keyframes = keyframes
        # Edges of each keyframe in the window to earlier ones, with that of the wheels, and where they begin.
        self._edges = _Rows()
        self._begins: dict[int, int] = {}
        self._wheels: dict[int, pose_graph.Edges] = {}
        self._latest: pose_graph.Edges | None = None

    def add(self, odometry: Float, segment: int) -> None:
        """Smooth after a keyframe was added; odometry: (3,) the step of the wheels to it, NaN where unknown.

        `segment` is the first keyframe that the new one can be laid on.
        """
        k = len(self._keyframes) - 1
        self._latest = None
        if k == segment:
            return
        poses = self._keyframes.poses
        self._wheels[k] = self._wheel_edge(k, odometry)
        self._wheels.pop(k - _RELAID, None)
        relaid, start = max(segment + 1, k + 1 - _RELAID), max(segment + 1, k - _LAG)
        self._edges.shorten(self._begins.get(relaid, self._edges.end))
        laid = self._laid(relaid, k, segment)
        for i in range(relaid, k + 1):
            self._begins[i] = self._edges.end
            self._latest = laid[laid.first == i]
            self._edges.extend(self._latest)
            self._edges.extend(self._wheels[i])
        for past in [i for i in self._begins if i < start]:
            del self._begins[past]
        window = self._edges.since(self._begins[start])
        pose_graph.solve_window(
            poses, start, window.first, window.second, window.T, window.hessians, window.gradients, _ROUNDS
        )

    def refill(self, odometry: Float, segment: int) -> None:
        """Take up keyframes that there were before, which stay where they are; odometry: (N, 3) steps to each."""
        count = len(self._keyframes)
        start = max(segment + 1, count - _LAG - _RELAID)
        laid = self._laid(start, count - 1, segment)
        for i in range(start, count):
            self._wheels[i] = self._wheel_edge(i, odometry[i])
            self._begins[i] = self._edges.end
            self._edges.extend(laid[laid.first == i])
            self._edges.extend(self._wheels[i])

    def latest(self) -> pose_graph.Edges | None:
        """The edges of the latest keyframe, at the present poses; None where there is none before it."""
        return None if self._latest is None else pose_graph.at_poses(self._keyframes.poses, self._latest)

    def _wheel_edge(self, k: int, odometry: Float) -> pose_graph.Edges:
        """The edge of keyframe k to the one before, by the step (3,) of the wheels or, where unknown, as it is."""
        poses = self._keyframes.poses
        step = relative(poses[k - 1], poses[k]) if np.isnan(odometry).any() else odometry
        last = np.array([k])
        return pose_graph.measured(last, last - 1, step[None], _wheel_information(step)[None])

    def _laid(self, relaid: int, k: int, segment: int) -> pose_graph.Edges:
        """Edges of the keyframes from `relaid` to k to those before them that they fit on."""
        first = np.repeat(np.arange(relaid, k + 1), len(_SPANS))
        second = first - np.tile(_SPANS, k + 1 - relaid)
        first, second = first[second >= segment], second[second >= segment]
        T, hessians, gradients, counts = pairing.few_pairs(
            self._keyframes.poses, first, second, *self._keyframes.arrays, _DISTANCE_M, _KERNEL_M, CORNER, 1
        )
        fits = (counts[:, 0] > _LEAST_INLIERS * counts[:, 1]) & (counts[:, 0] > _FEWEST_INLIERS)
        return pose_graph.Edges(first, second, T, hessians, gradients)[fits | (first - second <= _ALWAYS)]


class _Rows:
    """Edges one after the other, in arrays that need not be joined anew for every keyframe."""

    def __init__(self) -> None:
        self._arrays: tuple[NDArray[np.generic], ...] = (
            *(np.empty(_ROOM, np.int64), np.empty(_ROOM, np.int64)),
            *(np.empty((_ROOM, 3)), np.empty((_ROOM, 3, 3)), np.empty((_ROOM, 3))),
        )
        # Rows before `_first` are gone, those before `_kept` no longer needed.
        self._first = self._kept = self.end = 0

    def extend(self, edges: pose_graph.Edges) -> None:
        """Append edges."""
        if self.end + len(edges) - self._first > _ROOM:
            for array in self._arrays:
                array[: self.end - self._kept] = array[self._kept - self._first : self.end - self._first]
            self._first = self._kept
        rows = slice(self.end - self._first, self.end - self._first + len(edges))
        parts = edges.first, edges.second, edges.T, edges.hessians, edges.gradients
        for array, part in zip(self._arrays, parts, strict=True):
            array[rows] = part
        self.end += len(edges)

    def shorten(self, end: int) -> None:
        """Drop the rows from `end` on."""
        self.end = end

    def since(self, row: int) -> pose_graph.Edges:
        """The edges from this row on; earlier ones will not be asked for again."""
        self._kept = row
        rows = slice(row - self._first, self.end - self._first)
        first, second, T, hessians, gradients = (array[rows] for array in self._arrays)
        return pose_graph.Edges(first, second, T, hessians, gradients)  # type: ignore[arg-type]


def _wheel_information(step: Float) -> Float:
    way, turn = math.hypot(step[0], step[1]), abs(step[2])
    along = _ODOMETRY_WEIGHT * (PAIR_SIGMA_M / (0.02 + 0.1 * way)) ** 2
    return np.diag([along, along, (PAIR_SIGMA_M / (0.05 + 0.3 * turn)) ** 2])
