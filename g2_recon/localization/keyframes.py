# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The keyframes: scans that the map is made of, in arrays that grow."""

from __future__ import annotations

from copy import copy

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.session import Session
from g2_recon.localization.beams import Beams, normals_of_scans

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Arrays = tuple[Float32, Float32, NDArray[np.uint8], Float, Float]

# Arrays have room for so many keyframes at first, and for so many times more whenever they are full: what is copied
# then takes twice the memory for a while, and rows that are not in use take none.
_FEWEST_ROWS, _GROWTH = 256, 4
# Normals are kept of at least the latest keyframes, at most of so many where keyframes are added.
_LATEST, _MOST_NORMALS = 128, 256


class Keyframes:
    """Beams and poses of keyframes, in the order in which they were taken.

    All arrays have a row a keyframe. Scans with fewer beams than the largest end in invalid ones. Normals, which take
    as much memory as points, are kept of the latest keyframes, which every scan is laid on; when those of earlier ones
    are asked for they are made anew, the same to the bit. Where none were added after `fill`, those of all are kept.
    """

    def __init__(self) -> None:
        self._count = 0
        self._allocate(_FEWEST_ROWS, 1)
        self._first_normals, self._normals = 0, np.empty((_MOST_NORMALS, 1, 2), np.float32)

    def _allocate(self, rows: int, beams: int) -> None:
        # Empty, as rows that are not in use take no memory until they are written to.
        self._poses: Float = np.empty((rows, 3))
        self._points = np.empty((rows, beams, 2), np.float32)
        self._kinds = np.empty((rows, beams), np.uint8)
        self._firsts = np.empty(rows)
        self._increments = np.empty(rows)

    def __len__(self) -> int:
        return self._count

    @property
    def poses(self) -> Float:
        """T_map_laser (N, 3) of the keyframes; written to by whoever improves them."""
        return self._poses[: self._count]

    @property
    def points(self) -> Float32:
        """(N, B, 2) m; see Beams."""
        return self._points[: self._count]

    @property
    def kinds(self) -> NDArray[np.uint8]:
        """(N, B); see Beams."""
        return self._kinds[: self._count]

    @property
    def arrays(self) -> Arrays:
        """Points (N, B, 2), normals (N, B, 2), kinds (N, B), firsts (N,), increments (N,): see Beams."""
        return self.since(0)

    @property
    def latest(self) -> int:
        """The first of the latest keyframes, of which `since` costs nothing: the last 128 at least."""
        return self._first_normals

    def since(self, first: int, most: int | None = None) -> Arrays:
        """As `arrays`, of the keyframe `first` and those after it, not more than `most`."""
        end, begin = self._count, self._first_normals
        if most is not None:
            end = min(end, first + most)
        normals = self._normals[max(0, first - begin) : max(0, end - begin)]
        if first < begin:
            earlier = slice(first, min(begin, end))
            normals = np.concatenate([normals_of_scans(self._points[earlier], self._kinds[earlier]), normals])
        rows = slice(first, end)
        return self._points[rows], normals, self._kinds[rows], self._firsts[rows], self._increments[rows]

    def of_rows(self, rows: NDArray[np.int64]) -> Arrays:
        """As `arrays`, of some keyframes (M,)."""
        points, kinds = self._points[rows], self._kinds[rows]
        return points, normals_of_scans(points, kinds), kinds, self._firsts[rows], self._increments[rows]

    def snapshot(self) -> Keyframes:
        """The keyframes of now, whose poses stay as they are; their beams take no more memory."""
        same = copy(self)
        same._poses = self.poses.copy()
        return same

    def add(self, beams: Beams, pose: Float) -> int:
        """Add a scan, whose normals are those of its points, with its pose (3,); the index of the new keyframe."""
        count = len(beams.points)
        rows, width = self._kinds.shape
        if self._count == rows or count > width:
            self._grow(_GROWTH * rows if self._count == rows else rows, max(count, width))
        index = self._count
        if index - self._first_normals == len(self._normals) or count > self._normals.shape[1]:
            self._forget_normals()
        one = beams.points, beams.normals, beams.kinds, np.array(beams.first), np.array(beams.increment)
        self._put(index, pose[None], tuple(array[None] for array in one))
        self._count += 1
        return index

    @classmethod
    def of_session(cls, session: Session) -> Keyframes:
        """Those of a session, where they are in its map."""
        keyframes = cls()
        keyframes.fill(session.poses, session.beams)
        return keyframes

    def fill(self, poses: Float, arrays: tuple[NDArray[np.generic], ...]) -> None:
        """Replace all by poses (N, 3) and arrays as in `arrays`."""
        count, width = arrays[2].shape
        self._allocate(max(count, 1), max(width, 1))
        self._first_normals, self._normals = 0, np.empty(self._points.shape, np.float32)
        self._count = count
        self._put(0, poses, arrays)

    def _grow(self, rows: int, beams: int) -> None:
        poses, points, kinds = self.poses, self.points, self.kinds
        lines = self._firsts[: self._count], self._increments[: self._count]
        self._allocate(rows, beams)
        self._put_all_but_normals(0, poses, points, kinds, *lines)

    def _forget_normals(self) -> None:
        first = max(self._first_normals, self._count - _LATEST)
        kept = self._normals[first - self._first_normals : self._count - self._first_normals]
        # A new array, as snapshots see the one that there was.
        self._first_normals = first
        self._normals = np.empty((_MOST_NORMALS, *self._points.shape[1:]), np.float32)
        _write(self._normals, 0, kept)

    def _put(self, begin: int, poses: Float, arrays: tuple[NDArray[np.generic], ...]) -> None:
        points, normals, kinds, firsts, increments = arrays
        self._put_all_but_normals(begin, poses, points, kinds, firsts, increments)
        _write(self._normals, begin - self._first_normals, normals)

    def _put_all_but_normals(self, begin: int, poses: Float, *arrays: NDArray[np.generic]) -> None:
        points, kinds, firsts, increments = arrays
        _write(self._points, begin, points)
        _write(self._kinds, begin, kinds)
        rows = slice(begin, begin + len(poses))
        self._poses[rows], self._firsts[rows], self._increments[rows] = poses, firsts, increments


def _write(kept: NDArray[np.generic], begin: int, values: NDArray[np.generic]) -> None:
    """Write rows from `begin` on; beams that there are not become invalid ones."""
    rows, width = slice(begin, begin + len(values)), values.shape[1]
    kept[rows, :width], kept[rows, width:] = values, 0
