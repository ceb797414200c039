# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Clouds in and out: PLY, PCD, XYZ/CSV/TXT and NPZ."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud
from g2_recon.recording.files import atomic_write, read_bytes
from g2_recon.recording.npz import parse_npz
from g2_recon.recording.pcd import parse_pcd, write_pcd
from g2_recon.recording.ply import parse_ply, write_ply

_NAMES = ("x", "y", "z", "vx", "vy", "vz")
_COMMENTS = ("#", "//")
_MAX_FAULT_LENGTH = 200


def read_cloud(path: str | Path) -> Cloud:
    """Read a cloud; the ending says what the file is: .ply, .pcd, .xyz, .csv, .txt or .npz.

    Sensor positions come from vertex properties, fields or named columns `vx vy vz`, the array `sensor` of an NPZ
    file, or the VIEWPOINT of a PCD file (see pcd.parse_pcd). Points that are NaN are kept. Raises InputError if the
    file cannot be read, is malformed or cut short, or its ending is not known.
    """
    ending = Path(path).suffix.lower()
    if ending not in _PARSERS:
        raise _unknown_ending(path)
    content = read_bytes(path)
    try:
        return _PARSERS[ending](content)
    except InputError as error:
        raise InputError(str(error), where=path) from None


def write_cloud(path: str | Path, cloud: Cloud) -> None:
    """Write a cloud; the ending says how: .ply and .npz (float64), .pcd (float32), .xyz, .csv and .txt (9 decimals).

    Raises InputError if the ending is not known or the file cannot be written.
    """
    ending = Path(path).suffix.lower()
    if ending not in _WRITERS:
        raise _unknown_ending(path)
    with atomic_write(path) as temporary:
        _WRITERS[ending](temporary, cloud)


def check_cloud_ending(path: str | Path) -> None:
    """Raises InputError where a cloud cannot be written because of its ending."""
    if Path(path).suffix.lower() not in _WRITERS:
        raise _unknown_ending(path)


def _unknown_ending(path: str | Path) -> InputError:
    return InputError("has no ending that a cloud can have", where=path, advice=f"use one of {', '.join(_PARSERS)}")


def _parse_text(content: bytes) -> Cloud:
    """Rows of at least three numbers, separated by blanks, commas or semicolons.

    A line of column names may come first, also as a comment (#, //); x, y, z and vx, vy, vz are then taken by name,
    whatever their order. Without names the first three columns are x, y, z.
    """
    try:
        lines = [line for line in content.decode("utf-8-sig").splitlines() if line.strip()]
    except UnicodeDecodeError:
        raise InputError("is no text", advice="expected lines of x y z") from None
    comments = next((index for index, line in enumerate(lines) if not line.startswith(_COMMENTS)), len(lines))
    delimiter = next((mark for mark in ";," if lines[comments:] and mark in lines[comments]), None)
    columns = next((found for line in lines[:comments] if (found := _named_columns(line, delimiter))), None)
    if lines[comments:] and not _is_number(_split(lines[comments], delimiter)[0]):
        columns = _named_columns(lines[comments], delimiter)
        comments += 1
        if columns is None:
            raise InputError("has no columns x, y and z", advice="name them so, or leave out the line of names")
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="loadtxt")  # no data: told below, as an error
            table = np.loadtxt(
                lines[comments:], ndmin=2, comments=_COMMENTS, delimiter=delimiter, usecols=columns or [0, 1, 2]
            )
    except ValueError as error:
        raise InputError(
            f"is no table of points: {str(error)[:_MAX_FAULT_LENGTH]}", advice="expected lines of x y z"
        ) from None
    if len(table) == 0:
        raise InputError("holds no point", advice="expected lines of x y z")
    return Cloud(table[:, :3].copy(), table[:, 3:].copy() if table.shape[1] == 6 else None)


def _named_columns(line: str, delimiter: str | None) -> list[int] | None:
    """Indices of x, y, z and, where all are there, vx, vy, vz in a line of column names; None if it is no such line."""
    names = _split(line.lstrip("#/"), delimiter)
    if len(names) == 1:
        names = _split(line.lstrip("#/"), None)
    wanted = _NAMES if set(_NAMES) <= set(names) else _NAMES[:3]
    return [names.index(name) for name in wanted] if set(wanted) <= set(names) else None


def _split(line: str, delimiter: str | None) -> list[str]:
    return [word.strip().strip('"').lower() for word in line.split(delimiter)]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _write_text(path: Path, cloud: Cloud) -> None:
    delimiter = "," if path.suffix.lower() == ".csv" else " "
    columns = cloud.points if cloud.sensor is None else np.hstack([cloud.points, cloud.sensor])
    header = delimiter.join(_NAMES[: columns.shape[1]])
    comments = "" if path.suffix.lower() == ".csv" else "# "
    np.savetxt(path, columns, fmt="%.9f", delimiter=delimiter, header=header, comments=comments)


def _parse_npz(content: bytes) -> Cloud:
    """Arrays `points` (N, 3) and optional `sensor` (N, 3) of real numbers."""
    arrays = parse_npz(content, ["points"], ["sensor"])
    sensor = arrays.get("sensor")
    return Cloud(arrays["points"].astype(np.float64), None if sensor is None else sensor.astype(np.float64))


def _write_npz(path: Path, cloud: Cloud) -> None:
    if cloud.sensor is None:
        np.savez_compressed(path, points=cloud.points)
    else:
        np.savez_compressed(path, points=cloud.points, sensor=cloud.sensor)


_PARSERS = {
    ".ply": parse_ply,
    ".pcd": parse_pcd,
    ".xyz": _parse_text,
    ".csv": _parse_text,
    ".txt": _parse_text,
    ".npz": _parse_npz,
}
_WRITERS = {
    ".ply": write_ply,
    ".pcd": write_pcd,
    ".xyz": _write_text,
    ".csv": _write_text,
    ".txt": _write_text,
    ".npz": _write_npz,
}
