# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Work on many points, faces or cells in parallel, in parts that do not depend on the number of workers."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Result = TypeVar("Result")

# Points a task: many tasks a worker, each large enough that its start costs nothing.
_CHUNK = 8192


def in_chunks(work: Callable[[int, int], Result], size: int, workers: int, *, chunk: int = _CHUNK) -> list[Result]:
    """What work(begin, end) returns for parts of range(size), called in threads.

    It is for kernels without the global interpreter lock, or where NumPy lets go of it. What would be one task only is
    done here: a live mesh asks for hundreds of such a second, for which threads would cost more than the work.
    """
    if workers == 1 or size <= chunk:
        return [work(begin, min(begin + chunk, size)) for begin in range(0, size, chunk)]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(lambda begin: work(begin, min(begin + chunk, size)), range(0, size, chunk)))


def taken(array: NDArray[Any], rows: NDArray[np.int64], workers: int) -> NDArray[Any]:
    """The rows (M,), all there, of an array (N, ...); the same as array[rows], in parallel."""
    result = np.empty((len(rows), *array.shape[1:]), array.dtype)

    def take(begin: int, end: int) -> None:
        # With mode `raise` NumPy would write to a copy first.
        array.take(rows[begin:end], axis=0, out=result[begin:end], mode="clip")

    in_chunks(take, len(rows), workers)
    return result
