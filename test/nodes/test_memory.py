# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Memory of a process that works for days."""

import platform
import subprocess
import sys

import pytest

from g2_recon.nodes.memory import memory_mb

pytestmark = pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of glibc on Linux")

PRINTED = """
import ctypes, sys
from threading import Barrier, Thread
from g2_recon.nodes.memory import save_memory

if sys.argv[1] == "saving":
    save_memory()
libc = ctypes.CDLL(None)
libc.malloc.restype = libc.fopen.restype = ctypes.c_void_p
libc.malloc_info.argtypes = ctypes.c_int, ctypes.c_void_p
libc.fclose.argtypes = (ctypes.c_void_p,)
together = Barrier(4)

def take():
    libc.malloc(5000)
    together.wait()

threads = [Thread(target=take) for _ in range(4)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
path = sys.argv[2]
file = libc.fopen(path.encode(), b"w")
libc.malloc_info(0, file)
libc.fclose(file)
print(open(path).read().count("<heap nr="), [line for line in open("/proc/self/status") if "THP" in line])
"""


def printed(what, path):
    arguments = [sys.executable, "-c", PRINTED, what, str(path)]
    return subprocess.run(arguments, check=True, capture_output=True, text=True).stdout


def test_threads_share_their_memory_in_small_pages_once_it_is_to_be_saved(tmp_path):
    shared, apart = printed("saving", tmp_path / "shared"), printed("", tmp_path / "apart")
    assert int(shared.split()[0]) == 1 < int(apart.split()[0])
    if "THP" in apart:
        assert "THP_enabled:\\t0" in shared and "THP_enabled:\\t1" in apart


GIVEN_BACK = """
import sys
import numpy as np
from g2_recon.nodes.memory import memory_mb, save_memory

if sys.argv[1] == "saving":
    save_memory()
# The C library by itself keeps what it was given once, from now on.
large = np.ones(3_000_000)
del large
held = []
for _ in range(20):
    held += [np.ones(250_000), np.ones(100)]
before = memory_mb()
del held[::2]
print(before - memory_mb())
"""


def test_large_arrays_are_given_back_whatever_lies_between_once_memory_is_to_be_saved():
    saved, kept = (
        float(subprocess.run([sys.executable, "-c", GIVEN_BACK, what], check=True, capture_output=True).stdout)
        for what in ("saving", "")
    )
    assert saved > 35 > 10 > kept


def test_a_process_knows_its_memory():
    before = memory_mb()
    held = b"x" * 50_000_000
    assert len(held) == 50_000_000 and 40 < memory_mb() - before < 60
