# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The map merger: sessions of several robots become one map, as if one robot had driven it all."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.collaboration.alignment import Alignment, align
from g2_recon.collaboration.joint_map import joined, refined
from g2_recon.geometry import se2
from g2_recon.geometry.session import Session
from g2_recon.progress import Progress, silent

Float = NDArray[np.float64]

_GIVEN_SIGMA = np.array([0.5, 0.5, 0.1])


@dataclass(frozen=True, slots=True)
class JointMap:
    """One map of several robots.

    session: the keyframes of all robots that are in it, in the order of `rows`, which tells which of them are whose.
    alignments: where the map of each robot lies in it, or why that is not known. The frame is the map frame of the
    first robot in `rows`.
    """

    session: Session
    rows: dict[str, slice]
    alignments: dict[str, Alignment]

    def poses(self, robot: str) -> Float:
        """T_world_laser (N, 3) of the keyframes of a robot that is in the map."""
        return self.session.poses[self.rows[robot]]


def merge(
    sessions: Mapping[str, Session], *, starts: Mapping[str, ArrayLike] | None = None, progress: Progress = silent
) -> JointMap:
    """One map of the sessions of robots, by name; the same in whatever order they are given.

    starts: (3,) world ← <robot>/map where it is known about. The robot that began first, or the first with a start, is
    where the world is. Those whose place is not sure are left out. Raises InputError where a map is too large to
    search.
    """
    known = {name: np.asarray(start, float) for name, start in (starts or {}).items()}
    order = sorted(sessions, key=lambda name: (name not in known, sessions[name].stamps[0], _digest(sessions[name])))
    first = order.pop(0)
    world = _moved(sessions[first], known.get(first, se2.IDENTITY))
    rows = {first: slice(0, len(world))}
    alignments = {first: _given(known.get(first, se2.IDENTITY), sessions[first], "the world is where its map is")}
    waiting = order
    while waiting:
        # Who has found no place may find one when others are in.
        for name in waiting:
            session = sessions[name]
            alignment = (
                _given(known[name], session, "its start is given")
                if name in known
                else align(world, session, progress=progress)
            )
            alignments[name] = alignment
            if alignment.state == "aligned":
                count = len(world)
                world = joined(world, session, alignment.T_fixed_moving, alignment.keyframes)
                rows[name] = slice(count, len(world))
                progress("merging maps", len(rows), len(sessions))
                break
        else:
            break
        waiting = [name for name in waiting if name not in rows]
    return JointMap(refined(world, progress=progress) if len(rows) > 1 else world, rows, alignments)


def _digest(session: Session) -> bytes:
    """Something to sort sessions by that began at the same time."""
    return hashlib.sha256(session.points.tobytes() + session.poses.tobytes()).digest()


def _moved(session: Session, T: Float) -> Session:
    return replace(session, poses=se2.compose(T, session.poses))


def _given(T: Float, session: Session, reason: str) -> Alignment:
    return Alignment("aligned", reason, T, 0.0, 1.0, np.diag(_GIVEN_SIGMA**2), np.arange(len(session), dtype=np.int64))
