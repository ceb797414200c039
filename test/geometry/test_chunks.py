# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import os
import threading
import time

import numpy as np
import pytest

from g2_recon.geometry import chunks
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


def test_many_threads_do_each_part_once():
    seen = []

    def work(begin, end):
        seen.append(begin)
        return sum(in_chunks(lambda low, high: high - low, end - begin, 3, chunk=10))

    for _ in range(20):
        seen.clear()
        assert sum(in_chunks(work, 10_000, 4, chunk=100)) == 10_000
        assert sorted(seen) == list(range(0, 10_000, 100))


@pytest.mark.parametrize("in_caller", [True, False])
def test_an_error_of_one_thread_ends_the_work_of_all(in_caller):
    done = []

    def work(begin, end):
        if (threading.current_thread() is threading.main_thread()) == in_caller:
            raise ValueError("no more")
        time.sleep(1e-3)
        done.append(begin)

    with pytest.raises(ValueError, match="no more"):
        in_chunks(work, 2_000, 2, chunk=1)
    time.sleep(0.1)
    assert len(done) < 1_000


def test_the_caller_does_not_wait_for_threads_that_have_not_begun():
    over = threading.Event()
    held = [chunks._helpers().submit(over.wait, 10) for _ in range(os.cpu_count())]
    assert in_chunks(lambda begin, end: begin, 3, 2, chunk=1) == [0, 1, 2]
    assert not any(each.done() for each in held)
    over.set()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_the_child_of_a_fork_works_without_the_threads_of_its_parent():
    in_chunks(lambda begin, end: time.sleep(1e-3), 100, 2, chunk=1)
    child = os.fork()
    if not child:
        all_done = False
        try:
            all_done = in_chunks(lambda begin, end: 1, 3, 2, chunk=1) == [1, 1, 1]
        finally:
            os._exit(0 if all_done else 1)
    assert os.waitpid(child, 0)[1] == 0
