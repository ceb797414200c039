# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Trajectories as TUM files: a line a pose, `stamp x y z qx qy qz qw`, seconds and metres."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.recording.files import atomic_write, read_bytes

_HEADER = "stamp x y z qx qy qz qw"


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory, one line a pose, in its order; stamps to the nanosecond.

    Raises InputError where a number is not finite or the file cannot be written.
    """
    table = np.column_stack([trajectory.stamps, trajectory.positions, trajectory.quaternions])
    if not np.isfinite(table).all():
        raise InputError("a pose is not finite", where=path, advice="leave out the poses that are not known")
    with atomic_write(path) as temporary:
        np.savetxt(temporary, table, fmt=["%.9f"] * 4 + ["%.12f"] * 4, header=_HEADER)


def read_tum(path: str | Path) -> Trajectory:
    """Read a trajectory; lines that start with # are comments, quaternions are normalized.

    Raises InputError if the file cannot be read, holds no pose, a line does not have eight finite numbers, or a
    quaternion is not of unit length.
    """
    try:
        lines = read_bytes(path).decode("utf-8").splitlines()
    except UnicodeDecodeError:
        raise InputError("is no text", where=path, advice=f"expected lines of {_HEADER}") from None
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="loadtxt")  # no data: told below, as an error
            table = np.loadtxt(lines, ndmin=2, comments="#")
    except ValueError as error:
        raise InputError(f"is no trajectory: {error}", where=path, advice=f"expected lines of {_HEADER}") from None
    if len(table) == 0:
        raise InputError("holds no pose", where=path, advice=f"expected lines of {_HEADER}")
    if table.shape[1] != 8:
        raise InputError(f"has {table.shape[1]} numbers a line, not 8", where=path, advice=f"expected {_HEADER}")
    good = sound_poses(table[:, 1:4], table[:, 4:]) & np.isfinite(table[:, 0])
    if not good.all():
        raise InputError(
            f"pose {int(np.flatnonzero(~good)[0]) + 1} is not finite or its quaternion is not of unit length",
            where=path,
            advice=f"expected {_HEADER}",
        )
    lengths = np.linalg.norm(table[:, 4:], axis=1, keepdims=True)
    return Trajectory(table[:, 0].copy(), table[:, 1:4].copy(), table[:, 4:] / lengths)


def sound_poses(positions: NDArray[np.float64], quaternions: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Mask (N,) of the poses that geometry.se3.from_quaternion accepts: finite, quaternion nearly of unit length.

    positions: (N, 3) metres. quaternions: (N, 4) x y z w.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        lengths = np.linalg.norm(quaternions, axis=1)
    return np.asarray(np.isfinite(positions).all(axis=1) & (lengths > 0.5) & (lengths < 2.0))
