# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Work on many points in parallel, in parts that do not depend on the number of workers."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

# Points a task: many tasks a worker, each large enough that its start costs nothing.
_CHUNK = 8192


def in_chunks(work: Callable[[int, int], None], size: int, workers: int) -> None:
    """Call work(begin, end) for parts of range(size) in threads: for kernels without the global interpreter lock."""
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(lambda begin: work(begin, min(begin + _CHUNK, size)), range(0, size, _CHUNK)))
