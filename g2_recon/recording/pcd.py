# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Points in PCD files (Point Cloud Library, version 0.7): text, binary and packed, any fields in any order."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud
from g2_recon.recording import lzf
from g2_recon.recording.cloud_tables import (
    CUT_SHORT,
    binary_table,
    cloud_table,
    cut_header,
    points_and_sensor,
    stated_count,
    text_table,
)

_log = logging.getLogger(__name__)

_MAX_POINT_BYTES = 1 << 20
_TYPES = {
    **{("F", size): f"<f{size}" for size in (4, 8)},
    **{("I", size): f"<i{size}" for size in (1, 2, 4, 8)},
    **{("U", size): f"<u{size}" for size in (1, 2, 4, 8)},
}


@dataclass(frozen=True)
class _Field:
    """One field: its name, type of one number, and how many numbers a point has of it."""

    name: str
    kind: str
    count: int

    @property
    def size(self) -> int:
        return int(np.dtype(self.kind).itemsize) * self.count


def parse_pcd(content: bytes) -> Cloud:
    """The points of a PCD file, organized or not, with the sensor from fields `vx vy vz` or else the VIEWPOINT.

    VIEWPOINT is by that format where the points were seen from, in their frame; all zero is the sensor's own frame.
    Without that line the sensor is not known. Raises InputError if the file is malformed or cut short.
    """
    lines, body = cut_header(content, "DATA")
    header = {words[0]: words[1:] for words in lines if words and not words[0].startswith("#")}
    fields, rows = _parse_fields(header), _parse_rows(header)
    match header["DATA"]:
        case ["ascii"]:
            table = _text_points(body, fields, rows)
        case ["binary"]:
            table = binary_table(body, _layout(fields), rows)
        case ["binary_compressed"]:
            table = _unpack(body, fields, rows)
        case other:
            raise InputError(f"has data of kind {' '.join(other)[:40]!r}", advice="use ascii or binary")
    points, sensor = points_and_sensor(table)
    return Cloud(points, _viewpoint(header, len(points)) if sensor is None else sensor)


def write_pcd(path: Path, cloud: Cloud) -> None:
    """Write a binary PCD file with fields x y z and, where known, vx vy vz, all float32, as PCL expects them."""
    table = cloud_table(cloud, "<f4")
    names = table.dtype.names or ()
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join('4' for _ in names)}",
        f"TYPE {' '.join('F' for _ in names)}",
        f"COUNT {' '.join('1' for _ in names)}",
        f"WIDTH {len(table)}",
        "HEIGHT 1",
        f"POINTS {len(table)}",
        "DATA binary\n",
    ]
    path.write_bytes("\n".join(lines).encode("ascii") + table.tobytes())


def _parse_fields(header: dict[str, list[str]]) -> list[_Field]:
    names, sizes, kinds = (header.get(key, []) for key in ("FIELDS", "SIZE", "TYPE"))
    counts = header.get("COUNT", ["1"] * len(names))
    if not names or not len(names) == len(sizes) == len(kinds) == len(counts):
        raise InputError("FIELDS, SIZE, TYPE and COUNT do not match", advice="the header is damaged")
    fields = []
    for name, size, kind, count in zip(names, sizes, kinds, counts, strict=True):
        code = _TYPES.get((kind, stated_count(size, "a SIZE")))
        if code is None:
            raise InputError(f"field {name[:40]!r} has unknown type {kind[:10]} {size}", advice="use F, I or U")
        fields.append(_Field(name, code, stated_count(count, "a COUNT")))
    point_bytes = sum(field.size for field in fields)
    if point_bytes > _MAX_POINT_BYTES:
        raise InputError(f"states points of {point_bytes} bytes each", advice="the header is damaged")
    for name in ("x", "y", "z"):
        if [field.count for field in fields if field.name == name] != [1]:
            raise InputError(f"needs one field {name} with one number", advice="export points with coordinates")
    return fields


def _parse_rows(header: dict[str, list[str]]) -> int:
    stated = {key: stated_count(" ".join(header[key]), key) for key in ("WIDTH", "HEIGHT", "POINTS") if key in header}
    grid = stated["WIDTH"] * stated.get("HEIGHT", 1) if "WIDTH" in stated else None
    rows = stated.get("POINTS", grid)
    if rows is None or (grid is not None and rows != grid):
        raise InputError("POINTS is not WIDTH times HEIGHT", advice="the header is damaged")
    return rows


def _wanted(fields: list[_Field]) -> dict[str, int]:
    """Index of each field that is read, by its name."""
    wanted = ("x", "y", "z", "vx", "vy", "vz")
    return {field.name: index for index, field in enumerate(fields) if field.name in wanted and field.count == 1}


def _layout(fields: list[_Field]) -> np.dtype[Any]:
    offsets = np.cumsum([0, *(field.size for field in fields)]).tolist()
    wanted = _wanted(fields)
    return np.dtype(
        {
            "names": list(wanted),
            "formats": [fields[index].kind for index in wanted.values()],
            "offsets": [offsets[index] for index in wanted.values()],
            "itemsize": offsets[-1],
        }
    )


def _text_points(body: bytes, fields: list[_Field], rows: int) -> NDArray[Any]:
    starts = np.cumsum([0, *(field.count for field in fields)]).tolist()
    columns = {name: starts[index] for name, index in _wanted(fields).items()}
    return text_table(body, columns, rows, starts[-1])


def _unpack(body: bytes, fields: list[_Field], rows: int) -> NDArray[Any]:
    """Packed points: two sizes, then all values of the first field, of the second, and so on, as one LZF stream."""
    if len(body) < 8:
        raise InputError("ends before its points", advice=CUT_SHORT)
    packed_size, size = np.frombuffer(body, "<u4", 2).tolist()
    if packed_size > len(body) - 8:
        raise InputError(f"states {packed_size} packed bytes but has {len(body) - 8}", advice=CUT_SHORT)
    if size != rows * sum(field.size for field in fields):
        raise InputError("the size of the packed points does not match the header", advice="the header is damaged")
    unpacked = lzf.decompress(body[8 : 8 + packed_size], size)
    starts = np.cumsum([0, *(rows * field.size for field in fields)]).tolist()
    wanted = _wanted(fields)
    table = np.empty(rows, [(name, fields[index].kind) for name, index in wanted.items()])
    for name, index in wanted.items():
        table[name] = np.frombuffer(unpacked, fields[index].kind, rows, starts[index])
    return table


def _viewpoint(header: dict[str, list[str]], count: int) -> NDArray[np.float64] | None:
    if "VIEWPOINT" not in header:
        return None
    try:
        position = np.array(header["VIEWPOINT"][:3], float)
    except ValueError:
        position = np.empty(0)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise InputError("VIEWPOINT is not a position and a quaternion", advice="the header is damaged")
    _log.info("taking VIEWPOINT (%g, %g, %g) as where all points were seen from", *position)
    return np.tile(position, (count, 1))
