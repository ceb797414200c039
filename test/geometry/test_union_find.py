# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from g2_recon.geometry.union_find import groups, link


def grouped(links, size):
    parent = np.arange(size)
    for one, other in links:
        link(parent, one, other)
    return groups(parent)


@pytest.mark.parametrize("seed", range(5))
def test_groups_are_the_connected_components(seed):
    links = np.random.default_rng(seed).integers(0, 50, (30, 2))
    graph = coo_array((np.ones(len(links)), links.T), shape=(50, 50))
    count, expected = connected_components(graph, directed=False)
    group, first = grouped(links, 50)
    assert len(first) == count
    assert len(set(zip(group.tolist(), expected.tolist(), strict=True))) == count


def test_groups_are_numbered_by_their_first_members_whatever_the_order_of_links():
    links = [(4, 2), (5, 4), (3, 1)]
    for order in (links, links[::-1], [pair[::-1] for pair in links]):
        group, first = grouped(order, 6)
        assert group.tolist() == [0, 1, 2, 1, 2, 2]
        assert first.tolist() == [0, 1, 2]
