# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from g2_recon.localization.localized_scan import LocalizedScan


@pytest.mark.parametrize("degrees", [-90, -35, 0, 20, 89])
def test_the_weak_axis_is_the_long_one_of_the_ellipse(degrees):
    angle = math.radians(degrees)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    covariance = np.eye(3)
    covariance[:2, :2] = turn @ np.diag([0.3**2, 0.01**2]) @ turn.T
    direction, along, across = LocalizedScan(0.0, np.zeros(3), covariance, 1.0, True, False).weak_axis
    # An axis has no sign.
    assert math.sin(direction - angle) == pytest.approx(0, abs=1e-9)
    assert -math.pi / 2 <= direction < math.pi / 2
    assert (along, across) == pytest.approx((0.3, 0.01))
