# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.config import LocalizationConfig
from g2_recon.localization.localizer import Localizer
from g2_recon.localization.map_localizer import MapLocalizer
from g2_recon.localization.methods import make_localizer
from g2_recon.localization.paper import PaperLocalizer
from g2_recon.localization.resumed import ResumedLocalizer


@pytest.mark.parametrize(("method", "kind"), [("graph", Localizer), ("paper", PaperLocalizer)])
def test_the_setting_method_names_the_localizer(method, kind):
    assert type(make_localizer(LocalizationConfig(method=method), np.eye(4), keep_scans=True)) is kind


@pytest.mark.parametrize(("mode", "kind"), [("mapping", ResumedLocalizer), ("localization", MapLocalizer)])
def test_with_a_session_the_setting_mode_names_the_localizer(scan_of_room, mode, kind):
    before = Localizer(LocalizationConfig(), np.eye(4))
    before.process(scan_of_room((0, 0, 0)))
    config = LocalizationConfig(mode=mode, map="session.npz")
    assert type(make_localizer(config, np.eye(4), session=before.session())) is kind
