# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What tracking does with every scan, in one piece each: small arrays cost more in Python than what is done to them."""

from __future__ import annotations

import math

import numpy as np

from g2_recon.geometry.se2_kernels import is_within, relative
from g2_recon.kernels import kernel
from g2_recon.localization.likelihood import slide, telling
from g2_recon.localization.pairing import PAIR_SIGMA_M, agreements, match

# So many keyframes, the latest first, also have to agree with a scan, both ways by every other beam.
_WITNESSES, _EVERY = 5, 2
# Search distance and width of the robust kernel, first to last iteration, m.
_DISTANCE_M, _KERNEL_M = (0.35, 0.12), (0.08, 0.045)
# What the wheels say of a step is right within this, m and rad, and this share of the way and of the turn.
_WHEEL_SIGMA, _WHEEL_SHARE = (0.02, 0.02, 0.05), (0.1, 0.1, 0.2)

# Along the direction in which surfaces hold a scan least it slides so far, in such steps, in a grid of cells of this
# size, m. It comes to lie so exactly, m, if the likelihoods differ by more than this.
FINE_RESOLUTION_M = 0.05
_SLIDE_M, _SLIDE_STEP_M = 0.4, 0.025
_SLID_SIGMA_M, _LEAST_CONTRAST = 0.02, 0.08
# Beams farther apart than this, m, on a wall that runs along that direction (sine between them less than so much) say
# nothing about it.
_DENSE_M, _ALONG = 0.1, 0.5


@kernel
def wheel_sigma(step):  # type: ignore[no-untyped-def]
    """Sigma (3,) of what the wheels say of a step (3,)."""
    way, turn = math.hypot(step[0], step[1]), abs(step[2])
    sigma = np.empty(3)
    for u, size in enumerate((way, way, turn)):
        sigma[u] = _WHEEL_SIGMA[u] + _WHEEL_SHARE[u] * size
    return sigma


@kernel
def is_near(pose, guess, most, times):  # type: ignore[no-untyped-def]
    """Whether a pose (3,) is no farther from a guess than so many times `most` (3,), m and rad."""
    return is_within(relative(guess, pose), times * most)


@kernel
def match_on_latest(  # type: ignore[no-untyped-def]
    start, guess, sigma, pair_sigma, iterations, scan_points, scan_normals, scan_kinds, first, increment,
    spans, segment, poses, points, normals, kinds, firsts, increments,
):  # fmt: skip
    """Match a scan from a start (3,) on the keyframes that lie `spans` back, none of them before `segment`.

    The guess (3,) with its sigma (3,) holds what the scan does not; a pair of points errs by pair_sigma, m. Returns
    pose (3,), share of inliers, hessian (3, 3) with the guess, information (3, 3), how many points agree, and the
    share of agreement.
    """
    references = len(poses) - spans
    references = references[references >= segment]
    prior = np.zeros((3, 3))
    for u in range(3):
        prior[u, u] = (PAIR_SIGMA_M / sigma[u]) ** 2
    pose, inliers, hessian, _ = match(
        start, guess, scan_points, scan_normals, scan_kinds,
        references, poses, points, normals, kinds, firsts, increments,
        _DISTANCE_M[0], _DISTANCE_M[1], _KERNEL_M[0], _KERNEL_M[1], iterations, prior,
    )  # fmt: skip
    same, against = agreements(
        pose, scan_points, scan_normals, scan_kinds, first, increment,
        references[:_WITNESSES], poses, points, normals, kinds, firsts, increments, _EVERY,
    )  # fmt: skip
    information = (hessian - prior) / pair_sigma**2
    for u in range(3):
        information[u, u] += 1 / sigma[u] ** 2
    return pose, inliers, hessian, information, same, same / max(1, same + 2 * against)


@kernel
def slid(pose, information, held, weak, guess, away, points, normals, kinds, increment, grid, x0, y0):  # type: ignore[no-untyped-def]
    """Pose (3,) and information (3, 3) after sliding along `weak` (2,), which surfaces hold by `held` beams.

    guess: (3,) where the scan is expected to lie; a m^2 away from it costs `away` of the likelihood. grid: likelihoods
    in cells of FINE_RESOLUTION_M, with its corner x0, y0.
    """
    expected = (guess[0] - pose[0]) * weak[0] + (guess[1] - pose[1]) * weak[1]
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    in_scan = np.array([cos * weak[0] + sin * weak[1], cos * weak[1] - sin * weak[0]])
    tell = telling(points, normals, kinds, increment, in_scan, _DENSE_M, _ALONG)
    off, contrast = slide(
        grid, points, tell, pose, weak, _SLIDE_M, _SLIDE_STEP_M, expected, away, x0, y0, FINE_RESOLUTION_M
    )
    if contrast < _LEAST_CONTRAST:
        return pose, information
    seen = 1 / _SLID_SIGMA_M**2
    there, more = pose.copy(), information.copy()
    for u in range(2):
        there[u] += seen / (seen + held / PAIR_SIGMA_M**2) * off * weak[u]
        for v in range(2):
            more[u, v] += seen * (weak[u] * weak[v])
    return there, more
