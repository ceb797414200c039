# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Work on many points, faces or cells in parallel, in parts that do not depend on the number of workers."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")

# Points a task: many tasks a worker, each large enough that its start costs nothing.
_CHUNK = 8192


def in_chunks(work: Callable[[int, int], Result], size: int, workers: int, *, chunk: int = _CHUNK) -> list[Result]:
    """What work(begin, end) returns for parts of range(size), called in threads.

    It is for kernels without the global interpreter lock, or where NumPy lets go of it.
    """
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(lambda begin: work(begin, min(begin + chunk, size)), range(0, size, chunk)))
