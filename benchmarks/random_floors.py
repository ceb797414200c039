# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Floors at random, so that nothing can be tuned to them: six rooms in a block, each another size and height.

Walls inside are 10 cm thick and seen from both faces, rooms 2.4 m to 4 m high, with doors, windows, niches, beams,
round and square columns, and cabinets in their corners. Every number of a floor is one of a real building's.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from clouds import FREE, SOLID, Convex, Parts, Point, Scanned, Span, Survey, box, circle, prism, scan, surface

_COLUMNS, _ROWS = 3, 2
_WALL = 0.1  # m
_DOOR = (0.9, 2.0)  # m, width and height
_ASIDE = 0.5  # m from a door, where the robot turns towards it
_LOOP = 0.1  # of a room's sides, half the way around its middle

Cell = tuple[int, int]


@dataclass(frozen=True, slots=True)
class _Room:
    """Extent in the plan and height, m."""

    x: Span
    y: Span
    height: float

    def at(self, u: float, v: float) -> Point:
        """A place in the plan at shares of the two sides."""
        return self.x[0] + u * (self.x[1] - self.x[0]), self.y[0] + v * (self.y[1] - self.y[0])


def random_floor(seed: int) -> tuple[Parts, list[Point]]:
    """The parts of a floor and the way through all its rooms and back through some; a seed is always the same floor."""
    rng = np.random.default_rng(seed)
    rooms = _rooms(rng)
    doors = _doors(rooms, rng)
    parts: Parts = [(box(*_around(rooms), (-0.2, 4.3)), SOLID)]
    for room in rooms.values():
        parts.append((box(room.x, room.y, (0.0, room.height)), FREE))
    for cell, room in rooms.items():
        parts += _openings(cell, room, rng) + _things(room, rng)
    parts += [(_doorway(rooms[one], rooms[other], center), FREE) for (one, other), center in doors.items()]
    return parts, _way((0, 0), rooms, doors)


def make(seed: int) -> Scanned:
    """The cloud of a floor, with noise of 1 cm."""
    parts, way = random_floor(seed)
    return scan(*surface(parts), way, Survey(seed=seed))


def _rooms(rng: np.random.Generator) -> dict[Cell, _Room]:
    x, y = ([0.0, *np.cumsum(rng.uniform(3.0, 5.5, count) + _WALL)] for count in (_COLUMNS, _ROWS))
    return {
        (i, j): _Room((x[i], x[i + 1] - _WALL), (y[j], y[j + 1] - _WALL), float(rng.uniform(2.4, 4.0)))
        for i, j in itertools.product(range(_COLUMNS), range(_ROWS))
    }


def _around(rooms: dict[Cell, _Room]) -> tuple[Span, Span]:
    last = rooms[_COLUMNS - 1, _ROWS - 1]
    return (-0.3, last.x[1] + 0.3), (-0.3, last.y[1] + 0.3)


def _doors(rooms: dict[Cell, _Room], rng: np.random.Generator) -> dict[tuple[Cell, Cell], Point]:
    """The middle of each door, by the two rooms; one way leads from any room to any other."""
    reached, doors = {(0, 0)}, {}
    while len(reached) < len(rooms):
        beside = [(a, b) for a in sorted(reached) for b in rooms if b not in reached and _distance(a, b) == 1]
        one, other = beside[rng.integers(len(beside))]
        low = rooms[min(one, other)]
        x, y = low.at(*rng.uniform(0.4, 0.6, 2))
        between = (low.x[1] + _WALL / 2, y) if one[0] != other[0] else (x, low.y[1] + _WALL / 2)
        doors[one, other] = between
        reached.add(other)
    return doors


def _distance(one: Cell, other: Cell) -> int:
    return abs(one[0] - other[0]) + abs(one[1] - other[1])


def _doorway(one: _Room, other: _Room, center: Point) -> Convex:
    """What is free in the wall between two rooms."""
    half = (_WALL / 2, _DOOR[0] / 2) if one.y == other.y else (_DOOR[0] / 2, _WALL / 2)
    x, y = ((middle - h, middle + h) for middle, h in zip(center, half, strict=True))
    return box(x, y, (0.0, _DOOR[1]))


def _openings(cell: Cell, room: _Room, rng: np.random.Generator) -> Parts:
    """A window or a niche in an outer wall of a room."""
    north = cell[1] == _ROWS - 1
    depth = 0.3 if rng.random() < 0.5 else rng.uniform(0.12, 0.25)
    begin = rng.uniform(0.1, 0.5)
    x = room.at(begin, 0.0)[0], room.at(begin + rng.uniform(0.2, 0.4), 0.0)[0]
    y = (room.y[1], room.y[1] + depth) if north else (room.y[0] - depth, room.y[0])
    return [(box(x, y, (rng.choice([0.0, 0.9]), rng.uniform(1.8, 2.3))), FREE)]


def _things(room: _Room, rng: np.random.Generator) -> Parts:
    """A cabinet, a column and a beam, each in two of three rooms; the middle of the room stays free."""
    corners = list(itertools.product((0, 1), (0, 1)))
    first, second = (corners[i] for i in rng.permutation(4)[:2])
    parts: Parts = []
    if rng.random() < 2 / 3:
        sizes = rng.uniform(0.35, 0.6, 2)
        x, y = (
            (end[side] - size, end[side]) if side else (end[side], end[side] + size)
            for end, side, size in zip((room.x, room.y), first, sizes, strict=True)
        )
        parts.append((box(x, y, (0.0, rng.uniform(0.7, 2.1))), SOLID))
    if rng.random() < 2 / 3:
        u, v = (0.82 if side else 0.18 for side in second)
        outline = circle(room.at(u, v), rng.uniform(0.12, 0.2), int(rng.choice([4, 48])))
        parts.append((prism(outline, (0.0, room.height)), SOLID))
    if rng.random() < 2 / 3:
        begin = room.at(rng.uniform(0.3, 0.6), 0.0)[0]
        parts.append((box((begin, begin + 0.25), room.y, (room.height - rng.uniform(0.2, 0.4), room.height)), SOLID))
    return parts


def _way(cell: Cell, rooms: dict[Cell, _Room], doors: dict[tuple[Cell, Cell], Point]) -> list[Point]:
    """Once around the middle of a room, and through each of its doors into the next rooms and back."""
    room = rooms[cell]
    way = [room.at(0.5 + u * _LOOP, 0.5 + v * _LOOP) for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    for (one, other), door in doors.items():
        if one == cell:
            before, behind = (_before(door, rooms[side]) for side in (one, other))
            way += [before, behind, *_way(other, rooms, doors), behind, before]
    return way


def _before(door: Point, room: _Room) -> Point:
    """The place in a room before a door."""
    (x, y), (middle_x, middle_y) = door, room.at(0.5, 0.5)
    if room.x[0] < x < room.x[1]:
        return x, y + _ASIDE * (1 if middle_y > y else -1)
    return x + _ASIDE * (1 if middle_x > x else -1), y
