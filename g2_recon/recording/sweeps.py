# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""One sweep from a file: any cloud, or a scan of 3DTK with its pose."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.cloud import Cloud
from g2_recon.recording.clouds import read_cloud
from g2_recon.recording.slam6d import read_3d, read_3d_pose

SWEEP_ENDINGS = (".ply", ".pcd", ".xyz", ".csv", ".txt", ".npz", ".3d", ".3d.gz")


@dataclass(frozen=True, slots=True)
class Sweep:
    """name: of the file. cloud: in the frame of the laser. T_file_laser: (4, 4) where that was in the file's frame.

    T_map_file: (4, 4) where the sweep was taken, None where the file does not say.
    """

    name: str
    cloud: Cloud
    T_file_laser: NDArray[np.float64]
    T_map_file: NDArray[np.float64] | None


def read_sweep(path: str | Path) -> Sweep:
    """Read a sweep; `.3d` and `.3d.gz` as slam6d.read_3d with the `.pose` beside it, all else as clouds.read_cloud.

    The laser is at the origin, or where the file says that all its points were seen from. Raises InputError if the
    file, or its pose, cannot be read or is malformed.
    """
    name = Path(path).name
    if name.lower().endswith((".3d", ".3d.gz")):
        return Sweep(name, read_3d(path), np.eye(4), read_3d_pose(path))
    cloud = read_cloud(path)
    T_file_laser = np.eye(4)
    if cloud.sensor is not None and len(cloud) and (cloud.sensor == cloud.sensor[0]).all():
        T_file_laser[:3, 3] = cloud.sensor[0]
    return Sweep(name, Cloud(cloud.points - T_file_laser[:3, 3]), T_file_laser, None)
