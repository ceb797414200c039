# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""How a stage tells its caller how far it has come."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """A callable that a stage calls as `progress(stage, done, total)`.

    `stage` is a short name for what is being done; `done` counts up to `total`. Stages call it from one thread
    at a time and never depend on what it does.
    """

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Take note of `done` of `total` steps of `stage`."""


def silent(stage: str, done: int, total: int) -> None:
    """Report nothing."""
