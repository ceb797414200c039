# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Parts of sessions as bytes, for messages and journals: arrays as they are, of which nothing is trusted."""

from __future__ import annotations

from typing import Any

import numpy as np

from g2_recon.errors import InputError
from g2_recon.geometry.session import SessionPart
from g2_recon.recording.npz import Layout
from g2_recon.recording.records import pack, unpack
from g2_recon.recording.session_journal import OF_GRAPH, OF_SCANS

_VERSION = 1
_NUMBERS = ("number", "count", "revision", "first")
_LAYOUT: Layout = {
    **dict.fromkeys(_NUMBERS, ("<i8", (1,))),
    "last_stamp": ("<f8", (1,)),
    "poses": ("<f8", ("N", 3)),
    "stamps": ("<f8", ("K",)),
    **OF_SCANS,
    **OF_GRAPH,
}


def pack_part(part: SessionPart) -> bytes:
    """The bytes of a part."""
    numbers = {name: np.array([getattr(part, name)]) for name in (*_NUMBERS, "last_stamp")}
    return pack(_VERSION, _LAYOUT, {name: getattr(part, name) for name in _LAYOUT} | numbers)


def unpack_part(content: bytes) -> SessionPart:
    """The part of bytes. Raises InputError where they are none, or numbers in it do not fit each other."""
    _, arrays = unpack(content, {_VERSION: _LAYOUT})
    if (arrays["broken"] > 1).any():
        raise InputError("broken of a session is neither true nor false")
    values: dict[str, Any] = arrays | {"broken": arrays["broken"].astype(bool)}
    values |= {name: arrays[name][0].item() for name in (*_NUMBERS, "last_stamp")}
    part = SessionPart(**values)
    if not (0 <= part.number < 2**32 and 0 <= part.first <= part.first + len(part.stamps) <= part.count):
        raise InputError("is a part of a session that has keyframes which are not there")
    if len(part.poses) not in (0, part.count) or (len(part.stamps) and not len(part.poses)):
        raise InputError("is a part of a session with another number of poses than of keyframes")
    return part
