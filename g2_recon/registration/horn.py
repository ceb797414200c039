# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The rigid transform between paired points in closed form, by quaternions.

B. K. P. Horn: "Closed-form solution of absolute orientation using unit quaternions", JOSA A 4(4), 1987, as in
P. J. Besl, N. D. McKay: "A method for registration of 3-D shapes", PAMI 14(2), 1992, which the paper follows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry import se3

Float = NDArray[np.float64]


def absolute_orientation(fixed: Float, moving: Float, weights: Float | None = None) -> Float:
    """T_fixed_moving (4, 4) with the least sum of weighted squared distances between pairs (N, 3) in metres.

    weights: (N,), not negative. Where pairs do not determine the rotation (fewer than three, on one line), it is one
    of those that fit.
    """
    share = np.full(len(fixed), 1.0 / len(fixed)) if weights is None else weights / weights.sum()
    center_fixed, center_moving = share @ fixed, share @ moving
    S = (moving - center_moving).T @ ((fixed - center_fixed) * share[:, None])
    antisymmetric = np.array([S[1, 2] - S[2, 1], S[2, 0] - S[0, 2], S[0, 1] - S[1, 0]])
    N = np.empty((4, 4))  # Horn, section 4.A; the rotation is its eigenvector of the largest eigenvalue
    N[0, 0] = np.trace(S)
    N[0, 1:] = N[1:, 0] = antisymmetric
    N[1:, 1:] = S + S.T - np.trace(S) * np.eye(3)
    w, x, y, z = np.linalg.eigh(N)[1][:, -1]
    T = se3.from_quaternion(np.zeros(3), [x, y, z, w])
    T[:3, 3] = center_fixed - T[:3, :3] @ center_moving
    return T
