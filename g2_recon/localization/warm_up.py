# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The kernels of localization, run once: so that they are compiled or, where they are already, loaded from the disk."""

from __future__ import annotations

import numpy as np

from g2_recon.config import LocalizationConfig
from g2_recon.geometry.scan import Scan
from g2_recon.localization import likelihood, pose_graph
from g2_recon.localization.beams import Beams, beams
from g2_recon.localization.drawn_keyframes import DrawnKeyframes
from g2_recon.localization.keyframes import Keyframes
from g2_recon.localization.localizer import Localizer
from g2_recon.localization.map_localizer import MapLocalizer
from g2_recon.localization.methods import make_localizer
from g2_recon.localization.occupancy import GridBuilder
from g2_recon.localization.smoothing import Smoother
from g2_recon.localization.uncertainty import Uncertainty


def warm_up_localization() -> None:
    """All kernels of localization."""
    for method in ("graph", "paper"):
        _drive_up_and_down(LocalizationConfig(method=method))


def warm_up_tracking() -> None:
    """Those that the first scans in a new map need."""
    localizer = Localizer(LocalizationConfig(), np.eye(4))
    for stamp, x in enumerate(np.arange(-8.0, -6.0, 0.2).tolist()):
        localizer.process(_scan_in_the_hall(0.1 * stamp, x), (x, 0.0, 0.3 if stamp == 5 else 0.0))


def warm_up_matching() -> None:
    """Those of them that lay scans on each other."""
    localizer, keyframes = Localizer(LocalizationConfig(), np.eye(4)), Keyframes()
    for index, x in enumerate((-8.0, -7.95)):
        scan = _scan_in_the_hall(0.1 * index, x)
        localizer.process(scan, (x, 0.0, 0.0))
        keyframes.add(beams(scan, range_min=0.1, range_max=30.0), np.array([x, 0.0, 0.0]))
    Smoother(keyframes).refill(np.zeros((2, 3)), 0)


def warm_up_smoothing() -> None:
    """Those of them that improve poses by edges, tell how sure they are, and search in what is drawn of keyframes."""
    keyframes = Keyframes()
    nothing = Beams(np.zeros((3, 2), np.float32), np.zeros((3, 2), np.float32), np.zeros(3, np.uint8), 0.0, 0.5)
    uncertainty, step = Uncertainty(keyframes), np.array([0.3, 0.0, 0.0])
    for index in range(3):
        keyframes.add(nothing, index * step)
        uncertainty.add(None, wheels=step, broken=False)
    edges = pose_graph.measured(
        np.array([1, 2]), np.array([0, 1]), np.tile(step, (2, 1)), np.tile(np.eye(3), (2, 1, 1))
    )
    pose_graph.solve_window(keyframes.poses, 1, edges.first, edges.second, edges.T, edges.hessians, edges.gradients, 1)
    uncertainty.add(pose_graph.at_poses(keyframes.poses, edges), wheels=step, broken=False)
    drawn = DrawnKeyframes(keyframes, cells=32, resolution=0.05, sigma=0.05, reach=1)
    drawn.update(0)
    likelihood.search(
        drawn.grid, drawn.wide, nothing.points, nothing.kinds, step,
        drawn.corner[0], drawn.corner[1], drawn.resolution, 1, 0.1, 1, 1,
    )  # fmt: skip


def warm_up_mapping() -> None:
    """Those of method graph."""
    _drive_up_and_down(LocalizationConfig())


def _drive_up_and_down(config: LocalizationConfig) -> None:
    """Localize in a room of 12 m x 8 m, far enough to close a loop, with one wrong step of the odometry."""
    localizer = make_localizer(config, np.eye(4), keep_scans=True)
    grid = GridBuilder()
    for index, x in enumerate(np.abs(np.arange(-8.0, 40.0, 0.2) % 16.0 - 8.0).tolist()):
        scan = _scan_in_the_hall(0.1 * index, x)
        pose = localizer.process(scan, (x, 0.0, 0.3 if index == 9 else 0.0)).pose
        if index < 3:
            grid.add(pose, scan.angles(), scan.ranges.astype(float))
    localizer.finish()
    localizer.point_map()
    grid.grid()
    if isinstance(localizer, Localizer):
        in_map = MapLocalizer(config, np.eye(4), localizer.session())
        for _ in range(2):
            in_map.process(scan)
        in_map.reset(localizer.trajectory().planar()[-1])
        for _ in range(2):
            in_map.process(scan)


def _scan_in_the_hall(stamp: float, x: float) -> Scan:
    angles = np.linspace(-np.pi / 2, np.pi / 2, 181)
    cos, sin = np.cos(angles), np.sin(angles)
    along = np.where(cos > 0, (11.0 - x) / np.maximum(cos, 1e-9), np.inf)
    across = np.where(sin > 0, 3.0 / np.maximum(sin, 1e-9), 5.0 / np.maximum(-sin, 1e-9))
    return Scan(stamp, np.minimum(along, across).astype(np.float32), angles[0], angles[1] - angles[0])
