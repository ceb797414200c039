# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import math

import numpy as np
import pytest

from benchmarks import localization
from benchmarks.localization import (
    DEFAULTS,
    LOGS,
    Live,
    apart,
    beside,
    ellipses,
    kept,
    lay_pair,
    occupancy,
    relocalization_of,
    with_dropped_scans,
    with_invalid_beams,
    with_noise,
)
from benchmarks.random_poses import Floor, Search
from g2_recon.geometry.recording import Recording
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.localization.beams import beams

ANGLES = np.radians(np.arange(-90.0, 91.0))


def room(x=0.0):
    """Ranges (181,) in a room of 12 m x 8 m, of which the far wall is not seen beyond 9 m."""
    cos, sin = np.cos(ANGLES), np.sin(ANGLES)
    along = np.where(cos > 1e-9, (10.0 - x) / np.maximum(cos, 1e-9), np.inf)
    across = np.where(sin > 0, 3.0, 5.0) / np.maximum(np.abs(sin), 1e-9)
    ranges = np.minimum(along, across)
    return np.where(ranges > 9.0, np.inf, ranges).astype(np.float32)


@pytest.fixture(scope="module")
def recording():
    scans = [Scan(float(i), room(0.05 * i), ANGLES[0], ANGLES[1] - ANGLES[0]) for i in range(400)]
    odometry = np.column_stack([0.05 * np.arange(400.0), np.zeros(400), np.zeros(400)])
    return Recording(scans=scans, scan_odometry=odometry, T_base_laser=np.eye(4))


def ranges_of(recording):
    return np.array([scan.ranges for scan in recording.scans], float)


def test_noise_has_the_spread_that_is_said_and_leaves_what_is_no_measurement(recording):
    before, after = ranges_of(recording), ranges_of(with_noise(recording, np.random.default_rng(0)))
    measured = np.isfinite(before)
    assert not measured.all()
    np.testing.assert_array_equal(after[~measured], before[~measured])
    errors = after[measured] - before[measured]
    assert errors.std() == pytest.approx(0.01, rel=5 / math.sqrt(2 * len(errors)))  # m; five standard errors


def test_a_fifth_of_the_beams_becomes_invalid_and_the_others_stay(recording):
    before, after = ranges_of(recording), ranges_of(with_invalid_beams(recording, np.random.default_rng(0)))
    invalid = np.isnan(after)
    assert invalid.mean() == pytest.approx(0.2, abs=5 * math.sqrt(0.2 * 0.8 / invalid.size))
    np.testing.assert_array_equal(after[~invalid], before[~invalid])


def test_a_tenth_of_the_scans_is_dropped_with_its_odometry(recording):
    rest = with_dropped_scans(recording, np.random.default_rng(0))
    assert len(rest.scans) == pytest.approx(360, abs=5 * math.sqrt(400 * 0.1 * 0.9))
    np.testing.assert_allclose(rest.scan_odometry[:, 0], [0.05 * scan.stamp for scan in rest.scans])


def test_the_beginning_of_a_recording_is_kept(recording):
    assert [scan.stamp for scan in kept(recording, slice(3)).scans] == [0.0, 1.0, 2.0]
    assert len(kept(recording, slice(None)).scans) == 400


def test_ellipses_of_the_right_size_hold_the_truth_in_95_of_100():
    rng = np.random.default_rng(0)
    count, spread = 4000, np.array([[0.04, 0.01, 0.0], [0.01, 0.01, 0.0], [0.0, 0.0, 1.0]])
    stamps = np.arange(float(count))
    truth = Trajectory.from_se2(stamps, np.zeros((count, 3)))
    poses = rng.multivariate_normal(np.zeros(3), spread, count)
    found = Live(stamps, np.zeros(count), 0.0, poses, np.broadcast_to(spread, (count, 3, 3)), 0.0)
    inside, sigma = ellipses(found, truth)
    assert inside == pytest.approx(0.95, abs=5 * math.sqrt(0.95 * 0.05 / count))
    assert sigma == pytest.approx(math.sqrt(np.linalg.eigvalsh(spread[:2, :2])[1]))


@pytest.mark.parametrize("trusted", [False, True])
def test_a_scan_is_laid_on_itself_in_spite_of_a_wrong_guess(recording, trusted):
    seen = beams(recording.scans[60], range_min=0.1, range_max=40.0)
    found, believed = lay_pair(seen, seen, np.array([0.1, -0.1, 0.3]), trusted=trusted)
    assert believed
    assert np.abs(found).max() < 0.02  # m and rad, as the benchmark asks for


def test_a_grid_has_the_walls_where_the_room_has_them(recording):
    way = Trajectory.from_se2([float(i) for i in range(20)], recording.scan_odometry[:20])
    grid = occupancy(kept(recording, slice(20)), way, DEFAULTS)
    assert (grid.at([[1.0, 3.01], [1.0, -5.01]]) == 100).all()
    assert grid.at([[1.0, 0.0]]) == 0


def test_figures_say_how_many_times_the_undisturbed_one_they_are():
    assert beside(0.06, 0.04) == "0.0600 (x 1.50)"
    assert beside(0.0, 0.0) == "0.0000"


def test_a_run_that_fails_says_why_and_the_others_go_on():
    root, failure = apart(math.sqrt, [(4.0,), (-1.0,)], 2)
    assert root == 2.0
    assert failure.startswith("failed: ValueError")


def test_without_logs_it_says_where_they_are_and_uses_the_simulation(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(localization, "QUICK_SCANS", 60)
    monkeypatch.setattr(localization, "warm_up_localization", lambda: None)
    monkeypatch.setattr(localization, "apart", lambda work, calls, at_a_time=1: [work(*call) for call in calls])
    localization.main(["--quick", "--only", "accuracy", "simulation", "maps", "--out", str(tmp_path)])
    assert all(log.url in caplog.text for log in LOGS.values())
    assert not (tmp_path / "localization_accuracy.json").exists()
    table = json.loads((tmp_path / "localization_simulation.json").read_text())["table"]
    assert all(float(row["mean, cm"]) < 2 for row in table["sections"][""])
    page = (tmp_path / "localization_benchmarks.md").read_text()
    assert "| first_floor |" in page and "](localization_maps.png)" in page
    assert (tmp_path / "localization_maps.png").exists()


def test_of_robots_that_were_put_down_it_says_who_was_right_wrong_and_not_sure():
    found = [
        Search(scans=0, slowest=0.2, metres=0.02, degrees=0.1),
        Search(scans=7, slowest=0.3, metres=0.09, degrees=1.9),
        Search(scans=3, slowest=0.4, metres=0.02, degrees=2.1),
        Search(scans=90, slowest=0.1, metres=math.nan, degrees=math.nan),
    ]
    row = relocalization_of(found)
    assert [row[of] for of in ("right, %", "wrong, %", "not sure, %", "at once, %")] == ["50.0", "25.0", "25.0", "25.0"]
    assert (row["median error, cm"], row["slowest, s"]) == ("2.0", "0.40")


def test_robots_are_put_down_where_there_is_room_and_turn_once_around():
    floor = Floor(0, boxes=3)
    for _ in range(5):
        way = floor.way(floor.somewhere())
        assert way[36, 2] == pytest.approx(way[0, 2], abs=1e-9)
        np.testing.assert_array_equal(way[36, :2], way[0, :2])
        assert np.hypot(*np.diff(way[:, :2], axis=0).T).max() < 0.11
