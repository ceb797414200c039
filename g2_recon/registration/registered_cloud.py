# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What the stages of registration hand out: points in the map frame, piece by piece."""

from __future__ import annotations

from dataclasses import dataclass

from g2_recon.geometry.cloud import Cloud


@dataclass(frozen=True, slots=True)
class RegisteredCloud:
    """Points in the map frame, each with the place of the laser when it was measured.

    stamp: of the scan or sweep in seconds; of the newest one where there are several. piece: that the points belong to.
    revision: 0 for the points as they come; above that: all points of the piece, in place of all before.
    """

    stamp: float
    cloud: Cloud
    piece: int = 0
    revision: int = 0
