# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""pipeline_node: all nodes of one robot in one process, for a small computer or where there is no `ros2 launch`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence

from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from g2_recon.nodes.localizer_node import LocalizerNode
from g2_recon.nodes.reconstruct_node import ReconstructNode
from g2_recon.nodes.registrar_node import RegistrarNode
from g2_recon.nodes.replay_node import ReplayNode
from g2_recon.nodes.ros import run_together
from g2_recon.nodes.sweep_node import SweepNode

STAGES: dict[str, dict[str, Callable[[], Node]]] = {
    "vertical": {
        "localizer_node": LocalizerNode,
        "registrar_node": RegistrarNode,
        "reconstruct_node": ReconstructNode,
    },
    "sweeps": {"sweep_node": SweepNode, "reconstruct_node": ReconstructNode},
}
"""The nodes of a robot, by what it has: a horizontal and a vertical laser, or one that sweeps while it stands."""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pipeline_node",
        description="All nodes of one robot in one process. Behind --ros-args come parameters, for all nodes or for "
        "one (-p localizer_node:max_range:=20.0), parameter files and remappings.",
    )
    parser.add_argument(
        "--lasers",
        choices=STAGES,
        default="vertical",
        help="vertical: a horizontal and a vertical laser; sweeps: one that tilts while the robot stands "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--bag", help="recording to replay; without it, the nodes work on the topics of a running robot"
    )
    parser.add_argument(
        "--rate", type=float, default=1.0, help="speed of the replay; 1: as it was recorded (default: %(default)s)"
    )
    return parser


def main(args: Sequence[str] | None = None) -> int:
    """Run the nodes; the exit code. After a replay they go on, so that the mesh can be asked for and looked at."""
    given = list(sys.argv if args is None else args)
    options = _parser().parse_args(remove_ros_args(given)[1:])
    nodes = dict(STAGES[options.lasers])
    parameters: list[str] = []
    if options.bag:
        parameters = [f"{name}:use_sim_time:=true" for name in nodes]
        nodes["replay_node"] = ReplayNode
        parameters += [
            f"replay_node:bag:={json.dumps(options.bag)}",
            f"replay_node:rate:={options.rate!r}",
            "replay_node:exit_when_done:=false",
        ]
    extra = [word for parameter in parameters for word in ("-p", parameter)]
    return run_together(list(nodes.values()), [*given, *(["--ros-args", *extra] if extra else [])])


if __name__ == "__main__":
    sys.exit(main())
