# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Sweeps as 3DTK (slam6D) has them: `scan000.3d`, lines of x y z, with a first guess of the pose in `scan000.pose`.

Both are in centimetres and left-handed: x to the right, y up, z forward. Here they become metres, right-handed, x
forward, y left, z up.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud
from g2_recon.recording.files import read_bytes
from g2_recon.recording.packing import GZIP, unpack

Float = NDArray[np.float64]

_CENTIMETRES = 0.01
# Ours from theirs: x = z, y = -x, z = y.
_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def read_3d(path: str | Path) -> Cloud:
    """Points in the frame of the laser, in metres; columns after the third, such as reflectance, are left out.

    Also .3d.gz. Raises InputError if the file cannot be read, is no table of points or is cut short.
    """
    content = read_bytes(path)
    if Path(path).suffix.lower() == ".gz":
        packed = content.startswith(GZIP)
        content, complaint = unpack(content, where=path)
        if not packed or complaint:
            raise InputError("is no gzip file or is cut short", where=path, advice="copy it again")
    table = _table(content, path)
    if table.shape[1] < 3:
        raise InputError(f"has {table.shape[1]} numbers a line", where=path, advice="expected lines of x y z")
    return Cloud(_CENTIMETRES * table[:, :3] @ _AXES.T)


def read_3d_pose(path: str | Path) -> Float | None:
    """T_map_laser (4, 4) from the `.pose` beside a `.3d` file: x y z, then rx ry rz in degrees; None without one.

    Raises InputError if the file is there and does not hold six finite numbers.
    """
    name = str(path).removesuffix(".gz").removesuffix(".GZ")
    file = Path(name).with_suffix(".pose")
    if not file.exists():
        return None
    values = _table(read_bytes(file).replace(b"\n", b" "), file).ravel()
    if values.shape != (6,) or not np.isfinite(values).all():
        raise InputError("is no pose", where=file, advice="expected x y z (cm) rx ry rz (degrees)")
    return from_left_handed(left_handed(values))


def left_handed(pose: Float) -> Float:
    """The matrix (4, 4), in centimetres, of x y z (cm) and rx ry rz (degrees) as EulerToMatrix4 of 3DTK makes it."""
    (sx, sy, sz), (cx, cy, cz) = np.sin(np.radians(pose[3:])), np.cos(np.radians(pose[3:]))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = about_x @ about_y @ about_z, pose[:3]
    return matrix


def from_left_handed(matrix: Float) -> Float:
    """A transform (4, 4) in their axes and centimetres as one in ours and metres."""
    result = np.eye(4)
    result[:3, :3] = _AXES @ matrix[:3, :3] @ _AXES.T
    result[:3, 3] = _CENTIMETRES * _AXES @ matrix[:3, 3]
    return result


def _table(content: bytes, path: str | Path) -> Float:
    try:
        lines = content.decode("ascii").splitlines()
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="loadtxt")  # no data: told below, as an error
            table = np.loadtxt(lines, ndmin=2)
    except ValueError as error:
        raise InputError(f"is no table of numbers: {str(error)[:200]}", where=path, advice="copy it again") from None
    if not table.size:
        raise InputError("holds no number", where=path, advice="copy it again")
    return np.asarray(table, float)
