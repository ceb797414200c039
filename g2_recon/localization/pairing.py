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

from g2_recon.geometry.se2_kernels import inverse, relative, solve_3x3, wrap
from g2_recon.kernels import inner_kernel, kernel
from g2_recon.localization.beams import ANY_KIND, CORNER, INVALID, SURFACE

Float = NDArray[np.float64]

PAIR_SIGMA_M = 0.05
"""What one pair of points is trusted with, against wheels and guesses; neighboring beams err together."""

NO_PARTNER, OUT_OF_VIEW = -1, -2
"""Instead of the index of a beam: none near enough; the other scan did not look there."""

# Normals of partners differ by less than acos of this.
_LIKE_NORMAL = 0.8
# Beams to either side of the expected bearing are looked at within this, rad; the sine of such an angle is at least
# this share of it.
_WIDEST_SEARCH = 0.53
_SINE_SHARE = 0.95
# A partner counts as inlier up to this many of the robust kernel's sigma.
_INLIER_SIGMAS = 2.5
# A partner that is on no surface may be farther by this share of the distance from beam to beam, and the kernel is
# wider by that. With the weight 1 a beam on a surface has this sigma, m.
_BEAMS_APART, _LOOSE_SHARE, _SURFACE_SIGMA_M = 0.5, 0.3, 0.045
# Nearer points have no bearing to speak of, m.
_AT_THE_LASER_M = 0.05

_F = np.float32
# atan(t) for t in 0 to 1 within 1e-5 rad (Hastings, Approximations for digital computers, 1955): a vector loop cannot
# call the library's.
_A0, _A1, _A2 = _F(0.99997726), _F(-0.33262347), _F(0.19354346)
_A3, _A4, _A5 = _F(-0.11643287), _F(0.05265332), _F(-0.01172120)
_PI, _HALF_PI, _FULL_TURN, _TURNS_PER_RAD = _F(math.pi), _F(math.pi / 2), _F(2 * math.pi), _F(0.5 / math.pi)
_TINY = _F(1e-9)
_FAR = _F(1e18)


@kernel
def picked(points, normals, kinds, these, step):  # type: ignore[no-untyped-def]
    """Every `step`-th beam, if it is of one of the kinds: x, y, nx, ny as rows of (4, N)."""
    rows = np.empty((4, (len(points) + step - 1) // step), np.float32)
    count = 0
    for i in range(0, len(points), step):
        if kinds[i] & these:
            rows[0, count], rows[1, count] = points[i, 0], points[i, 1]
            rows[2, count], rows[3, count] = normals[i, 0], normals[i, 1]
            count += 1
    return rows[:, :count]


@inner_kernel(fastmath=True, error_model="numpy")
def _project(T_b_a, rows, first, increment, distance, share, at, where):  # type: ignore[no-untyped-def]
    """Where points x, y of a scan a appear in a scan b.

    at: x, y, range, and the square of how far a partner may be (m: distance + share * range), as rows of (4, N).
    where: beam of b at that bearing, and how many beams to either side may be near enough, as rows of (2, N).
    """
    cos, sin = _F(math.cos(T_b_a[2])), _F(math.sin(T_b_a[2]))
    tx, ty, start, per_rad = _F(T_b_a[0]), _F(T_b_a[1]), _F(first), _F(1.0 / increment)
    base, share, nearest, widest = _F(distance), _F(share), _F(_AT_THE_LASER_M), _F(_WIDEST_SEARCH)
    xs, ys, ranges, limits = at[0], at[1], at[2], at[3]
    centers, reaches = where[0], where[1]
    a_xs, a_ys = rows[0], rows[1]
    for i in range(rows.shape[1]):
        x = cos * a_xs[i] - sin * a_ys[i] + tx
        y = sin * a_xs[i] + cos * a_ys[i] + ty
        r = np.sqrt(x * x + y * y) + _TINY
        abs_x, abs_y = abs(x), abs(y)
        t = min(abs_x, abs_y) / (max(abs_x, abs_y) + _TINY)
        s = t * t
        bearing = t * (_A0 + s * (_A1 + s * (_A2 + s * (_A3 + s * (_A4 + s * _A5)))))
        bearing = _HALF_PI - bearing if abs_y > abs_x else bearing
        bearing = _PI - bearing if x < _F(0) else bearing
        bearing = -bearing if y < _F(0) else bearing
        offset = bearing - start
        offset -= _FULL_TURN * np.floor(offset * _TURNS_PER_RAD)
        limit = base + share * r
        xs[i], ys[i], ranges[i] = x, y, r
        limits[i] = limit * limit if r > nearest else _F(-1)
        centers[i] = np.int32(offset * per_rad + _F(0.5))
        reaches[i] = np.int32(min(limit / r, widest) * per_rad) + np.int32(1)


@numba.njit(nogil=True, inline="always", error_model="numpy")
def _squared_distance(points, kinds, beam, x, y, kind):  # type: ignore[no-untyped-def]
    dx, dy = points[beam, 0] - x, points[beam, 1] - y
    squared = dx * dx + dy * dy
    return squared if kinds[beam] & kind else _FAR


@kernel(error_model="numpy")
def _search(points, kinds, increment, kind, at, where, partners):  # type: ignore[no-untyped-def]
    """For points that were projected into a scan, the nearest of its beams of the kinds."""
    turn = int(2 * math.pi / increment + 0.5)
    # A beam that comes a full turn after the first one measures the same place again.
    count = min(len(points), turn)
    xs, ys, ranges, limits = at[0], at[1], at[2], at[3]
    spacing = _F(_SINE_SHARE * increment)
    for i in range(len(partners)):
        center, reach = np.int64(where[0, i]), np.int64(where[1, i])
        best = limits[i]
        if best < _F(0) or (center - reach >= count and center + reach < turn):
            partners[i] = OUT_OF_VIEW
            continue
        x, y = xs[i], ys[i]
        found = np.int64(NO_PARTNER)
        # Beams at k to either side of the center are at least k - 1/2 spacings away from the ray to the point.
        nearest = ranges[i] * spacing
        begin = 0
        if center >= 1 and center + 1 < count:
            # The usual case, without branches that a processor could only guess.
            middle = _squared_distance(points, kinds, center, x, y, kind)
            right = _squared_distance(points, kinds, center - 1, x, y, kind)
            left = _squared_distance(points, kinds, center + 1, x, y, kind)
            if middle < best:
                best, found = middle, center
            if right < best:
                best, found = right, center - 1
            if left < best:
                best, found = left, center + 1
            begin = 2
        for k in range(begin, reach + 1):
            bound = (_F(k) - _F(0.51)) * nearest
            if k and bound * bound >= best:
                break
            # Beyond the last beam of a full turn comes the first.
            beam = center + k
            if beam >= turn:
                beam -= turn
            if beam < count:
                squared = _squared_distance(points, kinds, beam, x, y, kind)
                if squared < best:
                    best, found = squared, beam
            beam = center - k
            if beam < 0:
                beam += turn
            if beam < count:
                squared = _squared_distance(points, kinds, beam, x, y, kind)
                if squared < best:
                    best, found = squared, beam
        partners[i] = found


@kernel
def room(count: int):  # type: ignore[no-untyped-def]
    """Working memory for `partners` and `accumulate` of up to so many beams."""
    return np.empty((4, count), np.float32), np.empty((2, count), np.int32), np.empty(count, np.int32)


@kernel
def partners(  # type: ignore[no-untyped-def]
    T_b_a, rows, points, kinds, first, increment, distance, share, kind, memory
):
    """For points of a scan a (rows: see `picked`) the nearest beams (N,) of the kinds in a scan b.

    A partner lies within distance (m) + share * range. NO_PARTNER: none is so near. OUT_OF_VIEW: b does not look there.
    """
    at, where, found = memory
    count = rows.shape[1]
    at, where, found = at[:, :count], where[:, :count], found[:count]
    _project(T_b_a, rows, first, increment, distance, share, at, where)
    _search(points, kinds, increment, kind, at, where, found)
    return found


@inner_kernel(fastmath=True, error_model="numpy")
def _sum(T_b_a, rows, at, found, points, normals, sigma, backwards, hessian, gradient):  # type: ignore[no-untyped-def]
    cos, sin = _F(math.cos(T_b_a[2])), _F(math.sin(T_b_a[2]))
    tx, ty = _F(T_b_a[0]), _F(T_b_a[1])
    per_squared, farthest, like = _F(1 / sigma**2), _F(_INLIER_SIGMAS * sigma), _F(_LIKE_NORMAL)
    inliers = seen = 0
    h00 = h01 = h02 = h11 = h12 = h22 = g0 = g1 = g2 = 0.0
    for i in range(len(found)):
        beam = found[i]
        if beam == OUT_OF_VIEW:
            continue
        seen += 1
        if beam == NO_PARTNER:
            continue
        nx, ny = normals[beam, 0], normals[beam, 1]
        mx, my = cos * rows[2, i] - sin * rows[3, i], sin * rows[2, i] + cos * rows[3, i]
        if nx * mx + ny * my < like:
            continue
        x, y = at[0, i], at[1, i]
        error = nx * (x - points[beam, 0]) + ny * (y - points[beam, 1])
        weight = _F(1) / (_F(1) + error * error * per_squared)
        weight *= weight
        if abs(error) < farthest:
            inliers += 1
        if backwards:
            # Estimated is T_a_b. Seen from a, the normal of the partner n is turned back; the residual is
            # n . (p - T_a_b q), and its derivative by yaw turns that normal.
            jx, jy = -(cos * nx + sin * ny), sin * nx - cos * ny
            jt = nx * y - ny * x
        else:
            jx, jy = nx, ny
            jt = ny * (x - tx) - nx * (y - ty)
        # In double precision, so that a sum stays positive definite.
        jx, jy, jt, error = float(jx), float(jy), float(jt), float(error)
        wx, wy, wt = weight * jx, weight * jy, weight * jt
        h00 += wx * jx
        h01 += wx * jy
        h02 += wx * jt
        h11 += wy * jy
        h12 += wy * jt
        h22 += wt * jt
        g0 += wx * error
        g1 += wy * error
        g2 += wt * error
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


@kernel
def parted(points, normals, kinds, loose, step):  # type: ignore[no-untyped-def]
    """Beams on surfaces, and loose ones of the kinds given, as two tables; see `picked`."""
    return picked(points, normals, kinds, SURFACE, step), picked(points, normals, kinds, loose, step)


@inner_kernel(fastmath=True, error_model="numpy")
def _sum_loose(T_b_a, rows, at, found, points, sigma, increment, backwards, hessian, gradient):  # type: ignore[no-untyped-def]
    """`_sum` for points on no surface: the residual is the way to the partner.

    A corner lies somewhere between two beams, so that the kernel is wider and the weight less where they are apart.
    """
    cos, sin = math.cos(T_b_a[2]), math.sin(T_b_a[2])
    tx, ty = T_b_a[0], T_b_a[1]
    h02 = h12 = h22 = g0 = g1 = g2 = total = 0.0
    for i in range(len(found)):
        beam = found[i]
        if beam < 0:
            continue
        x, y = float(at[0, i]), float(at[1, i])
        bx, by = float(points[beam, 0]), float(points[beam, 1])
        ex, ey = x - bx, y - by
        width = sigma + _LOOSE_SHARE * increment * at[2, i]
        weight = (_SURFACE_SIGMA_M / (width * (1 + (ex * ex + ey * ey) / width**2))) ** 2
        if backwards:
            # Seen from a, whose pose T_a_b is estimated, the partner moves.
            ux, uy = cos * bx + sin * by, -sin * bx + cos * by
            ex, ey = -(cos * ex + sin * ey), sin * ex - cos * ey
        else:
            ux, uy = x - tx, y - ty
        # d(residual) = [[1, 0, -uy], [0, 1, ux]] d(x, y, yaw).
        total += weight
        h02 -= weight * uy
        h12 += weight * ux
        h22 += weight * (ux * ux + uy * uy)
        g0 += weight * ex
        g1 += weight * ey
        g2 += weight * (ux * ey - uy * ex)
    hessian[0, 0] += total
    hessian[1, 1] += total
    hessian[0, 2] += h02
    hessian[2, 0] += h02
    hessian[1, 2] += h12
    hessian[2, 1] += h12
    hessian[2, 2] += h22
    gradient[0] += g0
    gradient[1] += g1
    gradient[2] += g2


@kernel
def accumulate(  # type: ignore[no-untyped-def]
    T_b_a, rows, points, normals, kinds, first, increment, distance, sigma, backwards, hessian, gradient, memory, loose
):
    """Add what beams of a scan a (rows: see `parted`) say about T_b_a, for a step added to it.

    hessian: (3, 3), gradient: (3,). The residual is the distance of a point on a surface from the line through its
    partner in b (Chen and Medioni, 1992), at most `distance` m away, and of a point of the kinds `loose` from its
    partner among such, weighted by Geman and McClure's kernel of width sigma (m). With `backwards` the roles of the
    given transform are swapped: T_b_a is the inverse of what is estimated, and so are hessian and gradient those of
    that inverse. Returns how many beams on surfaces found a partner that fits, and how many lie in view of b.
    """
    on_surfaces, others = rows
    reach = _BEAMS_APART * increment
    found = partners(T_b_a, others, points, kinds, first, increment, distance, reach, loose, memory)
    _sum_loose(T_b_a, others, memory[0], found, points, sigma, increment, backwards, hessian, gradient)
    found = partners(T_b_a, on_surfaces, points, kinds, first, increment, distance, 0.0, SURFACE, memory)
    return _sum(T_b_a, on_surfaces, memory[0], found, points, normals, sigma, backwards, hessian, gradient)


@kernel
def pair(T_j_i, i, j, points, normals, kinds, firsts, increments, distance, sigma, loose, step):  # type: ignore[no-untyped-def]
    """What keyframes i and j say about T_j_i, each scan laid on the other: hessian, gradient, inliers, seen.

    loose: kinds of beams on no surface that count. Every `step`-th beam is used.
    """
    rows = parted(points[i], normals[i], kinds[i], loose, step)
    memory = room(kinds.shape[1])
    return pair_of(T_j_i, i, rows, j, points, normals, kinds, firsts, increments, distance, sigma, loose, step, memory)


@inner_kernel
def pair_of(  # type: ignore[no-untyped-def]
    T_j_i, i, rows, j, points, normals, kinds, firsts, increments, distance, sigma, loose, step, memory
):
    """`pair`, for a keyframe i that many are laid on: its beams are parted already into rows."""
    hessian = np.zeros((3, 3))
    gradient = np.zeros(3)
    inliers, seen = accumulate(
        T_j_i, rows, points[j], normals[j], kinds[j], firsts[j], increments[j],
        distance, sigma, False, hessian, gradient, memory, loose,
    )  # fmt: skip
    more, seen_back = accumulate(
        inverse(T_j_i), parted(points[j], normals[j], kinds[j], loose, step),
        points[i], normals[i], kinds[i], firsts[i], increments[i],
        distance, sigma, True, hessian, gradient, memory, loose,
    )  # fmt: skip
    return hessian, gradient, inliers + more, seen + seen_back


@kernel(parallel=True)
def pairs(poses, first, second, points, normals, kinds, firsts, increments, distance, sigma, loose, step):  # type: ignore[no-untyped-def]
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
            T[m], i, j, points, normals, kinds, firsts, increments, distance, sigma, loose, step
        )
    return T, hessians, gradients, counts


@kernel
def add_turned(hessian, gradient, yaw, total, pull):  # type: ignore[no-untyped-def]
    """Add hessian (3, 3) and gradient (3,) of a step in a frame turned by yaw to those of a step in the parent's."""
    c, s = math.cos(yaw), math.sin(yaw)
    xx, xy, yy, xt, yt = hessian[0, 0], hessian[0, 1], hessian[1, 1], hessian[0, 2], hessian[1, 2]
    total[0, 0] += c * c * xx - 2 * c * s * xy + s * s * yy
    total[1, 1] += s * s * xx + 2 * c * s * xy + c * c * yy
    cross = c * s * (xx - yy) + (c * c - s * s) * xy
    total[0, 1] += cross
    total[1, 0] += cross
    total[0, 2] += c * xt - s * yt
    total[2, 0] += c * xt - s * yt
    total[1, 2] += s * xt + c * yt
    total[2, 1] += s * xt + c * yt
    total[2, 2] += hessian[2, 2]
    pull[0] += c * gradient[0] - s * gradient[1]
    pull[1] += s * gradient[0] + c * gradient[1]
    pull[2] += gradient[2]


@kernel
def add_levered(one, pull, x, y, hessian, gradient):  # type: ignore[no-untyped-def]
    """Add hessian (3, 3) and gradient (3,) of a step at x, y from the origin to those of a step of the origin."""
    # d(step there) / d(step here) = [[1, 0, -y], [0, 1, x], [0, 0, 1]].
    a, b, d = one[0, 0], one[0, 1], one[1, 1]
    e = one[0, 2] - y * a + x * b
    f = one[1, 2] - y * b + x * d
    hessian[0, 0] += a
    hessian[0, 1] += b
    hessian[1, 0] += b
    hessian[1, 1] += d
    hessian[0, 2] += e
    hessian[2, 0] += e
    hessian[1, 2] += f
    hessian[2, 1] += f
    hessian[2, 2] += one[2, 2] + x * one[1, 2] - y * one[0, 2] - y * e + x * f
    gradient[0] += pull[0]
    gradient[1] += pull[1]
    gradient[2] += pull[2] - y * pull[0] + x * pull[1]


@inner_kernel
def lay(  # type: ignore[no-untyped-def]
    pose,
    rows,
    references,
    poses,
    points,
    normals,
    kinds,
    firsts,
    increments,
    distance,
    sigma,
    hessian,
    gradient,
    memory,
):
    """`accumulate` for a scan at a pose (3,) and several keyframes, for a step added to that pose."""
    one, pull = np.zeros((3, 3)), np.zeros(3)
    inliers = seen = 0
    for k in references:
        one[:] = 0.0
        pull[:] = 0.0
        more, viewed = accumulate(
            relative(poses[k], pose), rows, points[k], normals[k], kinds[k], firsts[k], increments[k],
            distance, sigma, False, one, pull, memory, CORNER,
        )  # fmt: skip
        inliers += more
        seen += viewed
        add_turned(one, pull, poses[k, 2], hessian, gradient)
    return inliers, seen


@kernel
def match(  # type: ignore[no-untyped-def]
    start, guess, scan_points, scan_normals, scan_kinds, references, poses, points, normals, kinds, firsts, increments,
    max_distance, min_distance, max_sigma, min_sigma, iterations, prior,
):  # fmt: skip
    """Lay a scan on keyframes at fixed poses, from a start (3,) on, pulled to a guess (3,) by a prior.

    Returns the pose (3,), the share of inliers, the hessian (3, 3) of one keyframe with the prior, and the beams seen.

    Gauss-Newton; search distance and sigma (m) shrink geometrically over so many iterations; twice as many are run
    where the scan has not come to rest by then. prior: (3, 3) information of the guess in the
    units of the hessian.
    """
    pose = start.copy()
    total, pull = np.zeros((3, 3)), np.zeros(3)
    rows = parted(scan_points, scan_normals, scan_kinds, CORNER, 1)
    memory = room(len(scan_kinds))
    inliers = seen = 0
    count = max(1, len(references))
    for iteration in range(2 * iterations):
        share = min(1.0, iteration / max(1, iterations - 3))
        distance = max_distance * (min_distance / max_distance) ** share
        sigma = max_sigma * (min_sigma / max_sigma) ** share
        total[:] = 0.0
        pull[:] = 0.0
        inliers, seen = lay(
            pose,
            rows,
            references,
            poses,
            points,
            normals,
            kinds,
            firsts,
            increments,
            distance,
            sigma,
            total,
            pull,
            memory,
        )
        total /= count
        pull /= count
        off = pose - guess
        off[2] = wrap(off[2])
        for u in range(3):
            for v in range(3):
                pull[u] += prior[u, v] * off[v]
        total += prior
        change = solve_3x3(total, pull)
        pose -= change
        pose[2] = wrap(pose[2])
        if iteration >= iterations - 3 and abs(change[0]) + abs(change[1]) < 2e-4 and abs(change[2]) < 1e-4:
            break
    return pose, inliers / max(1, seen), total, seen


# A point counts as seen again within this (m, and share of the range), and as contradicted where it lies in front of
# what the other scan saw by more than twice that.
_SAME_PLACE_M, _SAME_PLACE_SHARE = 0.15, 0.02


@kernel
def agreement(T_b_a, rows, points, kinds, first, increment, memory):  # type: ignore[no-untyped-def]
    """How many points of a scan (rows: see `picked`) b sees, too, and how many lie where b looked through.

    The latter are at a place that b knows to be free.
    """
    same = against = 0
    turn = int(2 * math.pi / increment + 0.5)
    found = partners(T_b_a, rows, points, kinds, first, increment, _SAME_PLACE_M, _SAME_PLACE_SHARE, ANY_KIND, memory)
    at, where, _ = memory
    for i in range(len(found)):
        if found[i] >= 0:
            same += 1
        elif found[i] == NO_PARTNER:
            r = at[2, i]
            margin = 2 * (_SAME_PLACE_M + _SAME_PLACE_SHARE * r)
            through = 0
            for k in range(where[0, i] - 1, where[0, i] + 2):
                beam = k % turn
                if beam < len(points) and kinds[beam] != INVALID:
                    if r < math.hypot(points[beam, 0], points[beam, 1]) - margin:
                        through += 1
                    else:
                        through -= 9
            if through > 0:
                against += 1
    return same, against


@inner_kernel
def agreements_each_way(  # type: ignore[no-untyped-def]
    pose, scan_points, scan_normals, scan_kinds, first, increment,
    references, poses, points, normals, kinds, firsts, increments, step,
):  # fmt: skip
    """`agreement` of a scan at a pose (3,) with several keyframes, then of them with the scan: two counts each."""
    same = against = still = gone = 0
    rows = picked(scan_points, scan_normals, scan_kinds, ANY_KIND, step)
    memory = room(max(len(scan_kinds), kinds.shape[1]))
    for k in references:
        a, b = agreement(relative(poses[k], pose), rows, points[k], kinds[k], firsts[k], increments[k], memory)
        same += a
        against += b
        back = picked(points[k], normals[k], kinds[k], ANY_KIND, step)
        a, b = agreement(relative(pose, poses[k]), back, scan_points, scan_kinds, first, increment, memory)
        still += a
        gone += b
    return same, against, still, gone


@kernel
def agreements(  # type: ignore[no-untyped-def]
    pose, scan_points, scan_normals, scan_kinds, first, increment,
    references, poses, points, normals, kinds, firsts, increments, step,
):  # fmt: skip
    """Both ways, against several keyframes: points seen again, points contradicted."""
    same, against, still, gone = agreements_each_way(
        pose, scan_points, scan_normals, scan_kinds, first, increment,
        references, poses, points, normals, kinds, firsts, increments, step,
    )  # fmt: skip
    return same + still, against + gone
