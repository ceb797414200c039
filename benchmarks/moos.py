# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A log of the New College data set (Smith et al., "The New College vision and laser data set", IJRR 28(5), 2009).

A text file of MOOS: two lasers that look to the sides of a robot and scan upright planes, and its wheel odometry.
"""

from __future__ import annotations

import gzip
import math
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory

Float = NDArray[np.float64]

# The log does not say where the lasers are: the beams that look 45 deg down say 0.75 m over the ground.
HEIGHT_M, SIDE_M = 0.75, 0.2

_SCAN = re.compile(
    r" LMS_LASER_2D_(LEFT|RIGHT) .*?[, ]time=([\d.]+),angRes=([\d.]+).*?minAngle=([\d.]+).*?Range=\[\d+\]\{([^}]*)\}"
)
_POSE = re.compile(r" ODOMETRY_POSE .*?Pose=\[3x1\]\{([^}]*)\}.*?time=([\d.]+)")


def read_alog(path: Path) -> tuple[dict[str, list[Scan]], Trajectory]:
    """Scans of the lasers "left" and "right", and T_odom_base by the wheels, on level ground; x forward, y left.

    The tilt that is in the log, too, is too unsteady to help.
    """
    scans: dict[str, list[Scan]] = {"left": [], "right": []}
    stamps, poses = [], []
    with gzip.open(path, "rt", errors="replace") as lines:
        for line in lines:
            if found := _SCAN.search(line):
                side, time, spacing, first, ranges = found.groups()
                scans[side.lower()].append(_scan(float(time), float(spacing), float(first), ranges))
            elif found := _POSE.search(line):
                # There y is forward, and so is a yaw of 0.
                x, y, yaw = map(float, found[1].split(","))
                stamps.append(float(found[2]))
                poses.append((x, y, yaw + math.pi / 2))
    return scans, Trajectory.from_se2(stamps, np.reshape(poses, (-1, 3)))


def _scan(stamp: float, spacing: float, first: float, ranges: str) -> Scan:
    """Level is 90 deg there and 0 here. A range below 0 says that nothing came back."""
    values = np.array(ranges.split(","), np.float32)
    values[values <= 0] = np.inf
    # Within a scan the robot moves by a few millimetres.
    return Scan(stamp, values, math.radians(first - 90), math.radians(spacing))


def mounting_pose(side: str) -> Float:
    """T_base_laser (4, 4): the x axis of a laser looks to its side; the left one scans upwards, the right one down."""
    sign = 1.0 if side == "left" else -1.0
    T = np.eye(4)
    T[:3, :3] = np.column_stack([(0.0, sign, 0.0), (0.0, 0.0, sign), (1.0, 0.0, 0.0)])
    T[:3, 3] = 0.0, sign * SIDE_M, HEIGHT_M
    return T
