# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Whole files in and out: every fault of the file system ends in one InputError, no file is left half written."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError


def check_exists(path: str | Path) -> None:
    """Raises InputError if there is no file or directory of that name, or it may not be looked at."""
    try:
        Path(path).stat()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", where=path, advice="check the path") from error


def read_bytes(path: str | Path) -> bytes:
    """The content of a file. Raises InputError if it cannot be read or is empty."""
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror or error}", where=path, advice="check the path and its permissions"
        ) from error
    if not content:
        raise InputError("the file is empty", where=path, advice="record or export it again")
    return content


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """A path beside `path`, with the same ending, to write to; it takes the place of `path` when all went well.

    Missing parent folders are made. On any exception nothing is left and an older file stays as it was. Raises
    InputError where the file system refuses.
    """
    target = Path(path)
    temporary = target.parent / f".{target.stem}.{uuid4().hex[:8]}{target.suffix}"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        temporary.replace(target)
    except OSError as error:
        raise InputError(
            f"cannot be written: {error.strerror or error}", where=path, advice="choose another place or make room"
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file whole or not at all. Raises InputError where the file system refuses."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_arrays(path: str | Path, **arrays: NDArray[Any]) -> None:
    """Write arrays as a compressed NPZ file. Raises InputError where the file system refuses."""
    members: dict[str, Any] = dict(arrays)  # Any: some NumPy's stubs take the values for allow_pickle
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, **members)
