# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What nodes have accepted, in journals in their session_dir: a node that was killed goes on where it was.

A journal that cannot be opened or written to any more is said at once, and the node goes on in memory. What was written
survives the end of the process at once; once a second it is brought to the disk, in a thread of its own. Messages that
later ones have replaced are left out of the file now and then.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from rclpy.serialization import deserialize_message, serialize_message

from g2_recon.errors import InputError, JournalError
from g2_recon.nodes.stage_node import StageNode
from g2_recon.recording.journal import Copy, Journal, Span

_SYNC_S = 1.0
# As long as no more was replaced, it may stay.
_FEW_BYTES = 1_000_000
_DISK = ThreadPoolExecutor(1, "journals")


class NodeJournal:
    """A journal of a node, for as long as it can be written to."""

    def __init__(self, node: StageNode, session_dir: str, name: str) -> None:
        """Nothing is opened where there is no session_dir."""
        self.node = node
        self._name = name
        self._syncing: Future[None] | None = None
        self.journal: Journal | None = None
        if session_dir:
            self.journal = self.guarded(lambda: Journal(Path(session_dir).expanduser() / name))
            node.create_timer(_SYNC_S, self._sync, clock=node.steady_clock)

    def guarded(self, action: Callable[[], Any]) -> Any:
        """What an action returns; None, said once, where it fails, and there is no journal any more."""
        try:
            return action()
        except InputError as error:
            if self.journal is not None:
                self.journal.close()
            self.journal = None
            self.node.fail(self._name, f"{error}; nothing is written any more, and the node goes on in memory")
            return None

    def _sync(self) -> None:
        if self._syncing is not None and self._syncing.done() and self._syncing.exception() is not None:
            self.guarded(self._syncing.result)
        if self.journal is not None and (self._syncing is None or self._syncing.done()):
            self._syncing = _DISK.submit(self.journal.sync)


class Part(NamedTuple):
    """What a message is a part of: a newer revision of a number replaces the older ones."""

    group: Hashable
    number: int
    revision: int


class MessageJournal(NodeJournal):
    """The messages that a node has accepted.

    What was replaced is left out once it outweighs the rest.
    """

    def __init__(
        self,
        node: StageNode,
        session_dir: str,
        name: str,
        takers: Mapping[str, tuple[type, Callable[[Any], None]]],
    ) -> None:
        """takers: by a name of at most 255 letters, the type of its messages and what takes them up after a restart."""
        super().__init__(node, session_dir, name)
        self._takers = takers
        # Where the message of the last time lies that is being taken up.
        self._taking_up = False
        self._taken: Span | None = None
        # Where the messages lie that are parts, by group and number, and where those begin that were replaced.
        self._parts: dict[Hashable, dict[int, tuple[int, list[Span]]]] = {}
        self._replaced: set[int] = set()
        self._holding_bytes = self._replaced_bytes = 0
        self._copy: tuple[Copy, Future[None]] | None = None

    def take_up(self) -> None:
        """Hand the messages of the last time, in their order, to those that take them."""
        journal = self.journal
        if journal is None:
            return
        self._taking_up = True
        taken = self.guarded(lambda: sum(map(self._take, journal.located()))) or 0
        self._taking_up = False
        if journal.damaged:
            self.node.drop("damaged record of the journal")
        if taken:
            self.node.get_logger().info(f"going on from {journal.path}: {taken} messages")

    def _take(self, record: tuple[bytes, Span]) -> bool:
        """Whether a record is a message that somebody takes."""
        payload, self._taken = record
        length = payload[0] if payload else 0
        kind, take = self._takers.get(payload[1 : 1 + length].decode("ascii", "replace"), (None, None))
        try:
            message = None if kind is None else deserialize_message(payload[1 + length :], kind)
        except RuntimeError:
            message = None
        if message is None or take is None:
            self.node.drop("damaged record of the journal")
            return False
        take(message)
        return True

    def leave_out(self) -> None:
        """The message of the last time that is being taken up is not needed any more."""
        if self._taking_up and self._taken is not None:
            self._holding_bytes += self._taken.size
            self._lose([self._taken])

    def keep(self, name: str, message: Any, part: Part | None = None) -> None:
        """Write a message that was accepted."""
        journal = self.journal
        if journal is None:
            return
        if self._taking_up:
            span = self._taken
        else:
            head = name.encode("ascii")
            payload = bytes([len(head)]) + head + serialize_message(message)
            span = self.guarded(lambda: journal.append(payload))
        if span is not None:
            self._holding_bytes += span.size
            if part is not None:
                self._note(span, part)

    def _note(self, span: Span, part: Part) -> None:
        group = self._parts.setdefault(part.group, {})
        revision, spans = group.get(part.number, (part.revision, []))
        if part.revision > revision:
            self._lose(spans)
            revision, spans = part.revision, []
        spans.append(span)
        group[part.number] = revision, spans

    def forget(self, group: Hashable) -> None:
        """All parts of a group are replaced by nothing."""
        for _, spans in self._parts.pop(group, {}).values():
            self._lose(spans)

    def _lose(self, spans: Iterable[Span]) -> None:
        for span in spans:
            self._replaced.add(span.begin)
            self._holding_bytes -= span.size
            self._replaced_bytes += span.size

    def clear(self) -> None:
        """Begin anew; not while messages of the last time are handed on."""
        if self.journal is not None and not self._taking_up:
            self._abandon_copy()
            self._parts, self._replaced = {}, set()
            self._holding_bytes = self._replaced_bytes = 0
            self.guarded(self.journal.clear)

    def _sync(self) -> None:
        super()._sync()
        if self.journal is None:
            self._abandon_copy()
        elif self._copy is None:
            if self._replaced_bytes > max(self._holding_bytes, _FEW_BYTES):
                copy = self.journal.copy_without(frozenset(self._replaced))
                self._copy = copy, _DISK.submit(copy.write)
        elif self._copy[1].done():
            self._adopt_copy(self.journal, *self._copy)

    def _adopt_copy(self, journal: Journal, copy: Copy, written: Future[None]) -> None:
        self._copy = None
        # Where that fails, as on a full disk, the journal is as it was; it is tried again when more was replaced.
        self._replaced_bytes = 0
        try:
            written.result()
            places = journal.adopt(copy)
        except JournalError as error:
            self.node.say_once("journal copy", f"{error}; what was replaced stays in {journal.path}")
            return
        for group in self._parts.values():
            for _, spans in group.values():
                spans[:] = [places[span.begin] for span in spans]
        # What was replaced since the copy was begun.
        replaced = [places[begin] for begin in self._replaced if begin in places]
        self._replaced = {span.begin for span in replaced}
        self._replaced_bytes = sum(span.size for span in replaced)

    def _abandon_copy(self) -> None:
        """What is written beside is no longer of this journal."""
        if self._copy is not None:
            copy, written = self._copy
            self._copy = None
            written.add_done_callback(lambda _: copy.discard())
