# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Reconstruction of a surface by clusters and self-organizing maps."""

from __future__ import annotations

import os
from dataclasses import replace

from g2_recon.config import ReconstructionConfig
from g2_recon.geometry.cloud import Cloud
from g2_recon.progress import Progress, silent
from g2_recon.reconstruction.paper import reconstruct_as_published
from g2_recon.reconstruction.result import Reconstruction
from g2_recon.reconstruction.solid import reconstruct_solid
from g2_recon.reconstruction.usable_points import usable_points


def reconstruct(cloud: Cloud, config: ReconstructionConfig, *, progress: Progress = silent) -> Reconstruction:
    """Reconstruct the surface that a cloud was measured on.

    Raises InputError where the cloud has too few distinct points for a surface.
    """
    workers = config.workers or os.cpu_count() or 1
    usable, left_out = usable_points(cloud, min_sensor_distance=config.min_sensor_distance, workers=workers)
    way = reconstruct_solid if config.mode == "solid" else reconstruct_as_published
    result = way(usable, config, progress=progress)
    return replace(result, left_out=left_out | result.left_out)
