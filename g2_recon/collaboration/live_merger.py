# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The map merger while robots drive: what each has told, and where it lies in the world as far as that is known."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from g2_recon.collaboration.growing_session import GrowingSession
from g2_recon.collaboration.joint_cloud import Correction, JointCloud, StoredPiece
from g2_recon.collaboration.map_merger import JointMap, merge
from g2_recon.geometry import se3
from g2_recon.geometry.cloud import Cloud, Piece, concatenate
from g2_recon.geometry.session import Session, SessionPart

Float = NDArray[np.float64]

State = Literal["waiting", "aligned", "ambiguous", "rejected"]

# All is looked for anew when there is so many times as much as the last time.
_THOROUGH_GROWTH = 1.5
# Clouds follow at once where a robot moves a keyframe by so much, m or rad; with the next map, what is less.
_MOVED = 1e-3


@dataclass(frozen=True, slots=True)
class Place:
    """Where the map of a robot lies in the world, or why that is not known.

    T_world_map: (3,) where the robot is now, and its covariance (3, 3); None where it is not known. lift: (4, 4) what
    comes before it, see Correction. session: number of its present session, None before the first. way, agreement: see
    Alignment. sweeps: of a robot that has no keyframes.
    """

    state: State
    reason: str
    session: int | None = None
    keyframes: int = 0
    T_world_map: Float | None = None
    covariance: Float | None = None
    way: float = 0.0
    agreement: float = 0.0
    lift: Float = field(default_factory=lambda: np.eye(4))
    sweeps: int = 0


@dataclass(frozen=True, slots=True)
class SweepPlace:
    """Where the map of a robot that makes sweeps lies in the world, or why that is not known.

    T_world_map: (4, 4), covariance: (6, 6), the order of ROS; agreement: share of what both should see that is on the
    same surface.
    """

    state: State
    reason: str
    T_world_map: Float
    covariance: Float
    agreement: float = 0.0


@dataclass(frozen=True, slots=True)
class SweepWork:
    """Robots that make sweeps and have no keyframes, to be placed in a world: their sweeps, who began first is first.

    world: what other robots saw, None where nobody else is there. before: (4, 4) where each was found before, or is
    given.
    """

    world: Cloud | None
    robots: dict[str, tuple[Cloud, ...]]
    before: dict[str, Float]
    given: frozenset[str]


@dataclass(frozen=True, slots=True)
class StoredSweepWork:
    """The same while its points are those that are stored: another thread copies them, and nothing waits for that."""

    world: tuple[StoredPiece, ...]
    robots: dict[str, tuple[StoredPiece, ...]]
    before: dict[str, Float]
    given: frozenset[str]

    def copied(self) -> SweepWork:
        """With clouds of its own."""
        world = concatenate([piece.cloud() for piece in self.world])
        robots = {key: tuple(piece.cloud() for piece in pieces) for key, pieces in self.robots.items()}
        return SweepWork(world if len(world) else None, robots, self.before, self.given)


@dataclass(frozen=True, slots=True)
class Work:
    """What there is to merge, for another thread: sessions as they are now, and what was found before."""

    sessions: dict[str, GrowingSession]
    starts: dict[str, Float]
    before: JointMap | None

    def merged(self) -> JointMap:
        """The map of all. Raises InputError where one is too large to search."""
        found = {name: growing.session() for name, growing in self.sessions.items()}
        sessions = {name: session for name, session in found.items() if isinstance(session, Session)}
        return merge(sessions, starts=self.starts, before=self.before)

    @property
    def keyframes(self) -> int:
        """How many keyframes there are in all."""
        return sum(map(len, self.sessions.values()))


@dataclass(slots=True)
class _Robot:
    sessions: dict[int, GrowingSession] = field(default_factory=dict)

    @property
    def present(self) -> GrowingSession | None:
        """The session that began last."""
        return max(self.sessions.values(), key=lambda session: session.start, default=None)


class LiveMerger:
    """Sessions and clouds of robots as they come, and one map of all, whenever it has been made.

    Each session of a robot is merged by itself: one that begins a new map keeps what it had in the old one.
    """

    def __init__(self, starts: Mapping[str, Float], new_source: Callable[[], int]) -> None:
        """starts: (3,) world ← <robot>/map of robots where it is known about. new_source: see JointCloud."""
        self._starts = {robot: np.asarray(start, float) for robot, start in starts.items()}
        self.cloud = JointCloud(new_source)
        self._robots: dict[str, _Robot] = {}
        self._map: JointMap | None = None
        self._merged_versions: dict[str, tuple[int, int]] = {}
        self._thorough = False
        self._keyframes_at_thorough = 0
        self._sweep_places: dict[str, SweepPlace] = {}
        self._swept: tuple[object, ...] = ()

    @property
    def robots(self) -> list[str]:
        """All that have told something, by name."""
        return sorted(self._robots)

    @property
    def map(self) -> JointMap | None:
        """The latest map of all, None before the first."""
        return self._map

    def session(self, robot: str, number: int) -> GrowingSession | None:
        """A session of a robot, None where it has none of this number."""
        return self._robots[robot].sessions.get(number) if robot in self._robots else None

    def forget(self) -> None:
        """Take back all points that are in the world."""
        for name, robot in self._robots.items():
            for number in robot.sessions:
                self.cloud.place(name, number, None)
        for key in self._sweep_places:
            self.cloud.place(*_of_key(key), None)

    def take_part(self, robot: str, part: SessionPart) -> GrowingSession:
        """Take in what a robot tells of its session; that session. Raises InputError where it is unusable."""
        sessions = self._robots.setdefault(robot, _Robot()).sessions
        # One without keyframes is there all the same: it knows what it lacks.
        growing = sessions[part.number] if part.number in sessions else GrowingSession(part.number)
        before = growing.poses()
        growing.take(part)
        sessions[part.number] = growing
        times = {number: (one.start, one.last_stamp) for number, one in sessions.items() if len(one)}
        self.cloud.bind(robot, times)
        if (np.abs(growing.poses()[: len(before)] - before) > _MOVED).any():
            self._follow(robot, growing)
        return growing

    def take_cloud(self, robot: str, stamp: float, cloud: Cloud, piece: Piece) -> str:
        """Take in points in the map of a robot, seen at stamp s; why they are not used, empty if they are."""
        self._robots.setdefault(robot, _Robot())
        return self.cloud.add(robot, stamp, cloud, piece)

    def work(self, *, settled: bool) -> Work | None:
        """What is to be merged; None where nothing has come since the last time.

        settled: nothing comes at present, so that all can be looked for anew. The map is then the same in whatever
        order and at whatever times all has come.
        """
        growing = dict(self._sessions())
        versions = {key: one.version for key, one in growing.items()}
        if not growing or (versions == self._merged_versions and (self._thorough or not settled)):
            return None
        starts = {}
        for robot, start in self._starts.items():
            if robot in self._robots and self._robots[robot].sessions:
                first = min(self._robots[robot].sessions.values(), key=lambda session: session.start)
                if len(first):
                    starts[_key(robot, first.number)] = start
        work = Work({key: one.snapshot() for key, one in growing.items()}, starts, self._map)
        thorough = settled or work.keyframes > _THOROUGH_GROWTH * self._keyframes_at_thorough
        return Work(work.sessions, starts, None) if thorough else work

    def _sessions(self) -> Iterator[tuple[str, GrowingSession]]:
        for name, robot in sorted(self._robots.items()):
            for number, growing in sorted(robot.sessions.items()):
                if len(growing):
                    yield _key(name, number), growing

    def take_merged(self, work: Work, merged: JointMap) -> None:
        """Take what became of `work`: clouds follow."""
        self._map = merged
        self._merged_versions = {key: one.version for key, one in work.sessions.items()}
        self._thorough = work.before is None
        if self._thorough:
            self._keyframes_at_thorough = work.keyframes
        for name, robot in self._robots.items():
            for growing in robot.sessions.values():
                self._follow(name, growing)

    def sweep_work(self) -> StoredSweepWork | None:
        """Robots that make sweeps, to be placed; None where nothing has come since the last time.

        They do not change the map of the others, so that is made first.
        """
        sweeps = {
            _key(name, source): one
            for name, robot in sorted(self._robots.items())
            if not robot.sessions
            for source, one in self.cloud.sweeps(name).items()
        }
        version = (self._map, *((key, one.version) for key, one in sweeps.items()))
        if not sweeps or _same_version(version, self._swept):
            return None
        self._swept = version
        order = sorted(sweeps, key=lambda key: (_of_key(key)[0] not in self._starts, sweeps[key].begin, key))
        before = {key: place.T_world_map for key, place in self._sweep_places.items() if place.state == "aligned"}
        starts = {key: self._starts[_of_key(key)[0]] for key in order if _of_key(key)[0] in self._starts}
        return StoredSweepWork(
            self.cloud.stored_but_of({_of_key(key) for key in sweeps}),
            {key: sweeps[key].stored() for key in order},
            {key: se3.from_se2(start) for key, start in starts.items()} | before,
            frozenset(starts),
        )

    def take_placed(self, placed: Mapping[str, SweepPlace]) -> None:
        """Take what became of a `sweep_work`: clouds follow."""
        for key, place in placed.items():
            robot, source = _of_key(key)
            if self._robots[robot].sessions:
                continue
            self._sweep_places[key] = place
            aligned = place.state == "aligned"
            if aligned:
                self.cloud.bind_sweeps(robot, source)
            self.cloud.place(robot, source, Correction.rigid(place.T_world_map) if aligned else None)

    def _place_of_sweeps(self, robot: str) -> Place:
        sweeps = self.cloud.sweeps(robot)
        if not sweeps:
            return Place("waiting", "no keyframe of it has come")
        source = max(sweeps, key=lambda number: sweeps[number].begin)
        count = sweeps[source].version[0]
        place = self._sweep_places.get(_key(robot, source))
        if place is None:
            return Place("waiting", "its place is being looked for", source, sweeps=count)
        if place.state != "aligned":
            return Place(place.state, place.reason, source, agreement=place.agreement, sweeps=count)
        correction = Correction.rigid(place.T_world_map)
        planar = [0, 1, 5]
        return Place(
            "aligned",
            place.reason,
            source,
            T_world_map=correction.T_world_map[-1],
            covariance=place.covariance[np.ix_(planar, planar)],
            agreement=place.agreement,
            lift=correction.lift,
            sweeps=count,
        )

    def _follow(self, robot: str, growing: GrowingSession) -> None:
        self.cloud.place(robot, growing.number, self._correction(robot, growing))

    def _correction(self, robot: str, growing: GrowingSession) -> Correction | None:
        key = _key(robot, growing.number)
        if self._map is None or key not in self._map.rows:
            return None
        in_world = self._map.poses(key)
        # Where the robot has moved its keyframes since, its points come to lie otherwise, too.
        return Correction.between(growing.stamps()[: len(in_world)], growing.poses()[: len(in_world)], in_world)

    def place(self, robot: str) -> Place:
        """Where the map of a robot lies now, or why that is not known."""
        present = self._robots[robot].present if robot in self._robots else None
        if present is None or not len(present):
            return self._place_of_sweeps(robot)
        key = _key(robot, present.number)
        if self._map is None or key not in self._map.alignments:
            return Place("waiting", "its place is being looked for", present.number, len(present))
        found = self._map.alignments[key]
        correction = self._correction(robot, present)
        return Place(
            found.state,
            found.reason or f"{found.way:.0f} m of way in common agree by {found.agreement:.2f}",
            present.number,
            len(present),
            None if correction is None else correction.T_world_map[-1],
            None if correction is None else found.covariance,
            found.way,
            found.agreement,
        )

    def sessions_of(self, robot: str) -> int:
        """How many sessions a robot has had."""
        return len(self._robots[robot].sessions) if robot in self._robots else 0


def _key(robot: str, number: int) -> str:
    return f"{robot} {number:08x}"


def _of_key(key: str) -> tuple[str, int]:
    robot, number = key.rsplit(" ", 1)
    return robot, int(number, 16)


def _same_version(one: tuple[object, ...], other: tuple[object, ...]) -> bool:
    """Whether the map is the same object and nothing else differs."""
    return bool(other) and one[0] is other[0] and one[1:] == other[1:]
