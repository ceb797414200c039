# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The exceptions that g2_recon raises on purpose; anything else is a bug."""

from __future__ import annotations


class G2ReconError(Exception):
    """Base of every error that a caller can do something about."""


class InputError(G2ReconError):
    """A file, message or array cannot be used.

    The text is one line: where, what is wrong, and what to do about it.
    """

    def __init__(self, what: str, *, where: object = None, advice: str = "") -> None:
        text = f"{where}: {what}" if where is not None else what
        super().__init__(" ".join(f"{text}; {advice}".split()) if advice else " ".join(text.split()))


class ConfigError(InputError):
    """A setting is unknown, has the wrong type or is out of its range."""


class JournalError(InputError):
    """A journal cannot be opened or written to; what goes on goes on in memory."""
