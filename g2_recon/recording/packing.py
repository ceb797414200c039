# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Packed files, which may be cut short, damaged or made to unpack without end."""

from __future__ import annotations

import bz2
import zlib
from typing import Protocol

from g2_recon.errors import InputError

GZIP = b"\x1f\x8b"
"""How a gzip file begins."""

_MAX_UNPACKED_BYTES = 2 << 30
_PIECE = 4096
"""Packed bytes unpacked at once; small, so that a hostile file cannot unpack to more than some 100 MB at a time."""


class _Decompressor(Protocol):
    def decompress(self, data: bytes, /) -> bytes: ...

    @property
    def eof(self) -> bool: ...

    @property
    def unused_data(self) -> bytes: ...


def unpack(packed: bytes, *, where: object) -> tuple[bytes, str]:
    """The content of a plain, gzip or bzip2 file as far as it can be read, and a complaint if that is not all.

    Raises InputError, which names `where`, if there is too much of it.
    """
    if not packed.startswith((GZIP, b"BZh")):
        return packed, ""
    pieces: list[bytes] = []
    size = position = 0
    unpacker = _new_unpacker(packed)
    while position < len(packed):
        piece = packed[position : position + _PIECE]
        try:
            pieces.append(unpacker.decompress(piece))
        except (zlib.error, OSError, EOFError, ValueError):
            return b"".join(pieces), "damaged place in the packed file (the rest is lost)"
        position += len(piece)
        size += len(pieces[-1])
        if size > _MAX_UNPACKED_BYTES:
            raise InputError(f"unpacks to more than {_MAX_UNPACKED_BYTES >> 30} GiB", where=where, advice="split it")
        if unpacker.eof:
            position -= len(unpacker.unused_data)
            if not packed[position:].strip(b"\0"):
                return b"".join(pieces), ""
            unpacker = _new_unpacker(packed)
    return b"".join(pieces), "packed file that ends early (the rest is lost)"


def _new_unpacker(packed: bytes) -> _Decompressor:
    return zlib.decompressobj(wbits=31) if packed.startswith(GZIP) else bz2.BZ2Decompressor()
