# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Points near places, found in a tree of bounding boxes.

The nearest points to each of a few places near each other: SciPy's cKDTree finds the same ones, in twice the time, as
it descends once a place, and returns (N, k) arrays, where a kernel needs the neighbors of one point at a time. This
search is most of what mode solid does with each of the points. And whether there is a point near each of many places:
cKDTree tells it in five times the time, as it looks for the nearest.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.chunks import in_chunks, taken
from g2_recon.geometry.selection import select
from g2_recon.kernels import kernel

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Points in a leaf, and the best number of places to search for together.
BLOCK = 8

# Levels of the tree that are made one after the other, each in parallel; so are the parts below them. So few points
# are done before another thread has begun.
_SERIAL_LEVELS, _FEW_POINTS = 4, 4096
_LEVELS = 64


class PointTree(NamedTuple):
    """A tree of boxes around points; a tuple of arrays, so that kernels take it as it is.

    The tree is complete: node 1 is the root, 2 i and 2 i + 1 are the parts of node i, and leaf k of L holds the places
    8 k to 8 k + 7. Leaves behind the last point have no place and a box that is nowhere.

    boxes: (2 L, 6) m, low and high corner of each node, row 0 not used. leaves: (K, 3, 8) m, x, y and z of the points
    of each leaf that has any, infinite behind the last point. number: (M,) which point is at each place.
    """

    boxes: Float
    leaves: Float
    number: Int


def point_tree(points: Float, rows: Int | None = None, *, workers: int = 1) -> PointTree:
    """The tree of points (N, 3) in metres, all finite, or only of `rows` (M,) of them, at least one.

    Points that are near each other in the array make it faster. It does not depend on `workers`.
    """
    number = np.arange(len(points)) if rows is None else rows.astype(np.int64)
    sorted_points = taken(points, number, workers)
    filled = -(-len(number) // BLOCK)
    depth = (filled - 1).bit_length()
    boxes = np.zeros((2 << depth, 6))
    serial = 0 if workers == 1 or len(number) <= _FEW_POINTS else min(depth, _SERIAL_LEVELS)
    for level in range(serial + 1):
        until = level + 1 if level < serial else depth + 1
        halve = partial(_halve, sorted_points, number, boxes, level, until, depth)
        in_chunks(halve, 1 << level, workers, chunk=1)
    leaves = np.full((filled, 3, BLOCK), np.inf)
    _fill(sorted_points, leaves)
    return PointTree(boxes, leaves, number)


@kernel
def _halve(points, number, boxes, level, until, depth, begin, end):  # type: ignore[no-untyped-def]
    """Make the boxes of the nodes from `begin` to before `end` of a level, and of those below down to above `until`.

    Each node is cut across the longest side of its box, in multiples of a leaf, and points and their numbers are
    ordered so.
    """
    first, last = (1 << level) + begin, (1 << level) + end
    while level < until:
        size = BLOCK << (depth - level)
        for node in range(first, last):
            begin = min((node - (1 << level)) * size, len(points))
            end = min(begin + size, len(points))
            low_x = low_y = low_z = np.inf
            high_x = high_y = high_z = -np.inf
            for row in range(begin, end):
                x, y, z = points[row, 0], points[row, 1], points[row, 2]
                low_x, low_y, low_z = min(low_x, x), min(low_y, y), min(low_z, z)
                high_x, high_y, high_z = max(high_x, x), max(high_y, y), max(high_z, z)
            boxes[node, 0], boxes[node, 1], boxes[node, 2] = low_x, low_y, low_z
            boxes[node, 3], boxes[node, 4], boxes[node, 5] = high_x, high_y, high_z
            if level < depth and begin + size // 2 < end:
                axis = 0 if high_x - low_x >= high_y - low_y else 1
                if high_z - low_z > max(high_x - low_x, high_y - low_y):
                    axis = 2
                select(points, number, axis, begin, end, begin + size // 2)
        level += 1
        first, last = 2 * first, 2 * last


@kernel
def _fill(points, leaves):  # type: ignore[no-untyped-def]
    for row in range(len(points)):
        for a in range(3):
            leaves[row // BLOCK, a, row % BLOCK] = points[row, a]


@kernel
def nearest_to_block(tree, block, beyond, squared, places, found):  # type: ignore[no-untyped-def]
    """Find the k points nearest to each of a few places near each other (B, 3), of those nearer than the limit.

    beyond: m^2, finite, what a squared distance must be below. squared, places: (B, k), filled in with the squared
    distances (m^2), ascending, and with places in the tree. found: (B,), filled in with how many there are. Of points
    as far the one with the lowest number comes first; where k or more are at distance 0, any of these are taken, always
    the same.
    """
    boxes, leaves, number = tree
    leaf_count, k = len(boxes) // 2, squared.shape[1]
    low_x = low_y = low_z = np.inf
    high_x = high_y = high_z = -np.inf
    for q in range(len(block)):
        x, y, z = block[q, 0], block[q, 1], block[q, 2]
        low_x, low_y, low_z = min(low_x, x), min(low_y, y), min(low_z, z)
        high_x, high_y, high_z = max(high_x, x), max(high_y, y), max(high_z, z)
        found[q], squared[q, k - 1] = 0, beyond
    mid_x, mid_y, mid_z = 0.5 * (low_x + high_x), 0.5 * (low_y + high_y), 0.5 * (low_z + high_z)
    # The last distance of each place is its limit until it has k; the farthest of these is that of the block.
    farthest = beyond
    distance = np.empty(BLOCK)
    nodes, gaps = np.empty(_LEVELS, np.int64), np.empty(_LEVELS)
    nodes[0], gaps[0], top = 1, 0.0, 1
    while top > 0:
        top -= 1
        node = nodes[top]
        if gaps[top] > farthest:
            continue
        while node < leaf_count:
            near, far = 2 * node, 2 * node + 1
            # First where the middle of the block is; to all boxes that the block touches it is equally near.
            if _gap(boxes, far, mid_x, mid_y, mid_z, mid_x, mid_y, mid_z) < _gap(
                boxes, near, mid_x, mid_y, mid_z, mid_x, mid_y, mid_z
            ):
                near, far = far, near
            gap = _gap(boxes, far, low_x, low_y, low_z, high_x, high_y, high_z)
            if gap <= farthest:
                nodes[top], gaps[top] = far, gap
                top += 1
            if _gap(boxes, near, low_x, low_y, low_z, high_x, high_y, high_z) > farthest:
                break
            node = near
        else:
            leaf = node - leaf_count
            for q in range(len(block)):
                x, y, z = block[q, 0], block[q, 1], block[q, 2]
                limit, count = squared[q, k - 1], found[q]
                if _gap(boxes, node, x, y, z, x, y, z) > limit:
                    continue
                for i in range(BLOCK):
                    dx, dy, dz = leaves[leaf, 0, i] - x, leaves[leaf, 1, i] - y, leaves[leaf, 2, i] - z
                    distance[i] = dx * dx + dy * dy + dz * dz
                # Written out here: calls would count references to their arrays, for each of the points.
                for i in range(BLOCK):
                    new, place = distance[i], leaf * BLOCK + i
                    if new > limit or (new == limit and (count < k or number[places[q, k - 1]] < number[place])):
                        continue
                    at = min(count, k - 1)
                    while at > 0:
                        old = squared[q, at - 1]
                        if old < new or (old == new and number[places[q, at - 1]] < number[place]):
                            break
                        squared[q, at], places[q, at] = old, places[q, at - 1]
                        at -= 1
                    squared[q, at], places[q, at] = new, place
                    count = min(count + 1, k)
                    if count < k:
                        squared[q, k - 1] = beyond
                    limit = squared[q, k - 1]
                found[q] = count
            farthest = 0.0
            for q in range(len(block)):
                farthest = max(farthest, squared[q, k - 1])
            if farthest == 0.0:
                return


@kernel(inline="always")
def _gap(boxes, node, low_x, low_y, low_z, high_x, high_y, high_z):  # type: ignore[no-untyped-def]
    """Squared distance of a box from a node."""
    dx = max(boxes[node, 0] - high_x, low_x - boxes[node, 3], 0.0)
    dy = max(boxes[node, 1] - high_y, low_y - boxes[node, 4], 0.0)
    dz = max(boxes[node, 2] - high_z, low_z - boxes[node, 5], 0.0)
    return dx * dx + dy * dy + dz * dz


def are_near(points: Float, others: Float, distance: float, workers: int) -> Mask:
    """Mask (N,) of the points (N, 3) with another one (M, 3), all of these finite, within `distance` metres.

    Raises InputError for a distance that is not finite, or below 0.
    """
    if not (math.isfinite(distance) and distance >= 0):
        raise InputError(f"a distance of {distance} m", where="nearness", advice="give a length of at least 0")
    mask = np.zeros(len(points), bool)
    if len(others):
        tree = point_tree(others, workers=workers)
        in_chunks(lambda begin, end: _fill_near(points, tree, distance, begin, end, mask), len(points), workers)
    return mask


@kernel
def _fill_near(points, tree, distance, begin, end, mask):  # type: ignore[no-untyped-def]
    boxes, leaves, _ = tree
    leaf_count, squared = len(boxes) // 2, distance * distance
    nodes = np.empty(_LEVELS, np.int64)
    for row in range(begin, end):
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        nodes[0], top = 1, 1 if math.isfinite(x + y + z) else 0
        is_near = False
        while top > 0 and not is_near:
            top -= 1
            node = nodes[top]
            below_x, above_x = boxes[node, 0] - x, x - boxes[node, 3]
            below_y, above_y = boxes[node, 1] - y, y - boxes[node, 4]
            below_z, above_z = boxes[node, 2] - z, z - boxes[node, 5]
            dx, dy, dz = max(below_x, above_x, 0.0), max(below_y, above_y, 0.0), max(below_z, above_z, 0.0)
            if dx * dx + dy * dy + dz * dz > squared:
                continue
            if node < leaf_count:
                # Where the farthest corner of a box is near, all of its points are.
                dx, dy, dz = min(below_x, above_x), min(below_y, above_y), min(below_z, above_z)
                is_near = dx * dx + dy * dy + dz * dz <= squared
                nodes[top], nodes[top + 1] = 2 * node, 2 * node + 1
                top += 2
            else:
                leaf = node - leaf_count
                for i in range(BLOCK):
                    dx, dy, dz = leaves[leaf, 0, i] - x, leaves[leaf, 1, i] - y, leaves[leaf, 2, i] - z
                    is_near |= dx * dx + dy * dy + dz * dz <= squared
        mask[row] = is_near
