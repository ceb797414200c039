# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Correlative scan matching: where in a likelihood grid a set of points fits best (Olson, ICRA 2009).

The exhaustive search is for small windows; branch and bound over a pyramid of maxima (Hess et al., ICRA 2016) for large
ones.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from g2_recon.kernels import inner_kernel, kernel
from g2_recon.localization.beams import CORNER, INVALID, SURFACE

Float = NDArray[np.float64]
Grid = NDArray[np.uint8]

FULL = 255
"""Likelihood of a cell with a point in its middle."""


@kernel
def bell(resolution: float, sigma: float) -> Grid:
    """Likelihoods (5, 5) of the cells around a point in the middle one; resolution and sigma in m."""
    kernel = np.empty((5, 5), np.uint8)
    for u in range(5):
        for v in range(5):
            squared = ((u - 2) ** 2 + (v - 2) ** 2) * resolution**2
            kernel[u, v] = int(FULL * math.exp(-0.5 * squared / sigma**2))
    return kernel


@kernel
def splat(grid, points, kinds, poses, x0, y0, resolution, kernel):  # type: ignore[no-untyped-def]
    """Draw scans (K, B, 2) at poses (K, 3) into the grid with corner x0, y0: the larger likelihood stays.

    Returns the box (4,) that holds what was drawn: first and past the last row, and column.
    """
    width, height = grid.shape
    left, right, bottom, top = width, 0, height, 0
    for k in range(len(poses)):
        cos, sin = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        for b in range(points.shape[1]):
            if kinds[k, b] == 0:
                continue
            x = int((cos * points[k, b, 0] - sin * points[k, b, 1] + poses[k, 0] - x0) / resolution)
            y = int((sin * points[k, b, 0] + cos * points[k, b, 1] + poses[k, 1] - y0) / resolution)
            # What is in the middle is there already if the same place was hit before.
            if x < 2 or y < 2 or x >= width - 2 or y >= height - 2 or grid[x, y] == kernel[2, 2]:
                continue
            left, right, bottom, top = min(left, x - 2), max(right, x + 3), min(bottom, y - 2), max(top, y + 3)
            for u in range(5):
                for v in range(5):
                    if kernel[u, v] > grid[x + u - 2, y + v - 2]:
                        grid[x + u - 2, y + v - 2] = kernel[u, v]
    return np.array([left, max(left, right), bottom, max(bottom, top)])


@inner_kernel
def _widened(box, reach, shape):  # type: ignore[no-untyped-def]
    return max(0, box[0] - reach), min(shape[0], box[1] + reach), max(0, box[2] - reach), min(shape[1], box[3] + reach)


@kernel
def clear(grid, box, reach):  # type: ignore[no-untyped-def]
    """Set the cells in a box (4,), as of `splat`, and up to `reach` beside it to 0."""
    left, right, bottom, top = _widened(box, reach, grid.shape)
    for x in range(left, right):
        grid[x, bottom:top] = 0


@kernel
def score(grid, points, kinds, pose, x0, y0, resolution):  # type: ignore[no-untyped-def]
    """Mean likelihood, 0 to 1, of the points of a scan at a pose."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    width, height = grid.shape
    total = count = 0
    for b in range(len(points)):
        if kinds[b] == 0:
            continue
        count += 1
        x = int((cos * points[b, 0] - sin * points[b, 1] + pose[0] - x0) / resolution)
        y = int((sin * points[b, 0] + cos * points[b, 1] + pose[1] - y0) / resolution)
        if x >= 0 and y >= 0 and x < width and y < height:
            total += grid[x, y]
    return total / (FULL * max(count, 1))


@numba.njit(nogil=True)
def _raise(row, other, count):  # type: ignore[no-untyped-def]
    for k in range(count):
        one, two = row[k], other[k]
        row[k] = one if one > two else two


@kernel
def widen(grid, box, reach, wide):  # type: ignore[no-untyped-def]
    """Fill `wide` with the largest likelihood within +-reach cells of each cell of the grid.

    There is none outside of a box (4,), as of `splat`; farther away nothing is written.
    """
    left, right, bottom, top = _widened(box, reach, grid.shape)
    count = top - bottom
    row = np.empty(max(count, 0), grid.dtype)
    for x in range(left, right):
        row[:] = 0
        for other in range(max(left, x - reach), min(right, x + reach + 1)):
            _raise(row, grid[other, bottom:top], count)
        widened = wide[x, bottom:top]
        # Not the row at once; see se2_kernels.inverse_3x3.
        widened[:] = 0
        _raise(widened, row, count)
        for step in range(1, reach + 1):
            _raise(widened, row[step:], count - step)
            _raise(widened[step:], row, count - step)


@kernel
def search(  # type: ignore[no-untyped-def]
    grid, wide, points, kinds, guess, x0, y0, resolution, turns, turn, shifts, step
):
    """The best pose within +-`turns` steps of `turn` (rad) and +-`shifts` cells of a guess, and its score.

    Every `step`-th beam is used. `wide` is the grid widened by `shifts`: a turn whose best shift cannot win is not
    looked at further. The guess is favored a little: 0.3 % a degree, 2 % a cell. It stays where no point meets the
    grid.
    """
    best = 0.0
    found = guess.copy()
    width, height = grid.shape
    xs = np.empty(len(points), np.int64)
    ys = np.empty(len(points), np.int64)
    side = 2 * shifts + 1
    for m in range(2 * turns + 1):
        # 0, 1, -1, 2, -2, ...
        a = (m + 1) // 2 * (1 if m % 2 else -1)
        yaw = guess[2] + a * turn
        cos, sin = math.cos(yaw), math.sin(yaw)
        count = inside = 0
        bound = 0
        for b in range(0, len(points), step):
            if kinds[b] == 0:
                continue
            count += 1
            x = int((cos * points[b, 0] - sin * points[b, 1] + guess[0] - x0) / resolution)
            y = int((sin * points[b, 0] + cos * points[b, 1] + guess[1] - y0) / resolution)
            if x >= shifts and y >= shifts and x < width - shifts and y < height - shifts:
                xs[inside], ys[inside] = x, y
                inside += 1
                bound += wide[x, y]
        favor = 1 - 0.003 * abs(a) * math.degrees(turn)
        if bound / (FULL * max(count, 1)) * favor <= best:
            continue
        for u in range(side):
            for v in range(side):
                total = 0
                for k in range(inside):
                    total += grid[xs[k] + u - shifts, ys[k] + v - shifts]
                value = total / (FULL * max(count, 1)) * (favor - 0.02 * math.hypot(u - shifts, v - shifts))
                if value > best:
                    best = value
                    found[0] = guess[0] + (u - shifts) * resolution
                    found[1] = guess[1] + (v - shifts) * resolution
                    found[2] = yaw
    return found, best


@kernel
def climb(grid, points, kinds, start, x0, y0, resolution, turn, rounds):  # type: ignore[no-untyped-def]
    """The pose near a start that scores best: steps of half a cell and half a turn, halved in each round."""
    best = start.copy()
    value = score(grid, points, kinds, best, x0, y0, resolution)
    step = np.array([0.5 * resolution, 0.5 * resolution, 0.5 * turn])
    for _ in range(rounds):
        for axis in range(3):
            for sign in (-1.0, 1.0):
                pose = best.copy()
                pose[axis] += sign * step[axis]
                other = score(grid, points, kinds, pose, x0, y0, resolution)
                if other > value:
                    value = other
                    best = pose
        step *= 0.5
    return best


@kernel
def slide(  # type: ignore[no-untyped-def]
    grid, points, kinds, pose, direction, reach, step, expected, away, x0, y0, resolution
):
    """How far (m) along a direction (2,) from a pose (3,) the points of a scan fit best, within +-reach m.

    And how much better than where they fit worst. Steps of `step` m, then a parabola. A m^2 from where it is `expected`
    (m along the direction) costs `away`.
    """
    count = int(reach / step)
    costs = np.empty(2 * count + 1)
    lowest, highest = 1.0, 0.0
    at = pose.copy()
    for k in range(2 * count + 1):
        off = (k - count) * step
        at[0], at[1] = pose[0] + off * direction[0], pose[1] + off * direction[1]
        fit = score(grid, points, kinds, at, x0, y0, resolution)
        lowest, highest = min(lowest, fit), max(highest, fit)
        costs[k] = away * (off - expected) ** 2 - fit
    k = int(np.argmin(costs))
    off = (k - count) * step
    if 0 < k < 2 * count:
        bend = costs[k - 1] - 2 * costs[k] + costs[k + 1]
        if bend > 0:
            off += 0.5 * step * (costs[k - 1] - costs[k + 1]) / bend
    return off, highest - lowest


@kernel
def telling(points, normals, kinds, increment, direction, dense, steep):  # type: ignore[no-untyped-def]
    """The kinds (N,) of the beams that can tell how far a scan is along a direction (2,) in it, INVALID for the others.

    Beams farther apart than `dense` (m) on a wall along that direction (sine between them less than `steep`) hit it at
    the same bearings wherever the robot is: they would hold it where it was.
    """
    result = np.full(len(kinds), INVALID, kinds.dtype)
    for b in range(len(kinds)):
        x, y, nx, ny = points[b, 0], points[b, 1], normals[b, 0], normals[b, 1]
        if kinds[b] == CORNER:
            result[b] = kinds[b]
        elif kinds[b] == SURFACE:
            # From beam to beam along the wall, m: r d(bearing) over the cosine between beam and normal.
            apart = (x * x + y * y) * increment > dense * abs(x * nx + y * ny)
            if not (apart and abs(nx * direction[0] + ny * direction[1]) < steep):
                result[b] = kinds[b]
    return result
