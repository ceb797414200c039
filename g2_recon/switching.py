# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""How soon a thread gets the interpreter that another one holds."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

# Python's own is 5 ms. Tracking a scan takes 1 ms and gives the interpreter away a dozen times, at each kernel: while a
# thread beside it closes loops or draws maps it would wait far longer than it works.
_INTERVAL_S = 0.0005


def switch_soon() -> None:
    """From now on, in the whole process."""
    sys.setswitchinterval(min(_INTERVAL_S, sys.getswitchinterval()))


@contextmanager
def switching_soon() -> Iterator[None]:
    """Only meanwhile."""
    before = sys.getswitchinterval()
    switch_soon()
    try:
        yield
    finally:
        sys.setswitchinterval(before)
