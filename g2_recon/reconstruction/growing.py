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
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from g2_recon.config import ReconstructionConfig
from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud, concatenate
from g2_recon.geometry.mesh import Mesh
from g2_recon.geometry.point_grid import point_grid
from g2_recon.progress import Progress, silent
from g2_recon.reconstruction.collected_cloud import Part
from g2_recon.reconstruction.mesh_of_submaps import (
    Neurons,
    Sheet,
    data_of,
    finished,
    join,
    sound_cells,
    usual_edge,
    with_data,
    without_scraps,
)
from g2_recon.reconstruction.normals import SECTORS
from g2_recon.reconstruction.own_frame import OwnFrame, own_frame
from g2_recon.reconstruction.result import Reconstruction
from g2_recon.reconstruction.sewing import MADE_ANEW, sewn
from g2_recon.reconstruction.solid import (
    NORMAL_RADIUS,
    build_submaps,
    check_covered,
    find_clusters,
    find_surface,
    reported,
    wire_of,
)
from g2_recon.reconstruction.support import are_near, supported
from g2_recon.reconstruction.surface_points import SurfacePoints
from g2_recon.reconstruction.usable_points import check_enough, near_sensor

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Points within so many radii of those that are clustered anew tell what the surface there is like.
_COMPANY = 2.0
# Where a larger share of the points is clustered anew, all are.
_MOST_ANEW = 0.5
# Where a larger share of the faces is joined anew, all are: it takes no longer.
_MOST_JOINED = 0.5

_NONE = np.empty(0, np.int64)
_NO_FACES = np.empty((0, 3), np.int64)


@dataclass(frozen=True, slots=True)
class _Points:
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

    def take(self, rows: Int) -> _Points:
        """The points `rows` (M,), each once; a neighbor that is not among them becomes the point itself."""
        return _Points(
            part=self.part[rows],
            row=self.row[rows],
            own=self.own[rows],
            on_surface=self.on_surface[rows],
            neighbors=_renumbered(self.neighbors, rows),
            owner=self.owner[rows],
        )


@dataclass(slots=True)
class _State:
    """What there is after an update; a step of the next one changes it in place, so that nothing is there twice.

    clouds: in the map frame, by number of the part. frame: that of the points, None before the first. neurons: of all
    submaps, in which `submap` is the name of one; without cells and owners. faces: (F, 3) joined, before creases.
    loose: (V,) neurons that are new or have lost a face since; gone: (M, 3) where some were that are no more. sheet:
    the faces with creases and borders, None before there are any. sided: whether the normals of the submaps are towards
    sensors. noise: m, of the largest surface so far, of `noise_points` points. names: how many were given.
    """

    clouds: dict[int, Cloud]
    frame: OwnFrame | None
    points: _Points
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
    def of_nothing() -> _State:
        nothing = np.empty((0, 3))
        neurons = Neurons(nothing, nothing, nothing, _NONE, _NONE.astype(bool), _NO_FACES, _NONE)
        return _State({}, None, _blank(_NONE, _NONE, nothing), neurons, _NO_FACES, _NONE.astype(bool), nothing)

    def forget_submaps(self) -> None:
        """All submaps are gone, and all that was made of them; only names do not come again."""
        nothing = _State.of_nothing()
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


class GrowingReconstruction:
    """A reconstruction that keeps up with a cloud that comes, and is corrected, part by part."""

    def __init__(self, config: ReconstructionConfig) -> None:
        """config: of mode solid."""
        self._config = config
        self._taken: dict[Hashable, tuple[int, Part]] = {}
        self._numbers = 0
        self._state = _State.of_nothing()
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
                self._state.clouds = {number: part.cloud for number, part in self._taken.values()}
                mesh = _grow(self._state, gone, new, self._config, progress)
                self._result = _result(self._state, mesh, sum(len(part.cloud) for part in parts.values()))
        except BaseException:
            self.reset()
            raise
        return self._result

    def reset(self) -> None:
        """Forget all points and submaps: the next update begins from nothing."""
        self._taken, self._state, self._result = {}, _State.of_nothing(), None

    def _changes(self, parts: Mapping[Hashable, Part]) -> tuple[list[int], list[_New]]:
        """Numbers of the parts whose points are gone, and what is new."""
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
                added = part.cloud.select(np.arange(known, len(part.cloud))) if known else part.cloud
                new.append(_New(number, known, added))
            taken[key] = (number, part)
        self._taken = taken
        return gone, new


class _New(NamedTuple):
    """Points that are new: the number of their part, how many of it were known before, and the points."""

    part: int
    known: int
    cloud: Cloud


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


def _grow(state: _State, gone: list[int], new: list[_New], config: ReconstructionConfig, progress: Progress) -> Mesh:
    """The mesh after parts went and others came; the state becomes that of then."""
    names, anew, stale = _take_in(state, gone, new, config)
    # Without sensors only the whole tells which side of a surface is the free one.
    sided = state.seen_from and state.sided
    if not sided or np.count_nonzero(anew) >= _MOST_ANEW * len(anew):
        _submaps_of_all(state, names, config, progress)
    else:
        _leave_out(state, stale)
        if gone:
            _leave_what_has_data(state, config)
        _submaps_of_some(state, anew, names, config, progress)
    return _join(state, config, progress)


def _take_in(
    state: _State, gone: list[int], new: list[_New], config: ReconstructionConfig
) -> tuple[NDArray[np.int32], Mask, NDArray[np.int32]]:
    """Take points away and in.

    The name (N,) of the submap that each point was of, -1 for none; a mask (N,) of those that are to get a new one; and
    the names of the submaps that are no more, also of those of which no point is left.
    """
    workers = config.workers or os.cpu_count() or 1
    cloud, part, row = _possible(new, config, workers)
    if state.frame is None:
        # Nothing is known of them: they get their own frame, and what goes with it, all together.
        state.points = _blank(part, row, cloud.points)
        return np.full(len(cloud), -1, np.int32), np.ones(len(cloud), bool), np.empty(0, np.int32)
    added = _blank(part, row, state.frame.of(cloud, workers=workers).points)
    names, own = _names(state), state.points.own
    keep = ~np.isin(state.points.part, gone)
    changed = np.concatenate([own[~keep], added.own])
    near = are_near(own, changed, NORMAL_RADIUS * config.spacing, workers)
    stale = np.unique(names[(near | ~keep) & (names >= 0)])
    anew = np.isin(names, stale) | (near & (names < 0))
    if not keep.all():
        state.points = state.points.take(np.flatnonzero(keep))
    state.points = _together(state.points, added)
    nameless, all_of_them = np.full(len(added), -1, np.int32), np.ones(len(added), bool)
    return np.concatenate([names[keep], nameless]), np.concatenate([anew[keep], all_of_them]), stale


def _possible(
    new: list[_New], config: ReconstructionConfig, workers: int
) -> tuple[Cloud, NDArray[np.int32], NDArray[np.int32]]:
    """One cloud of what may be surface of that which is new, the number (N,) of the part of each point and its row."""
    cloud = concatenate([each.cloud for each in new])
    part = np.repeat(np.array([each.part for each in new], np.int32), [len(each.cloud) for each in new])
    row = np.concatenate([_NONE, *(each.known + np.arange(len(each.cloud)) for each in new)]).astype(np.int32)
    finite = np.asarray(np.isfinite(cloud.points).all(axis=1))
    if cloud.sensor is not None:
        finite &= np.isfinite(cloud.sensor).all(axis=1)
    if not finite.all():
        cloud, part, row = cloud.select(finite), part[finite], row[finite]
    near = near_sensor(cloud, config.min_sensor_distance, workers)
    return (cloud.select(~near), part[~near], row[~near]) if near.any() else (cloud, part, row)


def _submaps_of_all(state: _State, names: NDArray[np.int32], config: ReconstructionConfig, progress: Progress) -> None:
    """Phases 0 to 2 as for a cloud that does not grow. names: (N,) of the submap that each point was of."""
    surface, order = _surface_of_all(state, config, progress)
    rows = np.arange(len(surface))
    state.forget_submaps()
    state.points = _with_surface(state.points, rows, surface.neighbors)
    _add_submaps(state, rows, surface, names[order[: len(surface)]], config, progress)


def _surface_of_all(state: _State, config: ReconstructionConfig, progress: Progress) -> tuple[SurfacePoints, Int]:
    """Phase 0: the surface of all points, which the state then has in the order (N,) of the surface."""
    workers = config.workers or os.cpu_count() or 1
    cloud = state.cloud()
    check_enough(cloud, len(cloud))
    part, row = state.points.part, state.points.row
    # Nothing else that was known of them counts.
    state.points = _State.of_nothing().points
    state.frame = own_frame(cloud.points)
    cloud = state.frame.of(cloud, workers=workers)
    surface = reported(lambda: find_surface(cloud, config, workers), "normals", progress)
    # In the order of the surface, so that all that follows is the same to the last bit.
    others = np.ones(len(cloud), bool)
    others[surface.kept] = False
    order = np.concatenate([surface.kept, np.flatnonzero(others)])
    state.points = _blank(part[order], row[order], np.concatenate([surface.points, cloud.points[others]]))
    return surface, order


def _submaps_of_some(
    state: _State, anew: Mask, names: NDArray[np.int32], config: ReconstructionConfig, progress: Progress
) -> None:
    """New submaps of the points `anew` (N,) beside those there are.

    names: (N,) of the submap that each point was of, -1 for none.
    """
    workers = config.workers or os.cpu_count() or 1
    points = state.points
    company = are_near(points.own, points.own[anew], _COMPANY * NORMAL_RADIUS * config.spacing, workers)
    rows = np.flatnonzero(anew | company)
    state.points = replace(
        points, on_surface=points.on_surface & ~anew, owner=np.where(anew, np.int32(-1), points.owner)
    )
    if not anew.any() or state.frame is None:
        return
    around = state.frame.of(state.cloud(rows), workers=workers)
    try:
        surface = reported(lambda: find_surface(around, config, workers), "normals", progress)
        rows = rows[surface.kept]
        mine = anew[rows]
        links = rows[surface.neighbors[mine]].astype(np.int32)
        state.points = _with_surface(state.points, rows[mine], links)
        if mine.any():
            _add_submaps(state, rows[mine], _part_of(surface, mine), names[rows[mine]], config, progress)
    except InputError:
        # There is no surface here yet; more points may make one.
        pass


def _add_submaps(
    state: _State,
    rows: Int,
    surface: SurfacePoints,
    names: NDArray[np.int32],
    config: ReconstructionConfig,
    progress: Progress,
) -> None:
    """Phases 1 and 2: submaps of a surface, whose points (n,) are the points `rows`.

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
    state.points = replace(state.points, owner=owners)
    state.neurons = Neurons(
        places=np.concatenate([known.places, new.places]),
        normals=np.concatenate([known.normals, new.normals]),
        centers=np.concatenate([known.centers, new.centers]),
        submap=np.concatenate([known.submap, inherited[new.submap]]),
        bent=np.concatenate([known.bent, new.bent]),
        cells=len(known.places) + new.cells,
        owner=_NONE,
    )
    state.loose = np.concatenate([state.loose, np.ones(len(new.places), bool)])
    state.noise, state.noise_points, state.names = noise, noise_points, given


class _Some(NamedTuple):
    """Some of what there is. points: rows (n,) of those on a surface. neurons: (v,). faces: mask (F,)."""

    points: Int
    neurons: Int
    faces: Mask


def _join(state: _State, config: ReconstructionConfig, progress: Progress) -> Mesh:
    """Phases 3 and 4: join the cells of new submaps to the faces there are and finish what is around; the mesh."""
    check_covered(state.neurons.places)

    def work() -> Mesh:
        faces, sheet = _changed_only(state, config) or _joined(state, _all_of(state), config)
        mesh = without_scraps(sheet, config)
        check_covered(mesh.faces)
        state.neurons, state.faces, state.sheet = replace(state.neurons, cells=_NO_FACES), faces, sheet
        state.loose, state.gone = np.zeros(len(state.loose), bool), np.empty((0, 3))
        return mesh

    return reported(work, "joining", progress)


def _changed_only(state: _State, config: ReconstructionConfig) -> tuple[Int, Sheet] | None:
    """The faces and the sheet where only what is around changes is joined and finished; None where it is too much.

    Creases, bends, borders and holes hang on what is within some cells.
    """
    workers = config.workers or os.cpu_count() or 1
    changed = np.concatenate([state.neurons.places[state.loose], state.gone])
    if state.sheet is None:
        return None
    if not len(changed):
        return state.faces, state.sheet
    some = _some_around(state, changed, config, workers)
    if some is None:
        return None
    faces, new = _joined(state, some, config)
    sheet = sewn(changed, state.sheet, new, config.spacing, workers)
    return None if sheet is None else (np.concatenate([state.faces[~some.faces], faces]), sheet)


def _some_around(state: _State, changed: Float, config: ReconstructionConfig, workers: int) -> _Some | None:
    """What is around the places (M, 3) that have changed; None where that is most of it."""
    distance = MADE_ANEW * config.spacing
    neurons = are_near(state.neurons.places, changed, distance, workers)
    faces: Mask = np.asarray(neurons[state.faces].any(axis=1))
    if not faces.any() or faces.mean() > _MOST_JOINED:
        return None
    neurons[state.faces[faces]] = True
    owner = state.points.owner
    points = state.points.on_surface & np.where(owner >= 0, neurons[owner], False)
    free = np.flatnonzero(state.points.on_surface & (owner < 0))
    points[free] = are_near(state.points.own[free], changed, distance, workers)
    return _Some(np.flatnonzero(points), np.flatnonzero(neurons), faces)


def _all_of(state: _State) -> _Some:
    points = np.flatnonzero(state.points.on_surface)
    return _Some(points, np.arange(len(state.neurons.places)), np.ones(len(state.faces), bool))


def _joined(state: _State, some: _Some, config: ReconstructionConfig) -> tuple[Int, Sheet]:
    """The faces (F, 3), and the sheet that they become, of some of what there is and of all new cells."""
    known, rows = state.neurons, some.neurons
    data = data_of(
        state.points.own[some.points],
        _renumbered(state.points.neighbors, some.points),
        config,
        config.workers or os.cpu_count() or 1,
    )
    number = np.full(len(known.places) + 1, -1)
    number[rows] = np.arange(len(rows))
    neurons = Neurons(
        places=known.places[rows],
        normals=known.normals[rows],
        centers=known.centers[rows],
        submap=known.submap[rows],
        bent=known.bent[rows],
        cells=number[known.cells],
        owner=number[state.points.owner[some.points]],
    )
    sound = sound_cells(neurons, data, number[state.faces[some.faces]])
    # As of all, so that the front goes as far as it would there.
    edge = usual_edge(known, np.concatenate([state.faces[~some.faces], rows[sound]]), config)
    joined = join(neurons, sound, data, config, edge=edge)
    # Elsewhere the front would only try again what it could not do before.
    where = state.loose[rows][joined.faces].any(axis=1) | (np.arange(len(joined.faces)) < len(sound))
    joined = Sheet(joined.vertices, joined.faces[where], joined.submap[where])
    return rows[joined.faces], finished(joined, neurons, data, config)


def _leave_what_has_data(state: _State, config: ReconstructionConfig) -> None:
    """Take the faces away under which points are gone."""
    workers = config.workers or os.cpu_count() or 1
    near = config.support_distance or config.spacing
    grid = point_grid(state.points.own, cell=near / math.sqrt(3))
    stays = supported(state.neurons.places, state.faces, grid, near, workers)
    state.loose = state.loose.copy()
    state.loose[state.faces[~stays]] = True
    state.faces = state.faces[stays]


def _leave_out(state: _State, stale: NDArray[np.int32]) -> None:
    """Take the submaps of these names away, and the faces that touch them."""
    known = state.neurons
    keep = ~np.isin(known.submap, stale)
    number = np.where(keep, np.cumsum(keep) - 1, -1)
    state.gone = np.concatenate([state.gone, known.places[~keep]])
    state.neurons = Neurons(
        places=known.places[keep],
        normals=known.normals[keep],
        centers=known.centers[keep],
        submap=known.submap[keep],
        bent=known.bent[keep],
        cells=_NO_FACES,
        owner=_NONE,
    )
    owner = state.points.owner
    owner = np.where(owner >= 0, number[owner], -1).astype(np.int32)
    state.points = replace(state.points, owner=owner)
    stays = keep[state.faces].all(axis=1)
    loose = np.zeros(len(keep), bool)
    loose[state.faces[~stays]] = True
    state.loose = loose[keep]
    state.faces = number[state.faces[stays]]


def _names(state: _State) -> NDArray[np.int32]:
    """The name (N,) of the submap of each point, -1 for none."""
    owner = state.points.owner
    return np.where(owner >= 0, np.append(state.neurons.submap, -1)[owner], -1).astype(np.int32)


def _inherited(label: Int, before: NDArray[np.int32], count: int, given: int) -> tuple[Int, int]:
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


def _blank(part: NDArray[Any], row: NDArray[Any], own: Float) -> _Points:
    """Points of which nothing else is known yet."""
    itself = np.arange(len(own), dtype=np.int32)
    return _Points(
        part=part.astype(np.int32),
        row=row.astype(np.int32),
        own=own,
        on_surface=np.zeros(len(own), bool),
        neighbors=np.repeat(itself[:, None], SECTORS, axis=1),
        owner=np.full(len(own), -1, np.int32),
    )


def _together(one: _Points, other: _Points) -> _Points:
    return _Points(
        part=np.concatenate([one.part, other.part]),
        row=np.concatenate([one.row, other.row]),
        own=np.concatenate([one.own, other.own]),
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


def _result(state: _State, mesh: Mesh, count: int) -> Reconstruction:
    """The result from a mesh in the frame of the points, of `count` points that came."""
    points, neurons = state.points, state.neurons
    owned = points.owner >= 0
    if state.frame is not None:
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
