# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The localizers that there are, by the settings `method` and `mode`."""

from __future__ import annotations

from typing import TypeAlias

from numpy.typing import ArrayLike

from g2_recon.config import LocalizationConfig
from g2_recon.geometry.session import Session
from g2_recon.localization.localizer import Localizer
from g2_recon.localization.map_localizer import MapLocalizer
from g2_recon.localization.paper import PaperLocalizer
from g2_recon.localization.resumed import ResumedLocalizer

AnyLocalizer: TypeAlias = Localizer | PaperLocalizer


def make_localizer(
    config: LocalizationConfig,
    T_base_laser: ArrayLike,
    *,
    keep_scans: bool = False,
    session: Session | None = None,
) -> AnyLocalizer:
    """The localizer of a config, for a laser mounted at T_base_laser (4, 4); keep_scans: see Localizer.

    session: what is in the file that the setting `map` names. Raises InputError where it is too large to search.
    """
    if config.method == "paper":
        return PaperLocalizer(config, T_base_laser)
    if session is None:
        return Localizer(config, T_base_laser, keep_scans=keep_scans)
    kind = MapLocalizer if config.mode == "localization" else ResumedLocalizer
    return kind(config, T_base_laser, session, keep_scans=keep_scans)
