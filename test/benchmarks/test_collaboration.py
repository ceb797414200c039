# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json

import numpy as np

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
