# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Method `kiss`: the map and the point-to-point ICP with a robust kernel of KISS-ICP, used as parts.

I. Vizzo et al.: "KISS-ICP: In Defense of Point-to-Point ICP", RA-L 8(2), 2023. Its checks end the process instead of
raising, so nothing gets there that could fail one: no time stamps, no empty or infinite points, no guess that is not a
rotation to the last digit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry import se3
from g2_recon.registration.prepared_sweep import PreparedSweep

Float = NDArray[np.float64]

# Smaller voxels lose far guesses: pairs are looked for in neighboring voxels only.
_FIRST_VOXEL_M, _LAST_VOXEL_M = 0.25, 0.15
_POINTS_A_VOXEL = 20
_FIRST_KERNEL_M, _LAST_KERNEL_M = 0.3, 0.05
_ITERATIONS = 100
_CONVERGENCE = 1e-5
_FAR_M = 1e6
# The kernel makes far pairs weak, so that the gate may stay wider.
_MIDDLE = 3.0


def align(moving: PreparedSweep, fixed: PreparedSweep, T_fixed_moving: Float, gate: float, last_gate: float) -> Float:
    """T_fixed_moving (4, 4) from a guess (4, 4), with pairs nearer than `gate` at first.

    Raises InputError where the guess is not finite or no rotation.
    """
    # Not needed by the other methods, and slow to import.
    from kiss_icp.mapping import VoxelHashMap
    from kiss_icp.registration import Registration
    from kiss_icp.voxelization import voxel_down_sample

    guess = se3.orthonormal(T_fixed_moving)
    registration = Registration(max_num_iterations=_ITERATIONS, convergence_criterion=_CONVERGENCE, max_num_threads=1)
    for voxel, reach, kernel in (
        (_FIRST_VOXEL_M, gate, _FIRST_KERNEL_M),
        (_LAST_VOXEL_M, _MIDDLE * last_gate, _LAST_KERNEL_M),
    ):
        voxels = VoxelHashMap(voxel_size=voxel, max_distance=_FAR_M, max_points_per_voxel=_POINTS_A_VOXEL)
        voxels.add_points(fixed.measured)
        thinned = voxel_down_sample(moving.measured, voxel)
        guess = se3.orthonormal(registration.align_points_to_map(thinned, voxels, guess, reach, kernel))
    return guess
