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
from g2_recon.geometry.session import ScanPoses, Session
from g2_recon.localization.localizer import Localizer
from g2_recon.localization.map_localizer import MapLocalizer
from g2_recon.nodes.stage_node import StageNode
from g2_recon.recording.journal import Journal
from g2_recon.recording.session_journal import SessionJournal

_SYNC_S = 1.0
_DISK = ThreadPoolExecutor(1, "journals")


class _NodeJournal:
    """A journal of a node, for as long as it can be written to."""

    def __init__(self, node: StageNode, session_dir: str, name: str) -> None:
        """Nothing is opened where there is no session_dir."""
        self._node = node
        self._name = name
        self._syncing: Future[None] | None = None
        self._journal: Journal | None = None
        if session_dir:
            self._journal = self._guarded(lambda: Journal(Path(session_dir).expanduser() / name))
            node.create_timer(_SYNC_S, self._sync, clock=node.steady_clock)

    def _guarded(self, action: Callable[[], Any]) -> Any:
        """What an action returns; None, said once, where it fails, and there is no journal any more."""
        try:
            return action()
        except InputError as error:
            if self._journal is not None:
                self._journal.close()
            self._journal = None
            self._node.fail(self._name, f"{error}; nothing is written any more, and the node goes on in memory")
            return None

    def _sync(self) -> None:
        if self._syncing is not None and self._syncing.done() and self._syncing.exception() is not None:
            self._guarded(self._syncing.result)
        if self._journal is not None and (self._syncing is None or self._syncing.done()):
            self._syncing = _DISK.submit(self._journal.sync)


class MessageJournal(_NodeJournal):
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
        journal = self._journal
        if journal is None:
            return
        self._taking_up = True
        taken = self._guarded(lambda: sum(map(self._take, journal.records()))) or 0
        self._taking_up = False
        if journal.damaged:
            self._node.drop("damaged record of the journal")
        if taken:
            self._node.get_logger().info(f"going on from {journal.path}: {taken} messages")

    def _take(self, payload: bytes) -> bool:
        """Whether a record is a message that somebody takes."""
        length = payload[0] if payload else 0
        kind, take = self._takers.get(payload[1 : 1 + length].decode("ascii", "replace"), (None, None))
        try:
            message = None if kind is None else deserialize_message(payload[1 + length :], kind)
        except RuntimeError:
            message = None
        if message is None or take is None:
            self._node.drop("damaged record of the journal")
            return False
        take(message)
        return True

    def keep(self, name: str, message: Any) -> None:
        """Write a message that was accepted."""
        journal = self._journal
        if journal is not None and not self._taking_up:
            head = name.encode("ascii")
            self._guarded(lambda: journal.append(bytes([len(head)]) + head + serialize_message(message)))

    def clear(self) -> None:
        """Begin anew."""
        if self._journal is not None:
            self._guarded(self._journal.clear)


class LocalizerJournal(_NodeJournal):
    """Keyframes, loops and poses of scans, as they come."""

    def __init__(self, node: StageNode, session_dir: str, name: str) -> None:
        """Read what there was the last time."""
        super().__init__(node, session_dir, name)
        self._log: SessionJournal | None = None
        journal = self._journal
        if journal is not None:
            self._log = self._guarded(lambda: SessionJournal(journal))
        if self._log is not None and self._log.left_out:
            node.drop("damaged record of the journal")

    @property
    def session(self) -> Session | None:
        """The map of the last time, if there is one."""
        return None if self._log is None else self._log.session

    @property
    def scans(self) -> ScanPoses | None:
        """The way of the last time, if there is one."""
        return self._log.scans if self._log is not None and len(self._log.scans) else None

    def write(self, localizer: Localizer) -> None:
        """Write what the localizer has more than it had."""
        log = self._log
        if self._journal is None or log is None:
            return
        known = len(localizer.keyframes()) if isinstance(localizer, MapLocalizer) else log.keyframes
        self._guarded(lambda: log.write(localizer.growth(known, log.scan_count)))

    def clear(self) -> None:
        """Begin anew."""
        if self._journal is not None and self._log is not None:
            self._guarded(self._log.clear)
