# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Mode solid of a cloud that grows: only clusters whose data changed are found, trained and joined anew.

A cluster has changed where a point came or went within the radius in which normals are estimated. Its points, the new
ones and those near that had no cluster go through phases 0 to 2 together, in the company of the points around them; the
maps of all other clusters stay. So do the faces between them: the front of phase 3 goes on from these. Where most of
the points are concerned, all is done as for a cloud that does not grow, and with the same result.
"""

from __future__ import annotations

import os
from collections.abc import Hashable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from g2_recon.config import ReconstructionConfig
from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud, concatenate
from g2_recon.geometry.mesh import Mesh
from g2_recon.geometry.point_tree import are_near
from g2_recon.progress import Progress, silent
from g2_recon.reconstruction.collected_cloud import Part
from g2_recon.reconstruction.growing_joins import join_changed, leave_out_submaps, leave_what_has_data
from g2_recon.reconstruction.growing_state import Points, State, renumbered
from g2_recon.reconstruction.mesh_of_submaps import Neurons, with_data
from g2_recon.reconstruction.own_frame import own_frame
from g2_recon.reconstruction.result import Reconstruction
from g2_recon.reconstruction.solid import (
    NORMAL_RADIUS,
    build_submaps,
    find_clusters,
    find_surface,
    reported,
    wire_of,
)
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


class GrowingReconstruction:
    """A reconstruction that keeps up with a cloud that comes, and is corrected, part by part."""

    def __init__(self, config: ReconstructionConfig) -> None:
        """config: of mode solid."""
        self._config = config
        self._taken: dict[Hashable, tuple[int, Part]] = {}
        self._numbers = 0
        self._state = State.of_nothing()
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
        self._taken, self._state, self._result = {}, State.of_nothing(), None

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


def _grow(state: State, gone: list[int], new: list[_New], config: ReconstructionConfig, progress: Progress) -> Mesh:
    """The mesh after parts went and others came; the state becomes that of then."""
    names, anew, stale = _take_in(state, gone, new, config)
    # Without sensors only the whole tells which side of a surface is the free one.
    sided = state.seen_from and state.sided
    if not sided or np.count_nonzero(anew) >= _MOST_ANEW * len(anew):
        _submaps_of_all(state, names, config, progress)
    else:
        leave_out_submaps(state, stale)
        if gone:
            leave_what_has_data(state, config)
        _submaps_of_some(state, anew, names, config, progress)
    return join_changed(state, config, progress)


def _take_in(
    state: State, gone: list[int], new: list[_New], config: ReconstructionConfig
) -> tuple[NDArray[np.int32], Mask, NDArray[np.int32]]:
    """Take points away and in.

    The name (N,) of the submap that each point was of, -1 for none; a mask (N,) of those that are to get a new one; and
    the names of the submaps that are no more, also of those of which no point is left.
    """
    workers = config.workers or os.cpu_count() or 1
    cloud, part, row = _possible(new, config, workers)
    if state.frame is None:
        # Nothing is known of them: they get their own frame, and what goes with it, all together.
        state.points = Points.without_surface(part, row, cloud.points)
        return np.full(len(cloud), -1, np.int32), np.ones(len(cloud), bool), np.empty(0, np.int32)
    added = Points.without_surface(part, row, state.frame.of(cloud, workers=workers).points)
    names, own = state.names_of_points(), state.points.own
    keep = ~np.isin(state.points.part, gone)
    changed = np.concatenate([own[~keep], added.own])
    near = are_near(own, changed, NORMAL_RADIUS * config.spacing, workers)
    stale = np.unique(names[(near | ~keep) & (names >= 0)])
    anew = np.isin(names, stale) | (near & (names < 0))
    if not keep.all():
        state.points = state.points.take(np.flatnonzero(keep))
    state.points = state.points.together_with(added)
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


def _submaps_of_all(state: State, names: NDArray[np.int32], config: ReconstructionConfig, progress: Progress) -> None:
    """Phases 0 to 2 as for a cloud that does not grow. names: (N,) of the submap that each point was of."""
    surface, order = _surface_of_all(state, config, progress)
    rows = np.arange(len(surface))
    state.forget_submaps()
    state.points = state.points.with_surface(rows, surface.neighbors)
    _add_submaps(state, rows, surface, names[order[: len(surface)]], config, progress)


def _surface_of_all(state: State, config: ReconstructionConfig, progress: Progress) -> tuple[SurfacePoints, Int]:
    """Phase 0: the surface of all points, which the state then has in the order (N,) of the surface."""
    workers = config.workers or os.cpu_count() or 1
    cloud = state.cloud()
    check_enough(cloud, len(cloud))
    part, row = state.points.part, state.points.row
    # Nothing else that was known of them counts.
    state.points = State.of_nothing().points
    state.frame = own_frame(cloud.points)
    cloud = state.frame.of(cloud, workers=workers)
    surface = reported(lambda: find_surface(cloud, config, workers), "normals", progress)
    # In the order of the surface, so that all that follows is the same to the last bit.
    others = np.ones(len(cloud), bool)
    others[surface.kept] = False
    order = np.concatenate([surface.kept, np.flatnonzero(others)])
    state.points = Points.without_surface(
        part[order], row[order], np.concatenate([surface.points, cloud.points[others]])
    )
    return surface, order


def _submaps_of_some(
    state: State, anew: Mask, names: NDArray[np.int32], config: ReconstructionConfig, progress: Progress
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
        state.points = state.points.with_surface(rows[mine], links)
        if mine.any():
            _add_submaps(state, rows[mine], _part_of(surface, mine), names[rows[mine]], config, progress)
    except InputError:
        # There is no surface here yet; more points may make one.
        pass


def _add_submaps(
    state: State,
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


def _inherited(label: Int, before: NDArray[np.int32], count: int, given: int) -> tuple[Int, int]:
    """Names (count,) of clusters, and how many have been given now.

    label: (n,) cluster of each point and before: (n,) its name before, -1 for none, of `given` that there were. Those
    that share the most points come first; what inherits no name gets a new one.
    """
    both = (label >= 0) & (before >= 0)
    pairs, shared = np.unique(label[both] * given + before[both], return_counts=True)
    names = np.full(count, -1)
    taken: set[int] = set()
    for pair in pairs[np.argsort(-shared, kind="stable")].tolist():
        cluster, name = divmod(pair, given)
        if names[cluster] < 0 and name not in taken:
            names[cluster] = name
            taken.add(name)
    new = np.flatnonzero(names < 0)
    names[new] = given + np.arange(len(new))
    return names, given + len(new)


def _part_of(surface: SurfacePoints, which: Mask) -> SurfacePoints:
    """The points of a surface that a mask names."""
    rows = np.flatnonzero(which)
    return replace(
        surface,
        points=surface.points[rows],
        normals=surface.normals[rows],
        weights=surface.weights[rows],
        neighbors=renumbered(surface.neighbors, rows),
        cells=surface.cells[rows],
        kept=surface.kept[rows],
    )


def _result(state: State, mesh: Mesh, count: int) -> Reconstruction:
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
