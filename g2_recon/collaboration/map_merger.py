# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The map merger: sessions of several robots become one map, as if one robot had driven it all."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.collaboration.alignment import LEAST_WAY_M, Alignment, align, align_near, still_holds
from g2_recon.collaboration.joint_map import joined, refined
from g2_recon.geometry import se2
from g2_recon.geometry.session import Session
from g2_recon.progress import Progress, silent

Float = NDArray[np.float64]

# The place of a robot is looked for again when world or robot have so many times as many keyframes.
_WORTH_LOOKING = 1.2
# Once maps are joined, a place of one is recognized in the other after so much way in common, m, at least once: loops
# are judged by themselves, and where rooms are alike by chance there is hardly one.
_WAY_A_LOOP_M = 8.0
_GIVEN_SIGMA = np.array([0.5, 0.5, 0.1])


@dataclass(frozen=True, slots=True)
class JointMap:
    """One map of several robots.

    session: the keyframes of all robots that are in it, in the order of `rows`, which tells which of them are whose.
    alignments: where the map of each robot lies in it, or why that is not known. The frame is the map frame of the
    first robot in `rows`. looked_for: how many keyframes the world and a robot had when its place was last looked for.
    """

    session: Session
    rows: dict[str, slice]
    alignments: dict[str, Alignment]
    looked_for: dict[str, tuple[int, int]] = field(default_factory=dict)

    def poses(self, robot: str) -> Float:
        """T_world_laser (N, 3) of the keyframes of a robot that is in the map."""
        return self.session.poses[self.rows[robot]]


def merge(
    sessions: Mapping[str, Session],
    *,
    starts: Mapping[str, ArrayLike] | None = None,
    before: JointMap | None = None,
    progress: Progress = silent,
) -> JointMap:
    """One map of the sessions of robots, by name; the same in whatever order they are given.

    starts: (3,) world ← <robot>/map where it is known about; one that maps contradict is not believed, and its robot is
    looked for. The robot that began first, or the first with a start, is where the world is. Those whose place is not
    sure are left out. before: the map when sessions had fewer keyframes; what was found then is judged anew, and looked
    for again only where it does not hold any more, or where there is so much more that what was not found may be found.
    Raises InputError where a map is too large to search.
    """
    known = {name: np.asarray(start, float) for name, start in (starts or {}).items()}
    order = sorted(sessions, key=lambda name: (name not in known, *_rank(sessions[name])))
    first = order.pop(0)
    if before is not None and first != next(iter(before.rows)):
        before = None
    world = _moved(sessions[first], known.get(first, se2.IDENTITY))
    rows = {first: slice(0, len(world))}
    alignments = {first: _given(known.get(first, se2.IDENTITY), sessions[first], "the world is where its map is")}
    looked_for = {} if before is None else dict(before.looked_for)
    waiting = order
    while waiting:
        # Who has found no place may find one when others are in.
        for name in waiting:
            session = sessions[name]
            found = _as_before(name, world, session, before)
            if found is None and name in known:
                found = _as_given(known[name], world, session)
            if found is None:
                found = align(world, session, progress=progress)
                looked_for[name] = len(world), len(session)
                if name in known:
                    found = replace(found, reason=_wrong_start(found))
            if found.state == "aligned":
                both = joined(world, session, found.T_fixed_moving, found.keyframes)
                found = _recognized(found, _loops_between(both, len(world.local_maps)))
            alignments[name] = found
            if found.state == "aligned":
                rows[name] = slice(len(world), len(both))
                world = both
                progress("merging maps", len(rows), len(sessions))
                break
        else:
            break
        waiting = [name for name in waiting if name not in rows]
    session = refined(world, progress=progress) if len(rows) > 1 else world
    return JointMap(session, rows, alignments, looked_for)


def _as_before(name: str, world: Session, session: Session, before: JointMap | None) -> Alignment | None:
    """What was found out about the place of a robot, as far as it holds; None: it is to be looked for."""
    if before is None or name not in before.alignments:
        return None
    if name in before.rows:
        poses = before.poses(name)
        transforms = se2.compose(poses, se2.inverse(session.poses[: len(poses)]))
        # What has come since lies as the latest of what there was.
        later = np.repeat(transforms[-1:], len(session) - len(poses), axis=0)
        found = still_holds(world, session, before.alignments[name], np.concatenate([transforms, later]))
        return found if found.state == "aligned" else None
    most = _WORTH_LOOKING * np.array(before.looked_for.get(name, (0, 0)))
    return before.alignments[name] if (np.array([len(world), len(session)]) < most).all() else None


def _as_given(start: Float, world: Session, session: Session) -> Alignment | None:
    """The place of a robot whose start is given, as far as maps say nothing else; None: it is to be looked for."""
    found = align_near(world, session, start)
    if found.state == "aligned":
        return replace(found, reason=f"its start is given; {found.way:.0f} m of way in common agree")
    if found.way < LEAST_WAY_M or found.state == "ambiguous":
        return _given(start, session, "its start is given; too little is in common to judge it")
    return None


def _wrong_start(found: Alignment) -> str:
    wrong = "the start that is given does not hold"
    return f"{wrong}: it was found elsewhere" if found.state == "aligned" else f"{wrong}, and {found.reason}"


def _loops_between(both: Session, maps: int) -> int:
    """How many loops there are between the first so many local maps and the others."""
    return int(np.count_nonzero((both.loops[:, 0] < maps) & (both.loops[:, 1] >= maps)))


def _recognized(found: Alignment, loops: int) -> Alignment:
    """An alignment, rejected where too few places of one map were recognized in the other."""
    needed = math.ceil(found.way / _WAY_A_LOOP_M)
    if loops >= needed:
        return found
    reason = f"in {found.way:.0f} m of way in common {loops} places were recognized only, {needed} are needed"
    return replace(found, state="rejected", reason=reason)


def _rank(session: Session) -> tuple[bool, float, bytes, bytes]:
    """Who is first: of those that have driven far enough to be found in, that which began first.

    What began at the same time is told apart by its first scan.
    """
    short = bool(session.ways[-1] < LEAST_WAY_M)
    return short, float(session.stamps[0]), session.points[0].tobytes(), _digest(session)


def _digest(session: Session) -> bytes:
    """Something to sort sessions by that began alike."""
    return hashlib.sha256(session.points.tobytes() + session.poses.tobytes()).digest()


def _moved(session: Session, T: Float) -> Session:
    return replace(session, poses=se2.compose(T, session.poses))


def _given(T: Float, session: Session, reason: str) -> Alignment:
    return Alignment("aligned", reason, T, 0.0, 1.0, np.diag(_GIVEN_SIGMA**2), np.arange(len(session), dtype=np.int64))
