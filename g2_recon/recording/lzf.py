# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""LZF as in binary_compressed PCD files (Marc Lehmann's LibLZF): literal runs and references to what came before."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError

MAX_RATIO = 88
"""Three bytes of a reference unpack to at most 264."""


def decompress(packed: bytes, size: int) -> bytes:
    """The `size` bytes that `packed` unpacks to. Raises InputError if it is damaged or unpacks to another size."""
    if size > MAX_RATIO * len(packed):
        raise InputError(f"{len(packed)} packed bytes cannot hold {size}", advice="the file is cut short or damaged")
    unpacked = np.zeros(size, np.uint8)
    if _decompress(np.frombuffer(packed, np.uint8), unpacked) != size:
        raise InputError("the packed points are damaged", advice="export the file again")
    return unpacked.tobytes()


@numba.njit(cache=True)
def _decompress(packed: NDArray[np.uint8], unpacked: NDArray[np.uint8]) -> int:
    """Fill `unpacked`; returns the number of bytes written, -1 on a reference or run that leaves either array."""
    at, end = 0, 0
    while at < len(packed):
        control = int(packed[at])
        at += 1
        if control < 32:
            length = control + 1
            if at + length > len(packed) or end + length > len(unpacked):
                return -1
            for _ in range(length):
                unpacked[end] = packed[at]
                end += 1
                at += 1
            continue
        length = control >> 5
        if length == 7 and at < len(packed):
            length += int(packed[at])
            at += 1
        if at >= len(packed):
            return -1
        source = end - ((control & 31) << 8) - int(packed[at]) - 1
        at += 1
        length += 2
        if source < 0 or end + length > len(unpacked):
            return -1
        for _ in range(length):
            unpacked[end] = unpacked[source]
            end += 1
            source += 1
    return end
