# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from g2_recon.errors import InputError
from g2_recon.recording.records import pack, unpack

LAYOUTS = {7: {"a": ("<f8", ("N", 2)), "b": ("<i4", ("M",)), "c": ("|u1", ("N", "M"))}}


def arrays(n, m):
    return {"a": np.arange(2.0 * n).reshape(n, 2), "b": np.arange(m), "c": np.ones((n, m))}


@given(n=st.integers(0, 5), m=st.integers(0, 5))
def test_arrays_come_back(n, m):
    kind, found = unpack(pack(7, LAYOUTS[7], arrays(n, m)), LAYOUTS)
    assert kind == 7
    for name, array in arrays(n, m).items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == LAYOUTS[7][name][0]


def test_arrays_that_do_not_fit_each_other_are_no_record():
    with pytest.raises(ValueError, match=r"c is \(3, 2\)"):
        pack(7, LAYOUTS[7], arrays(2, 2) | {"c": np.ones((3, 2))})


@given(payload=st.binary(max_size=60))
def test_any_bytes_are_arrays_of_a_layout_or_are_refused(payload):
    try:
        _, found = unpack(payload, LAYOUTS)
    except InputError:
        return
    assert found["c"].shape == (len(found["a"]), len(found["b"]))


@pytest.mark.parametrize("lengths", [(2**32 - 1, 0), (0, 2**32 - 1), (2**32 - 1, 2**32 - 1)])
def test_no_memory_is_taken_for_lengths_that_are_only_claimed(lengths):
    claimed = b"\x07" + b"".join(length.to_bytes(4, "little") for length in lengths)
    with pytest.raises(InputError, match="another length"):
        unpack(claimed, LAYOUTS)


def test_an_unknown_kind_is_refused():
    with pytest.raises(InputError, match="unknown kind"):
        unpack(b"\x08", LAYOUTS)
