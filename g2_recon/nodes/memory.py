# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Memory of a process that works for days: what it has, and what it gives back.

What the C library (all of it is there in glibc on Linux) does not offer is left out.
"""

from __future__ import annotations

import ctypes
import os
from pathlib import Path
from typing import Any

# M_ARENA_MAX, M_MMAP_THRESHOLD and M_TRIM_THRESHOLD of malloc.h, PR_SET_THP_DISABLE of sys/prctl.h.
_MOST_ARENAS, _APART_FROM, _KEPT_FREE, _DISABLE_HUGE_PAGES = -8, -3, -1, 41
# Arrays of at least so many bytes are given back at once where they are gone, as they are few. What is smaller comes
# and goes with every scan: twice as much is kept for it.
_LARGE = 1 << 20


def memory_mb() -> float:
    """Memory that this process has in RAM, MB; 0 where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def give_back_memory() -> None:
    """Have the C library give back to the system what it keeps of large arrays that are gone."""
    if trim := _of_the_c_library("malloc_trim"):
        trim(0)


def save_memory() -> None:
    """Let gaps between what stays be few and small, from now on.

    All threads take memory from one place: each would else have its own, with gaps of its own. Large arrays lie apart,
    and leave no gap at all. And pages are small ones: Linux would else make a large one of a few small ones that are in
    use, and of what lies between.
    """
    if set_option := _of_the_c_library("mallopt"):
        set_option(_MOST_ARENAS, 1)
        set_option(_APART_FROM, _LARGE)
        set_option(_KEPT_FREE, 2 * _LARGE)
    if control := _of_the_c_library("prctl"):
        control(_DISABLE_HUGE_PAGES, 1, 0, 0, 0)


def _of_the_c_library(name: str) -> Any | None:
    return getattr(ctypes.CDLL(None), name, None) if os.name == "posix" else None
