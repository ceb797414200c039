# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What the readers and writers of PLY and PCD share: tables of named columns, checked against the file's size.

A header is never believed: what it claims is checked before memory is taken for it.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud

CUT_SHORT = "the file is cut short or damaged"
_POINT, _SENSOR = ("x", "y", "z"), ("vx", "vy", "vz")
_MAX_HEADER_BYTES = 1 << 16


def points_and_sensor(table: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """The columns x y z and, where all are there, vx vy vz of a structured array (N,), each (N, 3)."""
    names = set(table.dtype.names or ())
    if not names >= set(_POINT):
        raise InputError("has no x, y and z", advice="export points with coordinates")
    return _stack(table, _POINT), _stack(table, _SENSOR) if names >= set(_SENSOR) else None


def _stack(table: NDArray[Any], names: tuple[str, ...]) -> NDArray[np.float64]:
    with np.errstate(invalid="ignore"):  # a signaling NaN becomes a quiet one
        return np.column_stack([table[name].astype(np.float64) for name in names])


def cloud_table(cloud: Cloud, kind: DTypeLike) -> NDArray[Any]:
    """A cloud as a structured array (N,) with columns x y z and, where known, vx vy vz."""
    names = _POINT if cloud.sensor is None else _POINT + _SENSOR
    columns = cloud.points if cloud.sensor is None else np.hstack([cloud.points, cloud.sensor])
    table = np.empty(len(cloud), [(name, kind) for name in names])
    for name, column in zip(names, columns.T, strict=True):
        table[name] = column
    return table


def cut_header(content: bytes, last: str) -> tuple[list[list[str]], bytes]:
    """The words of each header line up to the one whose first word is `last`, that one too, and what comes after it."""
    lines: list[list[str]] = []
    start = 0
    while start < _MAX_HEADER_BYTES:
        end = content.find(b"\n", start, start + _MAX_HEADER_BYTES)
        if end < 0:
            break
        lines.append(content[start:end].decode("latin-1").split())
        start = end + 1
        if lines[-1][:1] == [last]:
            return lines, content[start:]
    raise InputError(f"has no {last} in its header", advice="the file is cut short or of another kind")


def stated_count(text: str, what: str) -> int:
    """A count that a header states."""
    if not (text.isascii() and text.isdecimal() and len(text) < 16):
        raise InputError(f"{what} is {text[:40]!r}, which is no count", advice="the header is damaged")
    return int(text)


def text_table(text: bytes, columns: dict[str, int], rows: int, per_row: int) -> NDArray[Any]:
    """Columns, given by name and index, of the first `rows` rows of a text with `per_row` numbers a row."""
    numbers = _parse_numbers(text, rows * per_row).reshape(rows, per_row)
    table = np.empty(rows, [(name, "f8") for name in columns])
    for name, index in columns.items():
        table[name] = numbers[:, index]
    return table


def binary_table(content: bytes, kind: np.dtype[Any], rows: int) -> NDArray[Any]:
    """The first `rows` rows of packed binary data."""
    if rows * kind.itemsize > len(content):
        raise InputError(
            f"states {rows} points of {kind.itemsize} bytes but has only {len(content)} bytes of them", advice=CUT_SHORT
        )
    return np.frombuffer(content, kind, rows)


def _parse_numbers(text: bytes, count: int) -> NDArray[np.float64]:
    """The first `count` numbers of a text, separated by blanks or line ends."""
    if count > (len(text) + 1) // 2:
        raise InputError(f"{count} numbers cannot be in {len(text)} bytes", advice=CUT_SHORT)
    if count == 0:
        return np.empty(0)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # NumPy before 2.3 warns where newer ones raise
            numbers = np.fromstring(text, sep=" ", count=count)
    except (ValueError, DeprecationWarning):
        raise InputError("holds something that is no number", advice="the file is damaged") from None
    if len(numbers) < count:
        raise InputError(f"ends after {len(numbers)} of {count} numbers", advice=CUT_SHORT)
    return np.asarray(numbers)
