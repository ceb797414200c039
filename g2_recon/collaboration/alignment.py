# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""How the map of one robot lies in the map of another, found from nothing but what both have seen.

Parts of the one map are looked for in the whole of the other, over all headings. A transform that several parts agree
on is compared with everything that both robots have seen: where one looked through a wall of the other they were not
in the same place. It is believed if it explains enough, contradicts nearly nothing, and if no other transform explains
nearly as much: the rooms along a corridor may be alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry import se2
from g2_recon.geometry.session import Session
from g2_recon.localization.beams import Beams
from g2_recon.localization.collecting import latest
from g2_recon.localization.keyframes import Keyframes
from g2_recon.localization.pairing import add_levered
from g2_recon.localization.relocalization import GIVEN_M, GIVEN_RAD, Place, WholeMap, judge_group
from g2_recon.progress import Progress, silent

Float = NDArray[np.float64]
Int = NDArray[np.int64]

State = Literal["aligned", "ambiguous", "rejected"]

# So many parts of a map are looked for at most, spread over its way, and a new one after so many keyframes; fewer where
# so many agree and others have only this share of their support.
_MOST_PARTS, _PART_KEYFRAMES = 24, 16
_ENOUGH_PARTS, _ENOUGH_SUPPORT, _HOPELESS_SHARE = 4, 2.5, 0.25
# Places that do not fit this well say nothing about the transform.
_LEAST_QUALITY = 0.7
# Parts agree on a transform if it brings them so near to where they were found: both maps are bent a little.
_SAME_M, _SAME_RAD = 0.6, math.radians(4.0)
# So many transforms are compared with all that was seen, by every so manieth keyframe and what so many see of it.
_COMPARED, _STRIDE, _WITNESSES = 6, 2, 4
# What a part says is compared with what was seen within so much way of it, m.
_AROUND_M = 12.0
# A keyframe has been where the other robot was if it shares this much of its points with it.
_SHARED = 0.3
# It is believed with at least so much way in common, m, and this share of agreement there, more where only one part
# speaks for it.
LEAST_WAY_M, _LEAST_AGREEMENT, _LEAST_ALONE = 8.0, 0.87, 0.94
# Another one with this share of its way makes it ambiguous, unless that is contradicted so many times as much, and more
# than noise does.
_RIVAL_SHARE, _RIVAL_CONTRADICTED, _NOISE_CONTRADICTED = 0.7, 3.0, 0.02
# It has to hold in all directions, m.
_MOST_SIGMA_M = 0.1
# Headings count as much as a point so far ahead, m.
_AHEAD_M = 3.0


@dataclass(frozen=True, slots=True)
class Alignment:
    """Where the map of one robot lies in that of another.

    state: whether it can be believed; reason: why not, in words. T_fixed_moving: (3,) x, y, yaw, the best that was
    found. way: m that both have in common. agreement: share of the points there that both see, contradictions counted
    twice. covariance: (3, 3) of the transform. keyframes: (P,) of the moving map that were found where it brings them.
    """

    state: State
    reason: str
    T_fixed_moving: Float
    way: float
    agreement: float
    covariance: Float
    keyframes: Int


@dataclass(frozen=True, slots=True)
class _Hypothesis:
    """A transform (3,) that parts agree on: their keyframes (P,), and the transform (P, 3) and value (P,) of each."""

    T_fixed_moving: Float
    owners: Int
    transforms: Float
    values: Float
    information: Float

    @property
    def support(self) -> float:
        return float(self.values.sum())


def align(fixed: Session, moving: Session, *, progress: Progress = silent) -> Alignment:
    """Find the map `moving` in the map `fixed`. Raises InputError where that is too large to search."""
    whole = WholeMap(Keyframes.of_session(fixed))
    scans = Keyframes.of_session(moving)
    hypotheses = _hypotheses(whole, scans, progress)
    if not hypotheses:
        return _nothing("no part of the map was found in the other one")
    best, *others = sorted(
        ((_judged(hypothesis, whole, fixed, moving, scans), hypothesis) for hypothesis in hypotheses[:_COMPARED]),
        key=lambda judged: -judged[0].way * judged[0].agreement,
    )
    # The ends of a bent map are elsewhere without contradicting each other.
    rivals = [alignment for alignment, hypothesis in others if np.isin(hypothesis.owners, best[1].owners).any()]
    return _believed(best[0], rivals)


def align_near(fixed: Session, moving: Session, T_fixed_moving: Float) -> Alignment:
    """Judge a transform (3,) that somebody gives, right to a metre and 20 deg, and take it to where the maps fit best.

    Raises InputError where the map `fixed` is too large to search.
    """
    whole = WholeMap(Keyframes.of_session(fixed))
    scans = Keyframes.of_session(moving)
    owners: list[int] = []
    places: list[Place] = []
    for k in range(0, len(moving), _PART_KEYFRAMES):
        guess = se2.compose(T_fixed_moving, moving.poses[k])
        place = whole.around(guess, _beams(moving, k), metres=GIVEN_M, radians=GIVEN_RAD)
        if place is not None and place.quality >= _LEAST_QUALITY:
            owners.append(k)
            places.append(place)
    hypotheses = _agreed(places, np.array(owners, int), scans.poses)
    if not hypotheses:
        rows = np.arange(0, len(moving), _PART_KEYFRAMES)
        transforms = np.tile(np.asarray(T_fixed_moving, float), (len(rows), 1))
        hypotheses = [_Hypothesis(transforms[0], rows, transforms, np.ones(len(rows)), np.eye(3))]
    return _believed(_judged(hypotheses[0], whole, fixed, moving, scans), [])


def still_holds(fixed: Session, moving: Session, before: Alignment, transforms: Float) -> Alignment:
    """Judge an alignment by all that has been seen until now.

    transforms: (N, 3) fixed ← moving map at each keyframe, as it was found before.
    """
    owners = np.arange(0, len(moving), _PART_KEYFRAMES)
    found = before.keyframes[before.keyframes < len(moving)]
    hypothesis = _Hypothesis(
        fitted(moving.poses[found], se2.compose(transforms[found], moving.poses[found])),
        owners,
        transforms[owners],
        np.ones(len(owners)),
        np.asarray(np.linalg.inv(before.covariance), float),
    )
    scans = Keyframes.of_session(moving)
    judged = _judged(hypothesis, WholeMap(Keyframes.of_session(fixed)), fixed, moving, scans)
    return _believed(replace(judged, keyframes=found), [])


def _hypotheses(whole: WholeMap, scans: Keyframes, progress: Progress) -> list[_Hypothesis]:
    """Different transforms that parts of a map agree on when they are looked for in the whole of another.

    That with the most parts behind it is the first.
    """
    ends = _ends(len(scans))
    owners: list[int] = []
    places: list[Place] = []
    hypotheses: list[_Hypothesis] = []
    for done, end in enumerate(ends, start=1):
        found = [place for place in whole.places(scans, latest(end))[0] if place.quality >= _LEAST_QUALITY]
        places += found
        owners += [end - 1] * len(found)
        progress("aligning maps", done, len(ends))
        hypotheses = _agreed(places, np.array(owners, int), scans.poses)
        if done >= _ENOUGH_PARTS and _is_decided(hypotheses):
            progress("aligning maps", len(ends), len(ends))
            break
    return hypotheses


def _ends(count: int) -> list[int]:
    """Before which of so many keyframes the parts of a map end: first far from one another, then between those."""
    parts = min(_MOST_PARTS, max(1, count // _PART_KEYFRAMES))
    ends = np.unique(np.linspace(count // parts, count, parts).round().astype(int)).tolist()
    order: list[int] = []
    step = 1 << (len(ends) - 1).bit_length()
    while step:
        order += [index for index in range(0, len(ends), step) if index not in order]
        step //= 2
    return [ends[index] for index in order]


def _is_decided(hypotheses: list[_Hypothesis]) -> bool:
    if not hypotheses or hypotheses[0].support < _ENOUGH_SUPPORT:
        return False
    return len(hypotheses) < 2 or hypotheses[1].support < _HOPELESS_SHARE * hypotheses[0].support


def _agreed(places: list[Place], owners: Int, moving: Float) -> list[_Hypothesis]:
    """Different transforms by places of keyframes (P,) with poses (N, 3), that with the most of them first."""
    if not places:
        return []
    poses = np.array([place.pose for place in places])
    values = np.array([place.value for place in places])
    transforms = se2.compose(poses, se2.inverse(moving[owners]))
    behind = [_best_of_each(np.flatnonzero(_near(T, poses, moving[owners])), values, owners) for T in transforms]
    support = np.array([values[rows].sum() for rows in behind])
    result: list[_Hypothesis] = []
    for m in np.lexsort((np.arange(len(places)), -values, -support)):
        if not any(_alike(transforms[m], other.T_fixed_moving, moving) for other in result):
            rows = behind[m]
            T = fitted(moving[owners[rows]], poses[rows])
            information = _together([places[row] for row in rows], places[m].pose)
            result.append(_Hypothesis(T, owners[rows], transforms[rows], values[rows], information))
    return result


def _together(places: list[Place], at: Float) -> Float:
    """Information (3, 3) of a step of the whole map at a pose (3,) in it: what one place leaves open, others hold."""
    total, unused = np.zeros((3, 3)), np.zeros(3)
    for place in places:
        x, y = place.pose[:2] - at[:2]
        add_levered(place.information, np.zeros(3), x, y, total, unused)
    return total


def _best_of_each(rows: Int, values: Float, owners: Int) -> Int:
    """Of places (R,), the best of each owner, by owner."""
    ordered = rows[np.lexsort((-values[rows], owners[rows]))]
    return ordered[np.unique(owners[ordered], return_index=True)[1]]


def _near(T: Float, poses: Float, moving: Float) -> NDArray[np.bool_]:
    """Mask (P,) of the poses (P, 3) to which a transform (3,) brings those that move."""
    off = se2.relative(se2.compose(T, moving), poses)
    return np.asarray((np.hypot(off[:, 0], off[:, 1]) < _SAME_M) & (np.abs(off[:, 2]) < _SAME_RAD))


def fitted(moving: Float, poses: Float) -> Float:
    """The transform (3,) that brings poses (P, 3) nearest to others, by least squares (Umeyama, PAMI 1991)."""
    ahead = np.array([_AHEAD_M, 0.0, 0.0])
    a = np.concatenate([moving[:, :2], se2.compose(moving, ahead)[:, :2]])
    b = np.concatenate([poses[:, :2], se2.compose(poses, ahead)[:, :2]])
    centered, target = a - a.mean(axis=0), b - b.mean(axis=0)
    cross = centered.T @ target
    yaw = math.atan2(cross[0, 1] - cross[1, 0], cross[0, 0] + cross[1, 1])
    turned = se2.transform_points(np.array([0.0, 0.0, yaw]), a.mean(axis=0)[None])[0]
    return np.array([*(b.mean(axis=0) - turned), yaw])


def _alike(one: Float, other: Float, poses: Float) -> bool:
    """Whether two transforms bring the poses (N, 3) to about the same places."""
    off = se2.relative(se2.compose(one, poses), se2.compose(other, poses))
    return bool(np.median(np.hypot(off[:, 0], off[:, 1])) < 2 * _SAME_M and abs(off[0, 2]) < 2 * _SAME_RAD)


def _judged(hypothesis: _Hypothesis, whole: WholeMap, fixed: Session, moving: Session, scans: Keyframes) -> Alignment:
    """A transform beside what both robots have seen around the parts that speak for it.

    Farther away both maps may be bent. Around each part the transform is as that part says.
    """
    off = np.abs(moving.ways[:, None] - moving.ways[hypothesis.owners])
    nearest = off.argmin(axis=1)
    rows = np.flatnonzero(off.min(axis=1) < _AROUND_M)[::_STRIDE]
    counts = np.zeros((len(rows), 4), int)
    for m, k in enumerate(rows):
        pose = se2.compose(hypothesis.transforms[nearest[k]], scans.poses[k])
        chosen = whole.seen_from(pose, _beams(moving, k), _WITNESSES)
        against_map = (*scans.since(k, 1), chosen[None], fixed.poses, *fixed.beams)
        counts[m] = judge_group(pose, np.zeros((1, 3)), *against_map)
    seen = np.count_nonzero(moving.kinds[rows], axis=1)
    same, against, still, gone = counts.T
    shared = same + against >= _SHARED * 0.5 * _WITNESSES * seen
    agreeing, contradicting = (same + still)[shared].sum(), (against + gone)[shared].sum()
    steps = np.diff(moving.ways, append=moving.ways[-1])
    way = sum(float(steps[k : k + _STRIDE].sum()) for k in rows[shared])
    return Alignment(
        "aligned",
        "",
        hypothesis.T_fixed_moving,
        way,
        float(agreeing / max(1, agreeing + 2 * contradicting)),
        np.asarray(np.linalg.inv(hypothesis.information), float),
        hypothesis.owners,
    )


def _beams(session: Session, k: int) -> Beams:
    return Beams(
        session.points[k],
        session.normals[k],
        session.kinds[k],
        float(session.firsts[k]),
        float(session.increments[k]),
    )


def _believed(best: Alignment, rivals: list[Alignment]) -> Alignment:
    """An alignment, with what speaks against it."""
    if best.way < LEAST_WAY_M:
        return _with(best, "rejected", f"only {best.way:.1f} m of way in common, {LEAST_WAY_M:g} m are needed")
    least = _LEAST_ALONE if len(best.keyframes) < 2 else _LEAST_AGREEMENT
    if best.agreement < least:
        return _with(best, "rejected", f"what both saw agrees by {best.agreement:.2f} only, not {least:g}")
    sigma = math.sqrt(np.linalg.eigvalsh(best.covariance[:2, :2])[1])
    if sigma > _MOST_SIGMA_M:
        return _with(best, "ambiguous", f"along one direction nothing holds it: sigma {sigma:.2f} m")
    told_apart = _RIVAL_CONTRADICTED * (1 - best.agreement) + _NOISE_CONTRADICTED
    for other in rivals:
        if other.way > _RIVAL_SHARE * best.way and 1 - other.agreement < told_apart:
            return _with(best, "ambiguous", f"another place has {other.way:.1f} m of way in common, too")
    return best


def _with(alignment: Alignment, state: State, reason: str) -> Alignment:
    return replace(alignment, state=state, reason=reason)


def _nothing(reason: str) -> Alignment:
    return Alignment("rejected", reason, se2.IDENTITY.copy(), 0.0, 0.0, np.full((3, 3), np.inf), np.empty(0, int))
