# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Compile kernels, so that no first use has to wait for it: python -m g2_recon.warm_up [PART...].

Parts are tracking (of localization, in a new map), localization, registration and reconstruction (of clouds with
sensors, mode solid); without any, all kernels there are.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np

from g2_recon.config import LocalizationConfig, ReconstructionConfig, RegistrationConfig, SweepConfig
from g2_recon.evaluation.surface import score_surface
from g2_recon.geometry.cloud import Cloud
from g2_recon.geometry.mesh import TrueSurface
from g2_recon.geometry.scan import Scan
from g2_recon.localization.localizer import Localizer
from g2_recon.localization.map_localizer import MapLocalizer
from g2_recon.localization.methods import make_localizer
from g2_recon.localization.occupancy import GridBuilder
from g2_recon.reconstruction.collected_cloud import Part
from g2_recon.reconstruction.growing import GrowingReconstruction
from g2_recon.reconstruction.reconstructor import reconstruct
from g2_recon.registration.prepared_map import prepare_map
from g2_recon.registration.prepared_sweep import prepare
from g2_recon.registration.registrar import Registrar


def warm_up() -> None:
    """Run every kernel once on a few points; Numba keeps what it compiles on disk."""
    warm_up_localization()
    warm_up_registration()
    _warm_up_reconstruction()
    cloud = _corner_of_a_room(with_sensor=False)
    reconstruct(cloud, ReconstructionConfig())
    triangles = np.eye(3), np.array([[0, 1, 2], [2, 1, 0]])
    score_surface(TrueSurface(*triangles), *triangles, samples=10)
    published = ReconstructionConfig(mode="paper", clusters=4, passes=50)
    for other in ({}, {"training": "batch"}, {"clustering": "neural_gas", "presentations": 100, "passes": 1}):
        reconstruct(cloud, published.model_copy(update=other))


def warm_up_localization() -> None:
    """The same for the kernels of localization only."""
    for method in ("graph", "paper"):
        _drive_up_and_down(LocalizationConfig(method=method))


def warm_up_registration() -> None:
    """The same for the kernels of registration only."""
    registrar = Registrar(RegistrationConfig(), np.eye(4))
    registrar.add_pose(0.0, np.eye(4))
    registrar.add_scan(Scan(0.0, np.ones(2, np.float32), 0.0, 1.0))
    points = np.random.default_rng(0).uniform(-2.0, 2.0, (1000, 3))
    sweep = prepare(points, SweepConfig())
    sweep.seen_through(sweep.points, 0.1)
    prepare_map(Cloud(points, np.zeros_like(points)), SweepConfig())


def _warm_up_tracking() -> None:
    localizer = Localizer(LocalizationConfig(), np.eye(4))
    for stamp, x in enumerate(np.arange(-8.0, -6.0, 0.2).tolist()):
        localizer.process(_scan_in_the_hall(0.1 * stamp, x), (x, 0.0, 0.3 if stamp == 5 else 0.0))


def _warm_up_mapping() -> None:
    _drive_up_and_down(LocalizationConfig())


def _warm_up_reconstruction() -> None:
    growing, cloud = GrowingReconstruction(ReconstructionConfig()), _corner_of_a_room(with_sensor=True)
    for end in (len(cloud) - 10, len(cloud)):
        growing.update({0: Part(0, cloud.select(np.arange(end)))})


PARTS: dict[str, Callable[[], None]] = {
    "tracking": _warm_up_tracking,
    "localization": _warm_up_mapping,
    "registration": warm_up_registration,
    "reconstruction": _warm_up_reconstruction,
}


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


def _corner_of_a_room(*, with_sensor: bool) -> Cloud:
    """Three sides of a room of 3 m, a point each 10 cm."""
    u, v = (grid.ravel() for grid in np.meshgrid(np.arange(0, 3, 0.1), np.arange(0, 3, 0.1)))
    sides = [np.column_stack(columns) for columns in ((u, v, 0 * u), (u, 0 * u, v), (0 * u, u, v))]
    points = np.concatenate(sides)
    return Cloud(points, np.full_like(points, 1.5) if with_sensor else None)


if __name__ == "__main__":
    for action in [PARTS[part] for part in sys.argv[1:]] or [warm_up]:
        action()
