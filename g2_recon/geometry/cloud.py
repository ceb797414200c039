# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A cloud: points in one frame, each with the place it was seen from where that is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry import se3


@dataclass(frozen=True, slots=True)
class Cloud:
    """Points (N, 3) in metres and, where known, sensor (N, 3): the position from which each point was seen."""

    points: NDArray[np.float64]
    sensor: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise InputError(f"a cloud needs points of shape (N, 3), got {self.points.shape}")
        if self.sensor is not None and self.sensor.shape != self.points.shape:
            raise InputError(
                f"a cloud needs one sensor position a point, got {self.sensor.shape} for {self.points.shape}"
            )

    def __len__(self) -> int:
        return len(self.points)

    def select(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> Cloud:
        """The points that a mask (N,) or an array of indices names."""
        return Cloud(self.points[which], None if self.sensor is None else self.sensor[which])

    def moved(self, T: NDArray[np.float64]) -> Cloud:
        """In another frame, by a transform (4, 4) from this one."""
        sensor = None if self.sensor is None else se3.transform_points(T, self.sensor)
        return Cloud(se3.transform_points(T, self.points), sensor)

    def finite(self) -> Cloud:
        """Without points or sensor positions that are NaN or infinite; itself where there is none."""
        parts = [self.points] if self.sensor is None else [self.points, self.sensor]
        if all(bool(np.isfinite(part).all()) for part in parts):
            return self
        return self.select(np.logical_and.reduce([np.isfinite(part).all(axis=1) for part in parts]))


@dataclass(frozen=True, slots=True)
class Piece:
    """Which part of a cloud that comes in pieces this is, each a number from 0 to 2^32 - 1.

    source: who made it. number: which of its pieces. revision: points of a newer one replace all points of the piece,
    those of the same one are added.
    """

    source: int
    number: int
    revision: int = 0


ALL_PIECES = 2**32 - 1
"""In place of the number of a piece: no point of the source is left, nor will any come."""


def concatenate(clouds: Sequence[Cloud]) -> Cloud:
    """One cloud of several in the same frame; sensor positions are kept if all have them."""
    if not clouds:
        return Cloud(np.empty((0, 3)), np.empty((0, 3)))
    sensors = [cloud.sensor for cloud in clouds if cloud.sensor is not None]
    return Cloud(
        np.concatenate([cloud.points for cloud in clouds]),
        np.concatenate(sensors) if len(sensors) == len(clouds) else None,
    )
