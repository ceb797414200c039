# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from g2_recon.errors import InputError
from g2_recon.recording.lzf import decompress


def _reference(packed: bytes) -> bytes:
    """The plain twin of the kernel, as LibLZF's format says."""
    out, at = bytearray(), 0
    while at < len(packed):
        control, at = packed[at], at + 1
        if control < 32:
            run = packed[at : at + control + 1]
            if len(run) != control + 1:
                raise IndexError
            out, at = out + run, at + control + 1
            continue
        length = (control >> 5) + 2
        if control >> 5 == 7:
            length, at = length + packed[at], at + 1
        source, at = len(out) - ((control & 31) << 8) - packed[at] - 1, at + 1
        if source < 0:
            raise IndexError
        for index in range(length):
            out.append(out[source + index])
    return bytes(out)


def test_a_literal_run_comes_as_it_is() -> None:
    assert decompress(b"\x02abc", 3) == b"abc"


def test_a_reference_may_overlap_what_it_writes() -> None:
    assert decompress(b"\x00a\xe0\x10\x00", 26) == b"a" * 26


@settings(max_examples=300, deadline=None)
@given(st.binary(min_size=1, max_size=60).map(lambda data: bytes(byte % 80 for byte in data)) | st.binary(min_size=1))
def test_the_kernel_agrees_with_its_plain_twin(packed: bytes) -> None:
    try:
        expected = _reference(packed)
    except IndexError:
        with pytest.raises(InputError):
            decompress(packed, 88 * len(packed))
        return
    assert decompress(packed, len(expected)) == expected


def test_a_reference_before_the_start_is_told() -> None:
    with pytest.raises(InputError, match="damaged"):
        decompress(b"\x00a\x20\x05", 4)


def test_another_size_than_stated_is_told() -> None:
    with pytest.raises(InputError, match="damaged"):
        decompress(b"\x02abc", 4)


def test_a_size_that_cannot_be_is_told_before_memory_is_taken() -> None:
    with pytest.raises(InputError, match="cannot hold"):
        decompress(b"\x02abc", 1 << 50)
