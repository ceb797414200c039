# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Opening bags of every kind by rosbags, so that whatever is wrong with one ends in one InputError.

rosbags lets what its parsers meet on a damaged file through: its own errors, but also struct.error, TypeError,
AssertionError, KeyError, apsw.Error, MemoryError and more. Its calls are therefore guarded here by catching Exception;
the code of this package is not.
"""

from __future__ import annotations

import logging
import shutil
import struct
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rosbags import rosbag1
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import Connection, ConnectionExtRosbag1, Nodetype, QosDurability, QosReliability
from rosbags.rosbag1.reader import IndexData
from rosbags.typesys import Stores, get_typestore

from g2_recon.errors import InputError
from g2_recon.recording.files import check_exists

BAG_ENDINGS = (".mcap", ".db3", ".bag")

_log = logging.getLogger(__name__)

_SAME_TYPES = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}
_MAX_FAULT_LENGTH = 200
_MAX_TOPICS_TOLD = 30
_MCAP_MAGIC = b"\x89MCAP0\r\n"
_MCAP_RECORD = struct.Struct("<BQ")
_MCAP_FOOTER, _MCAP_DATA_END = 0x02, 0x0F
# A data end without checksum and a footer without summary: readers then scan the file.
_MCAP_END = _MCAP_RECORD.pack(_MCAP_DATA_END, 4) + bytes(4) + _MCAP_RECORD.pack(_MCAP_FOOTER, 20) + bytes(20)


@dataclass(frozen=True, slots=True)
class RecordedQos:
    """The quality of service a topic was recorded with, as far as a replay needs it."""

    reliable: bool
    transient_local: bool
    depth: int


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """One message of a bag as it went over the wire.

    topic: with its leading slash. msgtype: such as "sensor_msgs/msg/LaserScan". stamp_ns: when it was received,
    nanoseconds. cdr: the message as ROS 2 serializes it, with encapsulation header. qos: None where not recorded.
    """

    topic: str
    msgtype: str
    stamp_ns: int
    cdr: bytes
    qos: RecordedQos | None


@dataclass
class OpenBag:
    """A bag while it is open. complaints: what could not be read, filled while reading."""

    path: Path
    reader: AnyReader
    complaints: list[str] = field(default_factory=list)
    _is_as_expected: dict[str, bool] = field(default_factory=dict)

    @property
    def connections(self) -> list[Connection]:
        """The topics of the bag, one entry a publisher."""
        return self.reader.connections

    def describe(self) -> str:
        """The topics and their types, and what could not be read, as part of one line."""
        topics = sorted({f"{connection.topic} ({connection.msgtype})" for connection in self.connections})
        listed = ", ".join(topics[:_MAX_TOPICS_TOLD]) + (" ..." if len(topics) > _MAX_TOPICS_TOLD else "")
        return "; ".join([f"its topics: {listed or 'none'}", *self.complaints])

    def messages(self, connections: Collection[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """Connection, receive time in nanoseconds and raw message; ends with a complaint at a damaged place."""
        if not connections:
            return
        stream = self.reader.messages(list(connections))
        while True:
            try:
                message = next(stream)
            except StopIteration:
                return
            except Exception as error:
                _log.warning("%s: damaged, the messages from here on are lost: %s", self.path, _describe(error))
                self.complaints.append("damaged place in the bag (the messages after it are lost)")
                return
            yield message

    def decode(self, raw: bytes, msgtype: str) -> Any | None:
        """The message as an object with the fields of its type; None if it is damaged or of another definition."""
        try:
            if msgtype not in self._is_as_expected:
                self._is_as_expected[msgtype] = _has_fields(self.reader.typestore, msgtype)
            return self.reader.deserialize(raw, msgtype) if self._is_as_expected[msgtype] else None
        except Exception as error:
            _log.debug("%s: a %s cannot be decoded: %s", self.path, msgtype, _describe(error))
            return None

    def use_file_order(self) -> None:
        """Read a ROS 1 bag in the order in which it was written.

        Some were converted from logs whose stamps step backwards: by time, which those bags took from the stamps,
        their messages are out of order.
        """
        for reader in self.reader.readers:
            if isinstance(reader, rosbag1.Reader):
                for index in reader.indexes.values():
                    index[:] = sorted(_InFileOrder(*entry) for entry in index)


def _has_fields(store: Any, msgtype: str) -> bool:
    """True if a message type of a bag has the fields that it has in ROS 2 Jazzy; ROS 1 has more in some."""
    stated = dict(store.fielddefs[msgtype][1])
    for name, kind in jazzy_types().fielddefs[_SAME_TYPES.get(msgtype, msgtype)][1]:
        if stated.get(name) != kind:
            return False
        item = kind[1][0] if kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) else kind
        if item[0] == Nodetype.NAME and not _has_fields(store, item[1]):
            return False
    return True


class _InFileOrder(IndexData):
    """Where a message is in a ROS 1 bag; by this, instead of by time, rosbags then merges the topics."""

    __slots__ = ()
    __hash__ = IndexData.__hash__

    def __lt__(self, other: tuple[int, ...]) -> bool:
        return self[1:] < other[1:]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, tuple) and self[1:] == other[1:]


@contextmanager
def open_bag(path: str | Path) -> Iterator[OpenBag]:
    """Open a rosbag2 directory, a single .mcap or .db3 file, or a ROS 1 .bag file.

    A bag whose recorder was killed (MCAP without its index, directory without metadata.yaml) is opened as far as it
    can be read, with a complaint. Raises InputError if the path does not exist, is no bag, or nothing can be read.
    """
    source = Path(path)
    files = _storage_files(source)
    with TemporaryDirectory(prefix="g2_recon_") as scratch:
        reader, complaint = _open_reader(source, files, Path(scratch))
        try:
            yield OpenBag(source, reader, [complaint] if complaint else [])
        finally:
            reader.close()


def messages(path: str | Path) -> Iterator[RecordedMessage]:
    """All messages of a bag in the order in which they were received.

    Messages of a ROS 1 bag are converted; types that ROS 2 Jazzy's common interfaces do not have are left out, with
    one line in the log. Ends early, with a line in the log, at a damaged place. Raises InputError if the bag cannot be
    opened.
    """
    with open_bag(path) as bag:
        connections = [connection for connection in bag.connections if _is_convertible(bag, connection)]
        qos = {connection.topic: _recorded_qos(connection) for connection in connections}
        for connection, stamp_ns, raw in bag.messages(connections):
            cdr = bytes(raw) if bag.reader.is2 else _to_cdr(raw, connection.msgtype)
            if cdr is not None:
                yield RecordedMessage(connection.topic, connection.msgtype, stamp_ns, cdr, qos[connection.topic])


@cache
def jazzy_types() -> Any:
    """The message types of ROS 2 Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


def _storage_files(source: Path) -> list[Path]:
    """The files that hold the messages."""
    check_exists(source)
    if not source.is_dir():
        if source.suffix.lower() not in BAG_ENDINGS:
            raise InputError("has no ending that a bag has", where=source, advice=f"use {', '.join(BAG_ENDINGS)}")
        if source.stat().st_size == 0:
            raise InputError("the file is empty", where=source, advice="record or copy it again")
        return [source]
    try:
        files = sorted(file for file in source.iterdir() if file.suffix in (".mcap", ".db3"))
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=source, advice="check its permissions") from error
    if not files and not (source / "metadata.yaml").exists():
        raise InputError("is no bag: it has no metadata.yaml, .mcap or .db3", where=source, advice="check the path")
    return files


def _open_reader(source: Path, files: list[Path], scratch: Path) -> tuple[AnyReader, str]:
    """An open reader, and a complaint if it is not of the bag as it is."""
    is_complete = not source.is_dir() or (source / "metadata.yaml").exists()
    fault = "it has no metadata.yaml"
    if is_complete:
        try:
            return _start([source]), ""
        except Exception as error:
            fault = _describe(error)
    try:
        readable = [_mend_mcap(file, scratch) if file.suffix == ".mcap" else file for file in files]
        if source.suffix == ".bag" or not readable or readable == [source]:
            raise InputError(fault)
        reader = _start(readable)
    except Exception as error:
        advice = "'rosbag reindex' may help" if source.suffix == ".bag" else "record or copy it again"
        raise InputError(f"is damaged or no bag: {_describe(error)}", where=source, advice=advice) from None
    _log.warning("%s: not closed properly, reading what is there: %s", source, fault)
    return reader, "bag that was not closed properly (its end may be lost)"


def _start(paths: list[Path]) -> AnyReader:
    reader = AnyReader(paths, default_typestore=jazzy_types())
    reader.open()
    return reader


def _mend_mcap(file: Path, scratch: Path) -> Path:
    """A copy of an MCAP file up to its last complete record, closed; the file itself if it is none."""
    end = _last_complete_record(file)
    if end == 0:
        return file
    mended = scratch / file.name
    shutil.copyfile(file, mended)
    with mended.open("r+b") as stream:
        stream.truncate(end)
        stream.seek(end)
        stream.write(_MCAP_END + _MCAP_MAGIC)
    return mended


def _last_complete_record(file: Path) -> int:
    """Where the last complete record of the data section ends; 0 if there is none."""
    size = file.stat().st_size
    with file.open("rb") as stream:
        if stream.read(len(_MCAP_MAGIC)) != _MCAP_MAGIC:
            return 0
        end = 0
        position = len(_MCAP_MAGIC)
        while len(head := stream.read(_MCAP_RECORD.size)) == _MCAP_RECORD.size:
            kind, length = _MCAP_RECORD.unpack(head)
            position += _MCAP_RECORD.size + length
            if kind in (0, _MCAP_FOOTER, _MCAP_DATA_END) or position > size:
                break
            end = position
            stream.seek(position)
    return end


def _describe(error: Exception) -> str:
    """What went wrong in rosbags, as part of one line."""
    text = f"{error}" if isinstance(error, AnyReaderError | InputError) else f"{type(error).__name__} {error}"
    text = "".join(letter if letter.isprintable() else " " for letter in text)
    return " ".join(text.split())[:_MAX_FAULT_LENGTH]


def _is_convertible(bag: OpenBag, connection: Connection) -> bool:
    if bag.reader.is2 or connection.msgtype in jazzy_types().fielddefs:
        return True
    _log.warning("%s: %s is left out: %s is not known", bag.path, connection.topic, connection.msgtype)
    return False


def _to_cdr(raw: bytes, msgtype: str) -> bytes | None:
    try:
        return bytes(jazzy_types().ros1_to_cdr(raw, msgtype))
    except Exception as error:
        _log.warning("a %s cannot be converted: %s", msgtype, _describe(error))
        return None


def _recorded_qos(connection: Connection) -> RecordedQos | None:
    if isinstance(connection.ext, ConnectionExtRosbag1):
        return RecordedQos(reliable=True, transient_local=bool(connection.ext.latching), depth=10)
    profiles = connection.ext.offered_qos_profiles
    if not profiles:
        return None
    return RecordedQos(
        reliable=profiles[0].reliability != QosReliability.BEST_EFFORT,
        transient_local=profiles[0].durability == QosDurability.TRANSIENT_LOCAL,
        depth=max(profiles[0].depth, 1),
    )
