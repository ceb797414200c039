# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Mode solid of a cloud that grows: only clusters whose data changed are found, trained and joined anew.

A cluster has changed where a point came or went within the radius in which normals are estimated. Its points, the new
ones and those near that had no cluster go through phases 0 to 2 together, in the company of the points around them; the
maps of all other clusters stay. So do the faces between them: the front of phase 3 goes on from these. Where most of
the points are concerned, all is done as for a cloud that does not grow, and with the same result.
"""

from __future__ import annotations

import math
import os
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from g2_recon.config import ReconstructionConfig
from g2_recon.errors import InputError
from g2_recon.geometry.chunks import in_chunks
from g2_recon.geometry.cloud import Cloud, concatenate
from g2_recon.geometry.mesh import Mesh
from g2_recon.geometry.point_grid import has_point_near, point_grid
from g2_recon.progress import Progress, silent
from g2_recon.reconstruction.collected_cloud import Part
from g2_recon.reconstruction.mesh_of_submaps import Neurons, Sheet, data_of, finished, join, sound_cells, with_data
from g2_recon.reconstruction.normals import SECTORS
from g2_recon.reconstruction.own_frame import OwnFrame, own_frame
from g2_recon.reconstruction.result import Reconstruction
from g2_recon.reconstruction.solid import (
    NORMAL_RADIUS,
    build_submaps,
    check_covered,
    find_clusters,
    find_surface,
    reported,
    wire_of,
)
from g2_recon.reconstruction.support import supported
from g2_recon.reconstruction.surface_points import SurfacePoints
from g2_recon.reconstruction.usable_points import check_enough, near_sensor

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Points within so many radii of those that are clustered anew tell what the surface there is like.
_COMPANY = 2.0
# Where a larger share of the points is clustered anew, all are.
_MOST_ANEW = 0.5

_NONE = np.empty(0, np.int64)
_NO_FACES = np.empty((0, 3), np.int64)


@dataclass(frozen=True, slots=True)
class _Points:
    """All points that may be surface.

    cloud: N of them in the map frame. own: (N, 3) m in a frame of their own. part: (N,) number of the part of each.
    on_surface: (N,) and neighbors: (N, 8) as phase 0 found them. owner: (N,) the neuron of each, -1 for none.
    """

    cloud: Cloud
    own: Float
    part: Int
    on_surface: Mask
    neighbors: NDArray[np.int32]
    owner: Int

    def __len__(self) -> int:
        return len(self.own)

    def take(self, rows: Int) -> _Points:
        """The points `rows` (M,), each once; a neighbor that is not among them becomes the point itself."""
        return _Points(
            cloud=self.cloud.select(rows),
            own=self.own[rows],
            part=self.part[rows],
            on_surface=self.on_surface[rows],
            neighbors=_renumbered(self.neighbors, rows),
            owner=self.owner[rows],
        )


@dataclass(frozen=True, slots=True)
class _State:
    """What there is after an update.

    neurons: of all submaps, in which `submap` is the name of one; without cells and owners. faces: (F, 3) joined,
    before creases. loose: (V,) neurons that are new or have lost a face since. noise: m, of the largest surface so far,
    of `noise_points` points. names: how many were given.
    """

    frame: OwnFrame
    points: _Points
    neurons: Neurons
    faces: Int
    loose: Mask
    noise: float
    noise_points: int
    names: int


class GrowingReconstruction:
    """A reconstruction that keeps up with a cloud that comes, and is corrected, part by part."""

    def __init__(self, config: ReconstructionConfig) -> None:
        """config: of mode solid."""
        self._config = config
        self._taken: dict[Hashable, tuple[int, Part]] = {}
        self._numbers = 0
        self._state: _State | None = None
        self._result: Reconstruction | None = None

    def update(self, parts: Mapping[Hashable, Part], *, progress: Progress = silent) -> Reconstruction:
        """The reconstruction of these parts (see CollectedCloud.parts), from that of the parts of the last time.

        A submap keeps its number from one time to the next; one that is gone does not come again. The result depends on
        what came when, but not on `workers`. What comes of the parts of the first time, or of parts that changed for
        the most part, is what `reconstruct` makes of them.
        Raises InputError where there are too few points for a surface, or these cover none of it; after that, or
        another fault, the next update begins from nothing.
        """
        try:
            gone, new = self._changes(parts)
            if self._result is None or gone or new:
                self._state, mesh = _grown(self._take_state(), gone, new, self._config, progress)
                self._result = _result(self._state, mesh, sum(len(part.cloud) for part in parts.values()))
        except BaseException:
            self.reset()
            raise
        return self._result

    def reset(self) -> None:
        """Forget all points and submaps: the next update begins from nothing."""
        self._taken, self._state, self._result = {}, None, None

    def _take_state(self) -> _State | None:
        """The state, which nobody else has then: what it was goes bit by bit while the next one comes to be."""
        state, self._state = self._state, None
        return state

    def _changes(self, parts: Mapping[Hashable, Part]) -> tuple[list[int], list[tuple[int, Cloud]]]:
        """Numbers of the parts whose points are gone, and clouds that are new, with the numbers of their parts."""
        gone = [number for key, (number, _) in self._taken.items() if key not in parts]
        taken, new = {}, []
        for key, part in parts.items():
            number, before = self._taken.get(key, (-1, None))
            if before is None or not _goes_on(before, part):
                gone += [number] if before is not None else []
                number, known = self._numbers, 0
                self._numbers += 1
            else:
                known = len(before.cloud)
            if len(part.cloud) > known:
                new.append((number, part.cloud.select(np.arange(known, len(part.cloud)))))
            taken[key] = (number, part)
        self._taken = taken
        return gone, new


def _goes_on(before: Part, part: Part) -> bool:
    """Whether all points of a part are still there, and in front of those that came since."""
    count = len(before.cloud)
    if part.version == before.version:
        return True
    if len(part.cloud) != count:
        return False
    one, other = before.cloud, part.cloud
    if one.sensor is None or other.sensor is None:
        return one.sensor is other.sensor and np.array_equal(one.points, other.points)
    return np.array_equal(one.points, other.points) and np.array_equal(one.sensor, other.sensor)


def _grown(
    state: _State | None,
    gone: list[int],
    new: list[tuple[int, Cloud]],
    config: ReconstructionConfig,
    progress: Progress,
) -> tuple[_State, Mesh]:
    """The state and the mesh after parts went and clouds came."""
    workers = config.workers or os.cpu_count() or 1
    cloud, part = _possible(new, config, workers)
    if state is None:
        return _all_anew(_blank(cloud, cloud.points, part), np.full(len(cloud), -1), 0, config, progress)
    added = _blank(cloud, state.frame.of(cloud, workers=workers).points, part)
    names, own = _names(state), state.points.own
    keep = ~np.isin(state.points.part, gone)
    changed = np.concatenate([own[~keep], added.own])
    near = _near(own, changed, NORMAL_RADIUS * config.spacing, workers)
    stale = np.unique(names[(near | ~keep) & (names >= 0)])
    anew = np.isin(names, stale) | (near & (names < 0))
    anew = np.concatenate([anew[keep], np.ones(len(added), bool)])
    del own
    if not keep.all():
        state = replace(state, points=state.points.take(np.flatnonzero(keep)))
    state = replace(state, points=_together(state.points, added))
    names = np.concatenate([names[keep], np.full(len(added), -1)])
    # Without sensors only the whole tells which side of a surface is the free one.
    if state.points.cloud.sensor is None or np.count_nonzero(anew) >= _MOST_ANEW * len(state.points):
        return _all_anew(state.points, names, state.names, config, progress)
    state = _without(state, stale)
    if gone:
        state = _on_data(state, config)
    return _some_anew(state, anew, names, config, progress)


def _possible(new: list[tuple[int, Cloud]], config: ReconstructionConfig, workers: int) -> tuple[Cloud, Int]:
    """One cloud of what may be surface among new ones, and the number (N,) of the part of each point."""
    cloud = concatenate([cloud for _, cloud in new])
    part = np.repeat(np.array([number for number, _ in new], np.int64), [len(cloud) for _, cloud in new])
    finite = np.asarray(np.isfinite(cloud.points).all(axis=1))
    if cloud.sensor is not None:
        finite &= np.isfinite(cloud.sensor).all(axis=1)
    if not finite.all():
        cloud, part = cloud.select(finite), part[finite]
    near = near_sensor(cloud, config.min_sensor_distance, workers)
    return (cloud.select(~near), part[~near]) if near.any() else (cloud, part)


def _all_anew(
    points: _Points, names: Int, given: int, config: ReconstructionConfig, progress: Progress
) -> tuple[_State, Mesh]:
    """As for a cloud that does not grow. given: how many names of submaps."""
    check_enough(points.cloud, len(points))
    workers = config.workers or os.cpu_count() or 1
    frame = own_frame(points.cloud.points)
    own = frame.of(points.cloud, workers=workers)
    surface = reported(lambda: find_surface(own, config, workers), "normals", progress)
    # In the order of the surface, so that all that follows is the same to the last bit.
    others = np.ones(len(points), bool)
    others[surface.kept] = False
    order = np.concatenate([surface.kept, np.flatnonzero(others)])
    rows = np.arange(len(surface))
    ordered = np.concatenate([surface.points, own.points[others]])
    points = _blank(points.cloud.select(order), ordered, points.part[order])
    state = _State(
        frame,
        _with_surface(points, rows, surface.neighbors),
        _no_neurons(),
        _NO_FACES,
        _NONE.astype(bool),
        0.0,
        0,
        given,
    )
    return _joined(_with_submaps(state, rows, surface, names[surface.kept], config, progress), config, progress)


def _some_anew(
    state: _State, anew: Mask, names: Int, config: ReconstructionConfig, progress: Progress
) -> tuple[_State, Mesh]:
    """New submaps of the points `anew` (N,) beside those there are.

    names: (N,) of the submap that each point was of, -1 for none.
    """
    workers = config.workers or os.cpu_count() or 1
    points = state.points
    company = _near(points.own, points.own[anew], _COMPANY * NORMAL_RADIUS * config.spacing, workers)
    rows = np.flatnonzero(anew | company)
    points = replace(points, on_surface=points.on_surface & ~anew, owner=np.where(anew, -1, points.owner))
    state = replace(state, points=points)
    if not anew.any():
        return _joined(state, config, progress)
    try:
        around = state.frame.of(points.cloud.select(rows), workers=workers)
        surface = reported(lambda: find_surface(around, config, workers), "normals", progress)
        rows = rows[surface.kept]
        mine = anew[rows]
        links = rows[surface.neighbors[mine]].astype(np.int32)
        state = replace(state, points=_with_surface(points, rows[mine], links))
        if mine.any():
            state = _with_submaps(state, rows[mine], _part_of(surface, mine), names[rows[mine]], config, progress)
    except InputError:
        # There is no surface here yet; more points may make one.
        pass
    return _joined(state, config, progress)


def _with_submaps(
    state: _State, rows: Int, surface: SurfacePoints, names: Int, config: ReconstructionConfig, progress: Progress
) -> _State:
    """Phases 1 and 2: the state with submaps of a surface, whose points (n,) are the points `rows`.

    names: (n,) of the submap that each point was of; the submap that most of its points go to inherits it.
    Raises InputError where there is no patch of surface.
    """
    workers = config.workers or os.cpu_count() or 1
    # All of a cloud has one noise; the more points the better it is known.
    noise_points, noise = max((state.noise_points, state.noise), (len(surface), surface.noise))
    surface = replace(surface, noise=noise)
    clusters = reported(lambda: find_clusters(surface, config, workers), "clustering", progress)
    submaps, owner = build_submaps(surface, clusters, config, workers, progress)
    new, known = with_data(submaps, owner), state.neurons
    inherited, given = _inherited(clusters.label, names, len(clusters), state.names)
    owners = state.points.owner.copy()
    owners[rows] = np.where(new.owner >= 0, len(known.places) + new.owner, -1)
    neurons = Neurons(
        places=np.concatenate([known.places, new.places]),
        normals=np.concatenate([known.normals, new.normals]),
        centers=np.concatenate([known.centers, new.centers]),
        submap=np.concatenate([known.submap, inherited[new.submap]]),
        bent=np.concatenate([known.bent, new.bent]),
        cells=len(known.places) + new.cells,
        owner=_NONE,
    )
    return replace(
        state,
        points=replace(state.points, owner=owners),
        neurons=neurons,
        loose=np.concatenate([state.loose, np.ones(len(new.places), bool)]),
        noise=noise,
        noise_points=noise_points,
        names=given,
    )


def _joined(state: _State, config: ReconstructionConfig, progress: Progress) -> tuple[_State, Mesh]:
    """Phases 3 and 4: the state with the cells of new submaps joined to the faces there are, and the mesh."""
    workers = config.workers or os.cpu_count() or 1
    check_covered(state.neurons.places)
    rows = np.flatnonzero(state.points.on_surface)
    neurons = replace(state.neurons, owner=state.points.owner[rows])
    data = data_of(state.points.own[rows], _renumbered(state.points.neighbors, rows), config, workers)

    def work() -> tuple[_State, Mesh]:
        sound = sound_cells(neurons, data, state.faces)
        joined = join(neurons, sound, data, config)
        # Elsewhere the front would only try again what it could not do before.
        where = state.loose[joined.faces].any(axis=1) | (np.arange(len(joined.faces)) < len(sound))
        joined = Sheet(joined.vertices, joined.faces[where], joined.submap[where])
        mesh = finished(joined, neurons, data, config)
        check_covered(mesh.faces)
        settled = replace(state.neurons, cells=_NO_FACES)
        return replace(state, neurons=settled, faces=joined.faces, loose=np.zeros(len(state.loose), bool)), mesh

    return reported(work, "joining", progress)


def _on_data(state: _State, config: ReconstructionConfig) -> _State:
    """The state without the faces under which points are gone."""
    workers = config.workers or os.cpu_count() or 1
    near = config.support_distance or config.spacing
    grid = point_grid(state.points.own, cell=near / math.sqrt(3))
    stays = supported(state.neurons.places, state.faces, grid, near, workers)
    loose = state.loose.copy()
    loose[state.faces[~stays]] = True
    return replace(state, faces=state.faces[stays], loose=loose)


def _without(state: _State, stale: Int) -> _State:
    """The state without the submaps of these names, and the faces that touch them."""
    known = state.neurons
    keep = ~np.isin(known.submap, stale)
    number = np.where(keep, np.cumsum(keep) - 1, -1)
    neurons = Neurons(
        places=known.places[keep],
        normals=known.normals[keep],
        centers=known.centers[keep],
        submap=known.submap[keep],
        bent=known.bent[keep],
        cells=_NO_FACES,
        owner=_NONE,
    )
    owner = state.points.owner
    stays = keep[state.faces].all(axis=1)
    loose = np.zeros(len(keep), bool)
    loose[state.faces[~stays]] = True
    return replace(
        state,
        points=replace(state.points, owner=np.where(owner >= 0, number[owner], -1)),
        neurons=neurons,
        faces=number[state.faces[stays]],
        loose=loose[keep],
    )


def _names(state: _State) -> Int:
    """The name (N,) of the submap of each point, -1 for none."""
    owner = state.points.owner
    return np.where(owner >= 0, np.append(state.neurons.submap, -1)[owner], -1)


def _inherited(label: Int, before: Int, count: int, given: int) -> tuple[Int, int]:
    """Names (count,) of clusters, and how many have been given now.

    label: (n,) cluster of each point and before: (n,) its name before, -1 for none. Those that share the most points
    come first; what inherits no name gets a new one.
    """
    both = (label >= 0) & (before >= 0)
    pairs, shared = np.unique(np.stack([label[both], before[both]]), axis=1, return_counts=True)
    names = np.full(count, -1)
    taken: set[int] = set()
    for cluster, name in pairs[:, np.argsort(-shared, kind="stable")].T.tolist():
        if names[cluster] < 0 and name not in taken:
            names[cluster] = name
            taken.add(name)
    new = np.flatnonzero(names < 0)
    names[new] = given + np.arange(len(new))
    return names, given + len(new)


def _blank(cloud: Cloud, own: Float, part: Int) -> _Points:
    """Points of which nothing is known yet."""
    rows = np.arange(len(cloud), dtype=np.int32)
    return _Points(
        cloud, own, part, np.zeros(len(cloud), bool), np.repeat(rows[:, None], SECTORS, axis=1), np.full(len(cloud), -1)
    )


def _together(one: _Points, other: _Points) -> _Points:
    return _Points(
        cloud=concatenate([one.cloud, other.cloud]),
        own=np.concatenate([one.own, other.own]),
        part=np.concatenate([one.part, other.part]),
        on_surface=np.concatenate([one.on_surface, other.on_surface]),
        neighbors=np.concatenate([one.neighbors, len(one) + other.neighbors]),
        owner=np.concatenate([one.owner, other.owner]),
    )


def _with_surface(points: _Points, rows: Int, neighbors: NDArray[np.int32]) -> _Points:
    """The points, of which `rows` (n,) lie on a surface and have these neighbors (n, 8)."""
    on_surface, all_neighbors = points.on_surface.copy(), points.neighbors.copy()
    on_surface[rows], all_neighbors[rows] = True, neighbors
    return replace(points, on_surface=on_surface, neighbors=all_neighbors)


def _part_of(surface: SurfacePoints, which: Mask) -> SurfacePoints:
    """The points of a surface that a mask names."""
    rows = np.flatnonzero(which)
    return replace(
        surface,
        points=surface.points[rows],
        normals=surface.normals[rows],
        weights=surface.weights[rows],
        neighbors=_renumbered(surface.neighbors, rows),
        cells=surface.cells[rows],
        kept=surface.kept[rows],
    )


def _renumbered(neighbors: NDArray[np.int32], rows: Int) -> NDArray[np.int32]:
    """The neighbors (M, 8) of the points `rows` (M,), numbered among them; the point itself for one that is not."""
    number = np.full(len(neighbors), -1, np.int32)
    number[rows] = np.arange(len(rows), dtype=np.int32)
    among = number[neighbors[rows]]
    return np.where(among >= 0, among, np.arange(len(rows), dtype=np.int32)[:, None])


def _near(points: Float, others: Float, distance: float, workers: int) -> Mask:
    """Mask (N,) of the points (N, 3) with another one (M, 3) within `distance` metres."""
    mask = np.zeros(len(points), bool)
    if len(others) and len(points):
        grid = point_grid(others, cell=distance)
        in_chunks(lambda begin, end: _fill_near(points, grid, distance, begin, end, mask), len(points), workers)
    return mask


@numba.njit(cache=True, nogil=True)
def _fill_near(points, grid, distance, begin, end, mask):  # type: ignore[no-untyped-def]
    for i in range(begin, end):
        mask[i] = has_point_near(grid, points[i, 0], points[i, 1], points[i, 2], distance)


def _result(state: _State, mesh: Mesh, count: int) -> Reconstruction:
    """The result from a mesh in the frame of the points, of `count` points that came."""
    points, neurons = state.points, state.neurons
    owned = points.owner >= 0
    mesh = replace(mesh, vertices=state.frame.back(mesh.vertices))
    left_out = {
        "not finite or nearer to the sensor than min_sensor_distance": count - len(points),
        "on no surface": int(np.count_nonzero(~points.on_surface)),
    }
    error = np.linalg.norm(points.own[owned] - neurons.places[points.owner[owned]], axis=1)
    return Reconstruction(
        wire_mesh=wire_of(mesh),
        mesh=mesh,
        points=int(np.count_nonzero(points.on_surface)),
        left_out={reason: number for reason, number in left_out.items() if number},
        clusters=len(np.unique(neurons.submap)),
        quantization_error=float(error.mean()),
    )


def _no_neurons() -> Neurons:
    nothing = np.empty((0, 3))
    return Neurons(nothing, nothing, nothing, _NONE, _NONE.astype(bool), _NO_FACES, _NONE)
