# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Where the map of a robot that makes sweeps lies in the map of others, found from nothing but what both have seen.

Some of its sweeps are looked for in the whole of the other map, over all headings. A transform that brings one there
is judged by all sweeps: each either lies on what others saw, contradicts it, or is where nobody else was. It is
believed if enough of them lie there, hardly one contradicts it, and no other transform has nearly as much for it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from g2_recon.config import SweepConfig
from g2_recon.errors import InputError
from g2_recon.geometry import se3
from g2_recon.geometry.cloud import Cloud
from g2_recon.progress import Progress, silent
from g2_recon.registration import sweep_graph
from g2_recon.registration.prepared_map import PreparedMap
from g2_recon.registration.prepared_sweep import PreparedSweep, prepare
from g2_recon.registration.sweep_graph import Edge
from g2_recon.registration.sweep_matching import Match, match_at, matches_anywhere

Float = NDArray[np.float64]

State = Literal["aligned", "ambiguous", "rejected"]

# So many sweeps are looked for at most, spread over the way, and at least; so many transforms are judged.
_MOST_LOOKED_FOR, _FEWEST_LOOKED_FOR, _MOST_JUDGED = 6, 2, 8
# Sweeps agree on a transform if it brings them so near to where they lie: both maps are bent a little.
_SAME_M, _SAME_RAD = 0.3, math.radians(3.0)
# A sweep contradicts a place where so much of it should be on what others saw and less than that is.
_SEEN_OVERLAP, _CONTRADICTED = 0.2, 0.75
_MOST_CONTRADICTING = 0.2
# Sweeps that lie there have this in common with what others saw, on the mean, and of it so much on the same surface:
# corridors that are alike but for a door do not. Where less is in common it has to fit better, and one sweep alone.
_OVERLAPS, _LEAST_INLIERS = (0.35, 0.65), (0.975, 0.95)
_ALONE_OVERLAP, _ALONE_INLIERS = 0.8, 0.96
# Beside what fits, what does not counts so many times.
_AGAINST = 4.0
# Another transform with this share of its support makes it ambiguous, unless that is contradicted so many times as
# much, and more than noise does.
_RIVAL_SHARE, _RIVAL_CONTRADICTED, _NOISE_CONTRADICTED = 0.75, 3.0, 0.02
# It has to hold in all directions, m.
_MOST_SIGMA_M = 0.05
# The sweeps of a robot are stiff among each other, as far as this goes.
_STIFF = 1e8


@dataclass(frozen=True, slots=True)
class MapSweep:
    """A sweep of a map, ready for matching: T_map_sweep (4, 4)."""

    sweep: PreparedSweep
    T_map_sweep: Float


@dataclass(frozen=True, slots=True)
class SweepAlignment:
    """Where the map of a robot that makes sweeps lies in another one.

    state: whether it can be believed; reason: why not, in words. T_fixed_moving: (4, 4), the best that was found.
    covariance: (6, 6) of it, the order of ROS. held: how many sweeps lie on what others saw; contradicting: how many do
    not though they should; overlap, inlier_share: of those that are held, the mean, see agreement.Agreement.
    """

    state: State
    reason: str
    T_fixed_moving: Float
    covariance: Float
    held: int
    contradicting: int
    overlap: float
    inlier_share: float

    @property
    def support(self) -> float:
        """What speaks for it, in sweeps; what contradicts it counts more."""
        return self.held * self.overlap * max(0.0, 1.0 - _AGAINST * (1.0 - self.inlier_share))


def map_sweeps(clouds: Iterable[Cloud], config: SweepConfig) -> list[MapSweep]:
    """Sweeps by their points in the map and the place of the laser; those that are too small are left out."""
    result = []
    for cloud in clouds:
        if cloud.sensor is None or not len(cloud):
            continue
        T = np.eye(4)
        T[:3, 3] = cloud.sensor[0]
        try:
            result.append(MapSweep(prepare(cloud.points - cloud.sensor[0], config), T))
        except InputError:
            continue
    return result


def align_sweeps(
    fixed: PreparedMap,
    moving: Sequence[MapSweep],
    config: SweepConfig,
    *,
    before: Float | None = None,
    progress: Progress = silent,
) -> SweepAlignment:
    """Find the map of `moving` in the map `fixed`; maps are level, at about the same height.

    before: (4, 4) where it was found before; where that still holds, nothing else is looked for.
    """
    if before is not None:
        again = _believed(_judged(before, fixed, moving, config), [])
        if again.state == "aligned":
            return again
    found: list[Float] = []
    judged: list[SweepAlignment] = []
    order = _spread(len(moving))[:_MOST_LOOKED_FOR]
    for done, k in enumerate(order, start=1):
        for match in matches_anywhere(moving[k].sweep, fixed, *_everywhere(fixed, moving[k], config)):
            T = match.T @ se3.inverse(moving[k].T_map_sweep)
            if not any(_alike(T, other, moving) for other in found):
                found.append(T)
                judged.append(_judged(T, fixed, moving, config))
        progress("aligning sweeps", done, len(order))
        judged = sorted(judged, key=lambda one: -one.support)[:_MOST_JUDGED]
        if done >= _FEWEST_LOOKED_FOR and judged and _believed(judged[0], judged[1:]).state == "aligned":
            break
    if not judged:
        return _nothing("none of its sweeps was found in the map")
    return _believed(judged[0], judged[1:])


def _spread(count: int) -> list[int]:
    """Numbers from 0 on: the ends, the middle, and then between those."""
    order: list[int] = []
    step = count
    while step:
        order += [k for k in [*range(0, count, step), count - 1] if k not in order]
        step //= 2
    return order


def _everywhere(fixed: PreparedMap, moving: MapSweep, config: SweepConfig) -> tuple[Float, SweepConfig]:
    """A guess in the middle of a map, and settings that search all of it from there."""
    low, high = fixed.points.min(axis=0), fixed.points.max(axis=0)
    guess = moving.T_map_sweep.copy()
    guess[:2, 3] = (low + high)[:2] / 2
    reach = float((high - low)[:2].max()) / 2
    return guess, config.model_copy(update={"search": reach, "search_angle": math.pi})


def _judged(T: Float, fixed: PreparedMap, moving: Sequence[MapSweep], config: SweepConfig) -> SweepAlignment:
    """A transform beside what all sweeps say of it, moved to where those lie that are held."""
    held: list[tuple[int, Match]] = []
    contradicting = 0
    for k, sweep in enumerate(moving):
        guess = T @ sweep.T_map_sweep
        match = match_at(sweep.sweep, fixed, guess, config)
        near = _near(match.T, guess)
        if near and not match.refused:
            held.append((k, match))
        elif match.overlap >= config.min_overlap or (
            match.overlap >= _SEEN_OVERLAP and match.inlier_share < _CONTRADICTED
        ):
            contradicting += 1
    if not held:
        return replace(_nothing("no sweep lies on what others saw"), T_fixed_moving=T, contradicting=contradicting)
    placed, covariance = _fitted(T, moving, held)
    return SweepAlignment(
        "aligned",
        "",
        placed,
        covariance,
        len(held),
        contradicting,
        float(np.mean([match.overlap for _, match in held])),
        float(np.mean([match.inlier_share for _, match in held])),
    )


def _fitted(T: Float, moving: Sequence[MapSweep], held: Sequence[tuple[int, Match]]) -> tuple[Float, Float]:
    """The transform (4, 4) that fits all matches best, and its covariance (6, 6)."""
    poses = [np.eye(4), T]
    edges: list[Edge] = []
    for k, match in held:
        poses.append(match.T)
        own = moving[k].T_map_sweep
        edges += [
            Edge(0, len(poses) - 1, match.T, match.information),
            Edge(1, len(poses) - 1, own, _STIFF * np.eye(6)),
        ]
    optimized = sweep_graph.optimize(np.array(poses), edges)
    return optimized[1], np.asarray(sweep_graph.covariances(optimized, edges, [1])[0])


def _believed(best: SweepAlignment, rivals: Sequence[SweepAlignment]) -> SweepAlignment:
    """An alignment, with what speaks against it."""
    if not best.held:
        return replace(best, state="rejected")
    if _is_contradicted(best):
        return replace(
            best,
            state="rejected",
            reason=f"{best.held} sweeps fit, but {best.contradicting} contradict what others saw",
        )
    alone = best.held < 2
    overlap = _ALONE_OVERLAP if alone else _OVERLAPS[0]
    inliers = _ALONE_INLIERS if alone else float(np.interp(best.overlap, _OVERLAPS, _LEAST_INLIERS))
    if best.overlap < overlap or best.inlier_share < inliers:
        fits = "one sweep fits" if alone else f"{best.held} sweeps fit"
        has = f"{best.overlap:.0%} of it in common and {best.inlier_share:.0%} of that on the same surface"
        return replace(best, state="rejected", reason=f"{fits}, with {has}; {overlap:.0%} and {inliers:.1%} are needed")
    sigma = math.sqrt(np.linalg.eigvalsh(best.covariance[:3, :3])[2])
    if sigma > _MOST_SIGMA_M:
        return replace(best, state="ambiguous", reason=f"along one direction nothing holds it: sigma {sigma:.2f} m")
    told_apart = _RIVAL_CONTRADICTED * (1 - best.inlier_share) + _NOISE_CONTRADICTED
    for other in rivals:
        contradicted = _is_contradicted(other) or 1 - other.inlier_share > told_apart
        if other.support > _RIVAL_SHARE * best.support and not contradicted and not _near_map(best, other):
            return replace(best, state="ambiguous", reason=f"at another place {other.held} sweeps fit, too")
    return best


def _is_contradicted(alignment: SweepAlignment) -> bool:
    return alignment.contradicting > _MOST_CONTRADICTING * alignment.held


def _near_map(one: SweepAlignment, other: SweepAlignment) -> bool:
    return _near(one.T_fixed_moving, other.T_fixed_moving)


def _near(T: Float, other: Float) -> bool:
    apart = se3.inverse(T) @ other
    # The angle between two rotations, from the trace.
    cos = (np.trace(apart[:3, :3]) - 1) / 2
    return bool(np.linalg.norm(apart[:3, 3]) < _SAME_M and cos > math.cos(_SAME_RAD))


def _alike(T: Float, other: Float, moving: Sequence[MapSweep]) -> bool:
    """Whether two transforms bring sweeps to about the same places."""
    return all(_near(T @ sweep.T_map_sweep, other @ sweep.T_map_sweep) for sweep in moving)


def _nothing(reason: str) -> SweepAlignment:
    return SweepAlignment("rejected", reason, np.eye(4), np.full((6, 6), np.inf), 0, 0, 0.0, 0.0)
