# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Every setting there is: one model a stage, each field with its default, unit, range and meaning.

A field is the key in a YAML file, the option on the command line and the ROS parameter of the same name.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic.fields import FieldInfo

from g2_recon.errors import ConfigError

Model = TypeVar("Model", bound=BaseModel)

# An error stays one line that can be read, whatever was in the file.
_PROBLEMS_SAID = 5
_short = reprlib.Repr()
_short.maxlevel = 2
_short.maxstring = 80


def _setting(default: Any, meaning: str, unit: str = "", *, ge: float | None = None, le: float | None = None) -> Any:
    extra: dict[str, Any] = {"unit": unit}
    return Field(default, ge=ge, le=le, description=meaning, json_schema_extra=extra)


def _pose(meaning: str) -> Any:
    return Field((), description=meaning, json_schema_extra={"unit": "m m m rad rad rad"})


def _check_pose(name: str, pose: tuple[float, ...]) -> None:
    if len(pose) not in (0, 6):
        raise ValueError(f"{name} needs six numbers x y z roll pitch yaw (m, rad), or none; got {len(pose)}")


def _check_ranges(nearest: float, farthest: float) -> None:
    if nearest >= farthest:
        raise ValueError("min_range must be smaller than max_range")


class _Model(BaseModel):
    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=False, validate_default=True
    )


class RecordingConfig(_Model):
    """Where in a bag the scans and the odometry are; a leading slash does not matter."""

    scan_topic: str = _setting(
        "scan", "LaserScan of the horizontal laser; if absent, the only LaserScan topic there is"
    )
    scan_vertical_topic: str = _setting("scan_vertical", "LaserScan of the vertical laser")
    scan_tilt_topic: str = _setting("scan_tilt", "LaserScan of the laser that sweeps while the robot stands")
    joint_topic: str = _setting("joint_states", "JointState with the angle of the sweeping laser")
    odom_topic: str = _setting("odom", "Odometry of the wheels; if absent, the only Odometry topic there is")
    base_frame: str = _setting("base_link", "frame of the robot that the lasers are mounted on")


class LocalizationConfig(_Model):
    """Where the robot was, from the scans of the horizontal laser."""

    laser_pose: tuple[float, ...] = _pose(
        "pose of the horizontal laser on the robot as x y z roll pitch yaw; empty: as the recording or TF says"
    )
    method: Literal["graph", "paper"] = _setting(
        "graph", "graph: smoothing, loop closures, refinement; paper: ICP of each scan against a global point map"
    )
    mode: Literal["mapping", "localization"] = _setting(
        "mapping",
        "mapping: the map grows, from nothing or from a loaded one; localization: the loaded map stays as it is",
    )
    map: str = _setting(
        "", "method graph: file of a saved session to go on in; the place in it is looked for; empty: a new map"
    )
    loop_closure: bool = _setting(True, "method graph: recognize places and correct the drift since then")
    use_odometry: bool = _setting(
        True, "take wheel odometry as the first guess where there is some; else constant velocity"
    )
    min_range: float = _setting(0.1, "nearer returns are the robot itself", "m", ge=0, le=10)
    max_range: float = _setting(40.0, "farther returns are not used", "m", ge=0.5, le=200)
    keyframe_distance: float = _setting(
        0.25, "the map grows when the robot has moved this far ...", "m", ge=0.01, le=10
    )
    keyframe_angle: float = _setting(
        round(math.radians(10), 4), "... or has turned this far since it last grew", "rad", ge=0.01, le=math.pi
    )
    map_spacing: float = _setting(0.05, "a point enters the map where it has no point this near", "m", ge=0.001, le=1)
    grid_resolution: float = _setting(0.05, "edge of a cell of the occupancy grid", "m", ge=0.01, le=1)
    max_correspondence: float = _setting(
        0.3, "method paper: farthest map point that a beam is paired with in the first iteration", "m", ge=0.05, le=5
    )
    min_correspondence: float = _setting(
        0.12, "method paper: the same in the last iterations, so that what does not fit is rejected", "m", ge=0.01, le=5
    )
    max_iterations: int = _setting(25, "method paper: ICP iterations at most for one scan", ge=1, le=500)
    min_inliers: float = _setting(
        0.4,
        "method paper: a match with a smaller share of paired beams is rejected; the pose then follows the first guess",
        ge=0,
        le=1,
    )

    @model_validator(mode="after")
    def _check(self) -> LocalizationConfig:
        _check_pose("laser_pose", self.laser_pose)
        _check_ranges(self.min_range, self.max_range)
        if self.min_correspondence > self.max_correspondence:
            raise ValueError("min_correspondence must not be larger than max_correspondence")
        if self.mode == "localization" and not self.map:
            raise ValueError("mode localization needs a map")
        if self.method == "paper" and self.map:
            raise ValueError("method paper cannot go on in a map")
        return self


class RegistrationConfig(_Model):
    """Vertical scans to a cloud in the map frame."""

    laser_pose: tuple[float, ...] = _pose(
        "pose of the vertical laser on the robot as x y z roll pitch yaw; empty: as the recording or TF says"
    )
    min_range: float = _setting(0.2, "nearer returns are the robot itself", "m", ge=0, le=10)
    max_range: float = _setting(30.0, "farther returns are not used", "m", ge=0.5, le=200)
    max_wait: float = _setting(
        30.0,
        "a scan for which no pose has come when scans this much newer have is dropped and counted",
        "s",
        ge=0,
        le=60,
    )
    max_gap: float = _setting(0.5, "poses farther apart in time are not interpolated between", "s", ge=0.001, le=60)
    voxel: float = _setting(
        0.0,
        "the cloud keeps the first point in each cube of this edge; live: in each piece of it; 0: all points",
        "m",
        ge=0,
        le=10,
    )
    correction_distance: float = _setting(
        0.01,
        "live: points are placed anew where the localizer has moved the way further than this ...",
        "m",
        ge=0,
        le=1,
    )
    correction_angle: float = _setting(
        round(math.radians(0.1), 4), "... or has turned it further than this since", "rad", ge=0, le=1
    )
    kept_scans: int = _setting(
        300_000,
        "live: scans kept to be placed anew, 1.5 kB each of 181 beams; the points of older ones stay where they are",
        ge=0,
        le=100_000_000,
    )
    scan_distance: float = _setting(
        0.05,
        "live: a scan is handed out where the robot has moved this far since the last ones that were ...",
        "m",
        ge=0,
        le=10,
    )
    scan_angle: float = _setting(
        round(math.radians(1.0), 4),
        "... or has turned this far; others are counted; either 0: wherever it is",
        "rad",
        ge=0,
        le=math.pi,
    )
    new_points: float = _setting(
        0.3,
        "live: of these, those are counted only of which a smaller share lies where pieces before the latest 30 have "
        "no point within a cube of 0.2 m, seen from the same side; 0: none",
        ge=0,
        le=1,
    )

    @model_validator(mode="after")
    def _check(self) -> RegistrationConfig:
        _check_pose("laser_pose", self.laser_pose)
        _check_ranges(self.min_range, self.max_range)
        return self


class SweepConfig(_Model):
    """Stop-and-go sweeps to one cloud."""

    method: Literal["gicp", "kiss", "paper"] = _setting(
        "gicp",
        "how sweeps are laid on each other; gicp: generalized ICP of small_gicp; kiss: the ICP of KISS-ICP; paper: "
        "point-to-point ICP as published",
    )
    scale: float = _setting(1.0, "metres a unit of the coordinates; 0.001 for millimetres", "m", ge=1e-6, le=1000)
    min_range: float = _setting(0.2, "nearer returns are the robot itself", "m", ge=0, le=10)
    max_range: float = _setting(30.0, "farther returns are not used", "m", ge=0.5, le=200)
    voxel: float = _setting(
        0.14, "sweeps are matched with one point a cube of this edge; the cloud keeps all", "m", ge=0.01, le=2
    )
    all_points: bool = _setting(
        False,
        "method paper: at last match all points of a sweep, as slam6D does, not one a voxel: what is near counts more",
    )
    first_gate: float = _setting(1.5, "farthest points that are paired at first", "m", ge=0.1, le=20)
    last_gate: float = _setting(0.1, "farthest points that are paired at last", "m", ge=0.02, le=5)
    search: float = _setting(
        2.0, "where a match from the guess is refused, places this far around it are tried; 0: none", "m", ge=0, le=20
    )
    search_angle: float = _setting(
        round(math.radians(45), 4), "the same for headings to both sides of it", "rad", ge=0, le=math.pi
    )
    min_overlap: float = _setting(
        0.3, "a match is refused where a smaller share of the sweep with fewer points is near the other", ge=0, le=1
    )
    min_inliers: float = _setting(
        0.92,
        "a match is refused where a smaller share of what both sweeps should see lies on the same surface",
        ge=0,
        le=1,
    )
    max_residual: float = _setting(
        0.04,
        "a match is refused where points lie farther from the surface they are paired with, as RMS",
        "m",
        ge=0.001,
        le=1,
    )
    weak_share: float = _setting(
        0.005,
        "a direction is left to odometry where less than this share of the normals, squared, points along it",
        ge=0,
        le=0.3,
    )
    loop_closure: bool = _setting(True, "match a sweep with all near ones before it; off: with the last one only")
    neighbors: int = _setting(6, "a sweep is matched against this many of the nearest ones before it", ge=1, le=1000)
    max_distance: float = _setting(10.0, "sweeps farther apart than this are not matched", "m", ge=0.1, le=200)
    odometry_distance: float = _setting(
        0.1, "standard deviation of odometry a metre that the robot drove, and at least 0.1 of a metre", ge=0.001, le=10
    )
    odometry_angle: float = _setting(
        0.1, "standard deviation of the heading of odometry between two sweeps", "rad", ge=0.001, le=4
    )

    correction_distance: float = _setting(
        0.01,
        "live: a sweep is published anew where later ones have moved it further than this ...",
        "m",
        ge=0,
        le=1,
    )
    correction_angle: float = _setting(
        round(math.radians(0.1), 4), "... or have turned it further than this since", "rad", ge=0, le=1
    )

    min_tilt: float = _setting(
        0.35, "tilting laser: a sweep whose tilt covers less is refused", "rad", ge=0.01, le=2 * math.pi
    )
    max_tilt_step: float = _setting(
        0.1,
        "tilting laser: a sweep whose tilt jumps further from one angle to the next is refused",
        "rad",
        ge=0.001,
        le=4,
    )
    max_motion: float = _setting(
        0.01, "tilting laser: a sweep during which the robot moved further is refused", "m", ge=0, le=1
    )
    max_turn: float = _setting(
        0.01, "tilting laser: a sweep during which the robot turned further is refused", "rad", ge=0, le=1
    )
    max_gap: float = _setting(
        0.5,
        "tilting laser: scans farther apart in time are of two sweeps; poses are not odometry between",
        "s",
        ge=0.001,
        le=60,
    )

    @model_validator(mode="after")
    def _check(self) -> SweepConfig:
        _check_ranges(self.min_range, self.max_range)
        if self.last_gate > self.first_gate:
            raise ValueError("last_gate must not be larger than first_gate")
        return self


# The training of one map looks at all pairs of its neurons.
_MOST_NEURONS = 2500


class ReconstructionConfig(_Model):
    """Clusters, one self-organizing map a cluster, joins, borders fitted once more."""

    mode: Literal["solid", "paper"] = _setting(
        "solid", "solid: a mesh of triangles over flat clusters; paper: the published method, a wire mesh"
    )
    theta: float = _setting(
        1.8, "border neurons are joined when nearer than this many mean distances to lattice neighbors", ge=0, le=10
    )
    epochs: int = _setting(30, "updates of each map by the batch rule", ge=1, le=100_000)
    min_sensor_distance: float = _setting(
        0.2, "points nearer to where they were seen from are the robot itself and are left out", "m", ge=0, le=10
    )
    spacing: float = _setting(0.2, "mode solid: distance of neighboring neurons", "m", ge=0.001, le=100)
    patch_area: float = _setting(
        0.0,
        "mode solid: surface for one cluster at first; bends and gaps part them further; 0: that of 40 cells",
        "m^2",
        ge=0,
        le=1e6,
    )
    flatness: float = _setting(
        0.0,
        "mode solid: how far points may lie off the plane of their cluster, if that is over 4.5 sigma of noise; 0: a "
        "fifth of the spacing",
        "m",
        ge=0,
        le=10,
    )
    support_distance: float = _setting(
        0.0, "mode solid: a triangle is kept where data lies this near to all of it; 0: the spacing", "m", ge=0, le=100
    )
    clusters: int = _setting(
        100,
        "mode paper: clusters, and so submaps; small clouds get fewer, each with a point a neuron or more",
        ge=1,
        le=100_000,
    )
    clustering: Literal["k_means", "neural_gas"] = _setting(
        "k_means", "mode paper: how clusters are found; the paper sees virtually no difference between the two"
    )
    presentations: int = _setting(
        40_000, "clustering neural_gas: presentations of single points, in random order", ge=1, le=100_000_000
    )
    cluster_gap: float = _setting(
        0.4,
        "mode paper: parts of a cluster farther apart than this become clusters of their own",
        "m",
        ge=0.001,
        le=1000,
    )
    lattice: Literal["rectangular", "hexagonal", "triangular"] = _setting(
        "rectangular",
        "neighbors of a neuron; rectangular: four, meshes are cut along their shorter diagonal; hexagonal: six, every "
        "other row shifted by half a step; triangular: four and those along one diagonal, so that meshes are triangles "
        "and borders straight; mode solid sizes lattices to their clusters at spacing, mode paper by rows and columns",
    )
    rows: int = _setting(10, "mode paper: neurons along one side of each lattice", ge=2, le=200)
    columns: int = _setting(5, "mode paper: neurons along the other side of each lattice", ge=2, le=200)
    training: Literal["iterative", "batch"] = _setting(
        "iterative",
        "mode paper: rule of training; iterative is the published one, batch is about a hundred times faster",
    )
    passes: int = _setting(10_000, "iterative rule: presentations of all data to each map", ge=1, le=1_000_000)
    learning_rate_start: float = _setting(0.5, "iterative rule: learning rate at the start", ge=0, le=1)
    learning_rate_end: float = _setting(0.005, "iterative rule: learning rate at the end", ge=0, le=1)
    border_width: int = _setting(
        2,
        "mode paper: rings of neurons that are re-optimized, counted from the joined border neurons inwards; 0: none",
        ge=0,
        le=100,
    )
    border_passes: int = _setting(
        1000,
        "iterative rule: presentations of the border data in the re-optimization, which the paper does not name; 0: as "
        "many as passes, for hardly any change",
        ge=0,
        le=1_000_000,
    )
    seed: int = _setting(0, "seed of everything random", ge=0, le=2**31 - 1)
    workers: int = _setting(0, "threads; 0: one a processor; the result does not depend on it", ge=0, le=1024)

    @model_validator(mode="after")
    def _check(self) -> ReconstructionConfig:
        if self.rows * self.columns > _MOST_NEURONS:
            raise ValueError(f"rows x columns must not be more than {_MOST_NEURONS} neurons")
        return self


class SimulationConfig(_Model):
    """A differential-drive robot with two LMS200 in a simulated building."""

    seed: int = _setting(0, "seed of all noise", ge=0, le=2**31 - 1)
    setup: Literal["orthogonal", "sweeping"] = _setting(
        "orthogonal",
        "orthogonal: a horizontal and a vertical laser while driving; sweeping: one that tilts while the robot stands",
    )
    max_speed: float = _setting(0.5, "top speed of the robot", "m/s", ge=0.05, le=5)
    max_turn_rate: float = _setting(0.8, "top turn rate of the robot", "rad/s", ge=0.05, le=5)
    acceleration: float = _setting(0.5, "acceleration of the robot", "m/s^2", ge=0.01, le=10)
    range_noise: float = _setting(0.01, "standard deviation of a range", "m", ge=0, le=1)
    beam_spacing: Literal["1", "0.5"] = _setting("1", "beam spacing in deg: 1 at 75 Hz or 0.5 at 37.5 Hz", "deg")
    measuring_mode: Literal["8", "80"] = _setting(
        "8", "how far the laser sees: 8 with a resolution of 1 mm or 80 with one of 1 cm", "m"
    )
    mixed_pixels: bool = _setting(True, "ranges between near and far where a beam is split by an edge")
    horizontal_every: int = _setting(
        3, "the horizontal or the sweeping laser keeps one scan in this many", ge=1, le=1000
    )
    vertical_every: int = _setting(26, "the vertical laser keeps one scan in this many", ge=1, le=1000)
    odometry_rate: float = _setting(25.0, "odometry messages a second", "Hz", ge=1, le=1000)
    odometry_drift: float = _setting(
        1.0, "scale of all wheel errors (unequal wheels, slip); 0: perfect odometry", ge=0, le=100
    )


class G2ReconConfig(_Model):
    """All stages of a run."""

    recording: RecordingConfig = RecordingConfig()
    localization: LocalizationConfig = LocalizationConfig()
    registration: RegistrationConfig = RegistrationConfig()
    sweeps: SweepConfig = SweepConfig()
    reconstruction: ReconstructionConfig = ReconstructionConfig()


@dataclass(frozen=True, slots=True)
class Setting:
    """One field of a model as the command line, a YAML file and a ROS parameter need it."""

    name: str
    type: type
    default: Any
    meaning: str
    unit: str
    minimum: float | None
    maximum: float | None
    choices: tuple[str, ...]

    def describe(self) -> str:
        """One line: meaning, unit and range."""
        unit = f" [{self.unit}]" if self.unit else ""
        limits = (
            f" ({self.minimum:g} to {self.maximum:g})" if self.minimum is not None and self.maximum is not None else ""
        )
        return f"{self.meaning}{unit}{limits}"


def settings(model: type[BaseModel]) -> Iterator[Setting]:
    """The settings of one stage's model, in order."""
    for name, field in model.model_fields.items():
        choices = tuple(get_args(field.annotation)) if get_origin(field.annotation) is Literal else ()
        annotation: Any = field.annotation
        kind = str if choices else get_origin(annotation) or annotation
        extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
        yield Setting(
            name=name,
            type=kind,
            default=field.default,
            meaning=field.description or "",
            unit=str(extra.get("unit", "")),
            minimum=_limit(field, "ge"),
            maximum=_limit(field, "le"),
            choices=choices,
        )


def _limit(field: FieldInfo, which: str) -> float | None:
    return next((getattr(item, which) for item in field.metadata if hasattr(item, which)), None)


def make(model: type[Model], values: Mapping[str, Any], *, where: object = None) -> Model:
    """A model from plain values. Raises ConfigError that names each wrong field, its value and what is allowed."""
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        problems = error.errors()
        said = [_problem(problem, model) for problem in problems[:_PROBLEMS_SAID]]
        more = [f"and {len(problems) - len(said)} more"] if len(problems) > len(said) else []
        raise ConfigError("; ".join(said + more), where=where) from None


def _problem(problem: Mapping[str, Any], model: type[BaseModel]) -> str:
    place = ".".join(_short.repr(part).strip("'") for part in problem["loc"]) or model.__name__
    text = f"{place}: {problem['msg'].removeprefix('Value error, ')}"
    if not problem["loc"] or problem["type"] in ("extra_forbidden", "value_error"):
        return text
    try:
        return f"{text}, got {_short.repr(problem['input'])}"
    except ValueError:  # Python refuses to write integers of thousands of digits.
        return text


def load(path: str | Path) -> G2ReconConfig:
    """The settings of a run from a YAML file as `dump` writes it; what is not in it keeps its default.

    Raises ConfigError if the file cannot be read, is no YAML mapping, or holds an unknown, wrong or repeated setting.
    """
    try:
        values = yaml.load(Path(path).read_text(encoding="utf-8"), _Loader)
    except OSError as error:
        raise ConfigError(error.strerror or "cannot be read", where=path) from error
    except RecursionError:
        raise ConfigError("is nested too deeply", where=path) from None
    except (yaml.YAMLError, ValueError) as error:  # ValueError: no UTF-8, no date, an integer without end
        raise ConfigError(f"is no YAML: {error}", where=path) from error
    if values is None:
        values = {}
    if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
        raise ConfigError("holds no settings", where=path, advice="expected sections such as 'localization:'")
    # A section without a body, as where all its settings are commented out.
    sections = {name: {} if section is None else section for name, section in values.items()}
    return make(G2ReconConfig, sections, where=path)


class _Loader(yaml.SafeLoader):
    """Plain YAML in which no key of a mapping is repeated."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Instead of merging `<<`, which a few lines could blow up without end, look for repeated keys."""
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"{_short.repr(key.value)} is there twice", key.start_mark
                )
            seen.add(key.value)


def dump(config: BaseModel, *, indent: int = 0) -> str:
    """Commented YAML of a config and the configs in it: each setting under its meaning, unit and range."""
    lines = []
    described = {setting.name: setting for setting in settings(type(config))}
    for name in type(config).model_fields:
        value = getattr(config, name)
        if isinstance(value, BaseModel):
            lines += [
                f"# {(type(value).__doc__ or '').strip()}",
                f"{name}:",
                dump(value, indent=indent + 2).rstrip("\n"),
                "",
            ]
        else:
            plain = list(value) if isinstance(value, tuple) else value
            text = yaml.safe_dump(plain, default_flow_style=True).removesuffix("\n").removesuffix("\n...")
            lines += [" " * indent + f"# {described[name].describe()}", " " * indent + f"{name}: {text}"]
    return "\n".join(lines).rstrip("\n") + "\n"
