# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Trajectory, point map and occupancy grid of a localizer, made and published beside it, so that no scan waits."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from time import monotonic

import numpy as np
from builtin_interfaces.msg import Time
from nav_msgs.msg import OccupancyGrid as GridMessage
from nav_msgs.msg import Path
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2

from g2_recon.geometry.cloud import Cloud
from g2_recon.geometry.occupancy_grid import OccupancyGrid
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.session import Session
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.localization.keyframe_grid import KeyframeGrid
from g2_recon.localization.methods import AnyLocalizer
from g2_recon.nodes import conversions
from g2_recon.nodes.memory import give_back_memory
from g2_recon.nodes.parameters import LocalizerParameters
from g2_recon.nodes.ros import LATCHED
from g2_recon.nodes.stage_node import StageNode

# Wall time a second for the occupancy grid, so that it takes a tenth of a core at most while a closed loop makes it
# count anew; it looks at the time after so many keyframes.
_GRID_S, _GRID_KEYFRAMES = 0.1, 16


class MapPublisher:
    """The topics `trajectory`, `point_map` and `map` of a localizer.

    What is to be drawn is taken when `publish` is called; drawing and publishing go on in a thread of its own. While
    that works, further calls do nothing: the next one takes what is new.
    """

    def __init__(self, node: StageNode[LocalizerParameters]) -> None:
        self._node = node
        self._trajectory = node.create_publisher(Path, "trajectory", LATCHED)
        self._point_map = node.create_publisher(PointCloud2, "point_map", LATCHED)
        self._map = node.create_publisher(GridMessage, "map", LATCHED)
        self._pool = ThreadPoolExecutor(1, "maps")
        self._work: Future[None] | None = None
        self._grid: KeyframeGrid | None = None
        # Keyframes that are not in the grid yet, and whether there are new ones since the last trajectory.
        self._scans: list[Scan] = []
        self._changed = False

    def begin(self, T_base_laser: NDArray[np.float64], session: Session | None) -> None:
        """Draw what a laser with this pose (4, 4) on the robot sees, beside the keyframes of a session."""
        self.forget()
        self._grid = KeyframeGrid(self._node.settings, T_base_laser)
        self.restart(session)

    def restart(self, session: Session | None) -> None:
        """Forget all keyframes but those of a session."""
        self.settle()
        self._scans, self._changed = [], session is not None
        if self._grid is not None:
            self._grid.clear()
            if session is not None:
                self._grid.add_session(session)

    def forget(self) -> None:
        """Draw nothing until `begin` is called."""
        self.settle()
        self._grid = None

    def add(self, scan: Scan) -> None:
        """A scan became a keyframe."""
        self._scans.append(scan)
        self._changed = True

    def moved(self) -> None:
        """All keyframes may lie elsewhere now."""
        self._changed = True

    def publish(self, localizer: AnyLocalizer, stamp: Time) -> None:
        """Have published what has changed since the last time, unless that is still going on."""
        if self._grid is None or (self._work is not None and not self._work.done()):
            return
        scans, self._scans = self._scans, []
        changed, self._changed = self._changed, False
        points = localizer.later_point_map() if changed else None
        self._work = self._pool.submit(self._draw, self._grid, scans, localizer.keyframes(), points, stamp)

    def clear(self, stamp: Time) -> None:
        """Publish an empty trajectory, which tells whoever builds on the poses that they start anew, and point map."""
        self.settle()
        head = conversions.header(stamp, self._node.settings.map_frame)
        self._trajectory.publish(Path(header=head))
        self._point_map.publish(conversions.cloud_to_message(head, flat_cloud(np.empty((0, 2)))))

    def grid(self, keyframes: Trajectory) -> OccupancyGrid | None:
        """The occupancy grid of all keyframes, of which these are the poses; None where nothing is drawn."""
        self.settle()
        if self._grid is None:
            return None
        _take(self._grid, self._scans)
        self._scans = []
        self._grid.update(keyframes.planar())
        self._say_left_out(self._grid)
        return self._grid.grid()

    def settle(self) -> None:
        """Wait until nothing is being drawn."""
        if self._work is not None:
            self._work.result()

    def close(self) -> None:
        """End the thread."""
        self._pool.shutdown()

    def _draw(
        self,
        grid: KeyframeGrid,
        scans: list[Scan],
        keyframes: Trajectory,
        points: Callable[[], NDArray[np.float64]] | None,
        stamp: Time,
    ) -> None:
        try:
            _take(grid, scans)
            head = conversions.header(stamp, self._node.settings.map_frame)
            if points is not None:
                self._trajectory.publish(conversions.serialized_path(head, keyframes))
                self._point_map.publish(conversions.cloud_to_message(head, flat_cloud(points())))
            poses = keyframes.planar()
            if not grid.is_current(poses) and _counted(grid, poses):
                self._say_left_out(grid)
                self._map.publish(conversions.grid_message(head, grid.grid()))
            # Poses and points of all keyframes, once a second, would else leave more and more between what stays.
            give_back_memory()
        except Exception:
            # A fault in here must not end the poses. While the node ends, nothing can be published any more.
            if self._node.context.ok():
                self._node.say_once("maps", f"maps: {traceback.format_exc()}")

    def _say_left_out(self, grid: KeyframeGrid) -> None:
        if grid.left_out:
            left_out = f"{grid.left_out} of {len(grid)} keyframes are not in `map`: {grid.why_left_out}"
            self._node.say_once("map", left_out)


def _take(grid: KeyframeGrid, scans: list[Scan]) -> None:
    for scan in scans:
        grid.add(scan)


def _counted(grid: KeyframeGrid, poses: NDArray[np.float64]) -> bool:
    """Count keyframes, as many as there is time for; whether all are counted."""
    end = monotonic() + _GRID_S
    while not grid.update(poses, most=_GRID_KEYFRAMES):
        if monotonic() > end:
            return False
    return True


def flat_cloud(points: NDArray[np.float64]) -> Cloud:
    """Points (N, 2) on the floor."""
    return Cloud(np.column_stack([points, np.zeros(len(points))]))
