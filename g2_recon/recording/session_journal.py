# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A mapping session in a journal: it grows with the map, and after a crash it is there up to the last scan."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.session import FARTHEST_M, LastScan, ScanPoses, Session, SessionGrowth, widened
from g2_recon.recording.journal import Journal
from g2_recon.recording.npz import Layout
from g2_recon.recording.records import pack, unpack
from g2_recon.recording.sessions import MOST_BYTES

Arrays = dict[str, NDArray[Any]]

_KEYFRAMES, _POSES, _GRAPH, _SCANS, _LAST = 1, 2, 3, 4, 5
OF_SCANS: Layout = {
    "points": ("<f4", ("K", "B", 2)),
    "normals": ("<f4", ("K", "B", 2)),
    "kinds": ("|u1", ("K", "B")),
    "firsts": ("<f8", ("K",)),
    "increments": ("<f8", ("K",)),
    "ways": ("<f8", ("K",)),
    "wheel_steps": ("<f8", ("K", 3)),
    "broken": ("|u1", ("K",)),
}
"""What does not change of K keyframes any more, but for their stamps; see Session."""

OF_GRAPH: Layout = {
    "local_maps": ("<i8", ("C",)),
    "loops": ("<i8", ("L", 2)),
    "loop_information": ("<f8", ("L", 3, 3)),
}
"""Local maps and loops; see Session."""

_OF_KEYFRAMES: Layout = {"stamps": ("<f8", ("K",)), "poses": ("<f8", ("K", 3)), **OF_SCANS}
_LAYOUTS: dict[int, Layout] = {
    _KEYFRAMES: {"first": ("<i8", (1,)), **_OF_KEYFRAMES},
    _POSES: {"first": ("<i8", (1,)), "poses": ("<f8", ("K", 3))},
    _GRAPH: OF_GRAPH,
    _SCANS: {"stamps": ("<f8", ("S",)), "owners": ("<i8", ("S",)), "offsets": ("<f8", ("S", 3))},
    _LAST: {"stamp": ("<f8", (1,)), "pose": ("<f8", (3,)), "odometry": ("<f8", (3,))},
}
_OF_BEAMS = ("points", "normals", "kinds")
_BYTES_A_BEAM = 17
# So many keyframes are in one record at most.
_TOGETHER = 1000
# While the robot stands, its scan is noted so often, s.
_STANDING_S = 1.0


class SessionJournal:
    """Writes what is new in a session, and only that; reads what there is when it is opened."""

    def __init__(self, journal: Journal) -> None:
        """Read a journal: `session` is None where it has no keyframe, `last` where it has no scan.

        left_out: how many records were unusable.

        Raises JournalError as a Journal does, and InputError where records that fit each other are no session.
        """
        self._journal = journal
        found = _Found()
        self.left_out = journal.damaged
        for payload in journal.records():
            if self.left_out > journal.damaged:
                # What counts keyframes cannot be used behind one that is missing.
                self.left_out += 1
                continue
            try:
                found.take(*unpack(payload, _LAYOUTS))
            except InputError:
                self.left_out += 1
        self.session = found.session()
        self.scans = found.scan_poses()
        self.last = found.last
        if self.left_out:
            self._journal.keep_copy()
        self._rewrite()

    def begin(self, session: Session) -> None:
        """Begin anew in a map that there is already. Raises JournalError."""
        self.clear()
        self.session = session
        self._rewrite()

    def _rewrite(self) -> None:
        """Put few records in the place of many, so that starts do not take longer and longer."""
        self._poses = np.empty((0, 3)) if self.session is None else self.session.poses.copy()
        self._scan_count = len(self.scans)
        self._noted = -np.inf
        self._journal.rewrite(_records_of(self.session, self.scans, self.last))

    @property
    def keyframes(self) -> int:
        """How many keyframes are in it."""
        return len(self._poses)

    @property
    def scan_count(self) -> int:
        """How many scans are in it."""
        return self._scan_count

    def write(self, growth: SessionGrowth) -> None:
        """Append what has come since there were `keyframes` and `scan_count`. Raises JournalError."""
        self._write_keyframes(growth)
        if len(growth.scans):
            self._journal.append(_scan_record(growth.scans))
        self._scan_count += len(growth.scans)
        if len(growth.scans) or growth.last.stamp >= self._noted + _STANDING_S:
            self._journal.append(_last_record(growth.last))
            self._noted = growth.last.stamp

    def _write_keyframes(self, growth: SessionGrowth) -> None:
        known = self._poses
        moved = np.flatnonzero((growth.poses[: len(known)] != known).any(axis=1))
        if len(moved):
            first, end = int(moved[0]), int(moved[-1]) + 1
            arrays = {"first": np.array([first]), "poses": growth.poses[first:end]}
            self._journal.append(pack(_POSES, _LAYOUTS[_POSES], arrays))
        if len(growth.stamps):
            new = {name: getattr(growth, name) for name in _OF_KEYFRAMES} | {"poses": growth.poses[growth.first :]}
            for payload in _keyframe_records(growth.first, new):
                self._journal.append(payload)
        if growth.graph is not None:
            self._journal.append(_graph_record(*growth.graph))
        self._poses = growth.poses

    def clear(self) -> None:
        """Forget all, for a new map. Raises JournalError."""
        self._journal.clear()
        self.session, self.scans, self.last = None, _NO_SCANS, None
        self._poses, self._scan_count, self._noted = np.empty((0, 3)), 0, -np.inf


class _Found:
    """What the records say, one after the other; each is refused that does not fit those before."""

    def __init__(self) -> None:
        self._keyframes: list[Arrays] = []
        self._count = self._beams = 0
        self._poses = np.empty((0, 3))
        self._graph: Arrays = {}
        self._scans: list[Arrays] = []
        self.last: LastScan | None = None

    def take(self, kind: int, arrays: Arrays) -> None:
        if kind == _KEYFRAMES:
            self._take_keyframes(arrays)
        elif kind == _POSES:
            first, count = int(arrays["first"][0]), len(arrays["poses"])
            if not 0 <= first <= first + count <= self._count:
                raise InputError("are poses of keyframes that are not there")
            self._poses[first : first + count] = arrays["poses"]
        elif kind == _GRAPH:
            if (arrays["local_maps"] >= self._count).any():
                raise InputError("are local maps of keyframes that are not there")
            self._graph = arrays
        elif kind == _LAST:
            _check_numbers(arrays["stamp"], arrays["pose"], arrays["odometry"][~np.isnan(arrays["odometry"])])
            self.last = LastScan(float(arrays["stamp"][0]), arrays["pose"], arrays["odometry"])
        else:
            _check_scans(arrays, self._count)
            self._scans.append(arrays)

    def _take_keyframes(self, arrays: Arrays) -> None:
        count, beams = arrays["kinds"].shape
        if arrays["first"][0] != self._count or not count:
            raise InputError("are not the keyframes that come next")
        if (self._count + count) * max(self._beams, beams) * _BYTES_A_BEAM > MOST_BYTES:
            raise InputError(f"are more keyframes than fit in {MOST_BYTES} bytes")
        self._keyframes.append(arrays)
        self._count += count
        self._beams = max(self._beams, beams)
        self._poses = np.concatenate([self._poses, arrays["poses"]])

    def session(self) -> Session | None:
        """Raises InputError where it is none."""
        if not self._count:
            return None
        joined = {
            name: np.concatenate([self._padded(name, part[name]) for part in self._keyframes]) for name in _OF_KEYFRAMES
        }
        if (joined["broken"] > 1).any():
            raise InputError("broken of a session is neither true nor false")
        graph = {
            "local_maps": np.zeros(1, np.int64),
            "loops": np.empty((0, 2), np.int64),
            "loop_information": np.empty((0, 3, 3)),
        }
        graph |= {name: array.copy() for name, array in self._graph.items()}
        return Session(**(joined | graph | {"poses": self._poses, "broken": joined["broken"].astype(bool)}))

    def _padded(self, name: str, array: NDArray[Any]) -> NDArray[Any]:
        """With as many beams as the largest scan has."""
        if name not in _OF_BEAMS or array.shape[1] == self._beams:
            return array
        return widened(array, self._beams)

    def scan_poses(self) -> ScanPoses:
        if not self._scans:
            return _NO_SCANS
        joined = {name: np.concatenate([part[name] for part in self._scans]) for name in _LAYOUTS[_SCANS]}
        return ScanPoses(**joined)


_NO_SCANS = ScanPoses(np.empty(0), np.empty(0, np.int64), np.empty((0, 3)))


def _check_scans(arrays: Arrays, keyframes: int) -> None:
    _check_numbers(arrays["stamps"], arrays["offsets"])
    if not ((arrays["owners"] >= -1) & (arrays["owners"] < keyframes)).all():
        raise InputError("are scans of keyframes that are not there")


def _check_numbers(stamps: NDArray[Any], *poses: NDArray[Any]) -> None:
    if not ((np.abs(stamps) <= 1e15).all() and all((np.abs(pose) <= FARTHEST_M).all() for pose in poses)):
        raise InputError("are scans whose numbers are not finite or absurdly large")


def _records_of(session: Session | None, scans: ScanPoses, last: LastScan | None) -> Iterator[bytes]:
    if session is not None:
        yield from _keyframe_records(0, {name: getattr(session, name) for name in _OF_KEYFRAMES})
        yield _graph_record(session.local_maps, session.loops, session.loop_information)
    if len(scans):
        yield _scan_record(scans)
    if last is not None:
        yield _last_record(last)


def _keyframe_records(first: int, arrays: Arrays) -> Iterator[bytes]:
    for begin in range(0, len(arrays["stamps"]), _TOGETHER):
        part = {name: array[begin : begin + _TOGETHER] for name, array in arrays.items()}
        yield pack(_KEYFRAMES, _LAYOUTS[_KEYFRAMES], part | {"first": np.array([first + begin])})


def _graph_record(local_maps: NDArray[Any], loops: NDArray[Any], information: NDArray[Any]) -> bytes:
    arrays = {"local_maps": local_maps, "loops": loops, "loop_information": information}
    return pack(_GRAPH, _LAYOUTS[_GRAPH], arrays)


def _scan_record(scans: ScanPoses) -> bytes:
    return pack(_SCANS, _LAYOUTS[_SCANS], {"stamps": scans.stamps, "owners": scans.owners, "offsets": scans.offsets})


def _last_record(last: LastScan) -> bytes:
    arrays = {"stamp": np.array([last.stamp]), "pose": last.pose, "odometry": last.odometry}
    return pack(_LAST, _LAYOUTS[_LAST], arrays)
