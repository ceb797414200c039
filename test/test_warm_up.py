# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import os
import subprocess
import sys


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


def test_what_another_process_compiles_meanwhile_is_what_tracking_needs():
    code = """
from g2_recon.localization import pairing, pose_graph, smoothing, tracking_kernels, uncertainty
from g2_recon.localization.warm_up import warm_up_matching, warm_up_smoothing, warm_up_tracking

def compiled():
    modules = pairing, pose_graph, smoothing, tracking_kernels, uncertainty
    return {
        (name, signature)
        for module in modules
        for name, kernel in vars(module).items()
        for signature in getattr(kernel, "overloads", ())
    }

warm_up_smoothing()
warm_up_matching()
halves = compiled()
assert any(name == "solve_window" for name, _ in halves)
assert any(name == "match_on_latest" for name, _ in halves)
warm_up_tracking()
print({name for name, _ in compiled() - halves})
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "set()\n", done
