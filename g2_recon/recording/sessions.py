# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Mapping sessions in and out: NPZ files with a version, of which nothing is trusted."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from g2_recon.errors import InputError
from g2_recon.geometry.session import Session
from g2_recon.recording.files import check_exists, read_bytes, write_arrays
from g2_recon.recording.npz import Layout, parse_layout

VERSION = 1

MOST_BYTES = 1_000_000_000
"""A session has no more than this in memory: 160,000 keyframes of 361 beams."""

_LAYOUT: Layout = {
    "stamps": ("<f8", ("N",)),
    "poses": ("<f8", ("N", 3)),
    "points": ("<f4", ("N", "B", 2)),
    "normals": ("<f4", ("N", "B", 2)),
    "kinds": ("|u1", ("N", "B")),
    "firsts": ("<f8", ("N",)),
    "increments": ("<f8", ("N",)),
    "ways": ("<f8", ("N",)),
    "wheel_steps": ("<f8", ("N", 3)),
    "broken": ("|b1", ("N",)),
    "local_maps": ("<i8", ("C",)),
    "loops": ("<i8", ("L", 2)),
    "loop_information": ("<f8", ("L", 3, 3)),
}


def write_session(path: str | Path, session: Session) -> None:
    """Write a session as a compressed NPZ file; the same session gives the same bytes.

    Raises InputError where the file system refuses.
    """
    arrays: dict[str, Any] = {
        name: np.ascontiguousarray(getattr(session, name), np.dtype(kind)) for name, (kind, _) in _LAYOUT.items()
    }
    write_arrays(path, session_version=np.array([VERSION], "<i8"), **arrays)


def read_session(path: str | Path) -> Session:
    """Read a session that was written by `write_session`.

    Raises InputError if the file cannot be read, is none, is of another version, is damaged, or numbers in it are not
    finite or out of their range.
    """
    check_exists(path)
    size = Path(path).stat().st_size
    if size > MOST_BYTES:
        raise InputError(f"has {size} bytes, more than any session", where=path, advice="choose a session.npz")
    content = read_bytes(path)
    try:
        version = parse_layout(content, {"session_version": ("<i8", (1,))}, most_bytes=8)["session_version"][0]
        if version != VERSION:
            raise InputError(f"is a session of version {version}, not {VERSION}", advice="save it with this release")
        arrays = parse_layout(content, _LAYOUT, most_bytes=MOST_BYTES)
        if (arrays["broken"].view(np.uint8) > 1).any():
            raise InputError("broken of a session is neither true nor false", advice="save it again")
        return Session(**{field.name: arrays[field.name].copy() for field in fields(Session)})
    except InputError as error:
        raise InputError(str(error), where=path) from None
