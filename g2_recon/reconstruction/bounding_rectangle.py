# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The smallest rectangle around points of a plane."""

from __future__ import annotations

import numpy as np

from g2_recon.geometry.sorting import ascending
from g2_recon.kernels import inner_kernel, kernel


@kernel
def bounding_rectangle(x, y, stray):  # type: ignore[no-untyped-def]
    """The smallest rectangle around points, x and y (N,), N >= 1; a share `stray` at each side may lie beyond it.

    Returns cosine and sine of the angle from x to its first axis, and its low (2,) and high (2,) corner along its axes.
    One side of the smallest rectangle around all points is a side of their convex hull (Freeman and Shapira, 1975).
    """
    first, lower, upper = _ends_of_columns(x, y)
    low_side = _chain(first, lower, 1.0)
    high_side = _chain(first, upper, -1.0)
    hull_x, hull_y = np.empty(len(low_side) + len(high_side)), np.empty(len(low_side) + len(high_side))
    for i in range(len(low_side)):
        hull_x[i], hull_y[i] = first[low_side[i]], lower[low_side[i]]
    for i in range(len(high_side)):
        place = len(low_side) + i
        hull_x[place], hull_y[place] = first[high_side[i]], upper[high_side[i]]
    # Sides that join the two chains are upright: an angle of 0.
    cosine, sine = 1.0, 0.0
    smallest = _area(hull_x, hull_y, cosine, sine)
    for i in range(len(hull_x) - 1):
        along, across = hull_x[i + 1] - hull_x[i], hull_y[i + 1] - hull_y[i]
        length = np.sqrt(along * along + across * across)
        if i == len(low_side) - 1 or length == 0.0:
            continue
        # Of the two axes, the one in the first quadrant is the first.
        if across < 0.0:
            along, across = -across, along
        area = _area(hull_x, hull_y, along / length, across / length)
        if area < smallest:
            smallest, cosine, sine = area, along / length, across / length
    low, high, turned = np.empty(2), np.empty(2), np.empty(len(x))
    for i in range(len(x)):
        turned[i] = cosine * x[i] + sine * y[i]
    low[0], high[0] = _quantiles(turned, stray)
    for i in range(len(x)):
        turned[i] = cosine * y[i] - sine * x[i]
    low[1], high[1] = _quantiles(turned, stray)
    return cosine, sine, low, high


@inner_kernel
def _ends_of_columns(x, y):  # type: ignore[no-untyped-def]
    """The distinct x, ascending, and the lowest and the highest y at each; no other point is a corner of the hull."""
    columns, lower, upper = np.empty(len(x)), np.empty(len(x)), np.empty(len(x))
    count = 0
    for i in ascending(x):
        if count == 0 or x[i] > columns[count - 1]:
            columns[count], lower[count], upper[count] = x[i], y[i], y[i]
            count += 1
        else:
            lower[count - 1] = min(lower[count - 1], y[i])
            upper[count - 1] = max(upper[count - 1], y[i])
    return columns[:count], lower[:count], upper[:count]


@inner_kernel
def _chain(x, y, side):  # type: ignore[no-untyped-def]
    """Numbers of the points on the lower (side 1) or upper (-1) side of the convex hull; x ascends.

    Andrew's monotone chain, 1979.
    """
    chain = np.empty(len(x), np.int64)
    count = 0
    for i in range(len(x)):
        while count >= 2:
            a, b = chain[count - 2], chain[count - 1]
            if side * ((x[b] - x[a]) * (y[i] - y[a]) - (y[b] - y[a]) * (x[i] - x[a])) > 0.0:
                break
            count -= 1
        chain[count] = i
        count += 1
    return chain[:count]


@inner_kernel
def _area(x, y, cosine, sine):  # type: ignore[no-untyped-def]
    """Area of the rectangle around points whose first side has this direction."""
    low_u = low_v = np.inf
    high_u = high_v = -np.inf
    for i in range(len(x)):
        u, v = cosine * x[i] + sine * y[i], cosine * y[i] - sine * x[i]
        low_u, high_u, low_v, high_v = min(low_u, u), max(high_u, u), min(low_v, v), max(high_v, v)
    return (high_u - low_u) * (high_v - low_v)


@inner_kernel
def _quantiles(values, share):  # type: ignore[no-untyped-def]
    """The quantiles `share` and 1 - `share`, between two values in proportion."""
    last = len(values) - 1
    place = share * last
    rank = int(place)
    following = min(rank + 1, last)
    order = ascending(values)
    low, high = values[order[rank]], values[order[last - rank]]
    return (
        low + (place - rank) * (values[order[following]] - low),
        high - (place - rank) * (high - values[order[last - following]]),
    )
