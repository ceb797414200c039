# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The map and the way of a localizer, in a journal."""

from __future__ import annotations

from g2_recon.geometry.session import ScanPoses, Session
from g2_recon.localization.localizer import Localizer
from g2_recon.localization.map_localizer import MapLocalizer
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
    def scans(self) -> ScanPoses | None:
        """The way of the last time, if there is one."""
        return self._log.scans if self._log is not None and len(self._log.scans) else None

    def write(self, localizer: Localizer) -> None:
        """Write what the localizer has more than it had."""
        log = self._log
        if self.journal is None or log is None:
            return
        known = len(localizer.keyframes()) if isinstance(localizer, MapLocalizer) else log.keyframes
        self.guarded(lambda: log.write(localizer.growth(known, log.scan_count)))

    def clear(self) -> None:
        """Begin anew."""
        if self.journal is not None and self._log is not None:
            self.guarded(self._log.clear)
