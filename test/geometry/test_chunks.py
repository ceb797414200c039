# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry.chunks import in_chunks, taken


@pytest.mark.parametrize("workers", [1, 3])
def test_all_parts_are_done_once_and_answer_in_order(workers):
    assert in_chunks(lambda begin, end: (begin, end), 10, workers, chunk=4) == [(0, 4), (4, 8), (8, 10)]


def test_nothing_is_done_for_nothing():
    assert in_chunks(lambda begin, end: (begin, end), 0, 2) == []


def test_an_error_in_a_part_is_not_lost():
    with pytest.raises(ZeroDivisionError):
        in_chunks(lambda begin, end: 1 // begin, 10, 2)


@pytest.mark.parametrize("shape", [(9000,), (9000, 3)])
def test_taken_rows_are_those_that_an_index_names(shape):
    rng = np.random.default_rng(0)
    array, rows = rng.normal(size=shape), rng.integers(0, 9000, 20_000)
    assert (taken(array, rows, 2) == array[rows]).all()
    assert taken(array, rows[:0], 2).shape == (0, *shape[1:])
