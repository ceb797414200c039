# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A scan of a 2D laser, and the way from its beams to points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError


@dataclass(frozen=True, slots=True)
class Scan:
    """One turn of a 2D laser, in the conventions of sensor_msgs/LaserScan and REP-117.

    stamp: seconds, when the first beam was measured; beam i was measured `i * time_increment` seconds later.
    ranges: (B,) metres, float32; +inf: no return, -inf: too close, NaN: invalid. Only values in
    [range_min, range_max] are measurements.
    angle_min, angle_increment: radians, counterclockwise from the x axis of the laser frame.
    """

    stamp: float
    ranges: NDArray[np.float32]
    angle_min: float
    angle_increment: float
    range_min: float = 0.0
    range_max: float = np.inf
    time_increment: float = 0.0
    frame_id: str = "laser"

    def __post_init__(self) -> None:
        if self.ranges.ndim != 1:
            raise InputError(f"the ranges of a scan are a vector, got shape {self.ranges.shape}")
        numbers = (self.stamp, self.angle_min, self.angle_increment, self.time_increment)
        if not np.isfinite(numbers).all() or (self.angle_increment == 0 and len(self.ranges) > 1):
            raise InputError("a scan needs a finite stamp, start angle, time increment and an angle increment not 0")

    def angles(self) -> NDArray[np.float64]:
        """Beam angles (B,) in radians."""
        return self.angle_min + self.angle_increment * np.arange(len(self.ranges), dtype=float)

    def beam_stamps(self) -> NDArray[np.float64]:
        """Times (B,) in seconds at which the beams were measured."""
        return self.stamp + self.time_increment * np.arange(len(self.ranges), dtype=float)

    @property
    def first_stamp(self) -> float:
        """Time in seconds of the beam that was measured first."""
        return self.stamp + min(0.0, self.time_increment * (len(self.ranges) - 1))

    @property
    def last_stamp(self) -> float:
        """Time in seconds of the beam that was measured last."""
        return self.stamp + max(0.0, self.time_increment * (len(self.ranges) - 1))

    def valid(self, *, range_min: float = 0.0, range_max: float = np.inf) -> NDArray[np.bool_]:
        """Mask (B,) of the beams that measured something (REP-117), within the given limits in metres too.

        A range of zero is never a measurement: many drivers code a missing return so.
        """
        near, far = max(self.range_min, range_min), min(self.range_max, range_max)
        with np.errstate(invalid="ignore"):
            return (self.ranges > 0) & (self.ranges >= near) & (self.ranges <= far) & np.isfinite(self.ranges)

    def points(
        self, *, range_min: float = 0.0, range_max: float = np.inf
    ) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        """Points (M, 2) in the laser frame of the beams that measured something, and their beam indices (M,)."""
        beams = np.flatnonzero(self.valid(range_min=range_min, range_max=range_max))
        angles = self.angle_min + self.angle_increment * beams
        ranges = self.ranges[beams].astype(float)
        return np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)]), beams
