# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The keyframes: scans that the map is made of, in arrays that grow."""

from __future__ import annotations

from copy import copy

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.session import Session
from g2_recon.localization.beams import Beams

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]

_FEWEST_ROWS = 256


class Keyframes:
    """Beams and poses of keyframes, in the order in which they were taken.

    All arrays have a row a keyframe; rows beyond `len` are not in use. Scans with fewer beams than the largest end in
    invalid ones.
    """

    def __init__(self) -> None:
        self._count = 0
        self._allocate(_FEWEST_ROWS, 1)

    def _allocate(self, rows: int, beams: int) -> None:
        # Empty, as rows that are not in use take no memory until they are written to.
        self._poses: Float = np.empty((rows, 3))
        self._points = np.empty((rows, beams, 2), np.float32)
        self._normals = np.empty((rows, beams, 2), np.float32)
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
    def arrays(self) -> tuple[Float32, Float32, NDArray[np.uint8], Float, Float]:
        """Points (N, B, 2), normals (N, B, 2), kinds (N, B), firsts (N,), increments (N,): see Beams."""
        n = self._count
        return self._points[:n], self._normals[:n], self._kinds[:n], self._firsts[:n], self._increments[:n]

    def snapshot(self) -> Keyframes:
        """The keyframes of now, whose poses stay as they are; their beams take no more memory."""
        same = copy(self)
        same._poses = self.poses.copy()
        return same

    def add(self, beams: Beams, pose: Float) -> int:
        """Add a scan with its pose (3,); the index of the new keyframe."""
        count = len(beams.points)
        rows, width = self._kinds.shape
        if self._count == rows or count > width:
            self._grow(2 * rows if self._count == rows else rows, max(count, width))
        index = self._count
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
        self._count = count
        self._put(0, poses, arrays)

    def _grow(self, rows: int, beams: int) -> None:
        poses, arrays = self.poses, self.arrays
        self._allocate(rows, beams)
        self._put(0, poses, arrays)

    def _put(self, begin: int, poses: Float, arrays: tuple[NDArray[np.generic], ...]) -> None:
        """Write to the rows from `begin` on; beams that there are not become invalid ones."""
        points, normals, kinds, firsts, increments = arrays
        count, width = kinds.shape
        rows = slice(begin, begin + count)
        self._poses[rows] = poses
        for kept, values in ((self._points, points), (self._normals, normals), (self._kinds, kinds)):
            kept[rows, :width], kept[rows, width:] = values, 0
        self._firsts[rows], self._increments[rows] = firsts, increments
