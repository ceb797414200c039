# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What a SICK LMS200 (and its sisters LMS211, LMS291) can do and how it says that it could not.

Facts from SICK's "Telegrams for Configuring and Operating the LMS2xx": the mirror turns 75 times a second and scans
180 deg at 1 deg (181 beams); at 0.5 deg two turns are interlaced, so 361 beams come 37.5 times a second. A reading is
a 13-bit number of millimetres (8 m mode) or centimetres (80 m mode); the topmost numbers are error codes.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

FIELD_OF_VIEW = math.pi
MIRROR_RATE_HZ = 75.0
SCAN_RATE_HZ = {1.0: MIRROR_RATE_HZ, 0.5: MIRROR_RATE_HZ / 2}
"""Scans a second by beam spacing in degrees."""

FIRST_ERROR_CODE = 8183
"""0x1FF7, "measured value > maximum value"; everything from here to 0x1FFF is no measurement."""

MAX_RANGE_M = {8: 8.182, 80: 81.82}
"""Largest measurement in metres by measuring mode."""

# CARMEN clips what it logs at a limit of its own, never below this; no LMS200 sees that far indoors.
_CARMEN_LIMIT_M = 50.0


def no_return_threshold(ranges: NDArray[np.floating]) -> float:
    """The range in metres from which on a reading of this log means "no return".

    ranges: all readings of one log, any shape. In 8 m mode nothing above the error codes occurs, so a log whose
    largest reading is at most 8.191 m is in that mode; otherwise CARMEN's own limit counts.
    """
    largest = float(np.max(ranges, initial=0.0))
    return FIRST_ERROR_CODE / 1000 if FIRST_ERROR_CODE / 1000 <= largest <= 8.1915 else _CARMEN_LIMIT_M


def beam_spacing(count: int, stated: float) -> float:
    """The beam spacing in radians of a scan with `count` beams that states the spacing `stated`.

    Drivers wrote half a turn divided by `count - 1` where the laser had left out its last beam: 180 beams are exactly
    1 deg apart and 360 beams 0.5 deg. That one mistake is put right; any other spacing is returned as stated.
    """
    for beams, spacing in ((180, math.radians(1.0)), (360, math.radians(0.5))):
        if count == beams and abs(abs(stated) - FIELD_OF_VIEW / (beams - 1)) < 1e-5:
            return math.copysign(spacing, stated)
    return stated
