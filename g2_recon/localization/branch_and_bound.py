# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Where in a local map do many points fit best, over a wide window? Branch and bound (Hess et al., ICRA 2016)."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2_recon.kernels import inner_kernel, kernel
from g2_recon.localization.likelihood import FULL

Float = NDArray[np.float64]
Grid = NDArray[np.uint8]

_LEVELS = 5
# Level of zlib.
_FAST = 1
_MARGIN_M = 2.0
_MOST_VISITED = 400_000
_MOST_LEVELS, _MOST_VISITED_PLACES = 8, 4_000_000


@dataclass(frozen=True, slots=True)
class Pyramid:
    """Likelihood grids (L, W, H): level 0 as measured, level l the maximum over 2^l x 2^l cells from each cell on.

    corner: (2,) m of cell 0, 0. resolution: m.
    """

    levels: Grid
    corner: Float
    resolution: float

    def ground(self) -> Ground:
        """What the pyramid can be made of again."""
        return Ground(zlib.compress(self.levels[0], _FAST), self.levels.shape[1:], self.corner, self.resolution)


@dataclass(frozen=True, slots=True)
class Ground:
    """The lowest level of a pyramid, of shape (W, H), in a tenth of its memory: most cells are empty."""

    packed: bytes
    shape: tuple[int, ...]
    corner: Float
    resolution: float

    def raised(self) -> Pyramid:
        """The pyramid that it was the ground of."""
        levels = np.zeros((_LEVELS, *self.shape), np.uint8)
        levels[0] = np.frombuffer(zlib.decompress(self.packed), np.uint8).reshape(self.shape)
        raise_maxima(levels)
        return Pyramid(levels, self.corner, self.resolution)


def pyramid(points: Float, *, resolution: float, sigma: float) -> Pyramid:
    """The pyramid of points (N, 2), at least one, each a bell of `sigma` m."""
    corner = points.min(axis=0) - _MARGIN_M
    width, height = np.ceil((points.max(axis=0) + _MARGIN_M - corner) / resolution).astype(int) + 1
    levels = np.zeros((_LEVELS, width, height), np.uint8)
    _fill(levels, points, corner, resolution, sigma)
    return Pyramid(levels, corner, resolution)


@kernel
def _fill(levels, points, corner, resolution, sigma):  # type: ignore[no-untyped-def]
    _, width, height = levels.shape
    for k in range(len(points)):
        fx, fy = (points[k, 0] - corner[0]) / resolution, (points[k, 1] - corner[1]) / resolution
        ix, iy = int(fx), int(fy)
        for a in range(max(0, ix - 2), min(width, ix + 3)):
            for b in range(max(0, iy - 2), min(height, iy + 3)):
                squared = ((a + 0.5 - fx) ** 2 + (b + 0.5 - fy) ** 2) * resolution**2
                value = int(FULL * math.exp(-0.5 * squared / sigma**2))
                if value > levels[0, a, b]:
                    levels[0, a, b] = value
    raise_maxima(levels)


@kernel
def raise_maxima(levels):  # type: ignore[no-untyped-def]
    """Make each level (L, W, H) the maximum of level 0 over 2^l x 2^l cells from each cell on."""
    _, width, height = levels.shape
    for level in range(1, len(levels)):
        half = 1 << (level - 1)
        for a in range(width):
            for b in range(height):
                value = levels[level - 1, a, b]
                if a + half < width:
                    value = max(value, levels[level - 1, a + half, b])
                    if b + half < height:
                        value = max(value, levels[level - 1, a + half, b + half])
                if b + half < height:
                    value = max(value, levels[level - 1, a, b + half])
                levels[level, a, b] = value


@inner_kernel
def _bound(levels, level, xs, ys, dx, dy):  # type: ignore[no-untyped-def]
    """At most this much do the points score anywhere in the 2^level cells from the offset on."""
    _, width, height = levels.shape
    reach = (1 << level) - 1
    total = 0
    for k in range(len(xs)):
        x, y = xs[k] + dx, ys[k] + dy
        # A block that starts before the grid ends in it, within the margin, where there is nothing: its part inside
        # is bounded by the block that starts at the edge.
        if x < 0:
            if x + reach < 0:
                continue
            x = 0
        if y < 0:
            if y + reach < 0:
                continue
            y = 0
        if x < width and y < height:
            total += levels[level, x, y]
    return total


@kernel
def find(levels, corner, resolution, points, guess, window, turns, least):  # type: ignore[no-untyped-def]
    """The pose (3,) of points (N, 2) that scores best within +-window m of a guess and at the given turns (A,), rad.

    The score is the mean likelihood, 0 to 1; the search sees nothing below `least` and then answers -1.
    """
    top = len(levels) - 1
    size = 1 << top
    count = len(points)
    reach = int(window / resolution)
    xs = np.empty((len(turns), count), np.int64)
    ys = np.empty((len(turns), count), np.int64)
    for a in range(len(turns)):
        cos, sin = math.cos(guess[2] + turns[a]), math.sin(guess[2] + turns[a])
        for k in range(count):
            x = cos * points[k, 0] - sin * points[k, 1] + guess[0] - corner[0]
            y = sin * points[k, 0] + cos * points[k, 1] + guess[1] - corner[1]
            xs[a, k] = math.floor(x / resolution)
            ys[a, k] = math.floor(y / resolution)
    side = (2 * reach) // size + 1
    bounds = np.empty(len(turns) * side * side, np.int64)
    m = 0
    for a in range(len(turns)):
        for u in range(side):
            for v in range(side):
                bounds[m] = _bound(levels, top, xs[a], ys[a], -reach + u * size, -reach + v * size)
                m += 1
    best = int(least * FULL * count)
    best_x = best_y = 0
    best_turn = -1
    stack = np.empty((8 * _LEVELS, 4), np.int64)
    child = np.empty((4, 3), np.int64)
    visited = 0
    for block in np.argsort(-bounds):
        if bounds[block] <= best or visited > _MOST_VISITED:
            break
        a = block // (side * side)
        stack[0, 0] = top
        stack[0, 1] = -reach + (block % (side * side)) // side * size
        stack[0, 2] = -reach + block % side * size
        stack[0, 3] = bounds[block]
        depth = 1
        while depth:
            depth -= 1
            level, x, y, bound = stack[depth]
            if bound <= best:
                continue
            if level == 0:
                best, best_x, best_y, best_turn = bound, x, y, a
                continue
            half = 1 << (level - 1)
            for c in range(4):
                child[c, 0], child[c, 1] = x + (c // 2) * half, y + (c % 2) * half
                child[c, 2] = _bound(levels, level - 1, xs[a], ys[a], child[c, 0], child[c, 1])
            visited += 4
            for c in np.argsort(child[:, 2]):
                if child[c, 2] > best:
                    stack[depth, 0] = level - 1
                    stack[depth, 1], stack[depth, 2], stack[depth, 3] = child[c, 0], child[c, 1], child[c, 2]
                    depth += 1
    found = guess.copy()
    if best_turn < 0:
        return found, -1.0
    found[0] += best_x * resolution
    found[1] += best_y * resolution
    found[2] += turns[best_turn]
    return found, best / (FULL * count)


@kernel
def find_places(  # type: ignore[no-untyped-def]
    levels, free, corner, resolution, points, turns, least, share, near, most
):
    """Of poses of points (N, 2) all over the map, those that score best and are no neighbors of each other.

    free: (L, W, H) whether a block of the level from each cell on holds a place where the origin of the points may be.
    turns: (A,) rad, evenly over a full turn. Poses that score below `least`, or below `share` of the best, are of no
    interest. near: (2,) cells and turns within which only the best counts. Returns poses (K, 3) and scores (K,) of at
    most `most`, the best first, and whether all was searched.
    """
    top = len(levels) - 1
    size = 1 << top
    count = len(points)
    _, width, height = levels.shape
    wide, high = (width + size - 1) // size, (height + size - 1) // size
    xs = np.empty((len(turns), count), np.int64)
    ys = np.empty((len(turns), count), np.int64)
    floor = int(least * FULL * count)
    bounds = np.empty(len(turns) * wide * high, np.int64)
    blocks = np.empty(len(bounds), np.int64)
    m = 0
    for a in range(len(turns)):
        cos, sin = math.cos(turns[a]), math.sin(turns[a])
        for k in range(count):
            xs[a, k] = math.floor((cos * points[k, 0] - sin * points[k, 1]) / resolution)
            ys[a, k] = math.floor((sin * points[k, 0] + cos * points[k, 1]) / resolution)
        for u in range(wide):
            for v in range(high):
                if free[top, u * size, v * size]:
                    bound = _bound(levels, top, xs[a], ys[a], u * size, v * size)
                    if bound > floor:
                        bounds[m] = bound
                        blocks[m] = (a * wide + u) * high + v
                        m += 1
    found = np.empty((most, 3), np.int64)
    scores = np.empty(most, np.int64)
    kept = visited = 0
    stack = np.empty((8 * _MOST_LEVELS, 4), np.int64)
    child = np.empty((4, 3), np.int64)
    whole = True
    for rank in np.argsort(-bounds[:m], kind="mergesort"):
        if bounds[rank] <= _interesting(floor, share, scores, kept):
            break
        if visited > _MOST_VISITED_PLACES:
            whole = False
            break
        block = blocks[rank]
        a = block // (wide * high)
        stack[0, 0] = top
        stack[0, 1] = block // high % wide * size
        stack[0, 2] = block % high * size
        stack[0, 3] = bounds[rank]
        depth = 1
        while depth:
            depth -= 1
            level, x, y, bound = stack[depth]
            if bound <= _interesting(floor, share, scores, kept):
                continue
            if _beaten(found, scores, kept, near, len(turns), a, level, x, y, bound):
                continue
            if level == 0:
                kept = _keep(found, scores, kept, near, len(turns), a, x, y, bound)
                continue
            half = 1 << (level - 1)
            for c in range(4):
                child[c, 0], child[c, 1] = x + (c // 2) * half, y + (c % 2) * half
                child[c, 2] = -1
                if child[c, 0] < width and child[c, 1] < height and free[level - 1, child[c, 0], child[c, 1]]:
                    child[c, 2] = _bound(levels, level - 1, xs[a], ys[a], child[c, 0], child[c, 1])
                    visited += 1
            for c in np.argsort(child[:, 2], kind="mergesort"):
                if child[c, 2] > floor:
                    stack[depth, 0] = level - 1
                    stack[depth, 1], stack[depth, 2], stack[depth, 3] = child[c, 0], child[c, 1], child[c, 2]
                    depth += 1
    while kept and scores[kept - 1] <= int(share * scores[0]):
        kept -= 1
    poses = np.empty((kept, 3))
    for k in range(kept):
        poses[k, 0] = corner[0] + found[k, 0] * resolution
        poses[k, 1] = corner[1] + found[k, 1] * resolution
        poses[k, 2] = turns[found[k, 2]]
    return poses, scores[:kept] / (FULL * count), whole


@inner_kernel
def _interesting(floor, share, scores, kept):  # type: ignore[no-untyped-def]
    """A pose has to score more than this to be kept."""
    least = floor
    if kept:
        least = max(least, int(share * scores[0]))
    if kept == len(scores):
        least = max(least, scores[kept - 1])
    return least


@inner_kernel
def _beaten(found, scores, kept, near, turns, a, level, x, y, bound):  # type: ignore[no-untyped-def]
    """Whether all poses of a block are neighbors of one that scores at least as well."""
    last = (1 << level) - 1
    for k in range(kept):
        if scores[k] < bound:
            return False
        turned = abs(found[k, 2] - a)
        dx = max(abs(x - found[k, 0]), abs(x + last - found[k, 0]))
        dy = max(abs(y - found[k, 1]), abs(y + last - found[k, 1]))
        if min(turned, turns - turned) <= near[1] and dx * dx + dy * dy <= near[0] * near[0]:
            return True
    return False


@kernel
def _keep(found, scores, kept, near, turns, a, x, y, score):  # type: ignore[no-untyped-def]
    """Put a pose among those that were found, in place of its neighbors; how many there are then."""
    left = 0
    for k in range(kept):
        turned = abs(found[k, 2] - a)
        dx, dy = x - found[k, 0], y - found[k, 1]
        if min(turned, turns - turned) > near[1] or dx * dx + dy * dy > near[0] * near[0]:
            found[left] = found[k]
            scores[left] = scores[k]
            left += 1
    k = min(left, len(scores) - 1)
    while k > 0 and scores[k - 1] < score:
        found[k] = found[k - 1]
        scores[k] = scores[k - 1]
        k -= 1
    found[k, 0], found[k, 1], found[k, 2] = x, y, a
    scores[k] = score
    return min(left + 1, len(scores))


@kernel
def rival(levels, corner, resolution, points, pose, direction, reach):  # type: ignore[no-untyped-def]
    """The best score 1 m to `reach` m away along a direction (2,), as a share of the score at the pose.

    Close to 1 where the place repeats itself along it, as a corridor does.
    """
    _, width, height = levels.shape
    here = away = 0
    steps = int(reach / 0.2)
    for turn in (0.0, -0.01, 0.01):
        cos, sin = math.cos(pose[2] + turn), math.sin(pose[2] + turn)
        for step in range(-steps, steps + 1):
            along = 0.2 * step
            if 0.25 < abs(along) < 1.0:
                continue
            for side in range(-2, 3):
                across = 0.1 * side
                x0 = pose[0] + along * direction[0] - across * direction[1] - corner[0]
                y0 = pose[1] + along * direction[1] + across * direction[0] - corner[1]
                total = 0
                for k in range(len(points)):
                    x = int((cos * points[k, 0] - sin * points[k, 1] + x0) / resolution)
                    y = int((sin * points[k, 0] + cos * points[k, 1] + y0) / resolution)
                    if 0 <= x < width and 0 <= y < height:
                        total += levels[0, x, y]
                if abs(along) <= 0.25:
                    here = max(here, total)
                else:
                    away = max(away, total)
    return away / max(here, 1)
