# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What nodes have accepted, in journals in their session_dir: a node that was killed goes on where it was.

A journal that cannot be opened or written to any more is said at once, and the node goes on in memory. What was written
survives the end of the process at once; once a second it is brought to the disk, in a thread of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from rclpy.serialization import deserialize_message, serialize_message

from g2_recon.errors import InputError
from g2_recon.nodes.stage_node import StageNode
from g2_recon.recording.journal import Journal

_SYNC_S = 1.0
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


class MessageJournal(NodeJournal):
    """The messages that a node has accepted."""

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
        self._taking_up = False

    def take_up(self) -> None:
        """Hand the messages of the last time, in their order, to those that take them."""
        journal = self.journal
        if journal is None:
            return
        self._taking_up = True
        taken = self.guarded(lambda: sum(map(self._take, journal.records()))) or 0
        self._taking_up = False
        if journal.damaged:
            self.node.drop("damaged record of the journal")
        if taken:
            self.node.get_logger().info(f"going on from {journal.path}: {taken} messages")

    def _take(self, payload: bytes) -> bool:
        """Whether a record is a message that somebody takes."""
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

    def keep(self, name: str, message: Any) -> None:
        """Write a message that was accepted."""
        journal = self.journal
        if journal is not None and not self._taking_up:
            head = name.encode("ascii")
            self.guarded(lambda: journal.append(bytes([len(head)]) + head + serialize_message(message)))

    def clear(self) -> None:
        """Begin anew; not while messages of the last time are handed on."""
        if self.journal is not None and not self._taking_up:
            self.guarded(self.journal.clear)
