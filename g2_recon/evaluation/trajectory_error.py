# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""How far a trajectory is from the true one."""

from __future__ import annotations

import numpy as np

from g2_recon.errors import InputError
from g2_recon.geometry.trajectory import Trajectory


def mean_position_error(estimate: Trajectory, truth: Trajectory) -> float:
    """Mean distance in metres, in the plane, between the poses of an estimate and the truth at the same stamps.

    Both must be in the same frame; nothing is aligned. Raises InputError where they have no time in common.
    """
    T_map_base, known = truth.interpolate(estimate.stamps)
    if not known.any():
        raise InputError("the trajectory and the truth have no time in common")
    error = estimate.positions[known, :2] - T_map_base[known, :2, 3]
    return float(np.hypot(error[:, 0], error[:, 1]).mean())
