# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Method `gicp`: generalized ICP of small_gicp, after point-to-plane ICP with far pairs among few points.

A. Segal, D. Haehnel, S. Thrun: "Generalized-ICP", RSS 2009.
"""

from __future__ import annotations

import numpy as np
import small_gicp
from numpy.typing import NDArray

from g2_recon.registration.prepared_sweep import PreparedSweep

Float = NDArray[np.float64]

# Every so manyth point is enough while pairs are far.
_COARSE_STEP = 4
_ITERATIONS = 30
# Edges of shadows are within a wide gate, and few guesses within a narrow one.
_MIDDLE = 3.0


def align(moving: PreparedSweep, fixed: PreparedSweep, T_fixed_moving: Float, gate: float, last_gate: float) -> Float:
    """T_fixed_moving (4, 4) from a guess (4, 4), with pairs nearer than `gate` at first and `last_gate` at last.

    What small_gicp says of its result is not looked at: `converged` is true also where no pair was found.
    """
    middle = _MIDDLE * last_gate
    if gate > middle:
        T_fixed_moving = roughly(moving, fixed, T_fixed_moving, gate)
    for near in (middle, last_gate):
        T_fixed_moving = _aligned("GICP", moving.gicp, fixed, T_fixed_moving, near)
    return T_fixed_moving


def roughly(moving: PreparedSweep, fixed: PreparedSweep, T_fixed_moving: Float, gate: float) -> Float:
    """T_fixed_moving (4, 4) from a poor guess (4, 4) to within some centimetres: point-to-plane ICP with far pairs."""
    few = small_gicp.PointCloud(moving.points[::_COARSE_STEP])
    return _aligned("PLANE_ICP", few, fixed, T_fixed_moving, gate)


def _aligned(
    kind: str, moving: small_gicp.PointCloud, fixed: PreparedSweep, T_fixed_moving: Float, gate: float
) -> Float:
    result = small_gicp.align(
        fixed.gicp,
        moving,
        fixed.tree,
        T_fixed_moving,
        registration_type=kind,
        max_correspondence_distance=gate,
        max_iterations=_ITERATIONS,
    )
    return np.asarray(result.T_target_source)
