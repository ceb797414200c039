# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Method `paper`: point-to-point ICP in 6 degrees of freedom (paper, section 2.2, second setup).

Pairs come from a kd-tree, the transform from quaternions in closed form. The gate beyond which pairs are rejected
shrinks from iteration to iteration: a wide one alone leaves the error of all that only one of the sweeps saw. With the
last gate all points of the fixed sweep take part, of the moving one those that its preparation says.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from g2_recon.geometry import se3
from g2_recon.registration.horn import absolute_orientation
from g2_recon.registration.prepared_sweep import PreparedSweep

Float = NDArray[np.float64]

_SHRINK = 0.6
_ITERATIONS = 40
_DONE_M, _DONE_OF_GATE = 1e-4, 0.01
_FEWEST_PAIRS = 6
# Every so manyth of the thinned points is enough while the gate is wide.
_COARSE_STEP = 4


def align(moving: PreparedSweep, fixed: PreparedSweep, T_fixed_moving: Float, gate: float, last_gate: float) -> Float:
    """T_fixed_moving (4, 4) from a guess (4, 4), with pairs nearer than `gate` at first and `last_gate` at last.

    Where no pairs are left, it stays where it had some.
    """
    surface, points, tree = fixed.points, moving.points[::_COARSE_STEP], cKDTree(fixed.points)
    for reach in _gates(gate, last_gate):
        narrow = reach == last_gate
        if narrow:
            surface, points, tree = fixed.measured, moving.paired, cKDTree(fixed.measured)
        for _ in range(_ITERATIONS):
            placed = se3.transform_points(T_fixed_moving, points)
            distances, rows = tree.query(placed, distance_upper_bound=reach)
            paired = np.isfinite(distances)
            if paired.sum() < _FEWEST_PAIRS:
                break
            step = absolute_orientation(surface[rows[paired]], placed[paired])
            T_fixed_moving = se3.orthonormal(step @ T_fixed_moving)
            moved = np.abs(se3.transform_points(step, placed[paired]) - placed[paired]).max()
            if moved < (_DONE_M if narrow else _DONE_OF_GATE * reach):
                break
    return T_fixed_moving


def _gates(first: float, last: float) -> list[float]:
    """Gates in metres, from the first to the last."""
    gates = [max(first, last)]
    while gates[-1] > last:
        gates.append(max(gates[-1] * _SHRINK, last))
    return gates
