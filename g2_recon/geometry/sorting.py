# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Orders of what is sorted, as kernels."""

from __future__ import annotations

import numpy as np

from g2_recon.kernels import kernel

# Shorter runs are sorted faster by insertion than by merging.
_RUN = 16


@kernel
def sort_by_counting(number, count):  # type: ignore[no-untyped-def]
    """The order (N,) that sorts numbers below `count`, equal ones as they come, and where (count + 1,) each begins."""
    begin = np.zeros(count + 1, np.int64)
    for row in range(len(number)):
        begin[number[row] + 1] += 1
    for group in range(count):
        begin[group + 1] += begin[group]
    end = begin[:-1].copy()
    order = np.empty(len(number), np.int64)
    for row in range(len(number)):
        order[end[number[row]]] = row
        end[number[row]] += 1
    return order, begin


@kernel
def ascending(values):  # type: ignore[no-untyped-def]
    """The order (N,) that sorts values (N,), equal ones as they come; Numba takes far longer to compile argsort.

    Where some are not a number, some order. Runs by insertion, then merged (Knuth, The Art of Computer Programming,
    volume 3, section 5.2.4).
    """
    count = len(values)
    order, other = np.empty(count, np.int64), np.empty(count, np.int64)
    for row in range(count):
        value, place = values[row], row
        while place % _RUN and values[order[place - 1]] > value:
            order[place] = order[place - 1]
            place -= 1
        order[place] = row
    width = _RUN
    while width < count:
        for begin in range(0, count, 2 * width):
            middle, end = min(begin + width, count), min(begin + 2 * width, count)
            one, two = begin, middle
            for place in range(begin, end):
                if two == end or (one < middle and values[order[one]] <= values[order[two]]):
                    other[place] = order[one]
                    one += 1
                else:
                    other[place] = order[two]
                    two += 1
        order, other = other, order
        width *= 2
    return order
