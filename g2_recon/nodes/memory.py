# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Memory of a process that works for days: what it has, and what it gives back (glibc; elsewhere nothing is done)."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path
from typing import Any

# M_ARENA_MAX of malloc.h.
_MOST_ARENAS = -8


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


def share_memory_among_threads() -> None:
    """Have all threads that begin from now on take memory from one place.

    Each would else have its own, and in each what is gone leaves gaps: as much again as what a thread beside has made.
    """
    if set_option := _of_the_c_library("mallopt"):
        set_option(_MOST_ARENAS, 1)


def _of_the_c_library(name: str) -> Any | None:
    return getattr(ctypes.CDLL(None), name, None) if os.name == "posix" else None
