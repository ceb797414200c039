# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Arrays in the records of a journal: a kind, the lengths that its layout leaves open, and the numbers as they are."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.recording.npz import Layout


def pack(kind: int, layout: Layout, arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """The payload of a record of a kind from 0 to 255: the arrays of the layout, in its order."""
    lengths: dict[str, int] = {}
    contents = []
    for name, (dtype, wanted) in layout.items():
        array = np.ascontiguousarray(arrays[name], np.dtype(dtype))
        for length, expected in zip(array.shape, wanted, strict=True):
            if length != (lengths.setdefault(expected, length) if isinstance(expected, str) else expected):
                raise ValueError(f"{name} is {array.shape}, not {wanted}")
        contents.append(array.tobytes())
    return bytes([kind]) + struct.pack(f"<{len(lengths)}I", *lengths.values()) + b"".join(contents)


def unpack(payload: bytes, layouts: Mapping[int, Layout]) -> tuple[int, dict[str, NDArray[Any]]]:
    """Kind and arrays of a record. Raises InputError where it is none of these kinds or not as long as it states."""
    layout = layouts.get(payload[0]) if payload else None
    if layout is None:
        raise InputError("is a record of an unknown kind", advice="read it with the release that wrote it")
    names = list(dict.fromkeys(length for _, shape in layout.values() for length in shape if isinstance(length, str)))
    head = struct.Struct(f"<{len(names)}I")
    if len(payload) < 1 + head.size:
        raise InputError("is a record that ends early")
    lengths = dict(zip(names, head.unpack_from(payload, 1), strict=True))
    shapes = {
        name: tuple(lengths[length] if isinstance(length, str) else length for length in shape)
        for name, (_, shape) in layout.items()
    }
    sizes = {name: math.prod(shapes[name]) * np.dtype(dtype).itemsize for name, (dtype, _) in layout.items()}
    if 1 + head.size + sum(sizes.values()) != len(payload):
        raise InputError("is a record of another length than it states")
    arrays, begin = {}, 1 + head.size
    for name, (dtype, _) in layout.items():
        count = math.prod(shapes[name])
        arrays[name] = np.frombuffer(payload, dtype, count, begin).reshape(shapes[name])
        begin += sizes[name]
    return payload[0], arrays
