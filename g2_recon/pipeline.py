# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The way of the data for recordings: localization, registration, reconstruction, one plain call each."""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2_recon import __version__, config
from g2_recon.config import G2ReconConfig, LocalizationConfig, ReconstructionConfig, RegistrationConfig, SweepConfig
from g2_recon.errors import InputError
from g2_recon.geometry import se2, se3
from g2_recon.geometry.cloud import Cloud, concatenate
from g2_recon.geometry.occupancy_grid import OccupancyGrid
from g2_recon.geometry.recording import Recording
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.session import Session
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.localization.keyframe_grid import KeyframeGrid
from g2_recon.localization.localizer import Localizer
from g2_recon.localization.methods import AnyLocalizer, make_localizer
from g2_recon.progress import Progress, silent
from g2_recon.reconstruction.reconstructor import Reconstruction, reconstruct
from g2_recon.recording.clouds import write_cloud
from g2_recon.recording.files import write_text
from g2_recon.recording.meshes import write_mesh, write_wire_mesh
from g2_recon.recording.occupancy_maps import write_map
from g2_recon.recording.sessions import read_session, write_session
from g2_recon.recording.sweeps import Sweep
from g2_recon.recording.trajectories import write_tum
from g2_recon.registration.calibration import Calibration
from g2_recon.registration.calibration import calibrate as estimate_mounting_pose
from g2_recon.registration.registrar import Registrar
from g2_recon.registration.sweep_assembler import SweepAssembler
from g2_recon.registration.sweep_merger import PlacedSweep, SweepMerger
from g2_recon.switching import switching_soon

Float = NDArray[np.float64]

# A share of scans without a match beyond which the trajectory is no longer to be trusted.
_DOUBTFUL_UNMATCHED = 0.1

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Localization:
    """trajectory: T_map_base of each horizontal scan, as known at the end; causal: as known when the scan came.

    point_map: (N, 2). grid: the occupancy grid, None where none could be made. keyframes, unmatched: how many scans.
    loops: how many were closed. odometry_jumps: between how many scans odometry was not believed. session: what it
    takes to go on in the map, None where the method has no such thing.
    """

    trajectory: Trajectory
    causal: Trajectory
    point_map: Float
    grid: OccupancyGrid | None
    keyframes: int
    unmatched: int
    loops: int
    odometry_jumps: int
    session: Session | None = None


@dataclass(frozen=True, slots=True)
class Mapped:
    """A localizer that has seen a whole recording, the grid of its keyframes, and T_map_base as known at each scan."""

    localizer: AnyLocalizer
    grid: KeyframeGrid
    causal: Trajectory


@dataclass(frozen=True, slots=True)
class Registration:
    """cloud: the vertical scans in the map frame. scans: how many were placed. drops: how many were not, by reason."""

    cloud: Cloud
    scans: int
    drops: dict[str, int]


@dataclass(frozen=True, slots=True)
class Merged:
    """cloud: of all sweeps that could be placed, in the map frame. trajectory: T_map_file of those, by their stamps.

    sweeps: what came of each, by name. loops: matches beyond those that hold the sweeps together.
    """

    cloud: Cloud
    trajectory: Trajectory
    sweeps: dict[str, PlacedSweep]
    loops: int


@dataclass(frozen=True, slots=True)
class Run:
    """What came of one recording, stage by stage."""

    localization: Localization
    registration: Registration
    reconstruction: Reconstruction
    drops: dict[str, int]


def run(recording: Recording, settings: G2ReconConfig, *, progress: Progress = silent) -> Run:
    """The whole way: from a recording to a mesh. Raises InputError where a stage has nothing to work on."""
    localization = localize(recording, settings.localization, progress=progress)
    registration = register(recording, localization.trajectory, settings.registration, progress=progress)
    reconstruction = reconstruct_surface(registration.cloud, settings.reconstruction, progress=progress)
    drops = Counter(recording.drops) + Counter(registration.drops) + Counter(reconstruction.left_out)
    return Run(localization, registration, reconstruction, dict(drops))


def localize(recording: Recording, settings: LocalizationConfig, *, progress: Progress = silent) -> Localization:
    """The trajectory of the robot from its horizontal scans, and from its odometry where there is some.

    Raises InputError where no scan can be used, or the map to go on in cannot be read or is too large; a trajectory
    that many scans do not fit is logged as doubtful.
    """
    return localization_of(map_recording(recording, settings, progress=progress), progress=progress)


def map_recording(recording: Recording, settings: LocalizationConfig, *, progress: Progress = silent) -> Mapped:
    """A localizer that has seen a whole recording. Raises and logs as `localize`."""
    if not recording.scans:
        raise InputError("the recording holds no scan of a horizontal laser", advice="name its topic with scan_topic")
    T_base_laser = mounting_pose("localization", settings.laser_pose, recording.T_base_laser)
    session = read_session(Path(settings.map).expanduser()) if settings.map else None
    localizer = make_localizer(settings, T_base_laser, keep_scans=True, session=session)
    odometry = odometry_at_scans(recording)
    grid = KeyframeGrid(settings, T_base_laser)
    if session is not None:
        grid.add_session(session)
    with switching_soon():
        for index, scan in enumerate(recording.scans):
            if localizer.process(scan, odometry[index]).keyframe:
                grid.add(scan)
            if index % 64 == 0 or index + 1 == len(recording.scans):
                progress("localization", index + 1, len(recording.scans))
    if not len(grid):
        raise InputError(
            f"none of the {len(recording.scans)} horizontal scans has enough beams on surfaces to start a map",
            advice="check scan_topic, and localization.min_range and max_range against the ranges in the recording",
        )
    if localizer.unmatched > _DOUBTFUL_UNMATCHED * len(recording.scans):
        _log.warning(
            "the trajectory is doubtful: %d of %d scans did not match the map; check laser_pose (a laser mounted "
            "upside down has a roll of pi) and the odometry (or use_odometry off)",
            localizer.unmatched,
            len(recording.scans),
        )
    causal = localizer.causal_trajectory()
    localizer.finish(progress)
    return Mapped(localizer, grid, causal)


def localization_of(mapped: Mapped, *, with_grid: bool = True, progress: Progress = silent) -> Localization:
    """What a localizer knows now; its own occupancy grid is not needed where there is one of several robots."""
    localizer = mapped.localizer
    return Localization(
        localizer.trajectory(),
        mapped.causal,
        localizer.point_map(),
        finished_grid(mapped.grid, localizer.keyframes(), progress) if with_grid else None,
        len(mapped.grid),
        localizer.unmatched,
        localizer.loops,
        localizer.odometry_jumps,
        localizer.session() if isinstance(localizer, Localizer) else None,
    )


def finished_grid(grid: KeyframeGrid, keyframes: Trajectory, progress: Progress) -> OccupancyGrid | None:
    """The occupancy grid at the final poses of the keyframes; what had to be left out of it is logged."""
    poses = keyframes.planar()
    while not grid.update(poses, most=64):
        progress("occupancy grid", grid.counted, len(grid))
    progress("occupancy grid", len(grid), len(grid))
    if grid.left_out:
        _log.warning("%d of %d keyframes are not in the map: %s", grid.left_out, len(grid), grid.why_left_out)
    made = grid.grid()
    return made if made.cells.size else None


def odometry_at_scans(recording: Recording) -> Float:
    """Odometry (N, 3) x, y, yaw of the robot at each horizontal scan, NaN where it is not known."""
    if recording.scan_odometry is not None:
        return recording.scan_odometry
    T_odom_base, known = recording.odometry.interpolate([scan.stamp for scan in recording.scans])
    result = np.full((len(recording.scans), 3), np.nan)
    result[known] = se2.from_se3(T_odom_base[known])
    return result


def register(
    recording: Recording, trajectory: Trajectory, settings: RegistrationConfig, *, progress: Progress = silent
) -> Registration:
    """The vertical scans of a recording as one cloud, each beam placed by the trajectory (T_map_base).

    Raises InputError where not one of them can be placed.
    """
    T_base_laser = _vertical_laser(recording, settings)
    registrar = Registrar(settings, T_base_laser)
    # As on the robot: whatever was first is handed over first.
    arrivals = sorted(
        [
            (stamp, T_map_base)
            for stamp, T_map_base in zip(trajectory.stamps.tolist(), trajectory.matrices(), strict=True)
        ]
        + [(scan.stamp, scan) for scan in recording.scans_vertical],
        key=lambda arrival: arrival[0],
    )
    clouds: list[Cloud] = []
    for index, (stamp, arrived) in enumerate(arrivals):
        if isinstance(arrived, Scan):
            registrar.add_scan(arrived)
        else:
            registrar.add_pose(stamp, arrived)
        clouds += [registered.cloud for registered in registrar.take()]
        if index % 64 == 0 or index + 1 == len(arrivals):
            progress("registration", index + 1, len(arrivals))
    clouds += [registered.cloud for registered in registrar.finish()]
    cloud = concatenate(clouds)
    if not len(cloud):
        reasons = ", ".join(f"{reason}: {count}" for reason, count in registrar.drops.items())
        raise InputError(
            f"none of the {len(recording.scans_vertical)} vertical scans could be placed ({reasons})",
            advice="check that the clocks of the two lasers agree, and registration.max_gap, min_range and max_range",
        )
    return Registration(cloud, len(clouds), registrar.drops)


def calibrate(recording: Recording, settings: G2ReconConfig, *, progress: Progress = silent) -> Calibration:
    """How the vertical laser is mounted, from a drive; the start is the setting, else what the recording says.

    Raises InputError where there is no start, or too little to see.
    """
    start = _vertical_laser(recording, settings.registration)
    trajectory = localize(recording, settings.localization, progress=progress).trajectory
    return estimate_mounting_pose(recording.scans_vertical, trajectory, start, settings.registration, progress=progress)


def _vertical_laser(recording: Recording, settings: RegistrationConfig) -> Float:
    """T_base_laser (4, 4) of the vertical laser. Raises InputError where there is none, or its pose is not known."""
    if not recording.scans_vertical:
        raise InputError(
            "the recording holds no scan of a vertical laser",
            advice="name its topic with scan_vertical_topic, or use the command localize",
        )
    return mounting_pose("registration", settings.laser_pose, recording.T_base_laser_vertical)


def merge(
    sweeps: Sequence[Sweep], settings: SweepConfig, *, guesses: Trajectory | None = None, progress: Progress = silent
) -> Merged:
    """Sweeps as one cloud. guesses: T_map_file of each, in their order, instead of what the files say, and stamps.

    Without guesses stamps count up from 0. Raises InputError, which names the sweep, where one cannot be used, where
    there are not as many guesses as sweeps, and where only one could be placed.
    """
    if guesses is not None and len(guesses) != len(sweeps):
        raise InputError(
            f"{len(guesses)} poses for {len(sweeps)} sweeps", advice="give one pose a sweep, in the same order"
        )
    given = [sweep.T_map_file for sweep in sweeps] if guesses is None else list(guesses.matrices())
    merger = SweepMerger(settings)
    placed: dict[str, PlacedSweep] = {}
    for index, (sweep, guess) in enumerate(zip(sweeps, given, strict=True)):
        try:
            result = merger.add(sweep.cloud, None if guess is None else guess @ sweep.T_file_laser)
        except InputError as error:
            raise InputError(str(error), where=sweep.name) from None
        # Files in different folders may have the same name.
        placed[sweep.name if sweep.name not in placed else f"{sweep.name} ({index + 1})"] = result
        if result.quality not in ("first", "good"):
            _log.warning("%s: %s: %s", sweep.name, result.quality, result.reason)
        progress("merging", index + 1, len(sweeps))
    if len(merger) < 2 <= len(sweeps):
        raise InputError(
            f"no sweep could be laid on another: {placed[list(placed)[1]].reason}",
            advice="give first guesses with --poses, or look at the settings that the reason names",
        )
    stamps = np.arange(len(sweeps), dtype=float) if guesses is None else guesses.stamps
    T_map_file = [
        pose @ se3.inverse(sweeps[number].T_file_laser)
        for number, pose in zip(merger.numbers, merger.poses(), strict=True)
    ]
    trajectory = Trajectory.from_matrices(stamps[merger.numbers], np.array(T_map_file))
    return Merged(merger.cloud(), trajectory, placed, merger.loops)


def assemble(recording: Recording, settings: SweepConfig) -> tuple[list[Sweep], Trajectory | None, dict[str, int]]:
    """The sweeps of a recording with a tilting laser, their poses by odometry where it is known, and what was dropped.

    Raises InputError where there is no sweep.
    """
    if not recording.scans_tilt:
        raise InputError("the recording holds no scan of a tilting laser", advice="name its topic with scan_tilt_topic")
    if recording.T_base_tilt is None:
        raise InputError("the recording does not say how the tilting laser is mounted", advice="add its transform")
    assembler = SweepAssembler(settings, recording.T_base_tilt)
    for stamp, angle in zip(recording.tilt_stamps.tolist(), recording.tilt_angles.tolist(), strict=True):
        assembler.add_angle(stamp, angle)
    odometry = recording.odometry
    for stamp, T_odom_base in zip(odometry.stamps.tolist(), odometry.matrices(), strict=True):
        assembler.add_odometry(stamp, T_odom_base)
    for scan in recording.scans_tilt:
        assembler.add_scan(scan)
    assembled = assembler.finish()
    if not assembled:
        reasons = ", ".join(f"{reason}: {count}" for reason, count in assembler.drops.items())
        raise InputError(f"none of the {len(recording.scans_tilt)} tilted scans is of a whole sweep ({reasons})")
    sweeps = [Sweep(f"sweep at {s.stamp:.2f} s", s.cloud, np.eye(4), s.T_odom_mount) for s in assembled]
    poses = [s.T_odom_mount for s in assembled if s.T_odom_mount is not None]
    guesses = Trajectory.from_matrices([s.stamp for s in assembled], poses) if len(poses) == len(assembled) else None
    return sweeps, guesses, assembler.drops


def reconstruct_surface(cloud: Cloud, settings: ReconstructionConfig, *, progress: Progress = silent) -> Reconstruction:
    """As `reconstruct`; raises InputError also where no triangle came of the cloud."""
    result = reconstruct(cloud, settings, progress=progress)
    if not len(result.mesh.faces):
        raise InputError(
            f"no surface was found in the {result.points} points of the cloud: the mesh has no triangle",
            advice=f"set a larger spacing (now {settings.spacing:g} m) or support_distance; coordinates are in metres",
        )
    return result


def mounting_pose(stage: str, setting: tuple[float, ...], recorded: Float | None) -> Float:
    """T_base_laser (4, 4): the setting where it is given, else what the recording says.

    Raises InputError where neither is there: the identity would be a guess.
    """
    if setting:
        return se3.from_xyz_rpy(setting)
    if recorded is None:
        raise InputError(
            "the recording does not say how the laser is mounted",
            advice=f"set {stage}.laser_pose to x y z roll pitch yaw (m, rad)",
        )
    return recorded


def summarize(result: Run) -> dict[str, Any]:
    """The counts of a run, ready for JSON."""
    return {
        "version": __version__,
        "scans": len(result.localization.trajectory),
        "unmatched_scans": result.localization.unmatched,
        "loops": result.localization.loops,
        "odometry_jumps": result.localization.odometry_jumps,
        "path_length_m": round(result.localization.trajectory.length(), 3),
        "vertical_scans": result.registration.scans,
        **summarize_surface(result.reconstruction),
        "dropped": result.drops,
    }


def summarize_surface(reconstruction: Reconstruction) -> dict[str, Any]:
    """The counts of a reconstruction, ready for JSON."""
    wire = reconstruction.wire_mesh
    return {
        "points": reconstruction.points,
        "clusters": reconstruction.clusters,
        "neurons": len(wire.vertices),
        "joins": int(wire.join.sum()),
        "faces": len(reconstruction.mesh.faces),
        "quantization_error_m": round(reconstruction.quantization_error, 5),
    }


def write_run(
    result: Run, settings: G2ReconConfig, folder: Path, *, summary: dict[str, Any], progress: Progress = silent
) -> None:
    """Write all files of a run into a folder: trajectory, map, cloud, meshes, pictures, settings and summary."""
    from g2_recon import pictures

    localization = result.localization
    grid = localization.grid
    steps = [
        lambda: write_tum(folder / "trajectory.tum", localization.trajectory),
        lambda: write_cloud(folder / "cloud.ply", result.registration.cloud),
        lambda: write_wire_mesh(folder / "wire_mesh.ply", result.reconstruction.wire_mesh),
        lambda: write_mesh(folder / "mesh.ply", result.reconstruction.mesh),
        lambda: write_mesh(folder / "mesh.glb", result.reconstruction.mesh),
        lambda: None if grid is None else write_map(folder / "map.yaml", grid),
        lambda: None if localization.session is None else write_session(folder / "session.npz", localization.session),
        lambda: pictures.draw_floor_plan(
            folder / "floor_plan.png", localization.point_map, localization.trajectory, grid
        ),
        lambda: pictures.draw_mesh(folder / "mesh.png", result.reconstruction.mesh, result.reconstruction.wire_mesh),
        lambda: write_text(folder / "config.yaml", config.dump(settings)),
        lambda: write_text(folder / "summary.json", json.dumps(summary, indent=2) + "\n"),
    ]
    for done, step in enumerate(steps, start=1):
        step()
        progress("writing", done, len(steps))
