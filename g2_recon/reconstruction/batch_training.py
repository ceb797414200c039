# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The batch rule (Kohonen, section 3.6) for maps as large as a wall, in time that grows with the points.

The neighborhood is a Gaussian of the distance on the lattice, not of the steps along it: the product of one Gaussian
across rows and one along them. Of a large map only the neurons near a point are compared with it.
"""

from __future__ import annotations

import math

import numpy as np

from g2_recon.geometry.sorting import sort_by_counting
from g2_recon.kernels import inner_kernel, kernel

# A final neighborhood of one lattice step would shrink each map by about a cell.
_WIDTH_END = 0.35
# At first the neighborhood is half the map, but no more steps than these: a sheet that is laid out well needs no more.
_WIDEST_START = 10.0
# Where the Gaussian is below 1e-7.
_REACH = math.sqrt(2.0 * math.log(1e7))
# Neurons that get less than this share of the weight of a point stay where they are.
_LEAST_WEIGHT = 1e-6
# Rows and columns of a tile: from two tiles on, the points of each are only compared with the neurons near it.
_TILE = 6
# Points at once, so that what is read again and again stays in the cache.
_BLOCK = 512
# The largest squared distance, and where the neurons are that only fill up, m.
_LARGEST = np.float32(3e38)
_FAR_OFF = np.float32(1e15)


@kernel
def train_sheet(x, y, z, weights, neurons, rows, columns, hexagonal, epochs, bmu):  # type: ignore[no-untyped-def]
    """Train a map with points x, y, z (N,) of `weights` (N,), N >= 1; neurons (n, 3) are changed in place.

    neurons: at first a flat sheet in the plane z = 0, row by row, rows along x; every other row of a hexagonal lattice
    is shifted by half a step. bmu: (N,) gets the best matching unit of each point. Coordinates are around the middle of
    the points, as the search is in single precision.
    """
    tiles = max(1, rows // _TILE), max(1, columns // _TILE)
    order, begin = _by_tiles(x, y, tiles)
    points = np.empty((3, len(x)), np.float32)
    weight, total = np.empty(len(x)), 0.0
    for k in range(len(order)):
        i = order[k]
        points[0, k], points[1, k], points[2, k], weight[k] = x[i], y[i], z[i], weights[i]
        total += weight[k]
    boxes = _boxes(points, begin)
    nearest = np.zeros(len(x), np.int32)
    sums = np.empty((rows, 4 * columns))
    least = _LEAST_WEIGHT * (total / len(x))
    across = math.sqrt(0.75) if hexagonal else 1.0
    start = max(min(max(rows * across, columns) / 2.0, _WIDEST_START), _WIDTH_END)
    for epoch in range(epochs):
        _search(points, begin, boxes, neurons, rows, columns, tiles, nearest)
        _sum_by_neuron(points, weight, nearest, sums.reshape(-1, 4))
        width = start * (_WIDTH_END / start) ** (epoch / max(epochs - 1, 1))
        _pull(neurons, sums, rows, columns, hexagonal, width, across, least)
    _search(points, begin, boxes, neurons, rows, columns, tiles, nearest)
    for k in range(len(order)):
        bmu[order[k]] = nearest[k]


@inner_kernel
def _by_tiles(x, y, tiles):  # type: ignore[no-untyped-def]
    """An order (N,) of the points in which those of a tile follow each other, and where each tile begins (T + 1,)."""
    tiles_x, tiles_y = tiles
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    for i in range(len(x)):
        low_x, high_x, low_y, high_y = min(low_x, x[i]), max(high_x, x[i]), min(low_y, y[i]), max(high_y, y[i])
    size_x, size_y = max(high_x - low_x, 1e-12) / tiles_x, max(high_y - low_y, 1e-12) / tiles_y
    tile = np.empty(len(x), np.int64)
    for i in range(len(x)):
        tile_x, tile_y = int((x[i] - low_x) / size_x), int((y[i] - low_y) / size_y)
        tile[i] = min(tile_x, tiles_x - 1) * tiles_y + min(tile_y, tiles_y - 1)
    return sort_by_counting(tile, tiles_x * tiles_y)


@inner_kernel
def _boxes(points, begin):  # type: ignore[no-untyped-def]
    """Lowest and highest coordinates (T, 2, 3) of the points of each tile; of an empty one, none at all."""
    boxes = np.empty((len(begin) - 1, 2, 3), np.float32)
    for tile in range(len(boxes)):
        for axis in range(3):
            boxes[tile, 0, axis], boxes[tile, 1, axis] = _LARGEST, -_LARGEST
            for i in range(begin[tile], begin[tile + 1]):
                boxes[tile, 0, axis] = min(boxes[tile, 0, axis], points[axis, i])
                boxes[tile, 1, axis] = max(boxes[tile, 1, axis], points[axis, i])
    return boxes


@kernel
def _search(points, begin, boxes, neurons, rows, columns, tiles, bmu):  # type: ignore[no-untyped-def]
    """The best matching unit (N,) of each of the points (3, N)."""
    count = len(neurons)
    columns_of = np.full((3, (count + 3) // 4 * 4), _FAR_OFF, np.float32)
    number = np.zeros(columns_of.shape[1], np.int32)
    if len(boxes) == 1:
        for j in range(count):
            columns_of[0, j], columns_of[1, j], columns_of[2, j] = neurons[j, 0], neurons[j, 1], neurons[j, 2]
            number[j] = j
        _nearest(points, begin[0], begin[1], columns_of, number, len(number), bmu)
        return
    strips, patches = _boxes_of_neurons(neurons, rows, columns, tiles)
    for tile in range(len(boxes)):
        if begin[tile] < begin[tile + 1]:
            chosen = _near_tile(tile, boxes[tile], neurons, rows, columns, strips, patches, columns_of, number)
            _nearest(points, begin[tile], begin[tile + 1], columns_of, number, chosen, bmu)


@inner_kernel
def _boxes_of_neurons(neurons, rows, columns, tiles):  # type: ignore[no-untyped-def]
    """Lowest and highest coordinates of the neurons of each row of tiles (S, 2, 3) and of each tile (S, T, 2, 3)."""
    strips, patches = np.empty((tiles[0], 2, 3)), np.empty((tiles[0], tiles[1], 2, 3))
    strips[:, 0], strips[:, 1], patches[:, :, 0], patches[:, :, 1] = np.inf, -np.inf, np.inf, -np.inf
    for j in range(len(neurons)):
        s, t = j // columns * tiles[0] // rows, j % columns * tiles[1] // columns
        for axis in range(3):
            place = neurons[j, axis]
            strips[s, 0, axis], strips[s, 1, axis] = min(strips[s, 0, axis], place), max(strips[s, 1, axis], place)
            patches[s, t, 0, axis] = min(patches[s, t, 0, axis], place)
            patches[s, t, 1, axis] = max(patches[s, t, 1, axis], place)
    return strips, patches


@inner_kernel
def _near_tile(tile, box, neurons, rows, columns, strips, patches, columns_of, number):  # type: ignore[no-untyped-def]
    """How many neurons may be the nearest to a point in the box (2, 3); columns_of and number get them, filled up to 4.

    No other can be: some neuron is nearer to all of the box than these to any of it. One of the same tile of the
    lattice is, where the map lies over the points about as it did at first.
    """
    tiles_y = patches.shape[1]
    reach = np.inf
    for r in range(*_part(tile // tiles_y, len(patches), rows)):
        for c in range(*_part(tile % tiles_y, tiles_y, columns)):
            reach = min(reach, _farthest(box, neurons[r * columns + c]))
    # Rounding to single precision must not leave out the nearest.
    reach *= 1.0001
    chosen = 0
    for s in range(len(patches)):
        if _gap(box, strips[s, 0], strips[s, 1]) > reach:
            continue
        for t in range(tiles_y):
            if _gap(box, patches[s, t, 0], patches[s, t, 1]) > reach:
                continue
            for r in range(*_part(s, len(patches), rows)):
                for c in range(*_part(t, tiles_y, columns)):
                    j = r * columns + c
                    if _gap(box, neurons[j], neurons[j]) <= reach:
                        for axis in range(3):
                            columns_of[axis, chosen] = neurons[j, axis]
                        number[chosen] = j
                        chosen += 1
    while chosen % 4:
        columns_of[0, chosen] = columns_of[1, chosen] = columns_of[2, chosen] = _FAR_OFF
        chosen += 1
    return chosen


@kernel
def _part(part, parts, count):  # type: ignore[no-untyped-def]
    """The first of `count` that is in this part, and the first of the next: those i with i * parts // count == part."""
    return (part * count + parts - 1) // parts, ((part + 1) * count + parts - 1) // parts


@inner_kernel
def _farthest(box, place):  # type: ignore[no-untyped-def]
    """Squared distance of a place (3,) from the farthest place in a box."""
    square = 0.0
    for axis in range(3):
        off = max(abs(box[0, axis] - place[axis]), abs(box[1, axis] - place[axis]))
        square += off * off
    return square


@inner_kernel
def _gap(box, low, high):  # type: ignore[no-untyped-def]
    """Squared distance of a box from another."""
    square = 0.0
    for axis in range(3):
        off = max(box[0, axis] - high[axis], low[axis] - box[1, axis], 0.0)
        square += off * off
    return square


@kernel(fastmath=True)
def _nearest(points, begin, end, columns_of, number, count, bmu):  # type: ignore[no-untyped-def]
    """The nearest (N,) to the points from `begin` to `end` among the first `count` neurons, a multiple of four.

    A processor works on eight points at once here, each against four neurons.
    """
    best = np.empty(_BLOCK, np.float32)
    for first in range(begin, end, _BLOCK):
        size = min(_BLOCK, end - first)
        x, y, z = points[0, first : first + size], points[1, first : first + size], points[2, first : first + size]
        own = bmu[first : first + size]
        best[:] = _LARGEST
        for j in range(0, count, 4):
            xa, ya, za, a = columns_of[0, j], columns_of[1, j], columns_of[2, j], number[j]
            xb, yb, zb, b = columns_of[0, j + 1], columns_of[1, j + 1], columns_of[2, j + 1], number[j + 1]
            xc, yc, zc, c = columns_of[0, j + 2], columns_of[1, j + 2], columns_of[2, j + 2], number[j + 2]
            xd, yd, zd, d = columns_of[0, j + 3], columns_of[1, j + 3], columns_of[2, j + 3], number[j + 3]
            for i in range(size):
                px, py, pz = x[i], y[i], z[i]
                to_a = (px - xa) * (px - xa) + (py - ya) * (py - ya) + (pz - za) * (pz - za)
                to_b = (px - xb) * (px - xb) + (py - yb) * (py - yb) + (pz - zb) * (pz - zb)
                to_c = (px - xc) * (px - xc) + (py - yc) * (py - yc) + (pz - zc) * (pz - zc)
                to_d = (px - xd) * (px - xd) + (py - yd) * (py - yd) + (pz - zd) * (pz - zd)
                name = b if to_b < to_a else a
                least = min(to_a, to_b)
                name = c if to_c < least else name
                least = min(least, to_c)
                name = d if to_d < least else name
                least = min(least, to_d)
                own[i] = name if least < best[i] else own[i]
                best[i] = min(least, best[i])


@inner_kernel
def _sum_by_neuron(points, weight, bmu, sums):  # type: ignore[no-untyped-def]
    """Weighted sum of the coordinates, and of the weights, of the points of each neuron (n, 4)."""
    sums[:] = 0.0
    for i in range(len(bmu)):
        own, w = sums[bmu[i]], weight[i]
        own[0] += w * points[0, i]
        own[1] += w * points[1, i]
        own[2] += w * points[2, i]
        own[3] += w


@inner_kernel(fastmath=True)
def _pull(neurons, sums, rows, columns, hexagonal, width, across, least):  # type: ignore[no-untyped-def]
    """Each neuron moves to the mean of all points, weighted by the neighborhood of their neurons.

    sums: (rows, 4 columns). width: of the Gaussian, in steps. across: steps from row to row. Rows that are shifted
    against each other are apart by half steps more, so that sums across rows are kept for either kind of row.
    """
    kinds = 2 if hexagonal else 1
    reach = int(_REACH * width / across) + 1
    by_row = np.empty(reach + 1)
    for d in range(reach + 1):
        by_row[d] = math.exp(-0.5 * (d * across / width) ** 2)
    along = int(_REACH * width) + 1
    by_half_column = np.empty(2 * along + 2)
    for d in range(2 * along + 2):
        by_half_column[d] = math.exp(-0.5 * (0.5 * d / width) ** 2)
    summed = np.empty((kinds, 4 * columns))
    for r in range(rows):
        summed[:] = 0.0
        for s in range(max(0, r - reach), min(rows, r + reach + 1)):
            h = by_row[abs(r - s)]
            into, own = summed[s % kinds], sums[s]
            for k in range(4 * columns):
                into[k] += h * own[k]
        for c in range(columns):
            x = y = z = total = 0.0
            for kind in range(kinds):
                shift = r % kinds - kind
                for s in range(max(0, c - along), min(columns, c + along + 1)):
                    h = by_half_column[abs(2 * (c - s) + shift)]
                    x += h * summed[kind, 4 * s]
                    y += h * summed[kind, 4 * s + 1]
                    z += h * summed[kind, 4 * s + 2]
                    total += h * summed[kind, 4 * s + 3]
            if total > least:
                j = r * columns + c
                neurons[j, 0], neurons[j, 1], neurons[j, 2] = x / total, y / total, z / total
