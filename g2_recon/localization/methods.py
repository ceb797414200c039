# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The localizers that there are, by the setting `method`."""

from __future__ import annotations

from typing import TypeAlias

from numpy.typing import ArrayLike

from g2_recon.config import LocalizationConfig
from g2_recon.localization.localizer import Localizer
from g2_recon.localization.paper import PaperLocalizer

AnyLocalizer: TypeAlias = Localizer | PaperLocalizer


def make_localizer(config: LocalizationConfig, T_base_laser: ArrayLike, *, keep_scans: bool = False) -> AnyLocalizer:
    """The localizer of a config, for a laser mounted at T_base_laser (4, 4); keep_scans: see Localizer."""
    if config.method == "paper":
        return PaperLocalizer(config, T_base_laser)
    return Localizer(config, T_base_laser, keep_scans=keep_scans)
