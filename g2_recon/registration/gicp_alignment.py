# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Method `gicp`: generalized ICP of small_gicp, after point-to-plane ICP with far pairs among few points.

A. Segal, D. Haehnel, S. Thrun: "Generalized-ICP", RSS 2009.
"""

from __future__ import annotations

import math

import numpy as np
import small_gicp
from numpy.typing import NDArray

from g2_recon.registration.prepared_sweep import PreparedSweep

Float = NDArray[np.float64]

# Every so manyth point is enough while pairs are far.
_COARSE_STEP = 4
_ITERATIONS = 30
# A step smaller than this ends the iteration: at first what comes after it does the rest.
_ROUGH_M, _ROUGH_RAD = 0.01, math.radians(0.5)
_DONE_M, _DONE_RAD = 0.001, math.radians(0.1)
# Edges of shadows are within a wide gate, and few guesses within a narrow one.
_MIDDLE = 3.0


def align(moving: PreparedSweep, fixed: PreparedSweep, T_fixed_moving: Float, gate: float, last_gate: float) -> Float:
    """T_fixed_moving (4, 4) from a guess (4, 4), with pairs nearer than `gate` at first and `last_gate` at last.

    What small_gicp says of its result is not looked at: `converged` is true also where no pair was found.
    """
    for near in sorted({gate, min(gate, _MIDDLE * last_gate)}, reverse=True):
        T_fixed_moving = roughly(moving, fixed, T_fixed_moving, near)
    return _aligned("GICP", moving.gicp, fixed, T_fixed_moving, last_gate)


def roughly(moving: PreparedSweep, fixed: PreparedSweep, T_fixed_moving: Float, gate: float) -> Float:
    """T_fixed_moving (4, 4) from a poor guess (4, 4) to within some centimetres: point-to-plane ICP with far pairs."""
    few = small_gicp.PointCloud(moving.points[::_COARSE_STEP])
    return _aligned("PLANE_ICP", few, fixed, T_fixed_moving, gate, _ROUGH_M, _ROUGH_RAD)


def _aligned(
    kind: str,
    moving: small_gicp.PointCloud,
    fixed: PreparedSweep,
    T_fixed_moving: Float,
    gate: float,
    done_m: float = _DONE_M,
    done_rad: float = _DONE_RAD,
) -> Float:
    result = small_gicp.align(
        fixed.gicp,
        moving,
        fixed.tree,
        T_fixed_moving,
        registration_type=kind,
        max_correspondence_distance=gate,
        max_iterations=_ITERATIONS,
        translation_epsilon=done_m,
        rotation_epsilon=done_rad,
    )
    return np.asarray(result.T_target_source)
