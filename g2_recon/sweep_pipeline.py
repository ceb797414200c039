# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Robots that make sweeps come into the world of others: registration finds where, collaboration keeps it."""

from __future__ import annotations

import numpy as np

from g2_recon.collaboration.live_merger import SweepPlace, SweepWork
from g2_recon.config import SweepConfig
from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud, concatenate
from g2_recon.geometry.voxels import voxel_numbers
from g2_recon.progress import Progress, silent
from g2_recon.registration.prepared_map import prepare_map
from g2_recon.registration.sweep_alignment import SweepAlignment, align_sweeps, map_sweeps

# Of what others saw, so much is enough to lay sweeps on: a point a cube of this edge, m.
_THINNED_M = 0.05
# Standard deviations of a start that is given, as for robots with keyframes; m and rad.
_GIVEN_M, _GIVEN_RAD = 0.5, 0.1


def place_sweeps(
    work: SweepWork, settings: SweepConfig | None = None, *, progress: Progress = silent
) -> dict[str, SweepPlace]:
    """Where each of the robots lies in the world; where nobody else is there, the world is where the first one is.

    Who has found no place may find one when others are in.
    """
    # Clouds are in metres, whatever the sweeps were in.
    config = (settings or SweepConfig()).model_copy(update={"scale": 1.0})
    places: dict[str, SweepPlace] = {}
    world = [] if work.world is None else [_thinned(work.world)]
    waiting = dict(work.robots)
    while waiting:
        for name, clouds in waiting.items():
            places[name] = _place(name, world, clouds, work, config, progress)
            if places[name].state == "aligned":
                world += [_thinned(cloud.moved(places[name].T_world_map)) for cloud in clouds]
                break
        else:
            break
        del waiting[name]
    return places


def _place(
    name: str, world: list[Cloud], clouds: tuple[Cloud, ...], work: SweepWork, config: SweepConfig, progress: Progress
) -> SweepPlace:
    before = work.before.get(name)
    if not world:
        reason = "its start is given" if name in work.given else "the world is where its map is"
        return _given(np.eye(4) if before is None else before, reason)
    moving = map_sweeps(clouds, config)
    if not moving:
        return _unknown("its sweeps are too small to be laid on what others saw")
    try:
        found = align_sweeps(prepare_map(concatenate(world), config), moving, config, before=before, progress=progress)
    except InputError as error:
        return _unknown(str(error))
    if found.state == "rejected" and name in work.given and before is not None and not _is_contradicted(found):
        return _given(before, "its start is given; nobody else was there")
    inliers = f"{found.inlier_share:.0%} of it on the same surface"
    reason = found.reason or f"{found.held} of {len(moving)} sweeps lie on what others saw, {inliers}"
    return SweepPlace(found.state, reason, found.T_fixed_moving, found.covariance, found.inlier_share)


def _is_contradicted(found: SweepAlignment) -> bool:
    return bool(found.held or found.contradicting)


def _given(T: np.ndarray, reason: str) -> SweepPlace:
    sigmas = np.repeat([_GIVEN_M, _GIVEN_RAD], 3)
    return SweepPlace("aligned", reason, T, np.diag(sigmas**2), 1.0)


def _unknown(reason: str) -> SweepPlace:
    return SweepPlace("rejected", reason, np.eye(4), np.full((6, 6), np.inf))


def _thinned(cloud: Cloud) -> Cloud:
    return cloud.select(np.unique(voxel_numbers(cloud.points, _THINNED_M), return_index=True)[1])
