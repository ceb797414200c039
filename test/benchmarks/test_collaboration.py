# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import math

import numpy as np
import pytest

from benchmarks import collaboration
from g2_recon.geometry.recording import Recording
from g2_recon.geometry.scan import Scan


def test_a_log_played_backwards_begins_where_it_ended():
    scans = [Scan(float(stamp), np.full(3, stamp, np.float32), -0.1, 0.1) for stamp in (10, 11, 13)]
    odometry = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    turned = collaboration.backwards(Recording(scans=scans, scan_odometry=odometry))
    assert [scan.stamp for scan in turned.scans] == [10.0, 12.0, 13.0]
    assert [scan.ranges[0] for scan in turned.scans] == [13, 11, 10]
    assert turned.scan_odometry is not None
    assert turned.scan_odometry[0].tolist() == [3, 0, 0]


def test_the_nearest_stamps_are_found():
    stamps = np.array([1.0, 2.0, 4.0, 8.0])
    wanted = np.array([0.0, 1.4, 3.1, 5.9, 6.1, 99.0])
    assert collaboration.nearest(stamps, wanted).tolist() == [0, 0, 2, 2, 3, 3]


def test_simulated_robots_come_into_one_map_and_the_page_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(collaboration, "ROBOTS", 2)
    collaboration.main(["--only", "simulated", "--seeds", "1", "--out", str(tmp_path)])
    rows = json.loads((tmp_path / "collaboration_simulated.json").read_text())["table"]["sections"][""]
    assert rows[0]["claimed"] == rows[0]["right"]
    assert "## Simulated robots" in (tmp_path / "collaboration_benchmarks.md").read_text()


@pytest.mark.parametrize("jobs", [1, 2])
def test_work_of_several_processes_is_in_the_order_in_which_it_was_given(jobs, monkeypatch):
    for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.setenv(name, "1")
    with collaboration.pool_of(jobs) as pool:
        *before, last = collaboration.done(pool, "legs", math.hypot, [(3.0, 4.0), (6.0, 8.0), (5.0, 12.0)])
    assert last == [5.0, 10.0, 13.0]
    assert [len(results) for results in before] == [1, 2]


def test_work_that_fails_does_not_take_the_rest_with_it():
    with collaboration.pool_of(1) as pool:
        *_, last = collaboration.done(pool, "roots", math.sqrt, [(4.0,), (-1.0,), (9.0,)])
    assert last == [2.0, 3.0]


def test_without_a_table_the_page_is_made_of_what_lies_there(tmp_path):
    collaboration.report.save(tmp_path / "collaboration_cost.json", collaboration.Table("Cost", "", {"": [{"a": 1}]}))
    collaboration.main(["--only", "--out", str(tmp_path)])
    assert "## Cost" in (tmp_path / "collaboration_benchmarks.md").read_text()
