# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The clouds of several robots in one world: pieces that follow wherever their robots' maps are laid.

A piece hangs on the keyframes of its session around the time at which it was seen: it is moved as they are moved from
the map of the robot into the world. So it follows both what the robot learns of its own way and what all learn of each
other's.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry import se2, se3
from g2_recon.geometry.cloud import ALL_PIECES, Cloud, Piece, concatenate

Float = NDArray[np.float64]

# A piece is moved where its points would be so much elsewhere, m, at this distance from where they were seen, m.
_MOVED_M, _ARM_M = 0.01, 5.0
# What is thinner, as a standard deviation, is a scan of a robot that stands, and no sweep, m.
_FLAT_M = 0.1


@dataclass(frozen=True, slots=True)
class Correction:
    """How the map of a session lies in the world along its way: T_world_map (N, 3) at stamps (N,) s of keyframes.

    lift: (4, 4) what comes before it, where the map is not level or not at the height of the world.
    """

    stamps: Float
    T_world_map: Float
    lift: Float = field(default_factory=lambda: np.eye(4))

    @classmethod
    def rigid(cls, T_world_map: Float) -> Correction:
        """Of a map that lies at one transform (4, 4)."""
        planar = se2.from_se3(T_world_map)
        return cls(np.zeros(1), planar[None], se3.inverse(se3.from_se2(planar)) @ T_world_map)

    @classmethod
    def between(cls, stamps: Float, in_map: Float, in_world: Float) -> Correction:
        """Of keyframes at T_map_laser (N, 3) that are at T_world_laser (N, 3)."""
        return cls(stamps, se2.compose(in_world, se2.inverse(in_map)))

    def at(self, stamps: Float) -> Float:
        """T_world_map (M, 3) at times (M,) s, between keyframes in between, beyond them as at the nearest one."""
        if len(self.stamps) == 1:
            return np.repeat(self.T_world_map, len(stamps), axis=0)
        k = np.clip(np.searchsorted(self.stamps, stamps, side="right") - 1, 0, len(self.stamps) - 2)
        share = np.clip((stamps - self.stamps[k]) / np.maximum(self.stamps[k + 1] - self.stamps[k], 1e-9), 0, 1)
        step = se2.relative(self.T_world_map[k], self.T_world_map[k + 1])
        return se2.compose(self.T_world_map[k], share[:, None] * step)


@dataclass(slots=True)
class _Piece:
    """Points of a robot's piece in its map, (N, 3) or with sensor (N, 6), as float32; `sent` of them are out."""

    stamp: float
    revision: int
    parts: list[NDArray[np.float32]]
    center: Float
    number: int = -1
    sent: int = 0
    out_revision: int = 0
    T: Float | None = None
    # Of how many points it is known whether they are a sweep.
    judged: tuple[int, bool] = (-1, False)

    @property
    def points(self) -> int:
        """How many there are."""
        return sum(map(len, self.parts))

    @property
    def is_sweep(self) -> bool:
        """Whether all of it was seen from one place, and reaches out in all directions."""
        if self.judged[0] != self.points:
            columns = np.concatenate(self.parts)
            alone = len(columns) > 3 and columns.shape[1] == 6 and bool((columns[:, 3:] == columns[0, 3:]).all())
            self.judged = self.points, alone and np.linalg.eigvalsh(np.cov(columns[:, :3].T))[0] > _FLAT_M**2
        return self.judged[1]


@dataclass(frozen=True, slots=True)
class StoredPiece:
    """Points of a piece as they are stored, (N, 3) or with sensor (N, 6), none of them copied.

    T: (3,) where they come to lie in the plane, after lift (4, 4).
    """

    parts: tuple[NDArray[np.float32], ...]
    T: Float = field(default_factory=lambda: np.zeros(3))
    lift: Float = field(default_factory=lambda: np.eye(4))

    def cloud(self) -> Cloud:
        """The points where they lie."""
        return _in_world(self.T, np.concatenate(self.parts), self.lift)


@dataclass(slots=True)
class _Place:
    """What of a session is in the world: its source there, how many pieces it has, and where it lies."""

    source: int
    correction: Correction
    pieces: list[_Piece] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Sweeps:
    """The pieces of a source that are sweeps; begin: of the first, s; version: changes with whatever is new."""

    begin: float
    version: tuple[int, int]
    pieces: tuple[_Piece, ...]

    def stored(self) -> tuple[StoredPiece, ...]:
        """Each sweep in the map of the robot, with where the laser was, as it is now."""
        return tuple(StoredPiece(tuple(piece.parts)) for piece in self.pieces)


class JointCloud:
    """Pieces as they come from robots, and as they go out in the world.

    Nothing that came is given up, not even where a robot begins a new map: that is another session of it.
    """

    def __init__(self, new_source: Callable[[], int]) -> None:
        """new_source: draws the number of a source in the world."""
        self._new_source = new_source
        self._sources: dict[tuple[str, int], dict[int, _Piece]] = {}
        self._session_of: dict[tuple[str, int], int] = {}
        self._sessions: dict[str, Mapping[int, tuple[float, float]]] = {}
        self._places: dict[tuple[str, int], _Place] = {}
        self._to_send: dict[int, tuple[tuple[str, int], _Piece]] = {}
        self._gone: list[int] = []
        # Of how many points there are, and how many have a place.
        self.points = self._placed = 0

    def add(self, robot: str, stamp: float, cloud: Cloud, piece: Piece) -> str:
        """Take in points in the map of a robot, seen at stamp s; why they are not used, empty if they are."""
        if piece.number == ALL_PIECES:
            return ""
        pieces = self._sources.setdefault((robot, piece.source), {})
        known = pieces.get(piece.number)
        if known is not None and piece.revision < known.revision:
            return "of an older revision"
        columns = cloud.points if cloud.sensor is None else np.hstack([cloud.points, cloud.sensor])
        part = columns.astype(np.float32)
        before = 0 if known is None else known.points
        if known is not None and part.shape[1] != known.parts[0].shape[1]:
            return "with other fields than the piece had"
        if known is None:
            center = cloud.points[:, :2].mean(axis=0) if len(cloud) else np.zeros(2)
            known = pieces[piece.number] = _Piece(stamp, piece.revision, [part], center)
        elif piece.revision == known.revision:
            known.parts.append(part)
        else:
            known.revision, known.parts = piece.revision, [part]
            self._send_anew(known)
        self.points += known.points - before
        if known.number >= 0:
            self._placed += known.points - before
        session = self._session_of.get((robot, piece.source))
        if session is not None:
            self._mark(robot, session, known)
        else:
            self._bind(robot, piece.source, [known])
        return ""

    def bind(self, robot: str, sessions: Mapping[int, tuple[float, float]]) -> None:
        """Tell which sessions a robot has: from when to when, s.

        All pieces of a source belong to the session during which one of them was seen.
        """
        self._sessions[robot] = sessions
        for (owner, source), pieces in self._sources.items():
            if owner == robot and (owner, source) not in self._session_of:
                self._bind(robot, source, pieces.values())

    def _bind(self, robot: str, source: int, pieces: Collection[_Piece]) -> None:
        """Find the session of a source by the stamps of some of its pieces."""
        sessions = self._sessions.get(robot, {})
        during = [
            number for number, (start, end) in sessions.items() if any(start <= piece.stamp <= end for piece in pieces)
        ]
        if during:
            session = self._session_of[robot, source] = max(during, key=lambda number: sessions[number][0])
            for piece in self._sources[robot, source].values():
                self._mark(robot, session, piece)

    def place(self, robot: str, session: int, correction: Correction | None) -> None:
        """Tell where a session lies in the world; None: that is not known, or not any more."""
        key = robot, session
        place = self._places.get(key)
        if correction is None:
            if place is not None:
                self._take_back(key, place)
            return
        if place is None:
            place = self._places[key] = _Place(self._new_source(), correction)
            for (owner, source), pieces in self._sources.items():
                if owner == robot and self._session_of.get((owner, source)) == session:
                    for piece in pieces.values():
                        self._mark(robot, session, piece)
            return
        lifted = np.abs(correction.lift - place.correction.lift).max() * _ARM_M > _MOVED_M
        place.correction = correction
        for piece in place.pieces if lifted else _moved(place):
            self._send_anew(piece)
            self._mark(robot, session, piece)

    def _take_back(self, key: tuple[str, int], place: _Place) -> None:
        self._gone.append(place.source)
        for piece in place.pieces:
            self._to_send.pop(id(piece), None)
            self._placed -= piece.points
            piece.number, piece.sent, piece.out_revision, piece.T = -1, 0, 0, None
        del self._places[key]

    @staticmethod
    def _send_anew(piece: _Piece) -> None:
        if piece.T is not None:
            piece.out_revision += 1
        piece.sent, piece.T = 0, None

    def _mark(self, robot: str, session: int, piece: _Piece) -> None:
        """Have a piece sent, if it lies in the world."""
        place = self._places.get((robot, session))
        if place is None:
            return
        if piece.number < 0:
            piece.number = len(place.pieces)
            place.pieces.append(piece)
            self._placed += piece.points
        self._to_send[id(piece)] = (robot, session), piece

    def send_all(self) -> None:
        """Have all pieces sent anew, as for somebody who came late."""
        for key, place in self._places.items():
            for piece in place.pieces:
                self._send_anew(piece)
                self._mark(*key, piece)

    @property
    def waiting(self) -> int:
        """How many pieces wait to be sent."""
        return len(self._to_send)

    @property
    def unplaced(self) -> int:
        """How many points have no place in the world yet."""
        return self.points - self._placed

    def take_gone(self) -> list[int]:
        """The sources whose points are to be taken back, since the last call."""
        gone, self._gone = self._gone, []
        return gone

    def sent(self) -> Iterator[tuple[float, Cloud, Piece]]:
        """Stamp (s), points in the world and piece of all that waits to be sent."""
        while self._to_send:
            key, piece = self._to_send.pop(next(iter(self._to_send)))
            place = self._places[key]
            if piece.T is None:
                piece.T = place.correction.at(np.array([piece.stamp]))[0]
            new = np.concatenate([np.empty((0, piece.parts[0].shape[1])), *piece.parts[piece.sent :]])
            piece.parts, piece.sent = [np.concatenate(piece.parts)], 1
            shown = _in_world(piece.T, new, place.correction.lift)
            yield piece.stamp, shown, Piece(place.source, piece.number, piece.out_revision)

    def cloud(self) -> Cloud:
        """All points in the world, session by session."""
        return concatenate([piece.cloud() for piece in self.stored_but_of(())])

    def stored_but_of(self, sources: Collection[tuple[str, int]]) -> tuple[StoredPiece, ...]:
        """The pieces in the world as they are now, session by session, without those of some sessions."""
        return tuple(
            StoredPiece(tuple(piece.parts), T, place.correction.lift)
            for key, place in sorted(self._places.items())
            if key not in sources and place.pieces
            for piece, T in zip(
                place.pieces, place.correction.at(np.array([piece.stamp for piece in place.pieces])), strict=True
            )
        )

    def sweeps(self, robot: str) -> dict[int, Sweeps]:
        """What a robot without keyframes has told, by source, as far as each piece was seen from one place."""
        return {
            source: Sweeps(
                min(piece.stamp for piece in pieces.values()),
                (len(pieces), sum(piece.revision for piece in pieces.values())),
                tuple(pieces.values()),
            )
            for (owner, source), pieces in sorted(self._sources.items())
            if owner == robot and pieces and all(piece.is_sweep for piece in pieces.values())
        }

    def bind_sweeps(self, robot: str, source: int) -> None:
        """Tell that a source is a session by itself, as that of a robot without keyframes."""
        if (robot, source) not in self._session_of:
            self._session_of[robot, source] = source
            for piece in self._sources[robot, source].values():
                self._mark(robot, source, piece)


def _moved(place: _Place) -> list[_Piece]:
    """The pieces that are out where they do not belong any more."""
    out = [piece for piece in place.pieces if piece.T is not None]
    if not out:
        return []
    now = place.correction.at(np.array([piece.stamp for piece in out]))
    centers = np.array([piece.center for piece in out])
    before = np.array([piece.T for piece in out])
    off = _applied(now, centers) - _applied(before, centers)
    far = np.hypot(off[:, 0], off[:, 1]) + _ARM_M * np.abs(se2.relative(before, now)[:, 2])
    return [out[index] for index in np.flatnonzero(far > _MOVED_M)]


def _applied(T: Float, points: Float) -> Float:
    """Each point (N, 2) by the transform (N, 3) of its own."""
    cos, sin = np.cos(T[:, 2]), np.sin(T[:, 2])
    x, y = points.T
    return np.column_stack([T[:, 0] + cos * x - sin * y, T[:, 1] + sin * x + cos * y])


def _in_world(T: Float, columns: NDArray[np.floating], lift: Float) -> Cloud:
    """Points (N, 3), or points and sensor (N, 6), moved by a transform (4, 4) and then by a planar one (3,)."""
    moved = np.array(columns, float)
    level = np.array_equal(lift, np.eye(4))
    for begin in range(0, moved.shape[1], 3):
        if not level:
            moved[:, begin : begin + 3] = se3.transform_points(lift, moved[:, begin : begin + 3])
        moved[:, begin : begin + 2] = se2.transform_points(T, moved[:, begin : begin + 2])
    return Cloud(moved[:, :3], moved[:, 3:] if moved.shape[1] == 6 else None)
