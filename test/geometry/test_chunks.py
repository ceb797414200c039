# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import pytest

from g2_recon.geometry.chunks import in_chunks


@pytest.mark.parametrize("workers", [1, 3])
def test_all_parts_are_done_once_and_answer_in_order(workers):
    assert in_chunks(lambda begin, end: (begin, end), 10, workers, chunk=4) == [(0, 4), (4, 8), (8, 10)]


def test_nothing_is_done_for_nothing():
    assert in_chunks(lambda begin, end: (begin, end), 0, 2) == []


def test_an_error_in_a_part_is_not_lost():
    with pytest.raises(ZeroDivisionError):
        in_chunks(lambda begin, end: 1 // begin, 10, 2)
