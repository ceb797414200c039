# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.config import LocalizationConfig
from g2_recon.localization.localizer import Localizer
from g2_recon.localization.methods import make_localizer
from g2_recon.localization.paper import PaperLocalizer


@pytest.mark.parametrize(("method", "kind"), [("graph", Localizer), ("paper", PaperLocalizer)])
def test_the_setting_method_names_the_localizer(method, kind):
    assert type(make_localizer(LocalizationConfig(method=method), np.eye(4), keep_scans=True)) is kind
