# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry.sorting import ascending, sort_by_counting


@pytest.mark.parametrize("count", [0, 1, 2, 15, 16, 17, 31, 32, 33, 100, 1000, 4097])
@pytest.mark.parametrize("distinct", [1, 3, 10_000])
def test_values_are_sorted_and_equal_ones_keep_their_order(count: int, distinct: int) -> None:
    values = np.random.default_rng(count).integers(0, distinct, count).astype(float)
    assert ascending(values).tolist() == np.argsort(values, kind="stable").tolist()
    assert ascending(-np.sort(values)).tolist() == np.argsort(-np.sort(values), kind="stable").tolist()


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_numbers_are_sorted_by_counting(count: int) -> None:
    number = np.random.default_rng(0).integers(0, 7, count)
    order, begin = sort_by_counting(number, 8)
    assert order.tolist() == np.argsort(number, kind="stable").tolist()
    assert begin.tolist() == np.searchsorted(np.sort(number), np.arange(9)).tolist()
