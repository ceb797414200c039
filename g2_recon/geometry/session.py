# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A mapping session that can be saved, loaded and gone on with: what the localizer knows of the places it has seen."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.scan import Scan

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int = NDArray[np.int64]

FARTHEST_M = 1e5
"""What lies farther from the origin of its map, or is a longer range of a beam, is no building."""

FINEST_RAD = 1e-4
"""No laser has its beams nearer to each other, a tenth of what fine ones have."""

LONGEST_WAY_M = 1e9
"""No robot has driven farther."""


@dataclass(frozen=True, slots=True)
class KeyframeArrays:
    """What there is of N keyframes with B beams each, but for where they are.

    stamps: (N,) s. points: (N, B, 2) m in the planar laser frame, normals: (N, B, 2) unit or zero, kinds: (N, B) 0 no
    measurement, 1 point, 2 point on a surface, 4 corner; firsts, increments: (N,) rad, bearing of the first beam and
    from beam to beam. ways: (N,) m driven until there. wheel_steps: (N, 3) step of the laser since the keyframe before
    as the wheels say, NaN where unknown. broken: (N,) where track was lost on the way to a keyframe.
    """

    stamps: Float
    points: Float32
    normals: Float32
    kinds: NDArray[np.uint8]
    firsts: Float
    increments: Float
    ways: Float
    wheel_steps: Float
    broken: NDArray[np.bool_]

    def of_rows(self, rows: slice) -> dict[str, NDArray[Any]]:
        """The arrays, by name, of some keyframes."""
        return {name: getattr(self, name)[rows] for name in OF_KEYFRAMES}


OF_KEYFRAMES = tuple(field.name for field in fields(KeyframeArrays))
"""The names of the arrays of keyframes."""


@dataclass(frozen=True, slots=True)
class Session(KeyframeArrays):
    """N keyframes, where they are in the map, and what ties them to each other.

    poses: (N, 3) T_map_laser. local_maps: (C,) how many keyframes there are when each of the C local maps begins.
    loops: (L, 2) which two local maps are the same place, and loop_information: (L, 3, 3) of the pose of the second as
    seen from the first.

    The poses are those of the laser, so that another robot can go on in the map. Raises InputError where arrays do not
    fit together, or numbers are not finite or out of their range.
    """

    poses: Float
    local_maps: Int
    loops: Int
    loop_information: Float

    def __post_init__(self) -> None:
        count, beams = self.kinds.shape if self.kinds.ndim == 2 else (-1, -1)
        shapes = {
            "stamps": (count,),
            "poses": (count, 3),
            "points": (count, beams, 2),
            "normals": (count, beams, 2),
            "kinds": (count, beams),
            "firsts": (count,),
            "increments": (count,),
            "ways": (count,),
            "wheel_steps": (count, 3),
            "broken": (count,),
            "loops": (len(self.loops), 2),
            "loop_information": (len(self.loops), 3, 3),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(f"{name} of a session are {getattr(self, name).shape}, not {shape}", advice=_ADVICE)
        if not count:
            raise InputError("a session without keyframes", advice="save it when the robot has seen something")
        self._check_keyframes()
        self._check_graph()

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def beams(self) -> tuple[Float32, Float32, NDArray[np.uint8], Float, Float]:
        """Points, normals, kinds, firsts and increments of the keyframes."""
        return self.points, self.normals, self.kinds, self.firsts, self.increments

    def _check_keyframes(self) -> None:
        _within("stamps", self.stamps, 1e15)
        _within("poses", self.poses, FARTHEST_M)
        _within("points", self.points, FARTHEST_M)
        _within("normals", self.normals, 1.001)
        _within("firsts", self.firsts, 4 * math.pi)
        _within("ways", self.ways, LONGEST_WAY_M)
        known = ~np.isnan(self.wheel_steps)
        _within("wheel_steps", self.wheel_steps[known], FARTHEST_M)
        # The bearing of a beam tells its index, and partners are looked for in steps of it.
        if not ((self.increments >= FINEST_RAD) & (self.increments <= 2 * math.pi)).all():
            raise InputError(f"increments of a session are angles from {FINEST_RAD:g} to 2 pi", advice=_ADVICE)
        if not np.isin(self.kinds, (0, 1, 2, 4)).all():
            raise InputError("kinds of a session are 0, 1, 2 or 4", advice=_ADVICE)
        if (np.diff(self.ways) < 0).any():
            raise InputError("ways of a session do not grow", advice=_ADVICE)

    def _check_graph(self) -> None:
        begins = self.local_maps
        if begins.ndim != 1 or not len(begins) or begins[0] != 0 or (np.diff(begins) <= 0).any():
            raise InputError("local_maps of a session do not begin one after the other", advice=_ADVICE)
        if begins[-1] >= len(self):
            raise InputError("a local map of a session has no keyframe", advice=_ADVICE)
        first, second = self.loops[:, 0], self.loops[:, 1]
        if not ((first >= 0) & (first < second) & (second < len(begins))).all():
            raise InputError("loops of a session are between local maps that are not there", advice=_ADVICE)
        _within("loop_information", self.loop_information, 1e12)
        if len(self.loops) and (
            not np.array_equal(self.loop_information, np.swapaxes(self.loop_information, 1, 2))
            or np.linalg.eigvalsh(self.loop_information).min() < -1e-6
        ):
            raise InputError("loop_information of a session is no information", advice=_ADVICE)

    def scans(self, *, upside_down: bool = False) -> list[Scan]:
        """The scans of the keyframes, as of a laser that is mounted so; a beam without a return says nothing."""
        ranges = np.where(self.kinds > 0, np.linalg.norm(self.points, axis=2), np.nan).astype(np.float32)
        turn = -1.0 if upside_down else 1.0
        return [
            Scan(float(stamp), row, turn * float(first), turn * float(increment))
            for stamp, row, first, increment in zip(self.stamps, ranges, self.firsts, self.increments, strict=True)
        ]


@dataclass(frozen=True, slots=True)
class ScanPoses:
    """Where S scans were: stamps (S,) s, owners (S,) the keyframe that each hangs on, offsets (S, 3) seen from there.

    An owner of -1 is none: the offset is then T_map_laser.
    """

    stamps: Float
    owners: Int
    offsets: Float

    def __len__(self) -> int:
        return len(self.stamps)


@dataclass(frozen=True, slots=True)
class LastScan:
    """Where a session was left: stamp s, pose (3,) T_map_laser, odometry (3,) T_odom_base, NaN where unknown."""

    stamp: float
    pose: Float
    odometry: Float


@dataclass(frozen=True, slots=True)
class SessionGrowth(KeyframeArrays):
    """What a session has more than at an earlier time, when it had `first` keyframes.

    poses: (N, 3) of all keyframes as they are now; those of KeyframeArrays are of the keyframes from `first` on.
    graph: local_maps, loops and loop_information as in Session, or None while they are in the making. scans: those
    that have come since, of a robot that stands only the first. last: the latest of all.
    """

    first: int
    poses: Float
    graph: tuple[Int, Int, Float] | None
    scans: ScanPoses
    last: LastScan


@dataclass(frozen=True, slots=True)
class SessionPart(KeyframeArrays):
    """What a robot tells of its session from time to time, from which others make it up.

    number: of the session, see `session_number`. count: how many keyframes it has. revision: another number where poses
    or graph are others. last_stamp: s, of the latest scan, keyframe or not. poses: (count, 3) T_map_laser of
    all keyframes, or none (0, 3) where they are as they were. first: the keyframe with which those of KeyframeArrays
    begin, which are of some keyframes in a row or of none. local_maps, loops, loop_information: the graph as in
    Session; no local maps where it is in the making.
    """

    number: int
    count: int
    revision: int
    last_stamp: float
    poses: Float
    first: int
    local_maps: Int
    loops: Int
    loop_information: Float


def session_number(stamp: float, points: Float32, kinds: NDArray[np.uint8]) -> int:
    """A number below 2^32 that tells sessions apart: of the first keyframe, whose points are (B, 2) and kinds (B,).

    So it stays the same when a session is gone on with.
    """
    return crc32(np.float64(stamp).tobytes() + np.ascontiguousarray(points[kinds > 0], "<f4").tobytes())


_ADVICE = "save it again"


def widened(rows: NDArray[Any], beams: int) -> NDArray[Any]:
    """Rows (N, B, ...) with as many beams as that, invalid ones (0) behind the last."""
    return np.pad(rows, [(0, 0), (0, beams - rows.shape[1]), *[(0, 0)] * (rows.ndim - 2)])


def _within(name: str, values: NDArray[np.floating], most: float) -> None:
    """Raises InputError where a number is not finite or absurdly large."""
    if not (np.abs(values) <= most).all():
        raise InputError(f"{name} of a session are not finite or above {most:g}", advice=_ADVICE)
