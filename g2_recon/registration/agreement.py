# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""How well two sweeps agree where one lies on the other, and in which directions that fixes the place.

The same for every method of matching. A step d is three metres along the axes of the fixed sweep and three radians
about them through the laser of the moving one, the order of ROS.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry import se3
from g2_recon.registration.prepared_sweep import PreparedSweep

Float = NDArray[np.float64]

# Points farther apart are not of the same surface.
_NEAR_M = 0.3
# How far off a surface a point may lie that was measured on it, and how far in front of what is seen behind it.
_ON_SURFACE_M = 0.06
_IN_FRONT_M = 0.15
_PARALLEL = 0.99
_LEVEL = 0.7


@dataclass(frozen=True, slots=True)
class Agreement:
    """What the moving sweep says about the fixed one at one place.

    overlap: share of the sweep with fewer points that has a point of the other near it. inlier_share: of what both
    should see, the share on the same surface: the rest lies beside it or where the other one looked through. Both are
    those of walls or those of floors and ceilings, whichever is less.
    residual: RMS distance of the inliers from the surface in m. hessian (6, 6) and gradient (6,): of half the sum of
    their squared distances. shares: (6,) eigenvalues of the hessian a pair, radians counted as metres at `radius`,
    ascending; directions: (6, 6), a column each.
    """

    overlap: float
    inlier_share: float
    residual: float
    hessian: Float
    gradient: Float
    shares: Float
    directions: Float
    radius: float


def agreement(moving: PreparedSweep, fixed: PreparedSweep, T_fixed_moving: Float, *, step: int = 2) -> Agreement:
    """Lay the moving sweep on the fixed one and look, at one point in `step`."""
    placed = se3.transform_points(T_fixed_moving, moving.points[::step])
    rows, distances = fixed.pairs(placed)
    near = distances < _NEAR_M
    normals, others = fixed.normals[rows], moving.normals[::step] @ T_fixed_moving[:3, :3].T
    off = np.einsum("ij,ij->i", normals, placed - fixed.points[rows])
    # Where normals differ there is an edge, or too few beams to tell the normal: such pairs say nothing.
    cos = np.einsum("ij,ij->i", normals, others)
    parallel = near & (np.abs(cos) > _PARALLEL)
    on_surface = parallel & (np.abs(off) < _ON_SURFACE_M)
    # Both ways: what one sweep looked through cannot be where the other saw a surface. Of clutter, which no pair of
    # parallel normals speaks for, nothing may speak against either, or there would be more of it the larger the voxels.
    back = se3.transform_points(se3.inverse(T_fixed_moving), fixed.points[::step])
    through = ~near & moving.flat[::step] & fixed.seen_through(placed, _IN_FRONT_M)
    through_back = fixed.flat[::step] & moving.seen_through(back, _IN_FRONT_M)
    through_back[through_back] = moving.pairs(back[through_back])[1] >= _NEAR_M
    inliers = int(on_surface.sum())
    # Floors and ceilings fit each other anywhere, so that walls have to fit on their own.
    level = np.abs(others[:, 2]) > _LEVEL
    level_back = np.abs(fixed.normals[::step] @ T_fixed_moving[:3, 2]) > _LEVEL
    inlier_shares, overlaps = [], []
    for here, there in ((level, level_back), (~level, ~level_back)):
        fit = int(np.sum(on_surface & here))
        against = int(np.sum((parallel & ~on_surface | through) & here)) + int(np.sum(through_back & there))
        if fit + against:
            inlier_shares.append(fit / (fit + against))
        if here.any() and there.any():
            overlaps.append(float(np.sum(near & here)) / min(int(here.sum()), int(there.sum())))

    arms, errors = placed[on_surface] - T_fixed_moving[:3, 3], off[on_surface]
    J = _jacobian(arms, normals[on_surface])
    hessian = step * J.T @ J
    # The noise of normals makes any direction look held. That of the two sweeps is independent, so it is not in this.
    crossed = J.T @ _jacobian(arms, others[on_surface] * np.sign(cos[on_surface])[:, None])
    radius = float(np.sqrt(np.mean(np.sum(arms**2, axis=1)))) if inliers else 1.0
    scaling = np.repeat([1.0, 1.0 / max(radius, 1e-3)], 3)
    shares, directions = np.linalg.eigh((crossed + crossed.T) / 2 * np.outer(scaling, scaling) / max(inliers, 1))
    return Agreement(
        overlap=min(1.0, *overlaps, math.inf) if overlaps else 0.0,
        inlier_share=min(inlier_shares, default=0.0),
        residual=float(np.sqrt(np.mean(errors**2))) if len(errors) else math.inf,
        hessian=hessian,
        gradient=step * J.T @ errors,
        shares=shares,
        directions=directions,
        radius=radius,
    )


def _jacobian(arms: Float, normals: Float) -> Float:
    """How the distances (K,) of points from surfaces change with a step, (K, 6)."""
    return np.hstack([normals, np.cross(arms, normals)])
