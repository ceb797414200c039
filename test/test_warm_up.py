# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import os
import subprocess
import sys

import pytest


def test_after_a_warm_up_nothing_is_left_to_compile(tmp_path):
    """Numba writes an index a kernel; a run on other data adds none in those of a reconstruction and a score."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    other_data = (
        "import numpy as np; from g2_recon.geometry.cloud import Cloud;"
        "from g2_recon.config import ReconstructionConfig;"
        "from g2_recon.reconstruction.reconstructor import reconstruct; rng = np.random.default_rng(0);"
        "p = np.hstack([3 * rng.random((3000, 2)), 0.01 * rng.normal(size=(3000, 1))]);"
        "[reconstruct(Cloud(p, p + (0, 0, z)), ReconstructionConfig(mode=m, passes=5, clusters=3))"
        " for m, z in (('solid', 2.0), ('paper', 2.0))];"
        "from g2_recon.evaluation.surface import score_surface; from g2_recon.geometry.mesh import TrueSurface;"
        "f = np.arange(3000).reshape(-1, 3); score_surface(TrueSurface(p, f, p[::2]), p + 0.01, f, workers=0)"
    )
    subprocess.run([sys.executable, "-m", "g2_recon.warm_up"], env=environment, check=True)
    compiled = {file.name for file in tmp_path.rglob("*.nbc")}
    subprocess.run([sys.executable, "-c", other_data], env=environment, check=True)
    assert compiled
    assert {file.name for file in tmp_path.rglob("*.nbc")} == compiled


@pytest.mark.parametrize(
    ("part", "halves", "whole", "some_of_one", "some_of_other"),
    [
        ("localization", ("smoothing", "matching"), "tracking", "solve_window", "match_on_latest"),
        ("reconstruction", ("submaps", "joining"), "reconstruction", "train_sheet", "_advance"),
    ],
)
def test_two_processes_compile_all_that_is_needed(part, halves, whole, some_of_one, some_of_other):
    code = f"""
import sys
from numba.core.dispatcher import Dispatcher
from g2_recon.{part} import warm_up

def compiled():
    modules = [module for name, module in list(sys.modules.items()) if name.startswith("g2_recon.{part}")]
    kernels = [kernel for module in modules for kernel in vars(module).values() if isinstance(kernel, Dispatcher)]
    return {{(kernel.py_func.__name__, signature) for kernel in kernels for signature in kernel.overloads}}

warm_up.warm_up_{halves[0]}()
one = compiled()
warm_up.warm_up_{halves[1]}()
both = compiled()
assert any(name == "{some_of_one}" for name, _ in one), one
assert not any(name == "{some_of_other}" for name, _ in one), one
assert any(name == "{some_of_other}" for name, _ in both), both
warm_up.warm_up_{whole}()
print({{name for name, _ in compiled() - both}})
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "set()\n", done
