# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Beams to points: each by the pose of the robot at the beam's own time."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from g2_recon.kernels import inner_kernel, kernel

Float = NDArray[np.float64]


@kernel
def place_beams(in_laser, times, stamps, positions, quaternions, T_base_laser, max_gap):  # type: ignore[no-untyped-def]
    """Points and sensor positions (M, 3) in the map frame, and a mask (M,) of those whose pose is known.

    in_laser: (M, 2) m. times: (M,) s, of the beams. stamps (N,) s, ascending, positions (N, 3) m, quaternions (N, 4)
    x y z w: T_map_base of the robot; between two poses at most `max_gap` s apart it moves evenly on a line and turns
    evenly (slerp; Shoemake, "Animating rotation with quaternion curves", 1985). Nothing is extrapolated.
    """
    count, last = len(times), len(stamps) - 1
    points, sensor, known = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count, np.bool_)
    right = 0
    for i in range(count):
        time = times[i]
        if last < 0 or not stamps[0] <= time <= stamps[last]:
            continue
        if right > last or (right > 0 and stamps[right - 1] >= time):
            right = 0
        while stamps[right] < time:
            right += 1
        left = right if stamps[right] == time else right - 1
        gap = stamps[right] - stamps[left]
        if gap > max_gap:
            continue
        known[i] = True
        share = 0.0 if gap == 0.0 else (time - stamps[left]) / gap
        x, y, z, w = _slerp(quaternions[left], quaternions[right], share)
        # Where the point is on the robot, then turned as the robot is: v + 2 q x (q x v + w v).
        for what in range(2):
            u, v = (in_laser[i, 0], in_laser[i, 1]) if what == 0 else (0.0, 0.0)
            px = T_base_laser[0, 0] * u + T_base_laser[0, 1] * v + T_base_laser[0, 3]
            py = T_base_laser[1, 0] * u + T_base_laser[1, 1] * v + T_base_laser[1, 3]
            pz = T_base_laser[2, 0] * u + T_base_laser[2, 1] * v + T_base_laser[2, 3]
            cx, cy, cz = y * pz - z * py + w * px, z * px - x * pz + w * py, x * py - y * px + w * pz
            target = points if what == 0 else sensor
            target[i, 0] = px + 2.0 * (y * cz - z * cy)
            target[i, 1] = py + 2.0 * (z * cx - x * cz)
            target[i, 2] = pz + 2.0 * (x * cy - y * cx)
            for axis in range(3):
                target[i, axis] += (1.0 - share) * positions[left, axis] + share * positions[right, axis]
    return points, sensor, known


@kernel
def pose_at(time, stamps, positions, quaternions):  # type: ignore[no-untyped-def]
    """Position (3,), m, and quaternion (4,), x y z w, of the robot at a time in seconds, by one or more poses.

    Between two poses as for `place_beams`; before the first and after the last one it stands there.
    """
    right = min(np.searchsorted(stamps, time), len(stamps) - 1)
    left = max(right - 1, 0)
    gap = stamps[right] - stamps[left]
    share = 1.0 if gap == 0.0 else min(max((time - stamps[left]) / gap, 0.0), 1.0)
    quaternion = _slerp(quaternions[left], quaternions[right], share)
    return (1.0 - share) * positions[left] + share * positions[right], np.array(quaternion)


@inner_kernel
def _slerp(a, b, share):  # type: ignore[no-untyped-def]
    """The unit quaternion a share of the shortest way from `a` to `b`."""
    cos = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    sign = -1.0 if cos < 0.0 else 1.0
    angle = math.acos(min(abs(cos), 1.0))
    from_a, from_b = 1.0 - share, sign * share
    # Below that the way is straight to the last digit.
    if angle > 1e-4:
        from_a, from_b = math.sin(from_a * angle) / math.sin(angle), sign * math.sin(share * angle) / math.sin(angle)
    x, y, z, w = (
        from_a * a[0] + from_b * b[0],
        from_a * a[1] + from_b * b[1],
        from_a * a[2] + from_b * b[2],
        from_a * a[3] + from_b * b[3],
    )
    length = math.sqrt(x * x + y * y + z * z + w * w)
    return x / length, y / length, z / length, w / length
