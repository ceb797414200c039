# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from benchmarks import registration
from benchmarks.simulated_sweeps import errors, off_by, ring, stop, sweep, two_rooms
from g2_recon.geometry import se3


def test_a_sweep_has_the_points_that_the_table_says() -> None:
    rectangles, stops = ring()
    assert sweep(rectangles, stops[0], np.random.default_rng(0)).shape == (36200, 3)


def test_points_of_a_sweep_lie_in_the_frame_of_the_laser() -> None:
    rectangles, _ = ring()
    seen = [sweep(rectangles, stop(1.1, y), np.random.default_rng(0), noise=0.0) for y in (1.1, 1.0)]
    # The wall on the right is 10 cm nearer from the second place; the floor stays where it is.
    assert seen[0][:, 1].min() - seen[1][:, 1].min() == pytest.approx(-0.1)
    assert seen[0][:, 2].min() == pytest.approx(-0.75)


def test_a_guess_is_off_by_what_is_said() -> None:
    metres, degrees = errors(off_by(np.random.default_rng(0), 0.3, 8.0), np.eye(4))
    assert (metres, degrees) == pytest.approx((0.3, 8.0))


def test_stops_in_two_rooms_do_not_see_each_other() -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        rectangles, (first, second) = two_rooms(rng)
        reach = se3.transform_points(first, sweep(rectangles, first, rng, noise=0.0))[:, 0].max()
        assert reach < se3.transform_points(second, sweep(rectangles, second, rng, noise=0.0))[:, 0].min()


def test_all_tables_that_need_no_recordings_are_made(tmp_path) -> None:
    registration.main(["--quick", "--only", "ring", "corridor", "recordings", "--out", str(tmp_path)])
    page = (tmp_path / "registration_benchmarks.md").read_text()
    assert "## A ring of sweeps" in page
    assert "## A bare corridor" in page
    assert "Recorded" not in page
    assert "good" not in page.split("## A bare corridor")[1].split("|---")[1]
