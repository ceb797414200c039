# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Groups of what hangs together: union-find with path halving (Tarjan and van Leeuwen, 1984), as kernels.

At first, each member is its own parent: np.arange(N). The root of a group is its first member, so that groups do not
depend on the order of the links.
"""

from __future__ import annotations

import numpy as np

from g2_recon.kernels import inner_kernel, kernel


@kernel
def link(parent, one, other):  # type: ignore[no-untyped-def]
    """Join the groups of two members; parent (N,) is changed in place."""
    first, second = _root(parent, one), _root(parent, other)
    parent[max(first, second)] = min(first, second)


@kernel
def groups(parent):  # type: ignore[no-untyped-def]
    """The group (N,) of each member, numbered by first members, and the first member (G,) of each group."""
    group, first = np.empty(len(parent), np.int64), np.empty(len(parent), np.int64)
    count = 0
    for member in range(len(parent)):
        root = _root(parent, member)
        if root == member:
            first[count] = member
            group[member] = count
            count += 1
        else:
            group[member] = group[root]
    return group, first[:count].copy()


@kernel
def linked(one, other, size):  # type: ignore[no-untyped-def]
    """The group (size,) of each member of what hangs together by links one (L,) to other (L,), and its first member."""
    parent = np.arange(size)
    for number in range(len(one)):
        link(parent, one[number], other[number])
    return groups(parent)


@inner_kernel
def _root(parent, member):  # type: ignore[no-untyped-def]
    while parent[member] != member:
        parent[member] = parent[parent[member]]
        member = parent[member]
    return member
