# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The way of the robot, pose by pose as it came, moved to where the localizer has its keyframes by now."""

from __future__ import annotations

import math
import operator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from g2_recon.geometry import se3
from g2_recon.geometry.trajectory import Trajectory

Float = NDArray[np.float64]

_FEWEST_ROWS = 1024
# Keyframes whose stamps step back by more are those of a session before, which goes on.
_ANOTHER_DRIVE_S = 1.0
# What thinned poses keep of a way that keyframes may still come for, in m and rad.
_STEP_M, _STEP_RAD = 0.01, 0.005


class Poses(NamedTuple):
    """T_map_base at times in ascending order: stamps (N,), positions (N, 3), quaternions (N, 4) x y z w."""

    stamps: Float
    positions: Float
    quaternions: Float


class CorrectedTrajectory:
    """Poses as a localizer hands them out, scan by scan, and as its keyframes correct them afterwards.

    A pose hangs on the keyframe before it: how the robot moved since then stays as it was measured. Where a keyframe is
    moved, its poses move with it; where the next one is moved otherwise, as at the seam of two local maps after a loop
    was closed, the difference is spread over the time between the two. A loop that is closed at a keyframe makes the
    poses that came jump there; the way as it is known then does not.

    thin_until: stamp in seconds before which poses have been thinned, -inf at first.
    """

    def __init__(self) -> None:
        self._count = 0
        self.thin_until = -np.inf
        self._rows = Poses(np.empty(_FEWEST_ROWS), np.empty((_FEWEST_ROWS, 3)), np.empty((_FEWEST_ROWS, 4)))
        # Of keyframes: stamps, poses as they are now and as they came.
        self._keyframe_stamps: Float = np.empty(0)
        self._now: Float = np.empty((0, 4, 4))
        self._came: Float = np.empty((0, 4, 4))
        # Of keyframes but the last: the step to the next one as first seen.
        self._steps: Float = np.empty((0, 4, 4))
        # Where keyframes are, as they and as the next ones have them, for whoever asked `moved` last.
        self._told: tuple[Float, Float] = np.empty((0, 4, 4)), np.empty((0, 4, 4))
        self._newest_stays = True
        self._ahead: Trajectory | None = None

    def __len__(self) -> int:
        return self._count

    @property
    def first_stamp(self) -> float:
        """The oldest stamp in seconds; +inf when empty."""
        return float(self._rows.stamps[0]) if self._count else np.inf

    @property
    def last_stamp(self) -> float:
        """The newest stamp in seconds; -inf when empty."""
        return float(self._rows.stamps[self._count - 1]) if self._count else -np.inf

    def add(self, stamp: float, T_map_base: ArrayLike) -> bool:
        """Add a pose (4, 4) at a time in seconds; of two with the same stamp the later counts.

        Whether keyframes count now that were told before their poses came.
        """
        matrix = np.asarray(T_map_base, float)
        if self._count == len(self._rows.stamps):
            self._rows = Poses(*map(_doubled, self._rows))
        row = int(np.searchsorted(self._rows.stamps[: self._count], stamp))
        if row == self._count or self._rows.stamps[row] != stamp:
            for rows in self._rows:
                rows[row + 1 : self._count + 1] = rows[row : self._count]
            self._count += 1
        self._rows.stamps[row] = stamp
        self._rows.positions[row] = matrix[:3, 3]
        self._rows.quaternions[row] = se3.to_quaternion(matrix)
        return self._ahead is not None and self._ahead.stamps.max() <= self.last_stamp and self.follow(self._ahead)

    def drop_before(self, stamp: float) -> None:
        """Forget poses that a look-up at `stamp` or later does not need."""
        keep = max(int(np.searchsorted(self._rows.stamps[: self._count], stamp)) - 1, 0)
        # Not each time: the others move up.
        if keep > self._count // 2:
            self._keep(np.arange(self._count) >= keep)

    def thin(self, until: float, spans: ArrayLike) -> None:
        """Forget poses before `until` that `between` does not need for any of these spans (N, 2), in seconds.

        Keyframes that are told later are placed by the poses around them: from the newest one on, those stay that tell
        where the robot has moved. Poses before `thin_until`, that of the last time, are not looked at again.
        """
        stamps = self._rows.stamps[: self._count]
        begin, end = np.searchsorted(stamps, [self.thin_until, until])
        self.thin_until = until
        if end - begin < 2:
            return
        firsts, lasts = np.reshape(spans, (-1, 2)).T
        begun = np.bincount(np.maximum(np.searchsorted(stamps, firsts, side="right") - 1, 0), minlength=len(stamps) + 1)
        ended = np.bincount(np.searchsorted(stamps, lasts) + 1, minlength=len(stamps) + 2)[: len(stamps) + 1]
        needed = np.cumsum(begun - ended)[: len(stamps)] > 0
        needed[: begin + 1] = needed[end - 1 :] = True
        open_from = max(begin, np.searchsorted(stamps, self._keyframe_stamps[-1:].max(initial=-np.inf)) - 1)
        if open_from < end:
            needed[open_from:end] |= self._moved_on(open_from, end)
        self._keep(needed)

    def _moved_on(self, begin: int, end: int) -> NDArray[np.bool_]:
        """Which of the poses from one row to before another tell where the robot has moved since the one before."""
        positions, quaternions = self._rows.positions[begin:end].tolist(), self._rows.quaternions[begin:end].tolist()
        told = np.zeros(end - begin, bool)
        at, turned = positions[0], quaternions[0]
        for row, (position, quaternion) in enumerate(zip(positions, quaternions, strict=True)):
            alike = abs(sum(map(operator.mul, turned, quaternion)))  # cosine of half the angle between
            if math.dist(at, position) > _STEP_M or alike < math.cos(_STEP_RAD / 2):
                # The one before, too: in between the robot has stood.
                told[row - 1 : row + 1] = True
                at, turned = position, quaternion
        return told

    def _keep(self, which: NDArray[np.bool_]) -> None:
        """Forget the poses that a mask (N,) does not name."""
        kept = [rows[: self._count][which] for rows in self._rows]
        self._count = len(kept[0])
        if 4 * self._count < len(self._rows.stamps):
            size = max(_FEWEST_ROWS, 2 * self._count)
            self._rows = Poses(np.empty(size), np.empty((size, 3)), np.empty((size, 4)))
        for rows, some in zip(self._rows, kept, strict=True):
            rows[: self._count] = some

    def follow(self, keyframes: Trajectory) -> bool:
        """Take note of where the keyframes are now; false, and nothing is changed, where they are of another map.

        Those before the first pose, as of a session that goes on, do not count.
        """
        stamps, matrices = _latest_drive(keyframes)
        known = self._keyframe_stamps
        rows = np.searchsorted(stamps, known)
        if len(known) and not (rows[-1] < len(stamps) and np.array_equal(stamps[rows], known)):
            return False
        if self._count and len(stamps) and stamps[0] > self.last_stamp:
            return False
        newest = known[-1] if len(known) else -np.inf
        new = (stamps > newest) & (stamps >= self.first_stamp) & (stamps <= self.last_stamp)
        self._ahead = keyframes if len(stamps) and stamps[-1] > self.last_stamp else None
        self._now = np.concatenate([matrices[rows], matrices[new]])
        self._keyframe_stamps = np.concatenate([known, stamps[new]])
        came = self._as_they_came(stamps[new])
        self._came = np.concatenate([self._came, came])
        self._told = np.concatenate([self._told[0], came]), np.concatenate([self._told[1], came])
        begun = len(self._steps)
        self._steps = np.concatenate([self._steps, se3.inverse(self._now[begun:-1]) @ self._now[begun + 1 :]])
        self._newest_stays = bool(np.allclose(self._now[-1:], self._came[-1:], rtol=0, atol=1e-9))
        return True

    def moved(self, distance: float, angle: float) -> tuple[Float, NDArray[np.bool_]]:
        """Stamps (K,) of the keyframes, and which of them (K,) are far from where they were.

        Far is more than `distance` in metres or `angle` in radians, there or on the way to the next one, from where the
        poses that came had it, or from where it was when this was last said of it.
        """
        places = self._places(np.arange(len(self._now)))
        far = np.zeros(len(self._now), bool)
        for told, now in zip(self._told, places, strict=True):
            turned = np.einsum("nij,nij->n", told[:, :3, :3], now[:, :3, :3])
            far |= np.linalg.norm(now[:, :3, 3] - told[:, :3, 3], axis=1) > distance
            far |= turned < 1.0 + 2.0 * np.cos(angle)  # trace of a rotation by `angle`
        for told, now in zip(self._told, places, strict=True):
            told[far] = now[far]
        return self._keyframe_stamps, far

    def between(self, first: float, last: float) -> Poses:
        """The poses, where they are now, that tell where the robot was from `first` to `last` in seconds."""
        poses = self._rows_between(first, last)
        keyframes = self._keyframe_stamps
        if not len(keyframes) or (self._newest_stays and bool((poses.stamps >= keyframes[-1]).all())):
            return poses
        return self._corrected(poses)

    def _corrected(self, poses: Poses) -> Poses:
        keyframe = np.searchsorted(self._keyframe_stamps, poses.stamps, side="right") - 1
        rows = np.flatnonzero(keyframe >= 0)
        if not len(rows):
            return poses
        keyframe = keyframe[rows]
        ends = np.append(self._keyframe_stamps, np.inf)[keyframe + 1]
        begins = self._keyframe_stamps[keyframe]
        share = (poses.stamps[rows] - begins) / (ends - begins)
        T_map_keyframe = _interpolated(*self._places(keyframe), share)
        T_map_came = se3.from_quaternion(poses.positions[rows], poses.quaternions[rows])
        T_map_base = T_map_keyframe @ se3.inverse(self._came[keyframe]) @ T_map_came
        positions, quaternions = poses.positions.copy(), poses.quaternions.copy()
        positions[rows], quaternions[rows] = T_map_base[:, :3, 3], se3.to_quaternion(T_map_base)
        return Poses(poses.stamps, positions, quaternions)

    def _places(self, keyframes: NDArray[np.intp]) -> tuple[Float, Float]:
        """Where keyframes are now, as they say themselves and as the next ones have them."""
        first = self._now[keyframes]
        second = first.copy()
        followed = keyframes < len(self._steps)
        followers = keyframes[followed]
        second[followed] = self._now[followers + 1] @ se3.inverse(self._steps[followers])
        return first, second

    def _as_they_came(self, stamps: Float) -> Float:
        """Poses (K, 4, 4) as they came, at times within."""
        if not len(stamps):
            return np.empty((0, 4, 4))
        return Trajectory(*self._rows_between(stamps[0], stamps[-1])).interpolate(stamps)[0]

    def _rows_between(self, first: float, last: float) -> Poses:
        stamps = self._rows.stamps[: self._count]
        begin = max(int(np.searchsorted(stamps, first, side="right")) - 1, 0)
        end = min(int(np.searchsorted(stamps, last)) + 1, self._count)
        return Poses(*(rows[begin:end] for rows in self._rows))


def _doubled(rows: Float) -> Float:
    """With room for as many again, which takes no memory until it is written to."""
    grown = np.empty((2 * len(rows), *rows.shape[1:]))
    grown[: len(rows)] = rows
    return grown


def _latest_drive(keyframes: Trajectory) -> tuple[Float, Float]:
    """Stamps (K,), ascending, and poses (K, 4, 4) of the keyframes; of a session that goes on, those of this drive."""
    drive = np.concatenate([[0], np.flatnonzero(np.diff(keyframes.stamps) < -_ANOTHER_DRIVE_S) + 1])[-1]
    stamps, matrices = keyframes.stamps[drive:], keyframes.matrices()[drive:]
    order = np.argsort(stamps, kind="stable")
    order = order[np.r_[np.diff(stamps[order]) > 0, True][: len(order)]]
    return stamps[order], matrices[order]


def _interpolated(start: Float, end: Float, share: Float) -> Float:
    """Transforms (N, 4, 4), each a share (N,) of the way from one to the other."""
    turn = Rotation.from_matrix(se3.inverse(start)[:, :3, :3] @ end[:, :3, :3]).as_rotvec()
    result = start.copy()
    result[:, :3, :3] = start[:, :3, :3] @ Rotation.from_rotvec(share[:, None] * turn).as_matrix()
    result[:, :3, 3] += share[:, None] * (end[:, :3, 3] - start[:, :3, 3])
    return result
