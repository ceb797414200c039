# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import sys

import pytest

from g2_recon.switching import switch_soon, switching_soon


@pytest.fixture(autouse=True)
def interval():
    before = sys.getswitchinterval()
    sys.setswitchinterval(0.005)
    yield
    sys.setswitchinterval(before)


def test_threads_switch_sooner_only_meanwhile_whatever_happens():
    with pytest.raises(ZeroDivisionError), switching_soon():
        assert sys.getswitchinterval() == pytest.approx(0.0005, abs=2e-6)
        raise ZeroDivisionError
    assert sys.getswitchinterval() == pytest.approx(0.005, abs=2e-6)


def test_what_is_sooner_still_stays():
    sys.setswitchinterval(0.0001)
    switch_soon()
    assert sys.getswitchinterval() == pytest.approx(0.0001, abs=2e-6)
