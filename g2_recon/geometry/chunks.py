# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Work on many points, faces or cells in parallel, in parts that do not depend on the number of workers."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from threading import local
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Result = TypeVar("Result")

# Points a task: many tasks a worker, each large enough that to hand it over costs nothing.
_CHUNK = 2048

_own = local()


def in_chunks(work: Callable[[int, int], Result], size: int, workers: int, *, chunk: int = _CHUNK) -> list[Result]:
    """What work(begin, end) returns for parts of range(size), called in threads.

    It is for kernels without the global interpreter lock, or where NumPy lets go of it. A live mesh asks for hundreds
    of such a second, and a thread may take milliseconds to begin where processors are busy: so the caller takes parts
    like all others, and waits for none that have not begun when nothing is left.
    """
    if workers == 1 or size <= chunk:
        return [work(begin, min(begin + chunk, size)) for begin in range(0, size, chunk)]
    left = deque(range(0, size, chunk))
    results: list[Any] = [None] * len(left)

    def take_part() -> None:
        try:
            while True:
                try:
                    begin = left.popleft()
                except IndexError:
                    return
                results[begin // chunk] = work(begin, min(begin + chunk, size))
        finally:
            # After an error, or an interrupt, nobody needs the rest.
            left.clear()

    helpers: list[Future[None]] = []
    try:
        helpers.extend(_helpers().submit(take_part) for _ in range(min(workers, len(left)) - 1))
        take_part()
    finally:
        left.clear()
        begun = [helper for helper in helpers if not helper.cancel()]
        wait(begun)
    for helper in begun:
        helper.result()
    return results


def _helpers() -> ThreadPoolExecutor:
    """The threads that help this thread, and end with it: they have its priority, as it starts them."""
    if not hasattr(_own, "helpers"):
        _own.helpers = ThreadPoolExecutor(os.cpu_count(), "chunks")
    helpers: ThreadPoolExecutor = _own.helpers
    return helpers


if hasattr(os, "register_at_fork"):
    # The child of a fork has none of the threads of its parent.
    os.register_at_fork(after_in_child=lambda: _own.__dict__.clear())


def taken(array: NDArray[Any], rows: NDArray[np.int64], workers: int) -> NDArray[Any]:
    """The rows (M,), all there, of an array (N, ...); the same as array[rows], in parallel."""
    result = np.empty((len(rows), *array.shape[1:]), array.dtype)

    def take(begin: int, end: int) -> None:
        # With mode `raise` NumPy would write to a copy first.
        array.take(rows[begin:end], axis=0, out=result[begin:end], mode="clip")

    in_chunks(take, len(rows), workers)
    return result
