# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A building as a solid block from which rooms are carved and into which furniture is put, and its exact surfaces."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CEILING = 2.8
TOILET_CEILING = 2.3
DOOR_HEIGHT = 2.0


@dataclass(frozen=True, slots=True)
class Box:
    """An axis-aligned box in the building frame, from the corner `low` to the corner `high`, both x, y, z in metres."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Building:
    """`block` without what is `carved` (rooms, doors, windows), with what is `placed` in the rooms (furniture)."""

    block: Box
    carved: tuple[Box, ...]
    placed: tuple[Box, ...]


@dataclass(frozen=True, slots=True)
class Rectangles:
    """Axis-aligned rectangles in the building frame.

    axis: (R,) the axis 0, 1 or 2 that each is perpendicular to, ascending. offset: (R,) where on that axis, metres.
    low, high: (R, 2) the corners on the two other axes, in their order. side: (R,) +1 or -1, the direction along
    `axis` in which the free space lies.
    """

    axis: NDArray[np.int64]
    offset: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    side: NDArray[np.int64]


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Box:
    """A box from its extent along each axis."""
    return Box((x[0], y[0], z[0]), (x[1], y[1], z[1]))


def room(x: tuple[float, float], y: tuple[float, float], ceiling: float = CEILING) -> Box:
    """The free space of a room; the walls are what is left between two rooms."""
    return box(x, y, (0.0, ceiling))


def door(x: tuple[float, float], y: tuple[float, float]) -> Box:
    """An opening from the floor to the height of a door."""
    return box(x, y, (0.0, DOOR_HEIGHT))


def window(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float] = (0.9, 2.1)) -> Box:
    """An opening in an outer wall: a hole if it goes through, a recess (drawn blinds) if it does not."""
    return box(x, y, z)


def cabinet(x: tuple[float, float], y: tuple[float, float], height: float = 1.8) -> Box:
    """A closed box on the floor."""
    return box(x, y, (0.0, height))


def desk(x: tuple[float, float], y: tuple[float, float]) -> list[Box]:
    """A desk top on two side panels, which stand at the ends of its longer side."""
    along_x = x[1] - x[0] > y[1] - y[0]
    panel, height = 0.03, 0.72
    if along_x:
        sides = [box((x[0], x[0] + panel), y, (0, height)), box((x[1] - panel, x[1]), y, (0, height))]
    else:
        sides = [box(x, (y[0], y[0] + panel), (0, height)), box(x, (y[1] - panel, y[1]), (0, height))]
    return [box(x, y, (height, height + 0.04)), *sides]


def table(x: tuple[float, float], y: tuple[float, float]) -> list[Box]:
    """A table top on four legs."""
    leg, height = 0.06, 0.70
    legs = [
        box((left, left + leg), (front, front + leg), (0, height))
        for left in (x[0], x[1] - leg)
        for front in (y[0], y[1] - leg)
    ]
    return [box(x, y, (height, height + 0.04)), *legs]


def first_floor() -> Building:
    """One floor of 20 m x 14 m: an L-shaped corridor, six rooms, two toilets with a lower ceiling.

    Inner walls are 12 cm thick, outer walls 30 cm. x points east, y north, z up from the floor.
    """
    rooms = [
        room((4.40, 6.40), (0.00, 14.00)),  # the corridor's long arm
        room((6.40, 20.00), (6.00, 7.80)),  # the corridor's short arm
        room((0.00, 4.28), (0.00, 5.60)),  # study
        room((0.00, 4.28), (5.72, 14.00)),  # laboratory
        room((6.52, 12.60), (7.92, 14.00)),  # hall
        room((12.72, 20.00), (7.92, 14.00)),  # seminar room
        room((10.92, 15.80), (0.00, 5.88)),  # workshop ...
        room((15.80, 20.00), (0.00, 2.40)),  # ... and its alcove
        room((6.52, 10.80), (0.00, 5.88)),  # office
        room((15.92, 17.90), (2.52, 5.88), TOILET_CEILING),
        room((18.02, 20.00), (2.52, 5.88), TOILET_CEILING),
    ]
    doors = [
        door((4.28, 4.40), (2.60, 3.50)),  # corridor - study
        door((4.28, 4.40), (9.30, 10.20)),  # corridor - laboratory
        door((8.20, 9.10), (7.80, 7.92)),  # corridor - hall
        door((12.60, 12.72), (12.20, 13.10)),  # hall - seminar room
        door((15.60, 16.50), (7.80, 7.92)),  # corridor - seminar room
        door((16.45, 17.35), (5.88, 6.00)),  # corridor - toilet
        door((18.55, 19.45), (5.88, 6.00)),  # corridor - toilet
        door((13.20, 14.10), (5.88, 6.00)),  # corridor - workshop
        door((10.80, 10.92), (1.60, 2.50)),  # workshop - office
        door((7.55, 8.45), (5.88, 6.00)),  # corridor - office
    ]
    windows = [
        window((4.90, 5.90), (-0.30, 0.00)),  # end of the long arm
        window((20.00, 20.30), (6.40, 7.40)),  # end of the short arm
        window((-0.30, 0.00), (1.20, 2.60)),
        window((-0.30, 0.00), (7.00, 8.40)),
        window((-0.20, 0.00), (11.00, 12.60)),
        window((7.40, 8.80), (14.00, 14.30)),
        window((10.40, 11.80), (14.00, 14.20)),
        window((14.00, 15.40), (14.00, 14.30)),
        window((17.20, 18.60), (14.00, 14.20)),
        window((20.00, 20.30), (10.00, 11.60)),
        window((12.60, 14.20), (-0.30, 0.00)),
        window((8.00, 9.40), (-0.20, 0.00)),
        window((20.00, 20.15), (3.60, 4.40), (1.5, 2.0)),
    ]
    furniture = [
        box((9.90, 10.30), (10.60, 11.00), (0.0, CEILING)),  # the column in the hall
        *desk((0.00, 0.80), (3.60, 5.20)),
        cabinet((2.60, 4.28), (0.00, 0.45)),
        *desk((0.00, 0.80), (6.60, 8.20)),
        *desk((0.00, 0.80), (11.40, 13.00)),
        cabinet((3.83, 4.28), (5.90, 8.30), 2.0),
        cabinet((2.20, 3.40), (13.50, 14.00), 1.2),
        cabinet((4.40, 4.75), (12.60, 13.90), 1.9),  # lockers in the corridor
        cabinet((6.52, 6.97), (11.60, 13.60)),
        cabinet((11.20, 12.40), (7.92, 8.60), 0.45),  # bench
        *table((16.60, 18.40), (10.20, 11.40)),
        cabinet((12.72, 13.12), (8.20, 10.20), 2.0),
        cabinet((18.60, 20.00), (13.40, 14.00), 0.9),
        *desk((14.60, 15.80), (3.20, 4.80)),
        cabinet((10.92, 11.37), (3.60, 5.60), 1.6),
        cabinet((18.60, 20.00), (0.00, 0.60), 1.1),
        *desk((6.52, 7.32), (0.60, 2.20)),
        cabinet((10.35, 10.80), (3.40, 5.20)),
        cabinet((15.92, 16.37), (2.52, 3.02), 0.85),  # wash basins
        cabinet((19.55, 20.00), (2.52, 3.02), 0.85),
    ]
    block = box((-0.30, 20.30), (-0.30, 14.30), (-0.20, 3.10))
    return Building(block, (*rooms, *doors, *windows), tuple(furniture))


def surfaces(building: Building) -> Rectangles:
    """The surfaces between what is solid and what is free, each piece once; the outside of the block is left out.

    The planes of all boxes divide the block into cells, each solid or free as a whole, so that hidden faces where
    boxes touch do not appear and the free side of each face is known.
    """
    boxes = (building.block, *building.carved, *building.placed)
    planes = [np.unique([round(corner[axis], 6) for b in boxes for corner in (b.low, b.high)]) for axis in range(3)]
    solid = np.ones([len(along) - 1 for along in planes], bool)
    for filled, parts in ((False, building.carved), (True, building.placed)):
        for part in parts:
            solid[_cells(planes, part)] = filled
    rows = [
        (axis, offset, *_extent(planes, axis, cells), side)
        for axis in range(3)
        for offset, side, faces in _faces(planes[axis], np.moveaxis(solid, axis, 0))
        for cells in _merge(faces)
    ]
    columns = list(zip(*rows, strict=True))
    return Rectangles(
        axis=np.array(columns[0], np.int64),
        offset=np.array(columns[1]),
        low=np.array(columns[2]),
        high=np.array(columns[3]),
        side=np.array(columns[4], np.int64),
    )


def _cells(planes: Sequence[NDArray[np.float64]], part: Box) -> tuple[slice, ...]:
    """The cells that a box fills."""
    first, last = (
        [int(np.searchsorted(along, round(value, 6))) for along, value in zip(planes, corner, strict=True)]
        for corner in (part.low, part.high)
    )
    return tuple(slice(*ends) for ends in zip(first, last, strict=True))


def _faces(planes: NDArray[np.float64], solid: NDArray[np.bool_]) -> Iterator[tuple[float, int, NDArray[np.bool_]]]:
    """Offset, free side and mask of the faces in each inner plane; the first axis of `solid` runs across the planes."""
    for offset, below, above in zip(planes[1:-1], solid[:-1], solid[1:], strict=True):
        yield float(offset), +1, below & ~above
        yield float(offset), -1, ~below & above


def _merge(faces: NDArray[np.bool_]) -> Iterator[tuple[slice, slice]]:
    """A mask as few rectangles that do not overlap: each grows along the rows, then across them."""
    left = faces.copy()
    while left.any():
        row, column = np.unravel_index(int(np.argmax(left)), left.shape)
        run = left[row, column:]
        width = int(np.argmin(run)) if not run.all() else len(run)
        columns = slice(int(column), int(column) + width)
        full = np.asarray(left[row:, columns].all(axis=1))
        height = int(np.argmin(full)) if not full.all() else len(full)
        rows = slice(int(row), int(row) + height)
        left[rows, columns] = False
        yield rows, columns


def _extent(
    planes: Sequence[NDArray[np.float64]], axis: int, cells: tuple[slice, slice]
) -> tuple[list[float], list[float]]:
    """The two corners in metres of a rectangle of cells on the axes other than `axis`."""
    others = [along for index, along in enumerate(planes) if index != axis]
    low = [float(along[span.start]) for along, span in zip(others, cells, strict=True)]
    high = [float(along[span.stop]) for along, span in zip(others, cells, strict=True)]
    return low, high


def triangles(rectangles: Rectangles) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (4 R, 3) in metres and faces (2 R, 3) of rectangles, counterclockwise seen from the free side."""
    count = len(rectangles.axis)
    vertices = np.empty((count, 4, 3))
    for axis in range(3):
        which = rectangles.axis == axis
        first, second = (other for other in range(3) if other != axis)
        low, high = rectangles.low[which], rectangles.high[which]
        corners = np.empty((int(which.sum()), 4, 3))
        corners[:, :, axis] = rectangles.offset[which, None]
        corners[:, :, first] = np.column_stack([low[:, 0], high[:, 0], high[:, 0], low[:, 0]])
        corners[:, :, second] = np.column_stack([low[:, 1], low[:, 1], high[:, 1], high[:, 1]])
        # first x second points along +axis for x and z, and along -axis for y.
        backward = rectangles.side[which] * (-1 if axis == 1 else 1) < 0
        corners[backward] = corners[backward, ::-1]
        vertices[which] = corners
    faces = 4 * np.arange(count)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)
