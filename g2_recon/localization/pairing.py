# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The one correspondence kernel: the beams of one scan and the beams of another that saw the same place.

Partners are searched among the beams of the other scan around the bearing at which the point would appear there, which
needs no tree: a scan is already in order.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.se2_kernels import relative, wrap
from g2_recon.localization.beams import INVALID, SURFACE

Float = NDArray[np.float64]

# Normals of partners differ by less than acos of this.
_LIKE_NORMAL = 0.8
# Beams to either side of the expected bearing are looked at within this, rad.
_WIDEST_SEARCH = 0.53
# A partner counts as inlier up to this many of the robust kernel's sigma.
_INLIER_SIGMAS = 2.5
# Nearer points have no bearing to speak of, m.
_AT_THE_LASER_M = 0.05


@numba.njit(cache=True, nogil=True)
def nearest_beam(  # type: ignore[no-untyped-def]
    x, y, points, kinds, first, increment, max_distance, kind
):
    """Index of the nearest beam of at least a kind to a point at x, y in the frame of its scan; -1: none so near.

    -2: the point lies outside the field of view.
    """
    count = len(points)
    distance = math.hypot(x, y)
    if distance < _AT_THE_LASER_M:
        return -2
    bearing = math.atan2(y, x)
    offset = bearing - first
    offset -= 2 * math.pi * math.floor(offset / (2 * math.pi))
    center = round(offset / increment)
    reach = int(min(max_distance / distance, _WIDEST_SEARCH) / increment) + 1
    turn = round(2 * math.pi / increment)
    # Beyond the last beam comes the first, in a full turn or where what lies between them is narrower than the search.
    closed = count + 2 * reach >= turn
    if not closed and center - reach >= count:
        # The bearing may be just before the first beam.
        center -= turn
        if center + reach < 0:
            return -2
    best = max_distance * max_distance
    found = -1
    for k in range(center - reach, center + reach + 1):
        beam = k
        if closed:
            beam = k % turn
        if beam < 0 or beam >= count or kinds[beam] < kind:
            continue
        dx, dy = points[beam, 0] - x, points[beam, 1] - y
        squared = dx * dx + dy * dy
        if squared < best:
            best = squared
            found = beam
    return found


@numba.njit(cache=True, nogil=True)
def accumulate(  # type: ignore[no-untyped-def]
    T_b_a,
    points_a,
    normals_a,
    kinds_a,
    points_b,
    normals_b,
    kinds_b,
    first_b,
    increment_b,
    max_distance,
    sigma,
    step,
    backwards,
    hessian,
    gradient,
):
    """Add what the points of scan a say about T_b_a, for a step added to it: hessian (3, 3), gradient (3,).

    The residual is the distance of a point of a from the line through its partner in b (Chen and Medioni, 1992),
    weighted by Geman and McClure's kernel of width sigma (m). Every `step`-th beam is used. With `backwards` the
    roles of the given transform are swapped: T_b_a is the inverse of what is estimated, and so are hessian and
    gradient those of that inverse. Returns how many beams found a partner that fits, and how many lie in view of b.
    """
    # What does not depend on the direction: T_b_a places a's points in b.
    cos, sin = math.cos(T_b_a[2]), math.sin(T_b_a[2])
    inliers = 0
    seen = 0
    h00 = h01 = h02 = h11 = h12 = h22 = 0.0
    g0 = g1 = g2 = 0.0
    for i in range(0, len(points_a), step):
        if kinds_a[i] != SURFACE:
            continue
        rx = cos * points_a[i, 0] - sin * points_a[i, 1]
        ry = sin * points_a[i, 0] + cos * points_a[i, 1]
        x, y = rx + T_b_a[0], ry + T_b_a[1]
        beam = nearest_beam(x, y, points_b, kinds_b, first_b, increment_b, max_distance, SURFACE)
        if beam == -2:
            continue
        seen += 1
        if beam < 0:
            continue
        nx, ny = normals_b[beam, 0], normals_b[beam, 1]
        mx = cos * normals_a[i, 0] - sin * normals_a[i, 1]
        my = sin * normals_a[i, 0] + cos * normals_a[i, 1]
        if nx * mx + ny * my < _LIKE_NORMAL:
            continue
        error = nx * (x - points_b[beam, 0]) + ny * (y - points_b[beam, 1])
        weight = 1.0 / (1.0 + (error / sigma) ** 2)
        weight *= weight
        if abs(error) < _INLIER_SIGMAS * sigma:
            inliers += 1
        if backwards:
            # Estimated is T_a_b: p_b - T_a_b^-1 ... in the frame of a the residual is n_a . (p_a - T_a_b q_b), with
            # n_a the partner's normal turned back; its derivative by yaw turns that normal.
            ax, ay = cos * nx + sin * ny, -sin * nx + cos * ny
            jx, jy = -ax, -ay
            tx = -(cos * T_b_a[0] + sin * T_b_a[1])
            ty = -(-sin * T_b_a[0] + cos * T_b_a[1])
            dx, dy = points_a[i, 0] - tx, points_a[i, 1] - ty
            jt = -ay * dx + ax * dy
        else:
            jx, jy = nx, ny
            jt = -nx * ry + ny * rx
        h00 += weight * jx * jx
        h01 += weight * jx * jy
        h02 += weight * jx * jt
        h11 += weight * jy * jy
        h12 += weight * jy * jt
        h22 += weight * jt * jt
        g0 += weight * jx * error
        g1 += weight * jy * error
        g2 += weight * jt * error
    hessian[0, 0] += h00
    hessian[0, 1] += h01
    hessian[1, 0] += h01
    hessian[0, 2] += h02
    hessian[2, 0] += h02
    hessian[1, 1] += h11
    hessian[1, 2] += h12
    hessian[2, 1] += h12
    hessian[2, 2] += h22
    gradient[0] += g0
    gradient[1] += g1
    gradient[2] += g2
    return inliers, seen


@numba.njit(cache=True, nogil=True)
def pair(T_j_i, i, j, points, normals, kinds, firsts, increments, max_distance, sigma, step):  # type: ignore[no-untyped-def]
    """What keyframes i and j say about T_j_i, each scan laid on the other: hessian, gradient, inliers, seen."""
    hessian = np.zeros((3, 3))
    gradient = np.zeros(3)
    inliers, seen = accumulate(
        T_j_i,
        points[i],
        normals[i],
        kinds[i],
        points[j],
        normals[j],
        kinds[j],
        firsts[j],
        increments[j],
        max_distance,
        sigma,
        step,
        False,
        hessian,
        gradient,
    )
    T_i_j = relative(T_j_i, np.zeros(3))
    more, seen_back = accumulate(
        T_i_j,
        points[j],
        normals[j],
        kinds[j],
        points[i],
        normals[i],
        kinds[i],
        firsts[i],
        increments[i],
        max_distance,
        sigma,
        step,
        True,
        hessian,
        gradient,
    )
    return hessian, gradient, inliers + more, seen + seen_back


@numba.njit(cache=True, nogil=True, parallel=True)
def pairs(  # type: ignore[no-untyped-def]
    poses, first, second, points, normals, kinds, firsts, increments, max_distance, sigma
):
    """`pair` for many: T_j_i (M, 3) of keyframes i = first, j = second, hessians (M, 3, 3), gradients, counts.

    The counts (M, 2) are of inliers and of beams in view.
    """
    count = len(first)
    T, hessians, gradients = np.empty((count, 3)), np.empty((count, 3, 3)), np.empty((count, 3))
    counts = np.empty((count, 2), np.int64)
    for m in numba.prange(count):
        i, j = first[m], second[m]
        T[m] = relative(poses[j], poses[i])
        hessians[m], gradients[m], counts[m, 0], counts[m, 1] = pair(
            T[m], i, j, points, normals, kinds, firsts, increments, max_distance, sigma, 1
        )
    return T, hessians, gradients, counts


@numba.njit(cache=True, nogil=True)
def few_pairs(  # type: ignore[no-untyped-def]
    poses, first, second, points, normals, kinds, firsts, increments, max_distance, sigma
):
    """`pairs` on one core: for a few, where waiting for the others would take longer."""
    count = len(first)
    T, hessians, gradients = np.empty((count, 3)), np.empty((count, 3, 3)), np.empty((count, 3))
    counts = np.empty((count, 2), np.int64)
    for m in range(count):
        i, j = first[m], second[m]
        T[m] = relative(poses[j], poses[i])
        hessians[m], gradients[m], counts[m, 0], counts[m, 1] = pair(
            T[m], i, j, points, normals, kinds, firsts, increments, max_distance, sigma, 1
        )
    return T, hessians, gradients, counts


@numba.njit(cache=True, nogil=True)
def match(  # type: ignore[no-untyped-def]
    start,
    guess,
    scan_points,
    scan_normals,
    scan_kinds,
    references,
    poses,
    points,
    normals,
    kinds,
    firsts,
    increments,
    max_distance,
    min_distance,
    max_sigma,
    min_sigma,
    iterations,
    prior,
):
    """Lay a scan on keyframes at fixed poses, from a start (3,) on, pulled to a guess (3,) by a prior.

    Returns the pose (3,), the share of inliers, the hessian (3, 3) of one keyframe with the prior, and the beams seen.

    Gauss-Newton; search distance and sigma (m) shrink geometrically over so many iterations; twice as many are run
    where the scan has not come to rest by then. prior: (3, 3) information of the guess in the
    units of the hessian.
    """
    pose = start.copy()
    total = np.zeros((3, 3))
    inliers = seen = 0
    count = max(1, len(references))
    for iteration in range(2 * iterations):
        share = min(1.0, iteration / max(1, iterations - 3))
        distance = max_distance * (min_distance / max_distance) ** share
        sigma = max_sigma * (min_sigma / max_sigma) ** share
        total[:] = 0.0
        pull = np.zeros(3)
        inliers = seen = 0
        for k in references:
            hessian = np.zeros((3, 3))
            gradient = np.zeros(3)
            more, viewed = accumulate(
                relative(poses[k], pose),
                scan_points,
                scan_normals,
                scan_kinds,
                points[k],
                normals[k],
                kinds[k],
                firsts[k],
                increments[k],
                distance,
                sigma,
                1,
                False,
                hessian,
                gradient,
            )
            inliers += more
            seen += viewed
            # From the frame of the keyframe to that of the map.
            cos, sin = math.cos(poses[k, 2]), math.sin(poses[k, 2])
            turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
            total += turn @ hessian @ turn.T
            pull += turn @ gradient
        total /= count
        pull /= count
        off = pose - guess
        off[2] = wrap(off[2])
        pull += prior @ off
        total += prior
        change = -np.linalg.solve(total, pull)
        pose += change
        pose[2] = wrap(pose[2])
        if iteration >= iterations - 3 and abs(change[0]) + abs(change[1]) < 2e-4 and abs(change[2]) < 1e-4:
            break
    return pose, inliers / max(1, seen), total, seen


# A point counts as seen again within this (m, and share of the range), and as contradicted where it lies in front of
# what the other scan saw by more than twice that.
_SAME_PLACE_M, _SAME_PLACE_SHARE = 0.15, 0.02


@numba.njit(cache=True, nogil=True)
def agreement(T_b_a, points_a, kinds_a, points_b, kinds_b, first_b, increment_b, step):  # type: ignore[no-untyped-def]
    """How many points of a scan b sees, too, and how many lie where b looked through: a place that it knows as free."""
    cos, sin = math.cos(T_b_a[2]), math.sin(T_b_a[2])
    same = against = 0
    turn = round(2 * math.pi / increment_b)
    for i in range(0, len(points_a), step):
        if kinds_a[i] == INVALID:
            continue
        x = cos * points_a[i, 0] - sin * points_a[i, 1] + T_b_a[0]
        y = sin * points_a[i, 0] + cos * points_a[i, 1] + T_b_a[1]
        r = math.hypot(x, y)
        near = _SAME_PLACE_M + _SAME_PLACE_SHARE * r
        beam = nearest_beam(x, y, points_b, kinds_b, first_b, increment_b, near, 1)
        if beam >= 0:
            same += 1
            continue
        if beam == -2:
            continue
        bearing = math.atan2(y, x) - first_b
        center = round((bearing - 2 * math.pi * math.floor(bearing / (2 * math.pi))) / increment_b)
        through = 0
        for k in range(center - 1, center + 2):
            b = k % turn
            if b < len(points_b) and kinds_b[b] != INVALID:
                if r < math.hypot(points_b[b, 0], points_b[b, 1]) - 2 * near:
                    through += 1
                else:
                    through -= 9
        if through > 0:
            against += 1
    return same, against


@numba.njit(cache=True, nogil=True)
def agreements(  # type: ignore[no-untyped-def]
    pose, scan_points, scan_kinds, first, increment, references, poses, points, kinds, firsts, increments, step
):
    """Both ways, against several keyframes: points seen again, points contradicted."""
    same = against = 0
    for k in references:
        a, b = agreement(
            relative(poses[k], pose), scan_points, scan_kinds, points[k], kinds[k], firsts[k], increments[k], step
        )
        same += a
        against += b
        a, b = agreement(relative(pose, poses[k]), points[k], kinds[k], scan_points, scan_kinds, first, increment, step)
        same += a
        against += b
    return same, against
