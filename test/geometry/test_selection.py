# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from g2_recon.geometry.selection import select


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(st.integers(0, 6), min_size=1, max_size=40), st.integers(0, 39))
def test_no_greater_value_is_before_the_middle_and_no_smaller_one_behind(values, middle):
    middle %= len(values)
    points, number = np.zeros((len(values), 3)), np.arange(len(values))
    points[:, 1] = values
    points[:, 2] = number
    select(points, number, 1, 0, len(values), middle)
    assert points[middle, 1] == sorted(values)[middle]
    assert (points[:middle, 1] <= points[middle, 1]).all()
    assert (points[middle:, 1] >= points[middle, 1]).all()
    assert (points[:, 2] == number).all()
    assert (points[:, 1] == np.array(values)[number]).all()


@pytest.mark.parametrize("axis", range(3))
def test_rows_outside_of_the_range_stay(axis):
    before = np.random.default_rng(axis).normal(size=(30, 3))
    points, number = before.copy(), np.arange(30)
    select(points, number, axis, 10, 20, 15)
    assert (points[:10] == before[:10]).all()
    assert (points[20:] == before[20:]).all()
    assert sorted(number[10:20].tolist()) == list(range(10, 20))
