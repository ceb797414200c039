# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Pictures of what was made: a floor plan and views of meshes, as PNG files.

To be imported where something is drawn: Matplotlib takes 25 MB and as long to start as all the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.transforms import Affine2D
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from numpy.typing import NDArray

from g2_recon.geometry.mesh import Mesh, WireMesh
from g2_recon.geometry.occupancy_grid import OCCUPIED, UNKNOWN, OccupancyGrid
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.recording.files import atomic_write

Float = NDArray[np.float64]

_WIRE, _JOIN, _PATH = "#24476b", "#d1495b", "viridis"
_UNKNOWN_GRAY = 0.8
_MARGIN = 0.03
# A grid is drawn with at most so many dots on a side, about as many as the picture has.
_GRID_DOTS = 1000
# Light from above the left shoulder of the viewer, and how bright a face away from it still is.
_LIGHT = np.array([-0.35, -0.5, 0.79])
_AMBIENT = 0.35
# A face whose normal points down this much is a ceiling.
_CEILING = -0.7


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """point_map: (N, 2) m. trajectory: the way of the robot in it. grid: what goes under it, if there is one."""

    point_map: Float
    trajectory: Trajectory
    grid: OccupancyGrid | None = None

    def size(self) -> Float:
        """Width and height (2,) of what is to be seen, in metres, at least one."""
        shown = self._shown()
        return np.maximum(np.ptp(shown, axis=0), 1.0) if len(shown) else np.ones(2)

    def limits(self) -> Float:
        """Corners (2, 2) of what is to be seen, with a margin."""
        shown, margin = self._shown(), _MARGIN * self.size()
        return np.array([shown.min(axis=0) - margin, shown.max(axis=0) + margin])

    def _shown(self) -> Float:
        outline = [] if self.grid is None else [self.grid.outline()]
        return np.vstack([self.point_map, self.trajectory.positions[:, :2], *outline])


def draw_floor_plan(
    path: str | Path, point_map: Float, trajectory: Trajectory, grid: OccupancyGrid | None = None
) -> None:
    """The point map (N, 2) from above with the way of the robot in it, colored by time; axes in metres.

    Under it goes the occupancy grid, where there is one: free white, occupied black, unknown gray.
    """
    plan = FloorPlan(point_map, trajectory, grid)
    size = plan.size()
    figure = Figure(figsize=(10, float(np.clip(10 * size[1] / size[0], 4, 16))), layout="constrained")
    _draw_plan(figure.add_subplot(), plan, title=f"{len(trajectory)} scans, {trajectory.length():.1f} m")
    _save(figure, path)


def draw_floor_plans(path: str | Path, plans: Sequence[FloorPlan], titles: Sequence[str]) -> None:
    """Floor plans as `draw_floor_plan` draws them, two in a row, each under its title."""
    columns = min(len(plans), 2)
    rows = -(-len(plans) // columns)
    figure = Figure(figsize=(6.5 * columns, 5.5 * rows), layout="constrained")
    for number, (plan, title) in enumerate(zip(plans, titles, strict=True), start=1):
        _draw_plan(figure.add_subplot(rows, columns, number), plan, title=title)
    _save(figure, path)


def _draw_plan(axes, plan: FloorPlan, *, title: str) -> None:  # type: ignore[no-untyped-def]
    point_map, grid = plan.point_map, plan.grid
    if grid is not None and grid.cells.size:
        _draw_grid(axes, grid)
    # A dot stands for a few centimetres of wall, however large the building is.
    dot = float(np.clip(4e3 / plan.size().max() ** 2, 0.3, 6))
    axes.scatter(point_map[:, 0], point_map[:, 1], s=dot, c="black", linewidths=0)
    way = plan.trajectory.positions[:, :2]
    if len(way) > 1:
        lines = LineCollection(
            list(np.stack([way[:-1], way[1:]], axis=1)), array=np.arange(len(way) - 1), cmap=_PATH, lw=1.2
        )
        axes.add_collection(lines)
    if len(way):
        axes.plot(*way[0], "o", color="tab:green", label="start")
        axes.plot(*way[-1], "s", color="tab:red", label="end")
        axes.legend(loc="upper right")
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    if grid is not None and grid.cells.size:
        # An image sets limits of its own, and does not know that it was turned.
        low, high = plan.limits()
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_title(title)


def _draw_grid(axes, grid: OccupancyGrid) -> None:  # type: ignore[no-untyped-def]
    # Of cells that share a dot of the picture the greatest is shown, or thin walls would fade away.
    height, width = grid.cells.shape
    step = -(-max(height, width) // _GRID_DOTS)
    shown = np.maximum.reduceat(grid.cells, np.arange(0, height, step), axis=0)
    shown = np.maximum.reduceat(shown, np.arange(0, width, step), axis=1)
    brightness = np.where(shown == UNKNOWN, _UNKNOWN_GRAY, 1 - shown / OCCUPIED)
    size = step * grid.resolution
    x, y, yaw = grid.origin
    axes.imshow(
        brightness,
        cmap="gray",
        vmin=0,
        vmax=1,
        origin="lower",
        interpolation="nearest",
        extent=(x, x + size * shown.shape[1], y, y + size * shown.shape[0]),
        transform=Affine2D().rotate_around(x, y, yaw) + axes.transData,
    )


def draw_mesh(path: str | Path, mesh: Mesh, wire: WireMesh) -> None:
    """Mesh and wire mesh from above, side by side.

    Faces that look down are left out, so that one looks into a building through its ceiling.
    """
    figure = Figure(figsize=(18, 8), layout="constrained")
    _draw_faces(
        figure.add_subplot(1, 2, 1, projection="3d"), mesh, title=f"mesh: {len(mesh.faces)} faces, ceilings cut away"
    )
    title = f"wire mesh: {len(wire.vertices)} neurons, {int(wire.join.sum())} joins (red)"
    _draw_wire(figure.add_subplot(1, 2, 2, projection="3d"), wire, title=title)
    _save(figure, path)


def draw_wire_meshes(
    path: str | Path, wires: Sequence[WireMesh], titles: Sequence[str], *, elevation: float = 18, height: float = 4
) -> None:
    """Wire meshes side by side, each under its title, seen from that many degrees above; height in inches."""
    figure = Figure(figsize=(7 * len(wires), height), layout="constrained")
    for number, (wire, title) in enumerate(zip(wires, titles, strict=True), start=1):
        axes = figure.add_subplot(1, len(wires), number, projection="3d")
        _draw_wire(axes, wire, title=title)
        axes.view_init(elev=elevation, azim=-72)
        axes.set_axis_off()
        limits = (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())
        # Without axes there is no need for the room that they would take.
        axes.set_box_aspect([high - low for low, high in limits], zoom=1.25)
        for lines in axes.collections:
            lines.set_clip_on(False)
    _save(figure, path)


def draw_meshes(path: str | Path, meshes: Sequence[Mesh], titles: Sequence[str]) -> None:
    """Meshes from above, three in a row, each under its title; faces that look down are left out."""
    columns = min(len(meshes), 3)
    rows = -(-len(meshes) // columns)
    figure = Figure(figsize=(7 * columns, 6 * rows), layout="constrained")
    for number, (mesh, title) in enumerate(zip(meshes, titles, strict=True), start=1):
        axes = figure.add_subplot(rows, columns, number, projection="3d")
        _draw_faces(axes, mesh, title=title)
    _save(figure, path)


def _draw_faces(axes, mesh: Mesh, *, title: str) -> None:  # type: ignore[no-untyped-def]
    _frame(axes, mesh.vertices, title)
    normals = mesh.face_normals()
    shown = normals[:, 2] > _CEILING
    if not shown.any():
        return
    shade = _AMBIENT + (1 - _AMBIENT) * np.abs(normals[shown] @ _LIGHT)
    height = mesh.vertices[mesh.faces[shown], 2].mean(axis=1)
    low, high = height.min(), height.max()
    share = ((height - low) / max(high - low, 1e-9))[:, None]
    color = (1 - share) * np.array([0.55, 0.66, 0.78]) + share * np.array([0.93, 0.89, 0.80])
    triangles = Poly3DCollection(mesh.vertices[mesh.faces[shown]], facecolors=color * shade[:, None], linewidths=0)
    axes.add_collection3d(triangles)


def _draw_wire(axes, wire: WireMesh, *, title: str) -> None:  # type: ignore[no-untyped-def]
    _frame(axes, wire.vertices, title)
    for which, color in ((~wire.join, _WIRE), (wire.join, _JOIN)):
        if which.any():
            axes.add_collection3d(Line3DCollection(wire.vertices[wire.edges[which]], colors=color, linewidths=0.4))


def _frame(axes, vertices: Float, title: str) -> None:  # type: ignore[no-untyped-def]
    axes.set_proj_type("ortho")
    axes.view_init(elev=50, azim=-65)
    # A few stray returns far outside must not make the building small.
    low, high = np.quantile(vertices, [0.005, 0.995], axis=0) if len(vertices) else np.array([np.zeros(3), np.ones(3)])
    for set_limits, bottom, top in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), low, high, strict=True):
        set_limits(bottom - 0.01, top + 0.01)
    axes.set_aspect("equal")
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", title=title)


def _save(figure: Figure, path: str | Path) -> None:
    FigureCanvasAgg(figure)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")
