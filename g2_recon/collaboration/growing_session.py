# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The session of a robot elsewhere, made up of the parts that it tells; what is lacking can be asked for."""

from __future__ import annotations

from copy import copy

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.session import FARTHEST_M, OF_KEYFRAMES, Session, SessionPart, widened

Float = NDArray[np.float64]

_OF_BEAMS = ("points", "normals", "kinds")
_LATEST = 1e15


class GrowingSession:
    """A session that grows by its parts, which may come twice, in another order, or not at all.

    number: of the session. told: how many keyframes the robot has. last_stamp: s, of its latest scan that is known.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        self.told = 0
        self.last_stamp = -np.inf
        self._keyframes: dict[str, list[NDArray]] = {name: [] for name in OF_KEYFRAMES}
        self._count = 0
        self._last_way = 0.0
        self._poses: Float = np.empty((0, 3))
        self._revision, self._told_revision = -1, -1
        self._graph: tuple[NDArray, NDArray, NDArray] | None = None

    def __len__(self) -> int:
        """How many keyframes are here."""
        return self._count

    @property
    def lacks(self) -> bool:
        """Whether the robot has more than is here, or has it elsewhere."""
        return self._count < self.told or self._revision != self._told_revision

    @property
    def start(self) -> float:
        """Stamp of the first keyframe, s; infinite while there is none."""
        return float(self._keyframes["stamps"][0][0]) if self._count else np.inf

    @property
    def version(self) -> tuple[int, int]:
        """Changes whenever there is something new."""
        return self._count, self._revision

    def take(self, part: SessionPart) -> None:
        """Take in what is new in a part of this session; one that comes late says nothing.

        Raises InputError, and takes nothing, where it is unusable.
        """
        _check(part)
        if part.count < self.told:
            return
        known = self._count - part.first
        if 0 <= known < len(part.stamps):
            self._append(part, known)
        if len(part.poses):
            self._poses, self._revision = part.poses[: self._count], part.revision
            if len(part.local_maps):
                self._graph = part.local_maps, part.loops, part.loop_information
        self.told, self._told_revision = part.count, part.revision
        self.last_stamp = max(self.last_stamp, part.last_stamp)

    def _append(self, part: SessionPart, known: int) -> None:
        new = part.of_rows(slice(known, None))
        poses = part.poses[self._count : part.first + len(part.stamps)]
        # Its own checks are those of a session.
        checked = Session(**new, poses=poses, **_no_loops())
        if checked.ways[0] < self._last_way:
            raise InputError("ways of a session do not grow")
        for name, array in new.items():
            self._keyframes[name].append(array)
        self._count += len(checked)
        self._last_way = float(checked.ways[-1])
        self._poses = np.concatenate([self._poses, poses])

    def snapshot(self) -> GrowingSession:
        """As it is now, for another thread."""
        same = copy(self)
        same._keyframes = {name: list(parts) for name, parts in self._keyframes.items()}
        return same

    def poses(self) -> Float:
        """T_map_laser (N, 3) of the keyframes that are here, as the robot has them."""
        return self._poses

    def stamps(self) -> Float:
        """Of the keyframes (N,), s."""
        return np.concatenate([np.empty(0), *self._keyframes["stamps"]])

    def session(self) -> Session | None:
        """All that is here; None where there is no keyframe. A graph that does not fit is left out."""
        if not self._count:
            return None
        beams = max(array.shape[1] for array in self._keyframes["kinds"])
        keyframes = {
            name: np.concatenate([widened(part, beams) if name in _OF_BEAMS else part for part in parts])
            for name, parts in self._keyframes.items()
        }
        if self._graph is not None:
            begins, loops, information = self._graph
            # Those of local maps whose keyframes have not come yet come later.
            begins = begins[begins < self._count]
            kept = (loops < len(begins)).all(axis=1)
            try:
                return Session(
                    **keyframes,
                    poses=self._poses,
                    local_maps=begins,
                    loops=loops[kept],
                    loop_information=information[kept],
                )
            except InputError:
                self._graph = None
        return Session(**keyframes, poses=self._poses, **_no_loops())


def _check(part: SessionPart) -> None:
    """Raises InputError where numbers are not finite or absurdly large."""
    if not ((np.abs(part.poses) <= FARTHEST_M).all() and abs(part.last_stamp) <= _LATEST and part.count > 0):
        raise InputError("is a part of a session whose numbers are not finite or absurdly large")


def _no_loops() -> dict[str, NDArray]:
    return {
        "local_maps": np.zeros(1, np.int64),
        "loops": np.empty((0, 2), np.int64),
        "loop_information": np.empty((0, 3, 3)),
    }
