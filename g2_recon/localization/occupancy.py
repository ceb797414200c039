# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""An occupancy grid from scans with known poses: each cell counts the scans that hit it and those that saw through."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.occupancy_grid import FREE, MOST_CELLS, OCCUPIED, UNKNOWN, OccupancyGrid
from g2_recon.kernels import kernel

Float = NDArray[np.float64]
Int = NDArray[np.int64]

# Cells are kept in square tiles, of which only those near a beam exist, so that memory follows what was seen and
# nothing has to move when the map grows. 64 cells on a side.
_TILE_BITS = 6
_TILE = 1 << _TILE_BITS
# What is kept of a cell: how many scans hit it, how many passed it, and the number of the last one that did either.
_HITS, _PASSES, _LAST = 0, 1, 2
# Farther from the origin of the map, in cells, neither the numbers nor the place make sense.
_FARTHEST = 1 << 31


class GridBuilder:
    """An occupancy grid that grows with every scan, in time proportional to the cells that its beams cross.

    The counting model (Hähnel et al., 2003; GMapping and slam_toolbox): a cell is occupied where the share of the scans
    that end in it, of all that end in it or cross it, is large. As in Cartographer a scan counts once in a cell, and
    its hits come first: beams that graze a wall on their way do not erase what their neighbors hit.
    """

    def __init__(
        self,
        *,
        resolution: float = 0.05,
        max_range: float = 30.0,
        free_range: float = 5.0,
        occupied_share: float = 0.1,
        fewest_scans: int = 2,
    ) -> None:
        """Start an empty grid. Raises InputError where a setting is out of its range.

        resolution: m, edge of a cell. max_range: m, farther returns are not trusted. free_range: m, what lies this near
        is free where a beam has no return or none that is trusted. occupied_share: of the scans in a cell, above which
        it is occupied; fewest_scans: that must have said something about a cell, or it is unknown. Both are those of
        slam_toolbox.
        """
        if not (math.isfinite(resolution) and resolution > 0):
            raise InputError(f"a resolution of {resolution} m", where="occupancy grid", advice="give a length above 0")
        if not (max_range > 0 and math.isfinite(max_range) and 0 <= free_range <= max_range):
            raise InputError(
                f"ranges of {max_range} m and, without a return, {free_range} m",
                where="occupancy grid",
                advice="give finite lengths, the second not above the first",
            )
        if not (0 <= occupied_share < 1 and fewest_scans >= 1):
            raise InputError(
                f"an occupied share of {occupied_share} of {fewest_scans} scans",
                where="occupancy grid",
                advice="give a share from 0 to below 1 of one scan or more",
            )
        self._resolution = resolution
        self._limits = max_range, free_range
        self._occupied_share, self._fewest_scans = occupied_share, fewest_scans
        self._scans = 0
        self._counts: NDArray[np.int32] = np.zeros((0, _TILE, _TILE, 3), np.int32)
        self._used = 0
        # The number of each tile, by row and column from the corner on; -1 where there is none.
        self._tiles: NDArray[np.int32] = np.empty((0, 0), np.int32)
        self._corner: Int = np.zeros(2, np.int64)
        # The cells that beams came to, (row, column) of the least and of the greatest.
        self._low: Int = np.zeros(2, np.int64)
        self._high: Int = np.full(2, -1, np.int64)

    def add(
        self,
        pose: ArrayLike,
        bearings: ArrayLike,
        ranges: ArrayLike,
        *,
        range_min: float = 0.0,
        range_max: float = np.inf,
    ) -> None:
        """Add one scan taken at `pose` (3,): x, y, yaw of the laser in the map frame.

        bearings: (B,) radians counterclockwise from the x axis of the laser as seen from above, so those of a laser
        mounted upside down change their sign. ranges: (B,) metres, by REP-117: +inf is no return; NaN, -inf, and what
        is not above 0 or not in [range_min, range_max], say nothing. Raises InputError and changes nothing where the
        pose or a bearing is not finite, or the grid would become absurdly large.
        """
        laser = np.asarray(pose, float)
        if laser.shape != (3,) or not np.isfinite(laser).all():
            raise InputError("the pose of a scan is a finite x, y, yaw", where="occupancy grid", advice="drop the scan")
        angles, lengths = np.asarray(bearings, float), np.asarray(ranges, float)
        if angles.ndim != 1 or angles.shape != lengths.shape or not np.isfinite(angles).all():
            raise InputError(
                "a scan has a finite bearing for each range", where="occupancy grid", advice="drop the scan"
            )
        start, ends, hits = _beams(laser, angles, lengths, range_min, range_max, *self._limits, self._resolution)
        if not len(ends):
            return
        self._reserve(*_bounds(start, ends))
        self._scans += 1
        count_scan(self._counts, self._tiles, self._corner, self._scans, start, ends, hits)

    def add_all(
        self,
        poses: ArrayLike,
        bearings: Iterable[ArrayLike],
        ranges: Iterable[ArrayLike],
        *,
        range_min: float = 0.0,
        range_max: float = np.inf,
    ) -> None:
        """Add scans at poses (K, 3), with bearings and ranges an array (B,) for each; see `add`.

        Raises InputError at the first scan that cannot be used; those before it stay.
        """
        for pose, angles, lengths in zip(np.reshape(poses, (-1, 3)), bearings, ranges, strict=True):
            self.add(pose, angles, lengths, range_min=range_min, range_max=range_max)

    def grid(self) -> OccupancyGrid:
        """The grid as it is now: cells 0, 100 and -1, just large enough for all beams, parallel to the map frame."""
        height, width = self._high - self._low + 1
        cells = np.full((height, width), UNKNOWN, np.int8)
        _decide(cells, self._low, self._counts, self._tiles, self._corner, self._occupied_share, self._fewest_scans)
        return OccupancyGrid(self._resolution, np.array([*(self._resolution * self._low[::-1]), 0.0]), cells)

    def _reserve(self, least: Float, greatest: Float) -> None:
        """Have a tile wherever there are cells from the least to the greatest (row, column)."""
        if not (np.abs(least).max() < _FARTHEST and np.abs(greatest).max() < _FARTHEST):
            raise InputError("a scan is absurdly far away", where="occupancy grid", advice="drop the scan")
        low, high = least.astype(np.int64), greatest.astype(np.int64)
        if self._scans and _are_there(self._tiles, self._corner, self._low, self._high, low, high):
            return
        lowest: Int = low if self._scans == 0 else np.minimum(low, self._low)
        highest: Int = high if self._scans == 0 else np.maximum(high, self._high)
        height, width = (int(size) for size in highest - lowest + 1)
        if height * width > MOST_CELLS:
            raise InputError(
                f"the map would have {height} x {width} cells of {self._resolution} m, more than {MOST_CELLS}",
                where="occupancy grid",
                advice="drop the scan, or use a coarser resolution",
            )
        corner: Int = lowest >> _TILE_BITS
        rows, columns = (int(size) for size in (highest >> _TILE_BITS) - corner + 1)
        tiles = self._tiles
        if tiles.shape != (rows, columns):
            tiles = np.full((rows, columns), -1, np.int32)
            top, left = self._corner - corner if self._tiles.size else (0, 0)
            tiles[top : top + self._tiles.shape[0], left : left + self._tiles.shape[1]] = self._tiles
        (top, left), (bottom, right) = (low >> _TILE_BITS) - corner, (high >> _TILE_BITS) - corner + 1
        window = tiles[top:bottom, left:right]
        missing = window < 0
        used = self._used + int(np.count_nonzero(missing))
        if used > len(self._counts):
            self._counts = self._grown(used)
        window[missing] = np.arange(self._used, used)
        self._tiles, self._corner, self._used = tiles, corner, used
        self._low, self._high = lowest, highest

    def _grown(self, used: int) -> NDArray[np.int32]:
        """The counts with room for twice as many tiles as are used; what is not written to takes no memory yet."""
        try:
            grown = np.zeros((2 * used, *self._counts.shape[1:]), np.int32)
        except MemoryError:
            raise InputError(
                f"there is no memory for a map of {used * _TILE**2} cells",
                where="occupancy grid",
                advice="use a coarser resolution",
            ) from None
        grown[: self._used] = self._counts[: self._used]
        return grown


@kernel
def _beams(laser, bearings, ranges, range_min, range_max, max_range, free_range, resolution):  # type: ignore[no-untyped-def]
    """Of the beams that say something: start (2,) and ends (B, 2), row and column, and whether something is there."""
    start = np.array([laser[1] / resolution, laser[0] / resolution])
    ends = np.empty((len(ranges), 2))
    hits = np.empty(len(ranges), np.bool_)
    free = max(min(free_range, range_max), 0.0)
    count = 0
    for i in range(len(ranges)):
        measured = ranges[i] > 0 and range_min <= ranges[i] <= range_max and ranges[i] < np.inf
        if not measured and ranges[i] != np.inf:
            continue
        hits[count] = measured and ranges[i] <= max_range
        reach = (ranges[i] if hits[count] else free) / resolution
        ends[count, 0] = start[0] + reach * math.sin(laser[2] + bearings[i])
        ends[count, 1] = start[1] + reach * math.cos(laser[2] + bearings[i])
        count += 1
    return start, ends[:count], hits[:count]


@kernel
def _bounds(start, ends):  # type: ignore[no-untyped-def]
    """The least and the greatest row and column, (2,) each, of cells; NaN and infinity, too far for any, stay."""
    least, greatest = start.copy(), start.copy()
    for i in range(len(ends)):
        for axis in range(2):
            least[axis], greatest[axis] = min(least[axis], ends[i, axis]), max(greatest[axis], ends[i, axis])
    return np.floor(least), np.floor(greatest)


@kernel
def _are_there(tiles, corner, lowest, highest, low, high):  # type: ignore[no-untyped-def]
    """Whether cells from low to high (2,) lie between those that there are and have tiles."""
    for axis in range(2):
        if low[axis] < lowest[axis] or high[axis] > highest[axis]:
            return False
    for row in range((low[0] >> _TILE_BITS) - corner[0], (high[0] >> _TILE_BITS) - corner[0] + 1):
        for column in range((low[1] >> _TILE_BITS) - corner[1], (high[1] >> _TILE_BITS) - corner[1] + 1):
            if tiles[row, column] < 0:
                return False
    return True


@kernel
def count_scan(counts, tiles, corner, scan, start, ends, hits):  # type: ignore[no-untyped-def]
    """Count one scan in all cells that its beams end in or cross, once in each.

    counts: (T, 64, 64, 3) int32 of tiles with hits, passes and the last scan of each cell. tiles: (H, W) their numbers,
    and corner: (2,) row and column of the first in units of tiles. scan: its number, from 1. start: (2,), ends: (B, 2):
    row and column of the laser and the ends of the beams in units of cells, and hits: (B,) whether something is there.
    Cells are visited by the traversal of Amanatides and Woo (1987).
    """
    top, left = corner[0] << _TILE_BITS, corner[1] << _TILE_BITS
    for beam in range(len(ends)):
        if hits[beam]:
            row, column = math.floor(ends[beam, 0]), math.floor(ends[beam, 1])
            _count(counts, tiles, row - top, column - left, scan, _HITS)
    for beam in range(len(ends)):
        row, column = math.floor(start[0]), math.floor(start[1])
        down, right = ends[beam, 0] - start[0], ends[beam, 1] - start[1]
        # The steps to go: counted, so that the walk ends in the right cell whatever is rounded on the way.
        rows = abs(math.floor(ends[beam, 0]) - row)
        columns = abs(math.floor(ends[beam, 1]) - column)
        row_step, column_step = (1 if down > 0 else -1), (1 if right > 0 else -1)
        # The share of the beam at which it enters the next row and column, and that from one to the next.
        next_row = (row + (down > 0) - start[0]) / down if rows > 0 else np.inf
        next_column = (column + (right > 0) - start[1]) / right if columns > 0 else np.inf
        row_share = 1.0 / abs(down) if rows > 0 else np.inf
        column_share = 1.0 / abs(right) if columns > 0 else np.inf
        _count(counts, tiles, row - top, column - left, scan, _PASSES)
        for _ in range(rows + columns):
            if columns == 0 or (rows > 0 and next_row < next_column):
                row += row_step
                rows -= 1
                next_row += row_share
            else:
                column += column_step
                columns -= 1
                next_column += column_share
            _count(counts, tiles, row - top, column - left, scan, _PASSES)


@kernel
def _count(counts, tiles, row, column, scan, what):  # type: ignore[no-untyped-def]
    # Unsigned, so that nothing looks whether an index counts from the end: a third of the time.
    tile = np.uint64(tiles[np.uint64(row >> _TILE_BITS), np.uint64(column >> _TILE_BITS)])
    i, j = np.uint64(row & (_TILE - 1)), np.uint64(column & (_TILE - 1))
    if counts[tile, i, j, _LAST] != scan:
        counts[tile, i, j, _LAST] = scan
        counts[tile, i, j, what] += 1


@kernel
def _decide(cells, low, counts, tiles, corner, occupied_share, fewest_scans):  # type: ignore[no-untyped-def]
    """Fill cells (H, W), of which the first is the cell `low` (2,), with what the counts say."""
    for row in range(cells.shape[0]):
        for column in range(cells.shape[1]):
            i, j = row + low[0], column + low[1]
            tile = tiles[(i >> _TILE_BITS) - corner[0], (j >> _TILE_BITS) - corner[1]]
            if tile < 0:
                continue
            cell = counts[tile, i & (_TILE - 1), j & (_TILE - 1)]
            scans = cell[_HITS] + cell[_PASSES]
            if scans >= fewest_scans:
                cells[row, column] = OCCUPIED if cell[_HITS] > occupied_share * scans else FREE
