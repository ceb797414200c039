# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What one robot recorded on one drive, wherever it was read from."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class Recording:
    """Scans and odometry of one drive, in file order.

    scans, scans_vertical: of the horizontal and the vertical laser.
    odometry: T_odom_base, as the wheels measured it.
    scan_odometry: (len(scans), 3) x, y, yaw of the robot in the odometry frame when each horizontal scan was taken,
        NaN where unknown; None: to be interpolated from `odometry`.
    scans_tilt, tilt_stamps (K,), tilt_angles (K,): scans of a laser that sweeps while the robot stands, and the
        angle in radians about the y axis of its mount at times in seconds.
    T_base_laser, T_base_laser_vertical, T_base_tilt: (4, 4) mounting poses, None where the recording does not say;
        of the sweeping laser at angle 0.
    drops: how many messages or lines were left out, by reason.
    """

    scans: list[Scan] = field(default_factory=list)
    scans_vertical: list[Scan] = field(default_factory=list)
    odometry: Trajectory = field(default_factory=lambda: Trajectory(np.empty(0), np.empty((0, 3)), np.empty((0, 4))))
    scan_odometry: NDArray[np.float64] | None = None
    scans_tilt: list[Scan] = field(default_factory=list)
    tilt_stamps: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    tilt_angles: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    T_base_laser: NDArray[np.float64] | None = None
    T_base_laser_vertical: NDArray[np.float64] | None = None
    T_base_tilt: NDArray[np.float64] | None = None
    drops: dict[str, int] = field(default_factory=dict)
