# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What a SICK LMS200 makes of the true distances."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2_recon.config import SimulationConfig
from g2_recon.geometry import sick_lms
from g2_recon.geometry.scan import Scan

SECONDS_PER_DEGREE = 1.0 / (sick_lms.MIRROR_RATE_HZ * 360.0)

RESOLUTION_M = {8: 0.001, 80: 0.01}
"""Metres a count by measuring mode."""

MIXED_PIXEL_JUMP = 0.2
"""Metres between the ranges of two neighbor beams from which on one of them may be split by the edge."""

MIXED_PIXEL_PROBABILITY = 0.1
"""Share of the beams beside such an edge whose footprint lies on both sides of it."""


@dataclass(frozen=True, slots=True)
class Lms200:
    """An LMS200 in one of its variants.

    beam_spacing: degrees, 1.0 or 0.5. measuring_mode: 8 or 80, metres. range_noise: standard deviation
    of a range in metres. mixed_pixels: whether a beam that meets an edge may give a range between near and far.
    """

    beam_spacing: float
    measuring_mode: int
    range_noise: float
    mixed_pixels: bool

    @classmethod
    def from_config(cls, config: SimulationConfig) -> Lms200:
        """The laser that the settings describe."""
        return cls(float(config.beam_spacing), int(config.measuring_mode), config.range_noise, config.mixed_pixels)

    @property
    def scan_rate(self) -> float:
        """Scans a second."""
        return sick_lms.SCAN_RATE_HZ[self.beam_spacing]

    @property
    def time_increment(self) -> float:
        """Seconds from beam to beam, as the mirror turns."""
        return self.beam_spacing * SECONDS_PER_DEGREE

    def angles(self) -> NDArray[np.float64]:
        """Beam angles (B,) in radians, from the right to the left."""
        count = round(180.0 / self.beam_spacing) + 1
        return -math.pi / 2 + math.radians(self.beam_spacing) * np.arange(count, dtype=float)

    def beam_times(self) -> NDArray[np.float64]:
        """Seconds (B,) from the first beam of a scan to each of its beams."""
        return np.asarray(self.time_increment * np.arange(len(self.angles()), dtype=float))

    def measure(self, distances: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float32]:
        """Ranges (S, B) in metres of S scans from the true distances (S, B), +inf where nothing is.

        As REP-117 wants it, what is beyond the largest range becomes +inf and what is too near to count -inf.
        """
        ranges = self._mix(distances, rng) if self.mixed_pixels else distances
        counts = np.round((ranges + rng.normal(0.0, self.range_noise, ranges.shape)) / self._resolution)
        measured = np.where(counts < 1, -np.inf, counts * self._resolution)
        measured[measured > self._max_range + self._resolution / 2] = np.inf
        return measured.astype(np.float32)

    def scan(self, stamp: float, ranges: NDArray[np.float32], frame_id: str) -> Scan:
        """The scan whose first beam was measured at `stamp`."""
        return Scan(
            stamp=stamp,
            ranges=ranges,
            angle_min=-math.pi / 2,
            angle_increment=math.radians(self.beam_spacing),
            range_min=0.0,
            range_max=self._max_range,
            time_increment=self.time_increment,
            frame_id=frame_id,
        )

    @property
    def _resolution(self) -> float:
        return RESOLUTION_M[self.measuring_mode]

    @property
    def _max_range(self) -> float:
        return sick_lms.MAX_RANGE_M[self.measuring_mode]

    @staticmethod
    def _mix(distances: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Replace the range of some beams beside an edge by one between theirs and that of the beam beyond the edge."""
        padded = np.pad(distances, ((0, 0), (1, 1)), mode="edge")
        split = rng.random(distances.shape) < MIXED_PIXEL_PROBABILITY
        share = rng.random(distances.shape)
        mixed = distances.copy()
        for neighbor in (padded[:, :-2], padded[:, 2:]):
            both = np.isfinite(distances) & np.isfinite(neighbor)
            beyond = np.subtract(neighbor, distances, out=np.zeros_like(distances), where=both)
            which = split & (np.abs(beyond) > MIXED_PIXEL_JUMP)
            mixed[which] = (distances + share * beyond)[which]
        return mixed
