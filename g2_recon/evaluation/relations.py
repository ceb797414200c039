# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The relations metric of Kuemmerle et al., "On measuring the accuracy of SLAM algorithms", Autonomous Robots 2009."""

from __future__ import annotations

import lzma
import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry import se2
from g2_recon.geometry.trajectory import Trajectory

_STAMP_TOLERANCE_S = 0.05
_MAX_FAULT_LENGTH = 200
_EXPECTED = "each line needs stamp1 stamp2 x y z roll pitch yaw"


@dataclass(frozen=True, slots=True)
class RelationsScore:
    """Mean and standard deviation of the error over all relations that the trajectory covers.

    relations, missed: how many have poses at both stamps, and how many have not. Translation in metres, rotation in
    degrees.
    """

    relations: int
    missed: int
    translation_mean: float
    translation_std: float
    rotation_mean: float
    rotation_std: float


def read_relations(path: str | Path) -> NDArray[np.float64]:
    """Rows (N, 8) of stamp1 stamp2 x y z roll pitch yaw: the true pose at stamp2 seen from that at stamp1."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # an empty file: said below
            rows = np.loadtxt(path, ndmin=2)
    except (EOFError, zlib.error, lzma.LZMAError) as error:
        raise InputError(f"is packed and damaged: {error}", where=path, advice="download or pack it again") from error
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror or error}", where=path, advice="check the path and its permissions"
        ) from error
    except ValueError as error:
        raise InputError(
            f"is no relations file: {str(error)[:_MAX_FAULT_LENGTH]}", where=path, advice=_EXPECTED
        ) from error
    if rows.shape[1:] != (8,) or not np.isfinite(rows).all():
        raise InputError("is no relations file", where=path, advice=_EXPECTED)
    return rows


def score_relations(relations: NDArray[np.float64], trajectory: Trajectory) -> RelationsScore:
    """The error of a trajectory: relation^-1 * (pose1^-1 * pose2), with poses at most 50 ms from the stamps.

    Raises InputError where the trajectory covers none of the relations.
    """
    order = np.argsort(trajectory.stamps, kind="stable")
    stamps, poses = trajectory.stamps[order], trajectory.planar()[order]
    first, first_gap = _nearest(stamps, relations[:, 0])
    second, second_gap = _nearest(stamps, relations[:, 1])
    found = np.maximum(first_gap, second_gap) <= _STAMP_TOLERANCE_S
    if not found.any():
        raise InputError("the trajectory covers none of the relations", advice="do their stamps belong together?")
    measured = se2.relative(poses[first[found]], poses[second[found]])
    error = se2.relative(relations[found][:, [2, 3, 7]], measured)
    translation, rotation = np.hypot(error[:, 0], error[:, 1]), np.degrees(np.abs(error[:, 2]))
    return RelationsScore(
        relations=int(found.sum()),
        missed=int((~found).sum()),
        translation_mean=float(translation.mean()),
        translation_std=float(translation.std()),
        rotation_mean=float(rotation.mean()),
        rotation_std=float(rotation.std()),
    )


def _nearest(stamps: NDArray[np.float64], wanted: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Index of the nearest of ascending stamps, and how far it is in seconds."""
    right = np.clip(np.searchsorted(stamps, wanted), 1, max(len(stamps) - 1, 1))
    left_is_nearer = np.abs(stamps[right - 1] - wanted) <= np.abs(stamps[np.minimum(right, len(stamps) - 1)] - wanted)
    index = np.where(left_is_nearer, right - 1, np.minimum(right, len(stamps) - 1))
    return index, np.abs(stamps[index] - wanted)
