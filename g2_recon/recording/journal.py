# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Journals: files that records are only ever appended to, so that nothing is lost when their writer is killed.

A record is a head of 12 bytes and its payload. The head is three little-endian numbers of 4 bytes: length of the
payload, CRC-32 of the payload, CRC-32 of the two numbers before. A length is so believed only if the head is whole, and
a payload only if it is, too.

A record is with the operating system when `append` returns: whoever kills the process takes away at most the record
that was being written. `sync` brings all of it to the disk: a failure of power takes away what came since.
"""

from __future__ import annotations

import fcntl
import glob
import os
import stat
import struct
from collections.abc import Container, Iterable, Iterator
from contextlib import suppress
from itertools import count
from pathlib import Path
from threading import RLock
from typing import NamedTuple, NoReturn
from uuid import uuid4
from zlib import crc32

from g2_recon.errors import JournalError

MOST_BYTES = 1 << 28
"""No payload is longer; what claims to be is damaged."""

_MAGIC = b"g2recon journal 1\n"
_NUMBERS = struct.Struct("<II")
_CHECK = struct.Struct("<I")
_HEAD_BYTES = _NUMBERS.size + _CHECK.size
# Of the names of files beside.
_NAME_DIGITS = 8


class Span(NamedTuple):
    """Where a record lies in its file, bytes."""

    begin: int
    end: int

    @property
    def size(self) -> int:
        """How many bytes it takes."""
        return self.end - self.begin


class Copy:
    """Records of a journal, but for some, on their way to a file beside.

    until: where what is appended meanwhile begins. places: where each record lies now, by where it began.
    """

    def __init__(self, path: Path, file: int, until: int, left_out: Container[int]) -> None:
        """file: of the journal, opened for this copy. left_out: where the others begin."""
        self.until = until
        self.places: dict[int, Span] = {}
        self._left_out, self._file = left_out, file
        self._beside = _beside(path)
        self.journal: Journal | None = None

    def write(self) -> None:
        """Write it, in any thread. Raises JournalError."""
        try:
            self.journal = Journal(self._beside)
            for payload, span in _whole(self._file, self.until, len(_MAGIC)):
                if span.begin not in self._left_out:
                    self.places[span.begin] = self.journal.append(payload)
            self.journal.sync()
        except OSError as error:
            self.discard()
            raise JournalError(f"cannot be read: {error.strerror or error}", where=self._beside) from error
        except BaseException:
            self.discard()
            raise

    def discard(self) -> None:
        """Give it up, or what is left of it once it was adopted."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1
        if self.journal is not None:
            self.journal.close()
        self.journal = None
        with suppress(OSError):
            self._beside.unlink(missing_ok=True)


class Journal:
    """A journal that one process at a time has open, to read what is in it and to append to it."""

    def __init__(self, path: str | Path) -> None:
        """Open a journal; folders and file are made where there are none.

        What a torn last record left behind is cut off. What lies behind other damage cannot be read any more: it is
        kept beside, in a file of the same name with the ending `.damaged`. Raises JournalError where the file system
        refuses, the file is none of ours, or another process has it open.
        """
        self.path = Path(path)
        # `sync` may run in another thread; its file must not be closed under its hands.
        self._changing = RLock()
        self._file = self._open()
        try:
            self._end, self.damaged = self._check()
        except BaseException:
            self.close()
            raise
        # Of a writer that was killed while it wrote a copy.
        for left in self.path.parent.glob(f".{glob.escape(self.path.name)}.{'[0-9a-f]' * _NAME_DIGITS}"):
            with suppress(OSError):
                left.unlink()

    def _open(self) -> int:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)
        except OSError as error:
            self._refuse(error)
        try:
            if not stat.S_ISREG(os.fstat(file).st_mode):
                raise JournalError("is no file", where=self.path, advice="choose another folder")
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(file)
            raise JournalError(
                "is in use by another process", where=self.path, advice="give each robot a folder of its own"
            ) from None
        except BaseException:
            os.close(file)
            raise
        return file

    def _check(self) -> tuple[int, int]:
        """Where the sound part ends, and how many records in it are damaged; what is behind it is moved away."""
        try:
            size = os.fstat(self._file).st_size
            start = os.pread(self._file, len(_MAGIC), 0)
            if len(start) < len(_MAGIC) and _MAGIC.startswith(start):
                # New, or its writer was killed when it was.
                os.ftruncate(self._file, 0)
                self._write(_MAGIC, 0)
                return len(_MAGIC), 0
            if start != _MAGIC:
                raise JournalError("is no journal", where=self.path, advice="choose another folder")
            end, damaged = len(_MAGIC), 0
            for payload, behind in _records(self._file, size):
                damaged += payload is None
                end = behind
            if _is_damaged(self._file, end, size):
                self._keep_beside(end, size)
                damaged += 1
            os.ftruncate(self._file, end)
        except OSError as error:
            self._refuse(error)
        return end, damaged

    def keep_copy(self) -> None:
        """Copy the journal beside, as before something in it is given up. Raises JournalError."""
        try:
            self._keep_beside(0, self._end)
        except OSError as error:
            self._refuse(error)

    def _keep_beside(self, begin: int, end: int) -> None:
        names = (self.path.with_name(f"{self.path.name}.damaged{number or ''}") for number in count())
        with next(name for name in names if not name.exists()).open("xb") as copy:
            os.lseek(self._file, begin, os.SEEK_SET)
            while piece := os.read(self._file, min(1 << 20, end - begin - copy.tell())):
                copy.write(piece)

    def records(self) -> Iterator[bytes]:
        """The payloads of all records that are whole, in the order in which they were appended.

        Raises JournalError where the file cannot be read.
        """
        for payload, _ in self.located():
            yield payload

    def located(self) -> Iterator[tuple[bytes, Span]]:
        """As `records`, with where each lies."""
        try:
            yield from _whole(self._file, self._end, len(_MAGIC))
        except OSError as error:
            self._refuse(error)

    def append(self, payload: bytes) -> Span:
        """Append a record; where it lies. Raises JournalError where the disk is full or the file system refuses.

        The journal is then as it was before.
        """
        if len(payload) > MOST_BYTES:
            raise JournalError(f"a record of {len(payload)} bytes is too long", where=self.path)
        numbers = _NUMBERS.pack(len(payload), crc32(payload))
        record = numbers + _CHECK.pack(crc32(numbers)) + payload
        try:
            self._write(record, self._end)
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(self._file, self._end)
            self._refuse(error)
        begin, self._end = self._end, self._end + len(record)
        return Span(begin, self._end)

    def sync(self) -> None:
        """Wait until all that was appended is on the disk. Raises JournalError where the file system refuses."""
        with self._changing:
            if self._file < 0:
                return
            try:
                os.fdatasync(self._file)
            except OSError as error:
                self._refuse(error)

    def rewrite(self, payloads: Iterable[bytes]) -> None:
        """Put these records in the place of all, at once: a killed writer leaves either. Raises JournalError.

        That of `append`; the journal is then as it was before.
        """
        beside = _beside(self.path)
        try:
            new = Journal(beside)
            try:
                for payload in payloads:
                    new.append(payload)
                new.sync()
                beside.replace(self.path)
            except BaseException:
                new.close()
                raise
        except OSError as error:
            self._refuse(error)
        finally:
            with suppress(OSError):
                beside.unlink(missing_ok=True)
        with self._changing:
            os.close(self._file)
            self._file, self._end, self.damaged = new._file, new._end, 0

    def copy_without(self, left_out: Container[int]) -> Copy:
        """A copy of the records but for those that begin there, to be written while others are appended, and adopted.

        Whoever writes it discards it where it is not adopted.
        """
        return Copy(self.path, os.dup(self._file), self._end, left_out)

    def adopt(self, copy: Copy) -> dict[int, Span]:
        """Put a copy that is written, and what was appended since it was begun, in the place of all, at once.

        Where its records lie now, by where they began. Raises JournalError; the journal is then as it was before.
        """
        new = copy.journal
        if new is None:
            raise JournalError("the copy was not written", where=self.path)
        try:
            for payload, span in _whole(self._file, self._end, copy.until):
                copy.places[span.begin] = new.append(payload)
            new.path.replace(self.path)
        except OSError as error:
            copy.discard()
            self._refuse(error)
        except BaseException:
            copy.discard()
            raise
        with self._changing:
            os.close(self._file)
            self._file, self._end, self.damaged = os.dup(new._file), new._end, 0
        copy.discard()
        return copy.places

    def clear(self) -> None:
        """Begin anew; what there was is kept beside, in a file of the same name with the ending `.before`.

        Raises JournalError where the file system refuses.
        """
        try:
            self.path.replace(self.path.with_name(self.path.name + ".before"))
        except OSError as error:
            self._refuse(error)
        with self._changing:
            self.close()
            self._file = self._open()
            self._end, self.damaged = self._check()

    def close(self) -> None:
        """Close the file, so that another process may open it."""
        with self._changing:
            if self._file >= 0:
                os.close(self._file)
            self._file = -1

    def _write(self, content: bytes, begin: int) -> None:
        view = memoryview(content)
        while view:
            written = os.pwrite(self._file, view, begin)
            begin, view = begin + written, view[written:]

    def _refuse(self, error: OSError) -> NoReturn:
        raise JournalError(
            f"cannot be written: {error.strerror or error}",
            where=self.path,
            advice="choose another folder or make room",
        ) from error


def _beside(path: Path) -> Path:
    """A name that no other file has."""
    return path.with_name(f".{path.name}.{uuid4().hex[:_NAME_DIGITS]}")


def _whole(file: int, size: int, begin: int) -> Iterator[tuple[bytes, Span]]:
    """The records from one on that are not damaged."""
    for payload, end in _records(file, size, begin):
        if payload is not None:
            yield payload, Span(begin, end)
        begin = end


def _records(file: int, size: int, begin: int = len(_MAGIC)) -> Iterator[tuple[bytes | None, int]]:
    """Payload of each record, None for one that is damaged, and where it ends; up to where no head is whole."""
    while length := _payload_length(file, begin, size):
        payload = os.pread(file, length[0], begin + _HEAD_BYTES)
        begin += _HEAD_BYTES + length[0]
        yield (payload if len(payload) == length[0] and crc32(payload) == length[1] else None), begin


def _payload_length(file: int, begin: int, size: int) -> tuple[int, int] | None:
    """Length and checksum that the head at `begin` states; None where there is no whole record."""
    head = os.pread(file, _HEAD_BYTES, begin)
    if not _is_head(head):
        return None
    length, checksum = _NUMBERS.unpack_from(head)
    return (length, checksum) if begin + _HEAD_BYTES + length <= size else None


def _is_head(head: bytes) -> bool:
    if len(head) < _HEAD_BYTES or crc32(head[: _NUMBERS.size]) != _CHECK.unpack_from(head, _NUMBERS.size)[0]:
        return False
    return bool(_NUMBERS.unpack_from(head)[0] <= MOST_BYTES)


def _is_damaged(file: int, begin: int, size: int) -> bool:
    """Whether what lies at `begin` is something else than the beginning of a record, as a killed writer leaves it."""
    head = os.pread(file, _HEAD_BYTES, begin)
    return len(head) == _HEAD_BYTES and not _is_head(head)
