# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Points in PLY files: text or binary of either byte order, vertex properties of any type in any order."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud
from g2_recon.recording.cloud_tables import (
    binary_table,
    cloud_table,
    cut_header,
    points_and_sensor,
    stated_count,
    text_table,
)

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_NO_LISTS: Mapping[str, str] = MappingProxyType({})
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class _Element:
    """One element of the header; types: of each property by its name, in order."""

    name: str
    count: int
    types: dict[str, str] = field(default_factory=dict)
    has_lists: bool = False


def parse_ply(content: bytes) -> Cloud:
    """The vertices of a PLY file, with the sensor from properties `vx vy vz`; anything after them is not looked at.

    Raises InputError if the file is malformed or cut short.
    """
    lines, body = cut_header(content, "end_header")
    if lines[0] != ["ply"]:
        raise InputError("is no PLY file", advice="check the file")
    byte_order, elements = _parse_header(lines)
    for element in elements:
        if element.has_lists:
            break
        if element.name == "vertex":
            return Cloud(*points_and_sensor(_vertex_table(body, element, byte_order)))
        body = _skip(body, element, byte_order)
    raise InputError("has no vertex element before its lists", advice="export points without list properties")


def write_ply(path: Path, cloud: Cloud) -> None:
    """Write a binary PLY file with properties x y z and, where known, vx vy vz, all double."""
    table = cloud_table(cloud, "<f8")
    path.write_bytes(ply_header([("vertex", table)]) + table.tobytes())


def ply_header(elements: list[tuple[str, NDArray[Any]]], lists: Mapping[str, str] = _NO_LISTS) -> bytes:
    """The header of a binary little-endian PLY file whose elements are structured arrays (N,).

    lists: by the column that counts the items of a list, the column that comes next and holds them.
    """
    names = {np.dtype(code): name for name, code in _TYPES.items() if not name[-1].isdigit()}
    lines = ["ply", "format binary_little_endian 1.0"]
    for element, table in elements:
        lines.append(f"element {element} {len(table)}")
        for name in table.dtype.names or ():
            kind = names[table.dtype[name].base]
            if name in lists:
                kind = f"list {kind} {names[table.dtype[lists[name]].base]}"
            if name not in lists.values():
                lines.append(f"property {kind} {lists.get(name, name)}")
    return "\n".join([*lines, "end_header\n"]).encode("ascii")


def _parse_header(lines: list[list[str]]) -> tuple[str, list[_Element]]:
    """Byte order, "" for text, and elements."""
    byte_order: str | None = None
    elements: list[_Element] = []
    for words in lines[1:]:
        match words:
            case ["format", name, *_] if name in _BYTE_ORDERS:
                byte_order = _BYTE_ORDERS[name]
            case ["element", name, count]:
                elements.append(_Element(name, stated_count(count, f"the number of {name[:40]}")))
            case ["property", "list", *_] if elements:
                elements[-1].has_lists = True
            case ["property", kind, name] if elements and kind in _TYPES and name not in elements[-1].types:
                elements[-1].types[name] = _TYPES[kind]
            case [] | ["comment" | "obj_info" | "end_header", *_]:
                pass
            case _:
                raise InputError(f"header line {' '.join(words)[:60]!r} is not known", advice="the header is damaged")
    if byte_order is None:
        raise InputError("has no known format in its header", advice=f"use one of {', '.join(_BYTE_ORDERS)}")
    return byte_order, elements


def _vertex_table(body: bytes, element: _Element, byte_order: str) -> NDArray[Any]:
    if byte_order:
        return binary_table(body, _row_type(element, byte_order), element.count)
    columns = {name: index for index, name in enumerate(element.types)}
    return text_table(body, columns, element.count, len(columns))


def _row_type(element: _Element, byte_order: str) -> np.dtype[Any]:
    return np.dtype([(name, byte_order + kind) for name, kind in element.types.items()])


def _skip(body: bytes, element: _Element, byte_order: str) -> bytes:
    """What comes after an element without lists."""
    if byte_order:
        return body[element.count * _row_type(element, byte_order).itemsize :]
    return b"".join(body.split(b"\n", min(element.count, len(body)))[element.count :])
