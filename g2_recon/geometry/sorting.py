# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Orders of what is sorted, as kernels."""

from __future__ import annotations

import numpy as np

from g2_recon.kernels import kernel


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
