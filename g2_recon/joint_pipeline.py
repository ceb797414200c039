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

from g2_recon import __version__, config, pipeline
from g2_recon.collaboration.alignment import Alignment
from g2_recon.collaboration.live_merger import SweepPlace, SweepWork
from g2_recon.collaboration.map_merger import JointMap, merge
from g2_recon.config import G2ReconConfig, LocalizationConfig, SweepConfig
from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud, concatenate
from g2_recon.geometry.occupancy_grid import OccupancyGrid
from g2_recon.geometry.recording import Recording
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.localization.keyframe_grid import KeyframeGrid
from g2_recon.localization.localizer import Localizer
from g2_recon.pipeline import Localization, Registration
from g2_recon.progress import Progress, silent
from g2_recon.reconstruction.reconstructor import Reconstruction
from g2_recon.recording.clouds import write_cloud
from g2_recon.recording.files import write_text
from g2_recon.recording.meshes import write_mesh, write_wire_mesh
from g2_recon.recording.occupancy_maps import write_map
from g2_recon.recording.sessions import write_session
from g2_recon.recording.trajectories import write_tum
from g2_recon.sweep_pipeline import place_sweeps

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
class SweepRun:
    """What came of a robot that makes sweeps, in the frame of the joint map where it is `in_map`, else in its own.

    cloud: of all its sweeps; trajectory: where they were taken.
    """

    cloud: Cloud
    trajectory: Trajectory
    sweeps: int
    place: SweepPlace
    drops: dict[str, int]

    @property
    def in_map(self) -> bool:
        """Whether its place was found."""
        return self.place.state == "aligned"


@dataclass(frozen=True, slots=True)
class JointRun:
    """What came of several robots, by name; cloud, grid and reconstruction are of those that are in the map.

    swept: the robots that make sweeps. map: of the others, None where there is none.
    """

    robots: dict[str, RobotRun]
    swept: dict[str, SweepRun]
    map: JointMap | None
    cloud: Cloud
    grid: OccupancyGrid | None
    reconstruction: Reconstruction


def run(recordings: Mapping[str, Recording], settings: G2ReconConfig, *, progress: Progress = silent) -> JointRun:
    """From the recordings of robots, by name, to one mesh, the same in whatever order they are given.

    What has only scans of a laser that tilts is a robot that makes sweeps.

    Raises InputError where a stage has nothing to work on, and where the settings do not make maps that can be merged.
    """
    swept = {name: recording for name, recording in recordings.items() if recording.scans_tilt and not recording.scans}
    driven = {name: recording for name, recording in recordings.items() if name not in swept}
    merged, robots = _driven(driven, settings, progress) if driven else (None, {})
    # In the order of the map, which does not depend on the order in which they were given.
    clouds = [] if merged is None else [robots[name].registration.cloud for name in merged.rows]
    sweeps = _swept(swept, concatenate(clouds) if clouds else None, settings.sweeps, progress)
    cloud = concatenate([*clouds, *(one.cloud for one in sweeps.values() if one.in_map)])
    reconstruction = pipeline.reconstruct_surface(cloud, settings.reconstruction, progress=progress)
    grid = None if merged is None else grid_of(merged, settings.localization, progress=progress)
    return JointRun(robots, sweeps, merged, cloud, grid, reconstruction)


def _driven(
    recordings: Mapping[str, Recording], settings: G2ReconConfig, progress: Progress
) -> tuple[JointMap, dict[str, RobotRun]]:
    """The map of robots that localize themselves, and what came of each."""
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
    return merged, robots


def _swept(
    recordings: Mapping[str, Recording], world: Cloud | None, settings: SweepConfig, progress: Progress
) -> dict[str, SweepRun]:
    """What came of robots that make sweeps, the first that began first, in a world of what others saw."""
    made = {}
    for name in sorted(recordings, key=lambda name: (recordings[name].scans_tilt[0].stamp, name)):
        sweeps, guesses, drops = pipeline.assemble(recordings[name], settings)
        made[name] = pipeline.merge(sweeps, settings, guesses=guesses, progress=progress), drops
    clouds = {name: tuple(_sweep_by_sweep(merged.cloud)) for name, (merged, _) in made.items()}
    places = place_sweeps(SweepWork(world, clouds, {}, frozenset()), settings, progress=progress)
    result = {}
    for name, (merged, drops) in made.items():
        place = places[name]
        if place.state != "aligned":
            _log.warning("%s is not in the map: %s", name, place.reason)
        # What is in no map stays as it is.
        T = place.T_world_map if place.state == "aligned" else np.eye(4)
        trajectory = Trajectory.from_matrices(merged.trajectory.stamps, T @ merged.trajectory.matrices())
        dropped = dict(Counter(recordings[name].drops) + Counter(drops))
        result[name] = SweepRun(merged.cloud.moved(T), trajectory, len(clouds[name]), place, dropped)
    return result


def _sweep_by_sweep(cloud: Cloud) -> list[Cloud]:
    """The parts of a cloud that were seen from one place each."""
    assert cloud.sensor is not None
    begins = np.flatnonzero((np.diff(cloud.sensor, axis=0) != 0).any(axis=1)) + 1
    return [cloud.select(rows) for rows in np.split(np.arange(len(cloud)), begins)]


def grid_of(merged: JointMap, settings: LocalizationConfig, *, progress: Progress = silent) -> OccupancyGrid | None:
    """The occupancy grid of a map of several robots; None where nothing is in it."""
    grid = KeyframeGrid(settings, np.eye(4))
    grid.add_session(merged.session)
    poses = Trajectory.from_se2(np.arange(len(merged.session), dtype=float), merged.session.poses)
    return pipeline.finished_grid(grid, poses, progress)


def summarize(result: JointRun) -> dict[str, Any]:
    """The counts of a run, ready for JSON."""
    ways = [run.localization.trajectory for run in result.robots.values()]
    ways += [run.trajectory for run in result.swept.values()]
    every: list[RobotRun | SweepRun] = [*result.robots.values(), *result.swept.values()]
    drops = sum((Counter(run.drops) for run in every), Counter(result.reconstruction.left_out))
    return {
        "version": __version__,
        "robots": {name: _summarize_robot(run) for name, run in result.robots.items()}
        | {name: _summarize_swept(run) for name, run in result.swept.items()},
        "path_length_m": round(sum(way.length() for way in ways), 3),
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


def _summarize_swept(run: SweepRun) -> dict[str, Any]:
    return {
        "state": run.place.state,
        "reason": run.place.reason,
        "in_map": run.in_map,
        "agreement": round(run.place.agreement, 3),
        "sweeps": run.sweeps,
    }


def write_run(
    result: JointRun, settings: G2ReconConfig, folder: Path, *, summary: dict[str, Any], progress: Progress = silent
) -> None:
    """Write all files of a run into a folder; trajectory and cloud of each robot go into one of its name in there."""
    from g2_recon import pictures

    inside = [name for name, run in result.robots.items() if run.in_map]
    points = np.concatenate([np.empty((0, 2)), *(result.robots[name].localization.point_map for name in inside)])
    plans = [pictures.FloorPlan(points, result.robots[name].localization.trajectory, result.grid) for name in inside]
    reconstruction = result.reconstruction
    steps = [
        lambda: write_cloud(folder / "cloud.ply", result.cloud),
        lambda: write_wire_mesh(folder / "wire_mesh.ply", reconstruction.wire_mesh),
        lambda: write_mesh(folder / "mesh.ply", reconstruction.mesh),
        lambda: write_mesh(folder / "mesh.glb", reconstruction.mesh),
        lambda: None if result.grid is None else write_map(folder / "map.yaml", result.grid),
        lambda: None if result.map is None else write_session(folder / "session.npz", result.map.session),
        lambda: pictures.draw_floor_plans(folder / "floor_plan.png", plans, inside) if plans else None,
        lambda: pictures.draw_mesh(folder / "mesh.png", reconstruction.mesh, reconstruction.wire_mesh),
        *[lambda name=name, run=run: _write_robot(run, folder / name) for name, run in result.robots.items()],
        *[lambda name=name, run=run: _write_swept(run, folder / name) for name, run in result.swept.items()],
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


def _write_swept(run: SweepRun, folder: Path) -> None:
    write_tum(folder / "trajectory.tum", run.trajectory)
    write_cloud(folder / "cloud.ply", run.cloud)
