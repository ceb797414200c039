# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Fixed-lag smoothing: the latest keyframes laid on one another, all at once, whenever one is added."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.se2_kernels import relative
from g2_recon.kernels import inner_kernel, kernel
from g2_recon.localization import pose_graph
from g2_recon.localization.beams import CORNER
from g2_recon.localization.keyframes import Keyframes
from g2_recon.localization.pairing import PAIR_SIGMA_M, pair_of, parted, room

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
        # Edges of each keyframe in the window to earlier ones, that of the wheels last, and where they begin.
        self._edges = _Rows()
        self._begins: dict[int, int] = {}
        # Steps of the wheels to the keyframes that may be laid anew.
        self._wheels: dict[int, Float] = {}
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
        self._wheels[k] = self._wheel_step(k, odometry)
        self._wheels.pop(k - _RELAID, None)
        relaid, start = max(segment + 1, k + 1 - _RELAID), max(segment + 1, k - _LAG)
        self._edges.shorten(self._begins.get(relaid, self._edges.end))
        for i in range(relaid, k + 1):
            self._lay(i, segment)
        self._latest = self._edges.between(self._begins[k], self._edges.end - 1)
        for past in [i for i in self._begins if i < start]:
            del self._begins[past]
        window = self._edges.since(self._begins[start])
        pose_graph.solve_window(
            poses, start, window.first, window.second, window.T, window.hessians, window.gradients, _ROUNDS
        )

    def refill(self, odometry: Float, segment: int) -> None:
        """Take up keyframes that there were before, which stay where they are; odometry: (N, 3) steps to each."""
        count = len(self._keyframes)
        for i in range(max(segment + 1, count - _LAG - _RELAID), count):
            self._wheels[i] = self._wheel_step(i, odometry[i])
            self._lay(i, segment)

    def latest(self) -> pose_graph.Edges | None:
        """The edges of the latest keyframe, at the present poses; None where there is none before it."""
        return None if self._latest is None else pose_graph.at_poses(self._keyframes.poses, self._latest)

    def _wheel_step(self, k: int, odometry: Float) -> Float:
        """The step (3,) from the keyframe before k by the wheels or, where unknown, as it is."""
        poses = self._keyframes.poses
        return np.asarray(relative(poses[k - 1], poses[k]) if np.isnan(odometry).any() else odometry)

    def _lay(self, i: int, segment: int) -> None:
        """Append the edges of keyframe i to those before it that it fits on, and that of the wheels."""
        self._begins[i] = self._edges.end
        keyframes, rows = self._keyframes, self._edges.room(len(_SPANS) + 1)
        latest = keyframes.latest
        laid = _lay_on_earlier(
            rows.first, rows.second, rows.T, rows.hessians, rows.gradients,
            i - latest, segment - latest, self._wheels[i], keyframes.poses[latest:], *keyframes.since(latest),
        )  # fmt: skip
        rows.first[:laid] += latest
        rows.second[:laid] += latest
        self._edges.end += laid


class _Rows:
    """Edges one after the other, in arrays that need not be joined anew for every keyframe."""

    def __init__(self) -> None:
        ends = np.empty(_ROOM, np.int64), np.empty(_ROOM, np.int64)
        self._edges = pose_graph.Edges(*ends, np.empty((_ROOM, 3)), np.empty((_ROOM, 3, 3)), np.empty((_ROOM, 3)))
        # Rows before `_first` are gone, those before `_kept` no longer needed.
        self._first = self._kept = self.end = 0

    def room(self, count: int) -> pose_graph.Edges:
        """Where so many rows more can be written to, from `end` on."""
        if self.end + count - self._first > _ROOM:
            kept = self.since(self._kept)
            edges = self._edges[: len(kept)]
            edges.first[:], edges.second[:] = kept.first, kept.second
            edges.T[:], edges.hessians[:], edges.gradients[:] = kept.T, kept.hessians, kept.gradients
            self._first = self._kept
        return self.between(self.end, self._first + _ROOM)

    def shorten(self, end: int) -> None:
        """Drop the rows from `end` on."""
        self.end = end

    def between(self, begin: int, end: int) -> pose_graph.Edges:
        """The edges from one row to before another; they change with the rows."""
        return self._edges[begin - self._first : end - self._first]

    def since(self, row: int) -> pose_graph.Edges:
        """The edges from this row on; earlier ones will not be asked for again."""
        self._kept = row
        return self.between(row, self.end)


@kernel
def _lay_on_earlier(  # type: ignore[no-untyped-def]
    first, second, T, hessians, gradients, i, segment, wheels, poses, points, normals, kinds, firsts, increments
):
    """Write the edges of keyframe i to earlier ones, from `segment` on, into the first rows; how many there are.

    The last one is that of the wheels, whose step (3,) is given.
    """
    rows, memory = parted(points[i], normals[i], kinds[i], CORNER, 1), room(kinds.shape[1])
    count = 0
    for span in _SPANS:
        j = i - span
        if j < segment:
            continue
        T_j_i = relative(poses[j], poses[i])
        hessian, gradient, inliers, seen = pair_of(
            T_j_i, i, rows, j, points, normals, kinds, firsts, increments, _DISTANCE_M, _KERNEL_M, CORNER, 1, memory
        )
        fits = inliers > _LEAST_INLIERS * seen and inliers > _FEWEST_INLIERS
        if fits or span <= _ALWAYS:
            first[count], second[count] = i, j
            _put(count, T_j_i, hessian, gradient, T, hessians, gradients)
            count += 1
    first[count], second[count] = i, i - 1
    _put(count, wheels, _wheel_information(wheels), np.zeros(3), T, hessians, gradients)
    return count + 1


@kernel
def _put(row, T_j_i, hessian, gradient, T, hessians, gradients):  # type: ignore[no-untyped-def]
    """Write an edge number by number; see se2_kernels.inverse_3x3."""
    for u in range(3):
        T[row, u], gradients[row, u] = T_j_i[u], gradient[u]
        for v in range(3):
            hessians[row, u, v] = hessian[u, v]


@inner_kernel
def _wheel_information(step):  # type: ignore[no-untyped-def]
    way, turn = math.hypot(step[0], step[1]), abs(step[2])
    information = np.zeros((3, 3))
    information[0, 0] = information[1, 1] = _ODOMETRY_WEIGHT * (PAIR_SIGMA_M / (0.02 + 0.1 * way)) ** 2
    information[2, 2] = (PAIR_SIGMA_M / (0.05 + 0.3 * turn)) ** 2
    return information
