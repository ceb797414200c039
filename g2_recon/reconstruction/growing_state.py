# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What there is of a cloud that grows, and of its submaps and faces, from one update to the next."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.cloud import Cloud
from g2_recon.reconstruction.mesh_of_submaps import NO_FACES, Neurons, Sheet
from g2_recon.reconstruction.normals import SECTORS
from g2_recon.reconstruction.own_frame import OwnFrame

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

_NONE = np.empty(0, np.int64)


@dataclass(frozen=True, slots=True)
class Points:
    """All points that may be surface.

    part: (N,) number of the part of each, row: (N,) which of its points it is. own: (N, 3) m in a frame of their own.
    on_surface: (N,) and neighbors: (N, 8) as phase 0 found them. owner: (N,) the neuron of each, -1 for none.
    """

    part: NDArray[np.int32]
    row: NDArray[np.int32]
    own: Float
    on_surface: Mask
    neighbors: NDArray[np.int32]
    owner: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.own)

    def take(self, rows: Int) -> Points:
        """The points `rows` (M,), each once; a neighbor that is not among them becomes the point itself."""
        return Points(
            part=self.part[rows],
            row=self.row[rows],
            own=self.own[rows],
            on_surface=self.on_surface[rows],
            neighbors=renumbered(self.neighbors, rows),
            owner=self.owner[rows],
        )

    @staticmethod
    def without_surface(part: NDArray[Any], row: NDArray[Any], own: Float) -> Points:
        """Points of which nothing else is known yet."""
        itself = np.arange(len(own), dtype=np.int32)
        return Points(
            part=part.astype(np.int32),
            row=row.astype(np.int32),
            own=own,
            on_surface=np.zeros(len(own), bool),
            neighbors=np.repeat(itself[:, None], SECTORS, axis=1),
            owner=np.full(len(own), -1, np.int32),
        )

    def together_with(self, other: Points) -> Points:
        """These points, then the others."""
        return Points(
            part=np.concatenate([self.part, other.part]),
            row=np.concatenate([self.row, other.row]),
            own=np.concatenate([self.own, other.own]),
            on_surface=np.concatenate([self.on_surface, other.on_surface]),
            neighbors=np.concatenate([self.neighbors, len(self) + other.neighbors]),
            owner=np.concatenate([self.owner, other.owner]),
        )

    def with_surface(self, rows: Int, neighbors: NDArray[np.int32]) -> Points:
        """The points, of which `rows` (n,) lie on a surface and have these neighbors (n, 8)."""
        on_surface, all_neighbors = self.on_surface.copy(), self.neighbors.copy()
        on_surface[rows], all_neighbors[rows] = True, neighbors
        return replace(self, on_surface=on_surface, neighbors=all_neighbors)


@dataclass(slots=True)
class State:
    """What there is after an update; a step of the next one changes it in place, so that nothing is there twice.

    clouds: in the map frame, by number of the part. frame: that of the points, None before the first. neurons: of all
    submaps, in which `submap` is the name of one; without cells and owners. faces: (F, 3) joined, before creases.
    loose: (V,) neurons that are new or have lost a face since; gone: (M, 3) where some were that are no more. sheet:
    the faces with creases and borders, None before there are any. sided: whether the normals of the submaps are towards
    sensors. noise: m, of the largest surface so far, of `noise_points` points. names: how many were given.
    """

    clouds: dict[int, Cloud]
    frame: OwnFrame | None
    points: Points
    neurons: Neurons
    faces: Int
    loose: Mask
    gone: Float
    sheet: Sheet | None = None
    sided: bool = True
    noise: float = 0.0
    noise_points: int = 0
    names: int = 0

    @staticmethod
    def of_nothing() -> State:
        """Before the first update."""
        nothing = np.empty((0, 3))
        neurons = Neurons(nothing, nothing, nothing, _NONE, _NONE.astype(bool), NO_FACES, _NONE)
        return State(
            {}, None, Points.without_surface(_NONE, _NONE, nothing), neurons, NO_FACES, _NONE.astype(bool), nothing
        )

    def forget_submaps(self) -> None:
        """All submaps are gone, and all that was made of them; only names do not come again."""
        nothing = State.of_nothing()
        self.neurons, self.faces, self.loose = nothing.neurons, nothing.faces, nothing.loose
        self.gone, self.sheet = nothing.gone, nothing.sheet
        self.sided, self.noise, self.noise_points = self.seen_from, nothing.noise, nothing.noise_points

    def cloud(self, rows: Int | None = None) -> Cloud:
        """The points `rows` (M,), or all, in the map frame."""
        part, row = self.points.part, self.points.row
        if rows is not None:
            part, row = part[rows], row[rows]
        seen = self.seen_from
        points = np.empty((len(part), 3))
        sensor = np.empty((len(part), 3)) if seen else None
        order = np.argsort(part, kind="stable")
        for group in np.split(order, np.flatnonzero(np.diff(part[order])) + 1) if len(order) else []:
            cloud, which = self.clouds[int(part[group[0]])], row[group]
            points[group] = cloud.points[which]
            if sensor is not None and cloud.sensor is not None:
                sensor[group] = cloud.sensor[which]
        return Cloud(points, sensor)

    @property
    def seen_from(self) -> bool:
        """Whether of all points it is known where they were seen from."""
        return all(cloud.sensor is not None for cloud in self.clouds.values() if len(cloud))

    def names_of_points(self) -> NDArray[np.int32]:
        """The name (N,) of the submap of each point, -1 for none."""
        owner = self.points.owner
        return np.where(owner >= 0, np.append(self.neurons.submap, -1)[owner], -1).astype(np.int32)


def renumbered(neighbors: NDArray[np.int32], rows: Int) -> NDArray[np.int32]:
    """The neighbors (M, 8) of the points `rows` (M,), numbered among them; the point itself for one that is not."""
    number = np.full(len(neighbors), -1, np.int32)
    number[rows] = np.arange(len(rows), dtype=np.int32)
    among = number[neighbors[rows]]
    return np.where(among >= 0, among, np.arange(len(rows), dtype=np.int32)[:, None])
