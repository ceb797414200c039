# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The command g2-recon."""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
import os
import re
import sys
import sysconfig
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel
from rich.console import Console
from rich.logging import RichHandler

import g2_recon
from g2_recon import config, joint_pipeline, pipeline
from g2_recon.config import (
    G2ReconConfig,
    LocalizationConfig,
    ReconstructionConfig,
    RecordingConfig,
    RegistrationConfig,
    SimulationConfig,
    SweepConfig,
)
from g2_recon.errors import ConfigError, G2ReconError, InputError
from g2_recon.evaluation.relations import RelationsScore, read_relations, score_relations
from g2_recon.evaluation.surface import SurfaceScore, score_surface
from g2_recon.evaluation.trajectory_error import mean_position_error
from g2_recon.geometry import se3
from g2_recon.geometry.mesh import TrueSurface
from g2_recon.reconstruction.reconstructor import Reconstruction
from g2_recon.recording.bags import BAG_ENDINGS, write_bag
from g2_recon.recording.clouds import check_cloud_ending, read_cloud, write_cloud
from g2_recon.recording.files import write_text
from g2_recon.recording.meshes import MESH_ENDINGS, read_mesh, write_mesh, write_wire_mesh
from g2_recon.recording.occupancy_maps import write_map
from g2_recon.recording.recordings import read_recording
from g2_recon.recording.sessions import write_session
from g2_recon.recording.surfaces import read_true_surface, write_true_surface
from g2_recon.recording.sweeps import SWEEP_ENDINGS, read_sweep
from g2_recon.recording.trajectories import read_tum, write_tum
from g2_recon.registration.calibration import AXES, Calibration
from g2_recon.simulation.simulator import simulate
from g2_recon.terminal import StageProgress, print_paths, print_table, stages

BUNDLED_RECORDING = "first_floor"
TRUTH_TRAJECTORY = Path("truth") / "trajectory.tum"
TRUTH_PERIOD_S = 0.04
TRUTH_SURFACES = Path("truth") / "surfaces.npz"

_RELATIONS_TEXT = """Mean and standard deviation of the error over true relations (Kuemmerle et al., 2009), translation
in m and rotation in deg. Relations without a pose within 50 ms of both stamps are counted as missed."""
_SURFACE_TEXT = """Distances in cm, mean and 95 % quantile, from the mesh to the truth (accuracy) and from the truth to
the mesh (completeness); shares in % of the mesh (precision) and of the truth (recall) that are nearer than 5 and 2 cm,
and their harmonic mean (F-score); mean |cos| of the angle between normals; how the faces hang together. Truth farther
than 10 cm from all that was seen does not count."""

_NEGATIVE_NUMBER = re.compile(r"-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")

Model = TypeVar("Model", bound=BaseModel)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit status is 0 on success, 1 on bad input, 2 on bad usage."""
    parser = build_parser()
    options = parser.parse_args(arguments)
    console = Console(stderr=True)
    level = (logging.WARNING, logging.INFO, logging.DEBUG)[min(options.verbose, 2)]
    handler = RichHandler(console=console, show_path=False, show_time=False)
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[handler], force=True)
    logging.getLogger("g2_recon").setLevel(level)
    try:
        options.command(options, console)
    except G2ReconError as error:
        print(f"g2-recon: {error}", file=sys.stderr)  # noqa: T201 - this is the one line that a user gets
        return 1
    except OSError as error:
        place = "" if error.filename is None else f"{error.filename}: "
        print(f"g2-recon: {place}{error.strerror or error}", file=sys.stderr)  # noqa: T201
        return 1
    except KeyboardInterrupt:
        print("g2-recon: interrupted", file=sys.stderr)  # noqa: T201
        return 130
    return 0


# The commands


def run_demo(options: argparse.Namespace, console: Console) -> None:
    """Run the whole way on the bundled recording."""
    _check_files([options.output / "config.yaml"])
    _run(bundled_recording(), options.output, G2ReconConfig(), console)


def run_recording(options: argparse.Namespace, console: Console) -> None:
    """Run the whole way on a recording, or on those of several robots."""
    settings = config.load(options.config) if options.config else G2ReconConfig()
    folder = options.output or Path("out") / "_".join(_robot_names(options.recordings))
    settings = _overridden(settings, options)
    # No other name in the folder can be that of settings, of a session or of a recording.
    session = Path(settings.localization.map).expanduser() if settings.localization.map else None
    _check_files(
        [folder / "config.yaml", folder / "map.yaml", folder / "session.npz"], inputs=[options.config, session]
    )
    if len(options.recordings) > 1:
        _run_together(options.recordings, folder, settings, console)
    else:
        _run(options.recordings[0], folder, settings, console)


def _robot_names(recordings: Sequence[Path]) -> list[str]:
    """Names of the robots of recordings. Raises InputError where two are the same."""
    names = [_stem(path) for path in recordings]
    for number, name in enumerate(names):
        if name in names[:number]:
            raise InputError("two recordings have this name, which is that of a robot", where=name)
    return names


def _run_together(paths: Sequence[Path], folder: Path, settings: G2ReconConfig, console: Console) -> None:
    with stages(console) as progress:
        recordings = {
            name: read_recording(path, settings.recording, progress=progress)
            for name, path in zip(_robot_names(paths), paths, strict=True)
        }
        result = joint_pipeline.run(recordings, settings, progress=progress)
        summary = joint_pipeline.summarize(result)
        summary["seconds"] = {name: round(seconds, 2) for name, seconds in progress.seconds.items()}
        joint_pipeline.write_run(result, settings, folder, summary=summary, progress=progress)
    _print_summary(summary, progress, folder, console)


def _run(recording_path: Path, folder: Path, settings: G2ReconConfig, console: Console) -> None:
    with stages(console) as progress:
        recording = read_recording(recording_path, settings.recording, progress=progress)
        result = pipeline.run(recording, settings, progress=progress)
        summary = pipeline.summarize(result)
        truth = recording_path / TRUTH_TRAJECTORY
        if truth.exists():
            error = mean_position_error(result.localization.trajectory, read_tum(truth))
            summary["trajectory_error_m"] = round(error, 5)
        summary["seconds"] = {name: round(seconds, 2) for name, seconds in progress.seconds.items()}
        pipeline.write_run(result, settings, folder, summary=summary, progress=progress)
    _print_summary(summary, progress, folder, console)


def run_localize(options: argparse.Namespace, console: Console) -> None:
    """Localize a recording's horizontal scans."""
    settings = _made(LocalizationConfig, _given(options, "localization"), options)
    topics = _made(RecordingConfig, _given(options, "recording"), options)
    target = options.output or Path(f"{_stem(options.recording)}.tum")
    plan, grid = target.with_suffix(".png"), target.with_suffix(".yaml")
    session = [] if options.session is None else [options.session]
    before = Path(settings.map).expanduser() if settings.map else None
    _check_files(
        [target, plan, grid, grid.with_suffix(".pgm"), *session], inputs=[options.recording, options.relations, before]
    )
    # Settings of a robot may have the name of its recordings.
    if grid.exists() and not re.search(rb"^image:", grid.read_bytes(), re.MULTILINE):
        raise InputError("exists and is no map", where=grid, advice="choose another name with --output")
    relations = read_relations(options.relations) if options.relations else None
    with stages(console) as progress:
        recording = read_recording(options.recording, topics, progress=progress)
        result = pipeline.localize(recording, settings, progress=progress)
        write_tum(target, result.trajectory)
        if result.grid is not None:
            write_map(grid, result.grid)
        if options.session is not None:
            if result.session is None:
                raise InputError("method paper has no session", where=options.session, advice="use --method graph")
            write_session(options.session, result.session)
        from g2_recon import pictures

        pictures.draw_floor_plan(plan, result.point_map, result.trajectory, result.grid)
        progress("writing", 1, 1)
    rows: dict[str, Any] = {
        "scans": f"{len(result.trajectory):,}",
        "scans a second": f"{len(result.trajectory) / max(progress.seconds['localization'], 1e-9):,.0f}",
        "way": f"{result.trajectory.length():.1f} m",
        "scans that did not match": result.unmatched,
        "loops closed": result.loops,
        "jumps of odometry": result.odometry_jumps,
        **{f"dropped: {reason}": count for reason, count in recording.drops.items()},
    }
    if relations is not None:
        rows |= _relations_rows(score_relations(relations, result.trajectory))
    print_table("localized", rows, progress, console)
    maps = {} if result.grid is None else {"map": grid}
    sessions = {} if options.session is None else {"session": options.session}
    print_paths({"trajectory": target, **maps, "floor plan": plan, **sessions}, console)


def run_calibrate(options: argparse.Namespace, console: Console) -> None:
    """Estimate the mounting pose of the vertical laser."""
    settings = config.load(options.config) if options.config else G2ReconConfig()
    settings = _overridden(settings, options)
    target = options.output or Path(f"{_stem(options.recording)}_calibration.yaml")
    session = Path(settings.localization.map).expanduser() if settings.localization.map else None
    _check_files([target], inputs=[options.recording, options.config, session])
    with stages(console) as progress:
        recording = read_recording(options.recording, settings.recording, progress=progress)
        found = pipeline.calibrate(recording, settings, progress=progress)
        pose = [round(value, 6) for value in se3.to_xyz_rpy(found.T_base_laser).tolist()]
        text = "\n".join(
            [
                f"# pose of the vertical laser, by g2-recon calibrate {options.recording.name}",
                *(f"# not observed, as at the start: {what}" for what in found.unobserved),
                "registration:",
                f"  laser_pose: {pose}",
                "",
            ]
        )
        write_text(target, text)
        progress("writing", 1, 1)
    rows: dict[str, Any] = {
        "laser_pose": " ".join(f"{value:.5f}" for value in pose),
        "moved from the start": _metres_and_degrees(found.start, found.T_base_laser),
        **{f"sigma {axis}": said for axis, said in zip(AXES, _sigmas(found), strict=True)},
        "thickness of surfaces": f"{100 * found.thickness:.2f} cm",
        **{f"dropped: {reason}": count for reason, count in recording.drops.items()},
    }
    print_table("calibrated", rows, progress, console)
    for said in found.unobserved:
        console.print(f"not observed, as at the start: {said}")
    print_paths({"settings for --config": target}, console)


def _sigmas(found: Calibration) -> list[str]:
    """Of each axis of the robot, along and about, in words."""
    mm, degrees = 1000 * found.sigma[:3], np.degrees(found.sigma[3:])
    return [f"{value:.1f} mm" for value in mm] + [f"{value:.3f} deg" for value in degrees]


def _metres_and_degrees(start: NDArray[np.float64], end: NDArray[np.float64]) -> str:
    """How far apart two poses (4, 4) are, in words."""
    cos = (np.trace(start[:3, :3].T @ end[:3, :3]) - 1) / 2
    metres = np.linalg.norm(end[:3, 3] - start[:3, 3])
    return f"{100 * metres:.2f} cm, {np.degrees(np.arccos(np.clip(cos, -1.0, 1.0))):.2f} deg"


def run_merge(options: argparse.Namespace, console: Console) -> None:
    """Merge stop-and-go sweeps into one cloud."""
    settings = _made(SweepConfig, _given(options, "sweep"), options)
    target = options.output or Path(f"{_stem(options.sweeps[0])}_merged.ply")
    poses = target.with_name("poses.tum")
    check_cloud_ending(target)
    _check_files([target, poses], inputs=[*options.sweeps, options.poses])
    dropped: dict[str, int] = {}
    with stages(console) as progress:
        guesses = read_tum(options.poses) if options.poses else None
        first: Path = options.sweeps[0]
        if first.is_dir() or first.suffix.lower() in BAG_ENDINGS:
            if len(options.sweeps) > 1:
                raise InputError("is a recording, of which only one can be merged", where=first)
            sweeps, driven, dropped = pipeline.assemble(read_recording(first, progress=progress), settings)
            guesses = guesses or driven
        else:
            sweeps = []
            for path in options.sweeps:
                sweeps.append(read_sweep(path))
                progress("reading", len(sweeps), len(options.sweeps))
        result = pipeline.merge(sweeps, settings, guesses=guesses, progress=progress)
        write_cloud(target, result.cloud)
        write_tum(poses, result.trajectory)
        progress("writing", 1, 1)
    rows: dict[str, Any] = {
        "sweeps": len(result.sweeps),
        "points": f"{len(result.cloud):,}",
        "loops closed": result.loops,
        **{name: placed.describe() for name, placed in result.sweeps.items()},
        **{f"dropped: {reason}": count for reason, count in dropped.items()},
    }
    print_table("merged", rows, progress, console)
    print_paths({"cloud": target, "poses": poses}, console)


def run_reconstruct(options: argparse.Namespace, console: Console) -> None:
    """Reconstruct a mesh from a cloud."""
    settings = _made(ReconstructionConfig, _given(options, "reconstruction"), options)
    target = options.output or Path(f"{_stem(options.cloud)}_mesh.ply")
    if target.suffix.lower() not in MESH_ENDINGS:
        raise InputError("unknown kind of mesh", where=target, advice=f"use one of {' '.join(MESH_ENDINGS)}")
    wire_target = target.with_name(f"{target.stem}_wire.ply")
    picture = target.with_suffix(".png")
    _check_files([target, wire_target, picture], inputs=[options.cloud])
    with stages(console) as progress:
        cloud = read_cloud(options.cloud)
        progress("reading", 1, 1)
        result = pipeline.reconstruct_surface(cloud, settings, progress=progress)
        write_mesh(target, result.mesh)
        write_wire_mesh(wire_target, result.wire_mesh)
        from g2_recon import pictures

        pictures.draw_mesh(picture, result.mesh, result.wire_mesh)
        progress("writing", 1, 1)
    print_table("reconstructed", _reconstruction_rows(result), progress, console)
    print_paths({"mesh": target, "wire mesh": wire_target, "picture": picture}, console)


def run_import(options: argparse.Namespace, console: Console) -> None:
    """Convert a CARMEN log to a rosbag2."""
    _check_new_bag(options.output, inputs=[options.recording], force=options.force)
    with stages(console) as progress:
        recording = read_recording(options.recording, progress=progress)
        write_bag(
            options.output, recording, description={"imported from": options.recording.name}, overwrite=options.force
        )
        progress("writing", 1, 1)
    rows = {"scans": len(recording.scans), **recording.drops}
    print_table("imported", rows, progress, console)
    print_paths({"bag": options.output}, console)


def run_simulate(options: argparse.Namespace, console: Console) -> None:
    """Simulate a drive and write it as a bag, with the truth beside it."""
    settings = _made(SimulationConfig, _given(options, "simulation"), options)
    _check_new_bag(options.output, force=options.force)
    with stages(console) as progress:
        simulation = simulate(settings, progress=progress)
        description = {
            "simulated": "yes: no robot has driven here; the truth is in the folder truth",
            "made by": f"g2-recon {g2_recon.__version__} simulate",
            "settings": settings.model_dump_json(),
        }
        write_bag(options.output, simulation.recording, description=description, overwrite=options.force)
        write_tum(options.output / TRUTH_TRAJECTORY, simulation.trajectory.resampled(TRUTH_PERIOD_S))
        surface = TrueSurface(simulation.vertices, simulation.faces, simulation.clean_vertical)
        write_true_surface(options.output / TRUTH_SURFACES, surface)
        progress("writing", 1, 1)
    recording = simulation.recording
    rows = {
        "horizontal scans": len(recording.scans),
        "vertical scans": len(recording.scans_vertical),
        "vertical points": f"{sum(int(scan.valid().sum()) for scan in recording.scans_vertical):,}",
        "tilted scans": len(recording.scans_tilt),
        "way": f"{simulation.trajectory.length():.1f} m",
    }
    print_table("simulated", rows, progress, console)
    print_paths({"bag": options.output}, console)


def run_evaluate_relations(options: argparse.Namespace, console: Console) -> None:
    """Score a trajectory by true relations."""
    _check_json(options, [options.relations, options.trajectory])
    with stages(console) as progress:
        relations, trajectory = read_relations(options.relations), read_tum(options.trajectory)
        progress("reading", 1, 1)
        score = score_relations(relations, trajectory)
        progress("scoring", 1, 1)
    _write_score(options, dataclasses.asdict(score))
    print_table("relations", _relations_rows(score), progress, console)


def run_evaluate_surface(options: argparse.Namespace, console: Console) -> None:
    """Score a mesh by the true surface."""
    _check_json(options, [options.truth, options.mesh, options.seen])
    with stages(console) as progress:
        truth = read_true_surface(options.truth)
        vertices, faces = read_mesh(options.mesh)
        if options.seen is not None:
            truth = dataclasses.replace(truth, seen=read_cloud(options.seen).finite().points)
        progress("reading", 1, 1)
        score = score_surface(truth, vertices, faces, workers=0, progress=progress)
    _write_score(options, dataclasses.asdict(score))
    print_table("surface", _surface_rows(score), progress, console)


def _check_json(options: argparse.Namespace, inputs: Sequence[Path | None]) -> None:
    if options.json is not None:
        _check_files([options.json], inputs=inputs)


def _write_score(options: argparse.Namespace, score: Mapping[str, Any]) -> None:
    """The score in a JSON file, in metres and degrees, shares from 0 to 1."""
    if options.json is not None:
        write_text(options.json, json.dumps(score, indent=2) + "\n")


def _check_files(files: Sequence[Path], *, inputs: Sequence[Path | None] = ()) -> None:
    """As _check_outputs, for outputs that are files."""
    _check_outputs(files, inputs=inputs)
    for file in files:
        if file.is_dir():
            raise InputError("is a folder", where=file, advice="choose another name with --output")


def _check_outputs(outputs: Sequence[Path], *, inputs: Sequence[Path | None] = ()) -> None:
    """Before any work: raises InputError where an output would replace an input or another one, or has no place."""
    sources = {Path(os.path.realpath(path)) for path in inputs if path is not None}
    taken: set[Path] = set()
    for output in outputs:
        # Unlike Path.resolve, this takes a link that leads to itself.
        real = Path(os.path.realpath(output))
        # An input is also what holds it, and what a folder that is read holds.
        is_read = any(real in (source, *source.parents) or source in real.parents for source in sources)
        if is_read and os.path.lexists(real):
            raise InputError("would replace what is read", where=output, advice="choose another name with --output")
        if real in taken:
            raise InputError(
                "two results would have this name", where=output, advice="choose another ending with --output"
            )
        taken.add(real)
        folder = real.parent
        while not os.path.lexists(folder):
            folder = folder.parent
        if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
            raise InputError(
                f"cannot be written: {folder} is no folder that may be written to",
                where=output,
                advice="choose another place with --output",
            )


def _check_new_bag(folder: Path, *, force: bool, inputs: Sequence[Path] = ()) -> None:
    if folder.exists() and not force:
        raise InputError("exists", where=folder, advice="choose another name or replace it with --force")
    _check_outputs([folder], inputs=inputs)
    if folder.exists() and not (folder / "metadata.yaml").is_file():
        raise InputError("exists and is no bag", where=folder, advice="choose another name or remove it")


def bundled_recording() -> Path:
    """The recording that comes with the package: beside the sources, or where an install puts shared files."""
    shared = [Path(prefix) / "share" / "g2_recon" for prefix in _install_prefixes()]
    candidates = [folder / "bags" / BUNDLED_RECORDING for folder in [Path(g2_recon.__file__).parents[1], *shared]]
    for candidate in candidates:
        if candidate.exists():
            return candidate
    raise InputError("the bundled recording is not installed", advice=f"looked for {', '.join(map(str, candidates))}")


def _install_prefixes() -> Iterator[str]:
    yield sysconfig.get_path("data")
    # colcon installs to PREFIX/lib/pythonX.Y/site-packages
    yield from map(str, Path(g2_recon.__file__).parents[2:6])


def _print_summary(summary: Mapping[str, Any], progress: StageProgress, folder: Path, console: Console) -> None:
    rows = {
        "points": f"{summary['points']:,}",
        "clusters": summary["clusters"],
        "neurons": f"{summary['neurons']:,}",
        "joins": f"{summary['joins']:,}",
        "faces": f"{summary['faces']:,}",
        "way": f"{summary['path_length_m']:.1f} m",
    }
    if "trajectory_error_m" in summary:
        rows["mean trajectory error"] = f"{100 * summary['trajectory_error_m']:.2f} cm"
    for name, robot in summary.get("robots", {}).items():
        rows[name] = "in the map" if robot["in_map"] else f"not in the map, {robot['state']}: {robot['reason']}"
    rows |= {f"dropped: {reason}": f"{count:,}" for reason, count in summary["dropped"].items()}
    print_table("done", rows, progress, console)
    print_paths({"files": folder}, console)


def _reconstruction_rows(result: Reconstruction) -> dict[str, Any]:
    return {
        "points": f"{result.points:,}",
        "clusters": result.clusters,
        "neurons": f"{len(result.wire_mesh.vertices):,}",
        "joins": f"{int(result.wire_mesh.join.sum()):,}",
        "faces": f"{len(result.mesh.faces):,}",
        "quantization error": f"{100 * result.quantization_error:.2f} cm",
        **{f"left out: {reason}": f"{count:,}" for reason, count in result.left_out.items()},
    }


def _relations_rows(score: RelationsScore) -> dict[str, Any]:
    return {
        "relations": f"{score.relations:,} ({score.missed:,} missed)",
        "translation error": f"{score.translation_mean:.4f} +- {score.translation_std:.4f} m",
        "rotation error": f"{score.rotation_mean:.3f} +- {score.rotation_std:.3f} deg",
    }


def _surface_rows(score: SurfaceScore) -> dict[str, Any]:
    rows = {
        "accuracy": f"{100 * score.accuracy:.2f} cm",
        "accuracy, 95 %": f"{100 * score.accuracy_95:.2f} cm",
        "completeness": f"{100 * score.completeness:.2f} cm",
        "completeness, 95 %": f"{100 * score.completeness_95:.2f} cm",
    }
    for at in score.at:
        rows |= {
            f"precision at {100 * at.threshold:g} cm": f"{100 * at.precision:.2f} %",
            f"recall at {100 * at.threshold:g} cm": f"{100 * at.recall:.2f} %",
            f"F-score at {100 * at.threshold:g} cm": f"{100 * at.f_score:.2f} %",
        }
    topology = score.topology
    return {
        **rows,
        "normals": f"{score.normals:.4f}",
        "faces": f"{topology.faces:,}",
        "vertices": f"{topology.vertices:,}",
        "components": f"{topology.components:,}",
        "boundary edges": f"{topology.boundary_edges:,}",
        "boundary loops": f"{topology.loops:,}",
        "non-manifold edges": f"{topology.nonmanifold_edges:,}",
        "non-manifold vertices": f"{topology.nonmanifold_vertices:,}",
        "self-intersecting faces": f"{100 * topology.self_intersecting:.2f} %",
    }


# The command line, made from the settings


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands; the options of a stage come from its config model."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("-v", "--verbose", action="count", default=0, help="log more; twice: everything")
    parser = argparse.ArgumentParser(prog="g2-recon", description=g2_recon.__doc__)
    parser.add_argument("--version", action="version", version=f"g2-recon {g2_recon.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def add(name: str, command: Any, text: str, details: str = "", to: Any = commands) -> argparse.ArgumentParser:
        sub: argparse.ArgumentParser = to.add_parser(name, parents=[common], help=text, description=details or text)
        sub.set_defaults(command=command, parser=sub)
        # That of Python 3.11 takes -1.5e-1 for an option.
        sub._negative_number_matcher = _NEGATIVE_NUMBER
        return sub

    demo = add("demo", run_demo, "the whole way on the recording that comes with g2-recon")
    demo.add_argument("-o", "--output", metavar="DIR", type=Path, default=Path("out/demo"), help="default: %(default)s")

    run = add(
        "run", run_recording, "the whole way on a recording, or one a robot: trajectories, cloud, meshes, pictures"
    )
    run.add_argument(
        "recordings",
        metavar="BAG",
        type=Path,
        nargs="+",
        help="a ROS 1 or ROS 2 bag with a horizontal and a vertical laser; several, one a robot, become one map",
    )
    run.add_argument("-o", "--output", metavar="DIR", type=Path, help="folder for all results; default: out/NAME")
    run.add_argument("--config", metavar="FILE", type=Path, help="settings as YAML, as in a result's config.yaml")
    for stage in G2ReconConfig.model_fields:
        model = type(getattr(G2ReconConfig(), stage))
        _add_settings(run, model, stage, prefix=f"{stage}.")

    localize = add(
        "localize", run_localize, "horizontal scans to a trajectory (TUM), a map (YAML, PGM) and a floor plan (PNG)"
    )
    localize.add_argument("recording", metavar="LOG", type=Path, help="CARMEN log (.log .clf, also .gz .bz2) or bag")
    localize.add_argument(
        "-o", "--output", metavar="TUM", type=Path, help="default: NAME.tum; map and floor plan beside it"
    )
    localize.add_argument(
        "--session", metavar="FILE", type=Path, help="also write the map as a session (.npz) to go on from with --map"
    )
    localize.add_argument("--relations", metavar="FILE", type=Path, help="score the trajectory by true relations")
    _add_settings(localize, LocalizationConfig, "localization")
    _add_settings(localize, RecordingConfig, "recording")

    calibrate = add(
        "calibrate",
        run_calibrate,
        "how the vertical laser is mounted, from a drive",
        "How the vertical laser is mounted, from a drive with turns: the planes that it sees must be planes. The start "
        "is registration.laser_pose, or what the recording says; it may be off by 5 cm and 3 deg. Sigma is the "
        "standard deviation along and about x (forward), y (left) and z (up) of the robot.",
    )
    calibrate.add_argument("recording", metavar="BAG", type=Path, help="a bag with a horizontal and a vertical laser")
    calibrate.add_argument(
        "-o", "--output", metavar="YAML", type=Path, help="settings for --config; default: NAME_calibration.yaml"
    )
    calibrate.add_argument("--config", metavar="FILE", type=Path, help="settings as YAML, as in a result's config.yaml")
    for stage, model in (
        ("recording", RecordingConfig),
        ("localization", LocalizationConfig),
        ("registration", RegistrationConfig),
    ):
        _add_settings(calibrate, model, stage, prefix=f"{stage}.")

    merge = add("merge", run_merge, "stop-and-go sweeps to one cloud, with the poses (TUM) of the sweeps beside it")
    merge.add_argument(
        "sweeps",
        metavar="SWEEP",
        type=Path,
        nargs="+",
        help=f"in the order of the drive: {' '.join(SWEEP_ENDINGS)}, in the frame of the laser, which stands level; "
        ".3d as 3DTK has it, with a first guess in the .pose beside it; or one bag with a tilting laser",
    )
    merge.add_argument(
        "-o", "--output", metavar="CLOUD", type=Path, help="default: NAME_merged.ply of the first; poses.tum beside it"
    )
    merge.add_argument(
        "--poses",
        metavar="FILE",
        type=Path,
        help="first guesses as TUM, a pose a sweep in their order: stamp x y z qx qy qz qw (s, m)",
    )
    _add_settings(merge, SweepConfig, "sweep")

    recon = add("reconstruct", run_reconstruct, "a cloud to a mesh")
    recon.add_argument("cloud", metavar="CLOUD", type=Path, help="PLY, PCD, XYZ, CSV or NPZ, in metres")
    recon.add_argument(
        "-o", "--output", metavar="MESH", type=Path, help=f"{' '.join(MESH_ENDINGS)}; default: NAME_mesh.ply"
    )
    _add_settings(recon, ReconstructionConfig, "reconstruction")

    importer = add("import", run_import, "a CARMEN log to a rosbag2 (MCAP) with LaserScan and Odometry")
    importer.add_argument("recording", metavar="LOG", type=Path, help="CARMEN log (.log .clf, also .gz .bz2)")
    importer.add_argument("-o", "--output", metavar="BAG", type=Path, required=True, help="the folder to make")
    importer.add_argument("--force", action="store_true", help="replace what is there")

    simulator = add("simulate", run_simulate, "a simulated robot in a simulated building, with the truth beside it")
    simulator.add_argument(
        "-o",
        "--output",
        metavar="BAG",
        type=Path,
        default=Path("out/simulated"),
        help="the folder to make; default: %(default)s",
    )
    simulator.add_argument("--force", action="store_true", help="replace what is there")
    _add_settings(simulator, SimulationConfig, "simulation")

    evaluate = commands.add_parser(
        "evaluate", help="how good a trajectory or a mesh is", description="How good a trajectory or a mesh is."
    )
    scores = evaluate.add_subparsers(required=True, metavar="SCORE")
    relations = add("relations", run_evaluate_relations, "a trajectory by true relations", _RELATIONS_TEXT, to=scores)
    relations.add_argument(
        "relations",
        metavar="RELATIONS",
        type=Path,
        help="true relations, a line each: stamp1 stamp2 x y z roll pitch yaw (s, m, rad); also .gz .bz2 .xz",
    )
    relations.add_argument("trajectory", metavar="TUM", type=Path, help="a pose a line: stamp x y z qx qy qz qw (s, m)")
    surface = add("surface", run_evaluate_surface, "a mesh by the true surface", _SURFACE_TEXT, to=scores)
    surface.add_argument(
        "truth",
        metavar="TRUTH",
        type=Path,
        help="NPZ with truth_vertices (V, 3) in m, truth_faces (F, 3) and, where not all of it was seen, clean (N, 3) "
        f"in m, the hits without noise; or a mesh ({' '.join(MESH_ENDINGS)})",
    )
    surface.add_argument(
        "mesh", metavar="MESH", type=Path, help=f"{' '.join(MESH_ENDINGS)}, in m, in the frame of the truth"
    )
    surface.add_argument(
        "--seen", metavar="CLOUD", type=Path, help="what was seen, in m, in the frame of the truth, in place of clean"
    )
    for score in (relations, surface):
        score.add_argument(
            "--json", metavar="FILE", type=Path, help="also write the score here: m, deg, shares from 0 to 1"
        )
    return parser


def _add_settings(parser: argparse.ArgumentParser, model: type[BaseModel], stage: str, *, prefix: str = "") -> None:
    """An option for each setting of a stage; `prefix` tells those of several stages apart."""
    group = parser.add_argument_group(f"{stage} settings", (model.__doc__ or "").strip())
    for setting in config.settings(model):
        name = setting.name.replace("_", "-")
        default = " ".join(map(str, setting.default)) if isinstance(setting.default, tuple) else setting.default
        shown = f"; default: {default}" if default not in ("", None) else ""
        extra: dict[str, Any] = {"metavar": (setting.unit.split(" ")[0] or setting.type.__name__).upper()}
        if setting.choices:
            extra = {"choices": setting.choices}
        elif setting.type is bool:
            extra = {"action": argparse.BooleanOptionalAction}
        elif setting.type is tuple:
            extra |= {"nargs": 6, "type": float, "metavar": ("X", "Y", "Z", "ROLL", "PITCH", "YAW")}
        else:
            extra |= {"type": _converter(setting)}
        group.add_argument(
            f"--{prefix}{name}",
            dest=f"{stage}.{setting.name}",
            default=argparse.SUPPRESS,
            help=(setting.describe() + shown).replace("%", "%%"),
            **extra,
        )


def _converter(setting: config.Setting) -> Callable[[str], Any]:
    """What makes the value of an option, so that one out of its range is bad usage."""

    def convert(text: str) -> Any:
        value = setting.type(text)
        lowest, highest = setting.minimum, setting.maximum
        if lowest is not None and highest is not None and not lowest <= value <= highest:
            raise argparse.ArgumentTypeError(f"{text} is not in {lowest:g} to {highest:g}")
        return value

    # argparse names it where the text is no such value.
    convert.__name__ = setting.type.__name__
    return convert


def _made(model: type[Model], values: Mapping[str, Any], options: argparse.Namespace, *, prefix: str = "") -> Model:
    """The settings of a stage; options that do not go together are bad usage. `prefix` is that of the options."""
    try:
        return config.make(model, values)
    except ConfigError as error:
        text = str(error).removeprefix(f"{model.__name__}: ")
        names = "|".join(sorted(model.model_fields, key=len, reverse=True))
        parser: argparse.ArgumentParser = options.parser
        parser.error(
            re.sub(rf"\b({names})\b", lambda found: f"--{prefix}{found[0].replace('_', '-')}", text),
        )


def _given(options: argparse.Namespace, stage: str) -> dict[str, Any]:
    """The settings of a stage that were given on the command line."""
    prefix = f"{stage}."
    return {name.removeprefix(prefix): value for name, value in vars(options).items() if name.startswith(prefix)}


def _overridden(settings: G2ReconConfig, options: argparse.Namespace) -> G2ReconConfig:
    """The settings of a run, with those that were given on the command line."""
    stages_of_run = {
        name: _made(type(stage), stage.model_dump() | _given(options, name), options, prefix=f"{name}.")
        for name, stage in settings
    }
    return G2ReconConfig(**stages_of_run)


def _stem(path: Path) -> str:
    """The name of a recording or cloud without its endings, such as `aces` of `aces.clf.bz2`."""
    absolute = os.path.abspath(path)  # noqa: PTH100 - Path.resolve fails on a link that leads to itself
    return Path(absolute).name.split(".")[0] or "recording"


if __name__ == "__main__":
    sys.exit(main())
