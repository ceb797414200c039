# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A trajectory: where a body was, at which times."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

from g2_recon.errors import InputError
from g2_recon.geometry import se2, se3

# Of so many poses there are matrices at once: of all of a long way they would take several times what it takes.
_AT_ONCE = 256


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses of one body in one fixed frame, in the order in which they were recorded.

    stamps: (N,) seconds, finite; may step backwards (some recordings do), so order is by index, not by time.
    positions: (N, 3) metres. quaternions: (N, 4) unit, x y z w.
    """

    stamps: NDArray[np.float64]
    positions: NDArray[np.float64]
    quaternions: NDArray[np.float64]

    def __post_init__(self) -> None:
        count = len(self.stamps)
        if self.stamps.shape != (count,) or self.positions.shape != (count, 3) or self.quaternions.shape != (count, 4):
            raise InputError("a trajectory needs as many positions (N, 3) and quaternions (N, 4) as stamps (N,)")

    def __len__(self) -> int:
        return len(self.stamps)

    @classmethod
    def from_matrices(cls, stamps: ArrayLike, T_map_body: ArrayLike) -> Trajectory:
        """From stamps (N,) and transforms (N, 4, 4)."""
        matrices = np.asarray(T_map_body, float).reshape(-1, 4, 4)
        return cls(np.asarray(stamps, float), matrices[:, :3, 3].copy(), se3.to_quaternion(matrices))

    @classmethod
    def from_se2(cls, stamps: ArrayLike, poses: ArrayLike) -> Trajectory:
        """From stamps (N,) and planar poses (N, 3)."""
        planar = np.asarray(poses, float).reshape(-1, 3)
        positions, quaternions = np.zeros((len(planar), 3)), np.empty((len(planar), 4))
        positions[:, :2] = planar[:, :2]
        for begin in range(0, len(planar), _AT_ONCE):
            rows = slice(begin, begin + _AT_ONCE)
            quaternions[rows] = se3.to_quaternion(se3.from_se2(planar[rows]))
        return cls(np.asarray(stamps, float), positions, quaternions)

    def matrices(self) -> NDArray[np.float64]:
        """Transforms T_map_body (N, 4, 4). Raises InputError where a pose is not finite or not a rotation."""
        return se3.from_quaternion(self.positions, self.quaternions)

    def planar(self) -> NDArray[np.float64]:
        """The planar part (N, 3): x, y, yaw."""
        return se2.from_se3(self.matrices())

    def length(self) -> float:
        """Length of the path in metres."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def resampled(self, period: float) -> Trajectory:
        """The trajectory at every `period` seconds from its first stamp on, interpolated. It must not be empty."""
        stamps = np.arange(self.stamps.min(), self.stamps.max(), period)
        return Trajectory.from_matrices(stamps, self.interpolate(stamps)[0])

    def interpolate(
        self, stamps: ArrayLike, *, max_gap: float = np.inf
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Transforms (M, 4, 4) at other times: linear in position, along the shortest rotation (slerp).

        Returns the transforms and a mask (M,) that is true where one is known: the time lies within the trajectory
        and the two poses beside it are at most `max_gap` seconds apart. Elsewhere the transform is NaN: nothing is
        extrapolated. Of poses with equal stamps the last one counts.
        """
        wanted = np.asarray(stamps, float).reshape(-1)
        result = np.full((len(wanted), 4, 4), np.nan)
        if len(self) == 0:
            return result, np.zeros(len(wanted), bool)
        order = np.argsort(self.stamps, kind="stable")
        order = order[np.r_[np.diff(self.stamps[order]) > 0, True]]
        times, positions = self.stamps[order], self.positions[order]
        inside = (wanted >= times[0]) & (wanted <= times[-1])
        right = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1))
        if len(times) == 1:
            result[inside] = se3.from_quaternion(positions[0], self.quaternions[order[0]])
            return result, inside
        on_pose = (wanted == times[right - 1]) | (wanted == times[right])
        known = inside & (on_pose | (times[right] - times[right - 1] <= max_gap))
        at = wanted[known]
        result[known, :3, :3] = Slerp(times, Rotation.from_quat(self.quaternions[order]))(at).as_matrix()
        for axis in range(3):
            result[known, axis, 3] = np.interp(at, times, positions[:, axis])
        result[known, 3] = (0, 0, 0, 1)
        return result, known


class PoseBuffer:
    """The latest poses of a body while they come in, for looking up the pose at a time in between.

    Poses may come late or twice; they are kept in order of time, and of two with the same stamp the later counts.
    """

    def __init__(self) -> None:
        self._stamps: list[float] = []
        self._positions: list[NDArray[np.float64]] = []
        self._quaternions: list[NDArray[np.float64]] = []

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def first_stamp(self) -> float:
        """The oldest stamp in seconds; +inf when empty."""
        return self._stamps[0] if self._stamps else np.inf

    @property
    def last_stamp(self) -> float:
        """The newest stamp in seconds; -inf when empty."""
        return self._stamps[-1] if self._stamps else -np.inf

    def add(self, stamp: float, T_map_body: ArrayLike) -> None:
        """Add a transform (4, 4) at a time in seconds."""
        matrix = np.asarray(T_map_body, float)
        index = bisect_right(self._stamps, stamp)
        if index and self._stamps[index - 1] == stamp:
            self.drop_at(index := index - 1)
        self._stamps.insert(index, stamp)
        self._positions.insert(index, matrix[:3, 3].copy())
        self._quaternions.insert(index, se3.to_quaternion(matrix))

    def drop_at(self, index: int) -> None:
        """Forget the pose at an index."""
        for row in (self._stamps, self._positions, self._quaternions):
            del row[index]

    def drop_before(self, stamp: float) -> None:
        """Forget poses that a look-up at `stamp` or later does not need."""
        keep = max(bisect_left(self._stamps, stamp) - 1, 0)
        for row in (self._stamps, self._positions, self._quaternions):
            del row[:keep]

    def clear(self) -> None:
        """Forget all poses."""
        self.drop_before(np.inf)
        if self._stamps:
            self.drop_at(0)

    def leads_to(self, stamp: float, longest: float) -> bool:
        """Whether `ahead` tells where the body is at a time."""
        end = bisect_right(self._stamps, stamp)
        if end < 2:
            return False
        before, last = self._stamps[end - 2 : end]
        return stamp - last <= min(last - before, longest)

    def ahead(self, stamp: float, longest: float) -> NDArray[np.float64] | None:
        """The transform (4, 4) at a time after a pose, if the body goes on from there as it came from the one before.

        None where the next pose must be there before that, as the last two are no farther apart, and where the time is
        more than `longest` s after the last. Poses after `stamp` make no difference.
        """
        if not self.leads_to(stamp, longest):
            return None
        end = bisect_right(self._stamps, stamp)
        share = (stamp - self._stamps[end - 1]) / (self._stamps[end - 1] - self._stamps[end - 2])
        (p, q), (before, turned) = ((self._positions[k], self._quaternions[k]) for k in (end - 1, end - 2))
        # On a straight line: over so short a time, the way and the turn bend by less than what odometry can tell.
        quaternion = q + share * (q - math.copysign(1.0, q @ turned) * turned)
        return se3.from_quaternion(p + share * (p - before), quaternion / np.linalg.norm(quaternion))

    def interpolate(
        self, stamps: ArrayLike, *, max_gap: float = np.inf
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Transforms (M, 4, 4) and mask (M,) at the given times; see Trajectory.interpolate."""
        wanted = np.asarray(stamps, float).reshape(-1)
        first = max(bisect_left(self._stamps, float(wanted.min(initial=np.inf))) - 1, 0)
        last = bisect_right(self._stamps, float(wanted.max(initial=-np.inf))) + 1
        window = slice(first, last)
        return Trajectory(
            np.array(self._stamps[window]),
            np.array(self._positions[window]).reshape(-1, 3),
            np.array(self._quaternions[window]).reshape(-1, 4),
        ).interpolate(wanted, max_gap=max_gap)
