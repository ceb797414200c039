# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Arrays in NPZ files; nothing is unpickled, and no memory is taken for what a header only claims."""

from __future__ import annotations

import math
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BytesIO
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.recording.cloud_tables import CUT_SHORT

_MAX_FAULT_LENGTH = 200
_MAX_DEFLATE_RATIO = 1100
"""Deflate packs at most 1032 to 1: a member of an NPZ file that claims more is damaged or hostile."""


_NOT_THREE_COLUMNS = "not real numbers (N, 3)"

Layout = Mapping[str, tuple[str, tuple[int | str, ...]]]
"""Of arrays by name: type of the numbers, and shape; where a length has the same name, it is the same."""

_Check = Callable[[tuple[int, ...], "np.dtype[Any]"], str]


def parse_npz(content: bytes, needed: Sequence[str], optional: Sequence[str] = ()) -> dict[str, NDArray[Any]]:
    """The named arrays (N, 3) of real numbers, those of `optional` only where they are there.

    Raises InputError if the file is damaged, lacks one that is needed, or one is something else.
    """
    with _opened(content) as archive:
        members = set(archive.namelist())
        for name in needed:
            if f"{name}.npy" not in members:
                wanted = ", ".join([*needed, *(f"optional {name}" for name in optional)])
                raise InputError(f"has no array '{name}'", advice=f"expected {wanted}, each (N, 3)")
        found = [name for name in (*needed, *optional) if f"{name}.npy" in members]
        return {name: _array(archive, f"{name}.npy", _three_columns) for name in found}


def parse_layout(content: bytes, layout: Layout, *, most_bytes: int) -> dict[str, NDArray[Any]]:
    """The arrays of a layout, all of them, of just the types and shapes that it says, together not above a size.

    Raises InputError if the file is damaged, or one is missing or something else.
    """
    lengths: dict[str, int] = {}
    left = most_bytes

    def check(name: str) -> _Check:
        def fault(shape: tuple[int, ...], kind: np.dtype[Any]) -> str:
            nonlocal left
            wanted_kind, wanted = layout[name]
            if kind.str != wanted_kind or len(shape) != len(wanted):
                return f"not {np.dtype(wanted_kind)} {wanted}".replace("'", "")
            for length, expected in zip(shape, wanted, strict=True):
                if length != (lengths.setdefault(expected, length) if isinstance(expected, str) else expected):
                    return f"not {wanted} as the other arrays have it".replace("'", "")
            left -= math.prod(shape) * kind.itemsize
            return f"more than the {most_bytes} bytes that all may have" if left < 0 else ""

        return fault

    with _opened(content) as archive:
        members = set(archive.namelist())
        missing = [name for name in layout if f"{name}.npy" not in members]
        if missing:
            raise InputError(f"has no array '{missing[0]}'", advice=f"expected {', '.join(layout)}")
        return {name: _array(archive, f"{name}.npy", check(name)) for name in layout}


@contextmanager
def _opened(content: bytes) -> Iterator[zipfile.ZipFile]:
    faults = (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, NotImplementedError, RuntimeError)
    try:
        with zipfile.ZipFile(BytesIO(content)) as archive:
            yield archive
    except (*faults, SyntaxError, tokenize.TokenError) as error:
        raise InputError(f"is no sound NPZ file: {str(error)[:_MAX_FAULT_LENGTH]}", advice=CUT_SHORT) from None


def _three_columns(shape: tuple[int, ...], kind: np.dtype[Any]) -> str:
    return "" if kind.kind in "fiu" and len(shape) == 2 and shape[1] == 3 else _NOT_THREE_COLUMNS


def _array(archive: zipfile.ZipFile, member: str, check: _Check) -> NDArray[Any]:
    """One array in which `check` finds no fault; numpy.load would take the memory that its header claims at once."""
    entry = archive.getinfo(member)
    if entry.file_size > _MAX_DEFLATE_RATIO * max(entry.compress_size, 1):
        raise InputError(f"{member} claims more than its packed data can hold", advice=CUT_SHORT)
    with archive.open(entry) as stream:
        version = npy.read_magic(stream)
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, fortran_order, kind = read_header(stream)
        fault = "no shape" if min(shape, default=0) < 0 else check(shape, kind)
        if fault:
            raise InputError(
                f"{member} is {f'{kind} {shape}'[:_MAX_FAULT_LENGTH]}, {fault}",
                advice="export it as numbers (N, 3)" if fault == _NOT_THREE_COLUMNS else "save it again",
            )
        size = math.prod(shape) * kind.itemsize
        if size > entry.file_size:
            raise InputError(f"{member} states {size} bytes but has {entry.file_size}", advice=CUT_SHORT)
        content = stream.read(size)
    if len(content) < size:
        raise InputError(f"{member} ends early", advice=CUT_SHORT)
    return np.frombuffer(content, kind).reshape(shape, order="F" if fortran_order else "C")
