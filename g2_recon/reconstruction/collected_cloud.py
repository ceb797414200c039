# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The cloud that comes bit by bit, in which points are replaced when their maker knows better."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field

from g2_recon.geometry.cloud import ALL_PIECES, Cloud, Piece, concatenate


@dataclass(frozen=True, slots=True)
class Part:
    """Points that belong together. As long as their version is the same, points are only added, behind those before."""

    version: int
    cloud: Cloud


@dataclass(slots=True)
class _Parts:
    """The points of one piece so far; without any where they were left out on purpose."""

    revision: int
    clouds: list[Cloud]
    left_out: bool = False
    version: int = 0

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
    """

    def __init__(self) -> None:
        self._plain = _Parts(0, [])
        self._sources: dict[tuple[str, int], _Source] = {}
        self._count = self._versions = 0

    def __len__(self) -> int:
        return self._count

    def add(self, cloud: Cloud, piece: Piece | None = None, *, topic: str = "", leave_out: bool = False) -> str:
        """Take in points in the map frame; why they are not used, empty if they are.

        leave_out: do not take in new points, but replace those that are there.
        """
        if piece is None:
            if leave_out:
                return "left out"
            self._plain.clouds.append(cloud)
            self._count += len(cloud)
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
        if known is None or piece.revision > known.revision:
            self._count -= 0 if known is None else sum(map(len, known.clouds))
            known = source.pieces[piece.number] = _Parts(piece.revision, [], version=self._new_version())
        known.clouds.append(cloud)
        self._count += len(cloud)
        return ""

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

    def _new_version(self) -> int:
        self._versions += 1
        return self._versions

    def _forget(self, source: _Source, first: int) -> None:
        self._count -= sum(len(cloud) for parts in source.pieces.values() for cloud in parts.clouds)
        source.pieces = {}
        source.first = max(first, source.first)
