# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The parameters of the nodes: a stage's settings and what only a node needs, from one model a node.

`python -m g2_recon.nodes.parameters` writes them all, commented, with the values of the robot G2; with names behind it,
for robots of these names that make one map.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, ClassVar, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, model_validator
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterUninitializedException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from g2_recon import config
from g2_recon.config import LocalizationConfig, ReconstructionConfig, RegistrationConfig, Setting, SweepConfig
from g2_recon.errors import ConfigError

Model = TypeVar("Model", bound=BaseModel)


def _parameter(default: Any, meaning: str, unit: str = "", *, ge: float | None = None, le: float | None = None) -> Any:
    return Field(default, ge=ge, le=le, description=meaning, json_schema_extra={"unit": unit})


def _as_in(model: type[BaseModel], name: str) -> Any:
    """The field of another model."""
    return model.model_fields[name]


class _NodeModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)

    live: ClassVar[frozenset[str]] = frozenset()
    """The parameters that can be changed while the node runs; the others are read-only."""

    queue_depth: int = _parameter(
        1000, "messages of a topic that are kept for a node that is busy; older ones are lost", ge=1, le=1_000_000
    )


_FRAMES = ("map_frame", "odom_frame", "base_frame")


class _MapNodeModel(_NodeModel):
    map_frame: str = _parameter("map", "frame of the map; what comes in another frame is dropped and counted")
    frame_prefix: str = _parameter(
        "", "goes before the names of all frames that are parameters, such as robot1/ for one robot of several"
    )

    def with_prefix(self: Model) -> Model:
        """The parameters with `frame_prefix` before each frame."""
        values = self.model_dump()
        prefix = values["frame_prefix"]
        return self.model_copy(update={name: prefix + values[name] for name in _FRAMES if name in values})


def effective(settings: Model) -> Model:
    """The settings as a node uses them: with the prefix before each frame."""
    return settings.with_prefix() if isinstance(settings, _MapNodeModel) else settings


class _SessionModel(BaseModel):
    session_dir: str = _parameter(
        "",
        "folder that ~/save writes to, and of the journal of all that was accepted, from which a node goes on after a "
        "crash; empty: neither",
    )


class LocalizerParameters(_SessionModel, _MapNodeModel, LocalizationConfig):
    """Parameters of localizer_node."""

    live: ClassVar[frozenset[str]] = frozenset({"odometry_wait", "publish_tf"})

    odom_frame: str = _parameter("odom", "frame of the wheel odometry, parent of the robot in TF")
    publish_tf: bool = _parameter(True, "send the transform map -> odom, where tf2 is installed")
    base_frame: str = _parameter("base_link", "frame of the robot that the laser is mounted on")
    odometry_wait: float = _parameter(
        0.2,
        "a scan that odometry does not reach waits for it, unless odometry is this much older than the newest scan",
        "s",
        ge=0,
        le=10,
    )


class RegistrarParameters(_SessionModel, _MapNodeModel, RegistrationConfig):
    """Parameters of registrar_node."""

    live: ClassVar[frozenset[str]] = frozenset({"min_range", "max_range", "max_wait", "max_gap"})

    base_frame: str = _parameter("base_link", "frame of the robot that the laser is mounted on")


class SweepParameters(_SessionModel, _MapNodeModel, SweepConfig):
    """Parameters of sweep_node."""

    laser_pose: tuple[float, ...] = _parameter(
        (),
        "pose of the laser, or of the mount that it tilts in, on the robot as x y z roll pitch yaw; empty: as TF says",
        "m m m rad rad rad",
    )
    base_frame: str = _parameter("base_link", "frame of the robot that the laser is mounted on")
    tilt_joint: str = _parameter("", "name of the joint that tilts the laser; empty: the first one of each message")
    odometry_kept: float = _parameter(60.0, "odometry is kept this long for sweeps that come late", "s", ge=0, le=3600)


_SHOWN = ("rebuild", "rebuild_period", "color_by")


class ReconstructParameters(_SessionModel, _MapNodeModel, ReconstructionConfig):
    """Parameters of reconstruct_node; each reconstruction takes those of the moment at which it begins."""

    live: ClassVar[frozenset[str]] = frozenset({*ReconstructionConfig.model_fields, *_SHOWN})

    rebuild: Literal["on_request", "every_n_seconds", "continuous"] = _parameter(
        "on_request",
        "when the mesh is made; on_request: by ~/reconstruct only; every_n_seconds, continuous: also live, mode solid "
        "where data changed, mode paper all of it",
    )
    rebuild_period: float = _parameter(
        5.0, "rebuild every_n_seconds: from the start of one to that of the next", "s", ge=0.1, le=3600
    )
    color_by: Literal["submap", "height", "error"] = _parameter(
        "submap",
        "what the colors of the markers tell; height: blue, red and back every 6 m; error: of a face, from blue to red "
        "at 5 cm, gray without points",
    )
    cloud_topics: tuple[str, ...] = _parameter(("cloud",), "topics of the clouds, one or more a robot")
    enough_points: int = _parameter(
        2,
        "where pieces of the cloud before the latest 30 have so many points in a cube with the edge that `spacing` has "
        "at the start, seen from the same side, others are counted and not kept: memory grows with the surfaces only",
        ge=1,
        le=100_000_000,
    )


class MapMergerParameters(_NodeModel):
    """Parameters of map_merger_node."""

    session_dir: str = _parameter(
        "",
        "folder of the journal of all that was accepted, from which the node goes on after a crash; empty: none",
    )
    robots: tuple[str, ...] = _parameter(
        ("",), "namespaces of the robots; empty: all right below the namespace of the node, as they come"
    )
    starts: tuple[str, ...] = _parameter(
        ("",), "where the map of a robot lies in the world, if it is known about, as 'robot1 x y yaw', one a robot"
    )
    world_frame: str = _parameter("world", "frame of the map of all robots")
    publish_tf: bool = _parameter(True, "send the transforms world -> <robot>/map, where tf2 is installed")
    stale_after: float = _parameter(5.0, "a robot that has been silent for so long is stale", "s", ge=1, le=3600)
    settle: float = _parameter(
        5.0, "where nothing has come for so long, the places of all robots are looked for anew", "s", ge=0.1, le=3600
    )
    map_spacing: float = _as_in(LocalizationConfig, "map_spacing")
    grid_resolution: float = _as_in(LocalizationConfig, "grid_resolution")

    @property
    def names(self) -> tuple[str, ...]:
        """The robots that are named."""
        return tuple(robot.strip("/") for robot in self.robots if robot.strip("/"))

    @property
    def known_starts(self) -> dict[str, tuple[float, float, float]]:
        """World ← <robot>/map by robot."""
        return dict(_start(text) for text in self.starts if text.strip())

    @model_validator(mode="after")
    def _check(self) -> MapMergerParameters:
        _ = self.known_starts
        return self


def _start(text: str) -> tuple[str, tuple[float, float, float]]:
    """Robot and pose. Raises ValueError where it is something else."""
    robot, *numbers = text.split()
    try:
        x, y, yaw = map(float, numbers)
    except ValueError:
        x = y = yaw = math.nan
    if not all(map(math.isfinite, (x, y, yaw))):
        raise ValueError(f"'{text}' of starts is not a robot and three numbers, as in 'robot1 2.0 0.5 1.57'")
    return robot.strip("/"), (x, y, yaw)


class ReplayParameters(_NodeModel):
    """Parameters of replay_node."""

    live: ClassVar[frozenset[str]] = frozenset({"rate", "loop", "exit_when_done"})

    bag: str = _parameter("", "recording to replay: the folder of a rosbag2 or a bag file")
    rate: float = _parameter(1.0, "speed of the replay; 1: as it was recorded", ge=0.01, le=100)
    loop: bool = _parameter(False, "start again at the end")
    wait_for_subscribers: float = _parameter(
        10.0, "the replay starts when every topic has a subscriber, or after this time", "s", ge=0, le=3600
    )
    start_delay: float = _parameter(
        1.0, "time that subscribers then get to make their connections before the replay starts", "s", ge=0, le=3600
    )
    exit_when_done: bool = _parameter(True, "the node ends when all is replayed and received")


G2: dict[str, BaseModel] = {
    "localizer_node": LocalizerParameters(laser_pose=(0.15, 0, 0.35, 0, 0, 0)),
    "registrar_node": RegistrarParameters(laser_pose=(-0.05, 0, 0.60, 0, round(-math.pi / 2, 7), 0), max_wait=60.0),
    "sweep_node": SweepParameters(laser_pose=(0.15, 0, 0.60, 0, 0, 0)),
    "reconstruct_node": ReconstructParameters(rebuild="every_n_seconds"),
    "map_merger_node": MapMergerParameters(),
    "replay_node": ReplayParameters(),
}
"""The robot of the paper: a horizontal laser in front, a vertical one behind it that looks up to both sides."""


def declare(node: Node, model: type[Model]) -> Model:
    """Declare every setting of `model` as a parameter of the node and return the model with their values.

    Raises ConfigError that names the parameter, its value and what is allowed.
    """
    where = f"parameters of {node.get_fully_qualified_name()}"
    values = {}
    for setting in config.settings(model):
        kind = _parameter_type(setting)
        default = _plain(setting.default)
        descriptor = describe(setting, live=setting.name in _live(model))
        try:
            node.declare_parameter(setting.name, kind if default == [] else default, descriptor)
            value = node.get_parameter(setting.name).value
        except InvalidParameterTypeException as error:
            raise ConfigError(
                str(error).removesuffix(f": {setting.name}"),
                where=where,
                advice="a decimal number needs a point, as in 1.0" if kind.name.startswith("DOUBLE") else "",
            ) from None
        except InvalidParameterValueException as error:
            raise ConfigError(str(error), where=where) from None
        except ParameterUninitializedException:
            value = setting.default
        values[setting.name] = _plain(value)
    _warn_of_unknown(node)
    return config.make(model, values, where=where)


def follow(node: Node, settings: Model, take: Callable[[Model], None]) -> None:
    """Let the live parameters of `settings` be changed: a value that does not do is refused with the reason.

    `take` gets the new settings once they are accepted.
    """
    current = settings

    def changed(changes: list[Parameter]) -> Model:
        new = {change.name: _plain(change.value) for change in changes if change.name in _live(type(settings))}
        return config.make(type(settings), current.model_dump() | new)

    def check(changes: list[Parameter]) -> SetParametersResult:
        try:
            changed(changes)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def accept(changes: list[Parameter]) -> None:
        nonlocal current
        new = changed(changes)
        if new != current:
            current = new
            take(new)

    node.add_on_set_parameters_callback(check)
    node.add_post_set_parameters_callback(accept)


def describe(setting: Setting, *, live: bool = False) -> ParameterDescriptor:
    """The ROS descriptor of a setting: type, meaning, unit and range; `live` ones can be changed."""
    descriptor = ParameterDescriptor(
        name=setting.name,
        type=_parameter_type(setting).value,
        description=setting.describe(),
        additional_constraints=f"one of: {', '.join(setting.choices)}" if setting.choices else "",
        read_only=not live,
    )
    if setting.minimum is not None and setting.maximum is not None:
        if setting.type is int:
            limits = IntegerRange(from_value=int(setting.minimum), to_value=int(setting.maximum))
            descriptor.integer_range = [limits]
        else:
            limits = FloatingPointRange(from_value=float(setting.minimum), to_value=float(setting.maximum))
            descriptor.floating_point_range = [limits]
    return descriptor


def _live(model: type[BaseModel]) -> frozenset[str]:
    live: frozenset[str] = getattr(model, "live", frozenset())
    return live


def dump(nodes: dict[str, BaseModel], robots: Sequence[str] = ()) -> str:
    """A commented ROS parameter file, by node; it applies in every namespace. robots: for several of these names."""
    if robots:
        nodes = nodes | {"map_merger_node": MapMergerParameters(robots=tuple(robots))}
    command = " ".join(["python -m g2_recon.nodes.parameters", *robots])
    file = "robots" if robots else "g2"
    lines = [
        "# SPDX-FileCopyrightText: 2026 The g2_recon developers",
        "# SPDX-License-Identifier: Apache-2.0",
        "# All parameters of all nodes, with the values of the robot G2, in every namespace. What is `live` can be",
        "# changed while the node runs (`ros2 param set`). Written by",
        f"#   {command} > config/{file}.yaml",
    ]
    for name, model in nodes.items():
        lines += ["", f"/**/{name}:", "  ros__parameters:", *_with_marks(model)]
    return "\n".join(lines) + "\n"


def _with_marks(model: BaseModel) -> Iterator[str]:
    """The lines of a model: a comment and a value in turn; comments say which parameters are live."""
    lines = config.dump(model, indent=4).splitlines()
    for comment, value in zip(lines[::2], lines[1::2], strict=True):
        yield f"{comment}; live" if value.split(":")[0].strip() in _live(type(model)) else comment
        yield value


def _parameter_type(setting: Setting) -> Parameter.Type:
    if setting.type is tuple:
        texts = setting.default and all(isinstance(item, str) for item in setting.default)
        return Parameter.Type.STRING_ARRAY if texts else Parameter.Type.DOUBLE_ARRAY
    kinds = {
        bool: Parameter.Type.BOOL,
        int: Parameter.Type.INTEGER,
        float: Parameter.Type.DOUBLE,
        str: Parameter.Type.STRING,
    }
    return kinds[setting.type]


def _plain(value: Any) -> Any:
    """Arrays and tuples as lists."""
    return value if isinstance(value, (bool, int, float, str)) else list(value)


def _warn_of_unknown(node: Node) -> None:
    """Name the parameters that were given but that the node does not have: most likely misspelled."""
    for name in node._parameter_overrides:
        if not node.has_parameter(name) and not name.startswith("qos_overrides."):
            node.get_logger().warning(f"there is no parameter '{name}': its value has no effect")


if __name__ == "__main__":
    sys.stdout.write(dump(G2, sys.argv[1:]))
