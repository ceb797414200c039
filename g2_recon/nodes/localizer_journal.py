# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The map and the way of a localizer, in a journal."""

from __future__ import annotations

from functools import partial

import numpy as np

from g2_recon.errors import InputError
from g2_recon.geometry.session import LastScan, Session
from g2_recon.localization.localizer import Localizer
from g2_recon.localization.map_localizer import MapLocalizer
from g2_recon.localization.resumed import ResumedLocalizer
from g2_recon.nodes.journals import NodeJournal
from g2_recon.nodes.stage_node import StageNode
from g2_recon.recording.session_journal import SessionJournal


class LocalizerJournal(NodeJournal):
    """Keyframes, loops and poses of scans, as they come."""

    def __init__(self, node: StageNode, session_dir: str, name: str) -> None:
        """Read what there was the last time."""
        super().__init__(node, session_dir, name)
        self._log: SessionJournal | None = None
        journal = self.journal
        if journal is not None:
            self._log = self.guarded(lambda: SessionJournal(journal))
        if self._log is not None and self._log.left_out:
            node.drop("damaged record of the journal")

    @property
    def session(self) -> Session | None:
        """The map of the last time, if there is one."""
        return None if self._log is None else self._log.session

    @property
    def last(self) -> LastScan | None:
        """Where the last time ended, if there was one."""
        return None if self._log is None else self._log.last

    def take_up(self, localizer: Localizer, *, near: bool) -> None:
        """Let a localizer go on from the last time; `near`: the robot is where it was, if the localizer has a map.

        Raises InputError where the journal is of another map.
        """
        log = self._log
        if log is None or log.last is None:
            return
        if isinstance(localizer, MapLocalizer) and not _same(localizer.session(), log.session):
            raise InputError("the journal is of another map")
        if log.session is not None and not isinstance(localizer, (MapLocalizer, ResumedLocalizer)):
            localizer.go_on(log.session, log.scans, log.last)
            return
        localizer.remember(log.scans)
        if near and isinstance(localizer, (MapLocalizer, ResumedLocalizer)) and len(log.scans):
            localizer.set_pose(localizer.trajectory().planar()[-1])

    def write(self, localizer: Localizer) -> None:
        """Write what the localizer has more than it had."""
        if self.journal is not None and self._log is not None:
            self.guarded(partial(self._write, self._log, localizer))

    def _write(self, log: SessionJournal, localizer: Localizer) -> None:
        if isinstance(localizer, MapLocalizer) and log.session is None:
            log.begin(localizer.session())
        log.write(localizer.growth(log.keyframes, log.scan_count))

    def clear(self) -> None:
        """Begin anew."""
        if self.journal is not None and self._log is not None:
            self.guarded(self._log.clear)


def _same(session: Session, other: Session | None) -> bool:
    """Whether two maps have the same keyframes."""
    return other is not None and np.array_equal(session.poses, other.poses)
