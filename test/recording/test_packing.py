# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import bz2
import gzip

import pytest

from g2_recon.errors import InputError
from g2_recon.recording import packing
from g2_recon.recording.slam6d import read_3d

CONTENT = b"100 20 300\n" * 5000


@pytest.mark.parametrize("pack", [bytes, gzip.compress, bz2.compress], ids=["plain", "gzip", "bzip2"])
def test_content_is_the_same_however_it_is_packed(pack):
    assert packing.unpack(pack(CONTENT), where="a") == (CONTENT, "")


def test_what_is_cut_short_is_kept_as_far_as_it_goes_and_complained_of():
    content, complaint = packing.unpack(gzip.compress(CONTENT)[:-20], where="a")
    assert CONTENT.startswith(content)
    assert "ends early" in complaint


def test_a_file_that_unpacks_without_end_is_refused_also_as_a_sweep(tmp_path, monkeypatch):
    monkeypatch.setattr(packing, "_MAX_UNPACKED_BYTES", 1 << 20)
    (tmp_path / "scan000.3d.gz").write_bytes(gzip.compress(bytes(4 << 20)))
    with pytest.raises(InputError, match=r"scan000\.3d\.gz.*unpacks to more than"):
        read_3d(tmp_path / "scan000.3d.gz")
