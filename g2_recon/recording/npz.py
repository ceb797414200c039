# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Arrays (N, 3) in NPZ files; nothing is unpickled, and no memory is taken for what a header only claims."""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Sequence
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


def parse_npz(content: bytes, needed: Sequence[str], optional: Sequence[str] = ()) -> dict[str, NDArray[Any]]:
    """The named arrays (N, 3) of real numbers, those of `optional` only where they are there.

    Raises InputError if the file is damaged, lacks one that is needed, or one is something else.
    """
    try:
        with zipfile.ZipFile(BytesIO(content)) as archive:
            members = set(archive.namelist())
            for name in needed:
                if f"{name}.npy" not in members:
                    wanted = ", ".join([*needed, *(f"optional {name}" for name in optional)])
                    raise InputError(f"has no array '{name}'", advice=f"expected {wanted}, each (N, 3)")
            found = [name for name in (*needed, *optional) if f"{name}.npy" in members]
            return {name: _array(archive, f"{name}.npy") for name in found}
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, NotImplementedError, RuntimeError) as error:
        raise InputError(f"is no sound NPZ file: {str(error)[:_MAX_FAULT_LENGTH]}", advice=CUT_SHORT) from None


def _array(archive: zipfile.ZipFile, member: str) -> NDArray[Any]:
    """One array (N, 3); numpy.load would take the memory that its header claims before looking at its size."""
    entry = archive.getinfo(member)
    if entry.file_size > _MAX_DEFLATE_RATIO * max(entry.compress_size, 1):
        raise InputError(f"{member} claims more than its packed data can hold", advice=CUT_SHORT)
    with archive.open(entry) as stream:
        version = npy.read_magic(stream)
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, fortran_order, kind = read_header(stream)
        if kind.kind not in "fiu" or len(shape) != 2 or shape[1] != 3:
            raise InputError(
                f"{member} is {f'{kind} {shape}'[:_MAX_FAULT_LENGTH]}, not real numbers (N, 3)",
                advice="export it as numbers (N, 3)",
            )
        size = math.prod(shape) * kind.itemsize
        if size > entry.file_size:
            raise InputError(f"{member} states {size} bytes but has {entry.file_size}", advice=CUT_SHORT)
        content = stream.read(size)
    if len(content) < size:
        raise InputError(f"{member} ends early", advice=CUT_SHORT)
    return np.frombuffer(content, kind).reshape(shape, order="F" if fortran_order else "C")
