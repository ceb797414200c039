# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Halving points at a median, as trees of boxes are made."""

from __future__ import annotations

from g2_recon.kernels import kernel


@kernel
def select(points, number, axis, begin, end, middle):  # type: ignore[no-untyped-def]
    """Order rows `begin` to `end` of points (N, 3), and number (N,) with them, in place, by their coordinate `axis`.

    Then no greater ones are before `middle` and no smaller ones from there on. Hoare, "Algorithm 65: find", 1961.
    """
    low, high = begin, end - 1
    # Pivots at random (Park and Miller, 1988): scans, and faces in strips, come in orders that make any fixed place a
    # bad one.
    random = 1
    while low < high:
        random = random * 48271 % 2147483647
        pivot = points[low + random % (high - low + 1), axis]
        i, j = low, high
        while i <= j:
            while points[i, axis] < pivot:
                i += 1
            while points[j, axis] > pivot:
                j -= 1
            if i <= j:
                for a in range(3):
                    points[i, a], points[j, a] = points[j, a], points[i, a]
                number[i], number[j] = number[j], number[i]
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return
