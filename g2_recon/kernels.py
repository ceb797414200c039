# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""How functions become kernels: compiled by Numba, kept on disk, and without the lock of Python while they run.

What others call is compiled with wrappers around it, for Python and for C. To compile those of all kernels takes a
quarter of the time that a first start takes, and most are never called.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numba
import numpy as np

kernel: Any = partial(numba.njit, cache=True, nogil=True, no_cfunc_wrapper=True)

# For those that only kernels call: a call from Python ends the process. See test_kernels.py.
inner_kernel: Any = partial(kernel, no_cpython_wrapper=True)

# For what begins at 0: a plain 0 has a type of its own, and what takes it is compiled for that, too.
ZERO: Any = np.int64(0)
