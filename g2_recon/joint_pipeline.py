# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The way of the data for the recordings of several robots: one map, one cloud, one mesh."""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2_recon import __version__, config, pictures, pipeline
from g2_recon.collaboration.alignment import Alignment
from g2_recon.collaboration.map_merger import JointMap, merge
from g2_recon.config import G2ReconConfig, LocalizationConfig
from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud, concatenate
from g2_recon.geometry.occupancy_grid import OccupancyGrid
from g2_recon.geometry.recording import Recording
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.localization.keyframe_grid import KeyframeGrid
from g2_recon.localization.localizer import Localizer
from g2_recon.pictures import FloorPlan
from g2_recon.pipeline import Localization, Registration
from g2_recon.progress import Progress, silent
from g2_recon.reconstruction.reconstructor import Reconstruction
from g2_recon.recording.clouds import write_cloud
from g2_recon.recording.files import write_text
from g2_recon.recording.meshes import write_mesh, write_wire_mesh
from g2_recon.recording.occupancy_maps import write_map
from g2_recon.recording.sessions import write_session
from g2_recon.recording.trajectories import write_tum

Float = NDArray[np.float64]

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RobotRun:
    """What came of one robot, in the frame of the joint map where it is `in_map`, else in that of its own map."""

    localization: Localization
    registration: Registration
    alignment: Alignment
    in_map: bool
    drops: dict[str, int]


@dataclass(frozen=True, slots=True)
class JointRun:
    """What came of several robots, by name; cloud, grid and reconstruction are of those that are in the map."""

    robots: dict[str, RobotRun]
    map: JointMap
    cloud: Cloud
    grid: OccupancyGrid | None
    reconstruction: Reconstruction


def run(recordings: Mapping[str, Recording], settings: G2ReconConfig, *, progress: Progress = silent) -> JointRun:
    """From the recordings of robots, by name, to one mesh, the same in whatever order they are given.

    Raises InputError where a stage has nothing to work on, and where the settings do not make maps that can be merged.
    """
    localization = settings.localization
    if localization.method != "graph" or localization.map:
        raise InputError(
            "several recordings are mapped one by one and then merged",
            advice="set localization.method to graph and leave localization.map empty",
        )
    mapped = {name: pipeline.map_recording(r, localization, progress=progress) for name, r in recordings.items()}
    localizers = {name: one.localizer for name, one in mapped.items() if isinstance(one.localizer, Localizer)}
    merged = merge({name: localizer.session() for name, localizer in localizers.items()}, progress=progress)
    robots = {}
    for name, recording in recordings.items():
        if name in merged.rows:
            localizers[name].move_keyframes(merged.poses(name))
        else:
            _log.warning("%s is not in the map: %s", name, merged.alignments[name].reason)
        found = pipeline.localization_of(mapped[name], with_grid=False, progress=progress)
        registered = pipeline.register(recording, found.trajectory, settings.registration, progress=progress)
        drops = dict(Counter(recording.drops) + Counter(registered.drops))
        robots[name] = RobotRun(found, registered, merged.alignments[name], name in merged.rows, drops)
    # In the order of the map, which does not depend on the order in which they were given.
    cloud = concatenate([robots[name].registration.cloud for name in merged.rows])
    reconstruction = pipeline.reconstruct_surface(cloud, settings.reconstruction, progress=progress)
    return JointRun(robots, merged, cloud, grid_of(merged, localization, progress=progress), reconstruction)


def grid_of(merged: JointMap, settings: LocalizationConfig, *, progress: Progress = silent) -> OccupancyGrid | None:
    """The occupancy grid of a map of several robots; None where nothing is in it."""
    grid = KeyframeGrid(settings, np.eye(4))
    grid.add_session(merged.session)
    poses = Trajectory.from_se2(np.arange(len(merged.session), dtype=float), merged.session.poses)
    return pipeline.finished_grid(grid, poses, progress)


def summarize(result: JointRun) -> dict[str, Any]:
    """The counts of a run, ready for JSON."""
    runs = result.robots.values()
    drops = sum((Counter(run.drops) for run in runs), Counter(result.reconstruction.left_out))
    return {
        "version": __version__,
        "robots": {name: _summarize_robot(run) for name, run in result.robots.items()},
        "path_length_m": round(sum(run.localization.trajectory.length() for run in runs), 3),
        **pipeline.summarize_surface(result.reconstruction),
        "dropped": dict(drops),
    }


def _summarize_robot(run: RobotRun) -> dict[str, Any]:
    alignment = run.alignment
    return {
        "state": alignment.state,
        "reason": alignment.reason,
        "in_map": run.in_map,
        "way_in_common_m": round(alignment.way, 2),
        "agreement": round(alignment.agreement, 3),
        "scans": len(run.localization.trajectory),
        "unmatched_scans": run.localization.unmatched,
        "loops": run.localization.loops,
        "vertical_scans": run.registration.scans,
    }


def write_run(
    result: JointRun, settings: G2ReconConfig, folder: Path, *, summary: dict[str, Any], progress: Progress = silent
) -> None:
    """Write all files of a run into a folder; trajectory and cloud of each robot go into one of its name in there."""
    inside = [name for name, run in result.robots.items() if run.in_map]
    points = np.concatenate([result.robots[name].localization.point_map for name in inside])
    plans = [FloorPlan(points, result.robots[name].localization.trajectory, result.grid) for name in inside]
    reconstruction = result.reconstruction
    steps = [
        lambda: write_cloud(folder / "cloud.ply", result.cloud),
        lambda: write_wire_mesh(folder / "wire_mesh.ply", reconstruction.wire_mesh),
        lambda: write_mesh(folder / "mesh.ply", reconstruction.mesh),
        lambda: write_mesh(folder / "mesh.glb", reconstruction.mesh),
        lambda: None if result.grid is None else write_map(folder / "map.yaml", result.grid),
        lambda: write_session(folder / "session.npz", result.map.session),
        lambda: pictures.draw_floor_plans(folder / "floor_plan.png", plans, inside),
        lambda: pictures.draw_mesh(folder / "mesh.png", reconstruction.mesh, reconstruction.wire_mesh),
        *[lambda name=name, run=run: _write_robot(run, folder / name) for name, run in result.robots.items()],
        lambda: write_text(folder / "config.yaml", config.dump(settings)),
        lambda: write_text(folder / "summary.json", json.dumps(summary, indent=2) + "\n"),
    ]
    for done, step in enumerate(steps, start=1):
        step()
        progress("writing", done, len(steps))


def _write_robot(run: RobotRun, folder: Path) -> None:
    write_tum(folder / "trajectory.tum", run.localization.trajectory)
    write_cloud(folder / "cloud.ply", run.registration.cloud)
    if not run.in_map and run.localization.session is not None:
        write_session(folder / "session.npz", run.localization.session)
