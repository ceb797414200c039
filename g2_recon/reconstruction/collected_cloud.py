# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The cloud that comes bit by bit, in which points are replaced when their maker knows better.

A robot that drives through rooms that it knows sends points of the same surfaces again and again. Where there are
enough, others are not kept, so that memory grows with the surfaces and not with time.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass, field

from g2_recon.geometry.cloud import ALL_PIECES, Cloud, Piece, concatenate
from g2_recon.geometry.voxels import VoxelCounts, numbers_of_same_side, sided_voxel_numbers

# Of so many latest pieces all points are kept, whatever the others have: their places are the least sure, and a robot
# that turns in a room on its first visit sees much of it twice.
_LATEST = 30


@dataclass(frozen=True, slots=True)
class Part:
    """Points that belong together. As long as their version is the same, points are only added, behind those before."""

    version: int
    cloud: Cloud


@dataclass(slots=True)
class _Parts:
    """The points of one piece so far; without any where they were left out on purpose.

    redundant: how many were not kept. settled: whether they are in the counts.
    """

    revision: int
    clouds: list[Cloud]
    left_out: bool = False
    version: int = 0
    redundant: int = 0
    settled: bool = False

    def merged(self) -> Cloud:
        if len(self.clouds) > 1:
            self.clouds = [concatenate(self.clouds)]
        return self.clouds[0] if self.clouds else concatenate([])


@dataclass(slots=True)
class _Source:
    """What one maker sent: its pieces by number. Those before `first` are forgotten for good."""

    pieces: dict[int, _Parts] = field(default_factory=dict)
    first: int = 0


class CollectedCloud:
    """Points in the order in which they came; those of a piece are replaced by a newer revision of it.

    Messages may come in any order, twice, or not at all: of each piece the newest revision counts that has come.

    A point is not kept where pieces before the latest ones have `enough` points in the cube of `edge` metres that it
    lies in, seen from the same side. A piece is what came with one number or, without any, in one message.

    redundant: how many points of the pieces there are were not kept.
    """

    def __init__(self, edge: float = 1.0, enough: float = math.inf) -> None:
        """edge: of the cubes in m. enough: points in one."""
        self._edge, self._enough = edge, enough
        self._sources: dict[tuple[str, int], _Source] = {}
        self._count = self._versions = self.redundant = 0
        self._plain = _Parts(0, [])
        self._latest: deque[_Parts] = deque()
        self._counts = VoxelCounts()

    def __len__(self) -> int:
        return self._count

    def add(self, cloud: Cloud, piece: Piece | None = None, *, topic: str = "", leave_out: bool = False) -> str:
        """Take in points in the map frame; why they are not used, empty if they are.

        leave_out: do not take in new points, but replace those that are there.
        """
        if piece is None:
            if leave_out:
                return "left out"
            alone = self._begin(_Parts(0, []))
            self._keep(alone, cloud)
            self._plain.clouds += alone.clouds
            return ""
        source = self._sources.setdefault((topic, piece.source), _Source())
        if piece.number == ALL_PIECES:
            self._forget(source, ALL_PIECES)
            return ""
        if piece.number < source.first:
            return "of a piece that was forgotten"
        known = source.pieces.get(piece.number)
        if known is not None and piece.revision < known.revision:
            return "of an older revision"
        if known is not None and known.left_out:
            return "left out"
        new = known is None or piece.revision == known.revision
        if leave_out and new:
            if known is None:
                source.pieces[piece.number] = _Parts(piece.revision, [], left_out=True)
            return "left out"
        if known is None:
            known = source.pieces[piece.number] = self._begin(_Parts(piece.revision, []))
        elif piece.revision > known.revision:
            self._lose(known)
            known.revision = piece.revision
        else:
            return self._keep(known, cloud)
        known.version = self._new_version()
        return self._keep(known, cloud)

    def cloud(self) -> Cloud:
        """All points there are: first those that are of no piece, then piece by piece."""
        return concatenate([part.cloud for part in self.parts().values()])

    def parts(self) -> dict[Hashable, Part]:
        """The same, part by part: to tell what has changed since another time, compare versions and lengths."""
        parts: dict[Hashable, _Parts] = {None: self._plain}
        for name, source in self._sources.items():
            parts |= {(name, number): source.pieces[number] for number in sorted(source.pieces)}
        merged = {key: Part(part.version, part.merged()) for key, part in parts.items()}
        return {key: part for key, part in merged.items() if len(part.cloud)}

    def clear(self) -> None:
        """Forget all points. Of each source, pieces before the latest are not taken in again."""
        self._count -= sum(map(len, self._plain.clouds))
        self._plain = _Parts(0, [], version=self._new_version())
        for source in self._sources.values():
            # What was measured since then may belong to the latest one.
            self._forget(source, max(source.pieces, default=source.first))
        self._latest.clear()
        self._counts, self.redundant = VoxelCounts(), 0

    def _begin(self, parts: _Parts) -> _Parts:
        """A new piece; the oldest of the latest ones counts from now on."""
        self._latest.append(parts)
        if len(self._latest) > _LATEST:
            old = self._latest.popleft()
            old.settled = True
            self._count_in(old.clouds)
        return parts

    def _keep(self, parts: _Parts, cloud: Cloud) -> str:
        """Take those of the points into a piece that there are not enough of yet."""
        few = self._counts.of(numbers_of_same_side(cloud, self._edge)).sum(axis=0) < self._enough
        kept = cloud if few.all() else cloud.select(few)
        if len(kept):
            parts.clouds.append(kept)
        parts.redundant += len(cloud) - len(kept)
        self.redundant += len(cloud) - len(kept)
        self._count += len(kept)
        if parts.settled:
            self._count_in([kept])
        return ""

    def _lose(self, parts: _Parts) -> None:
        """The points of a piece are gone."""
        self._count -= sum(map(len, parts.clouds))
        self.redundant -= parts.redundant
        if parts.settled:
            self._count_in(parts.clouds, -1)
        parts.clouds, parts.redundant = [], 0

    def _count_in(self, clouds: list[Cloud], times: int = 1) -> None:
        for cloud in clouds:
            self._counts.add(sided_voxel_numbers(cloud, self._edge), times)

    def _new_version(self) -> int:
        self._versions += 1
        return self._versions

    def _forget(self, source: _Source, first: int) -> None:
        for parts in source.pieces.values():
            self._lose(parts)
        source.pieces = {}
        source.first = max(first, source.first)
