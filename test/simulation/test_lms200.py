# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import numpy as np
import pytest

from g2_recon.simulation.lms200 import MIXED_PIXEL_JUMP, Lms200


def laser(*, spacing=1.0, mode=8, noise=0.0, mixed=False):
    return Lms200(beam_spacing=spacing, measuring_mode=mode, range_noise=noise, mixed_pixels=mixed)


@pytest.mark.parametrize(("spacing", "beams", "rate"), [(1.0, 181, 75.0), (0.5, 361, 37.5)])
def test_the_variants_have_the_beams_and_the_rate_of_the_device(spacing, beams, rate):
    device = laser(spacing=spacing)
    assert (len(device.angles()), device.scan_rate) == (beams, rate)


def test_beams_run_from_right_to_left():
    np.testing.assert_allclose(laser().angles()[[0, 90, 180]], [-math.pi / 2, 0.0, math.pi / 2], atol=1e-12)


def test_the_mirror_turns_75_times_a_second():
    device = laser(spacing=0.5)
    assert device.time_increment / math.radians(0.5) == pytest.approx(1 / (75 * 2 * math.pi))


@pytest.mark.parametrize(("mode", "resolution"), [(8, 0.001), (80, 0.01)])
def test_ranges_are_whole_counts(mode, resolution):
    ranges = laser(mode=mode).measure(np.random.default_rng(0).uniform(0.1, 8, (10, 181)), np.random.default_rng(0))
    counts = ranges / resolution
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-3)  # float32 at 8 m is exact to 5e-7 m


@pytest.mark.parametrize(("mode", "last"), [(8, 8.182), (80, 81.82)])
def test_what_is_beyond_the_largest_range_is_no_return(mode, last):
    distances = np.array([[last, last * 1.001, np.inf]])
    ranges = laser(mode=mode).measure(distances, np.random.default_rng(0))
    np.testing.assert_array_equal(ranges, np.array([[last, np.inf, np.inf]], np.float32))


def test_the_largest_range_is_a_valid_one():
    device = laser()
    scan = device.scan(0.0, device.measure(np.full((1, 181), 8.182), np.random.default_rng(0))[0], "laser")
    assert scan.valid().all()


def test_what_is_nearer_than_one_count_is_too_close():
    assert laser().measure(np.array([[0.0002]]), np.random.default_rng(0))[0, 0] == -np.inf


def test_noise_has_the_standard_deviation_set():
    ranges = laser(noise=0.02).measure(np.full((500, 181), 4.0), np.random.default_rng(0))
    assert np.std(ranges) == pytest.approx(0.02, rel=0.02)  # 90,500 samples: sigma known to 0.24 %


def test_noise_has_no_bias():
    ranges = laser(noise=0.02).measure(np.full((500, 181), 4.0), np.random.default_rng(0))
    assert abs(float(np.mean(ranges, dtype=float)) - 4.0) < 5 * 0.02 / math.sqrt(500 * 181)


def test_mixed_pixels_lie_between_near_and_far():
    distances = np.tile(np.where(np.arange(181) < 90, 2.0, 5.0), (400, 1))
    ranges = laser(mixed=True).measure(distances, np.random.default_rng(0))
    mixed = ranges[(ranges != np.float32(2.0)) & (ranges != np.float32(5.0))]
    assert len(mixed) > 20 and mixed.min() >= 2.0 and mixed.max() <= 5.0


def test_mixed_pixels_are_beside_edges_only():
    distances = np.tile(np.where(np.arange(181) < 90, 2.0, 5.0), (400, 1))
    ranges = laser(mixed=True).measure(distances, np.random.default_rng(0))
    assert set(np.nonzero(np.abs(ranges - distances) > 1e-3)[1]) == {89, 90}


def test_small_steps_make_no_mixed_pixels():
    distances = np.tile(np.where(np.arange(181) % 2 == 0, 2.0, 2.0 + 0.9 * MIXED_PIXEL_JUMP), (100, 1))
    ranges = laser(mixed=True).measure(distances, np.random.default_rng(0))
    np.testing.assert_allclose(ranges, distances, atol=1e-3)


def test_an_edge_against_nothing_makes_no_mixed_pixels():
    distances = np.tile(np.where(np.arange(181) < 90, 2.0, np.inf), (400, 1))
    np.testing.assert_array_equal(laser(mixed=True).measure(distances, np.random.default_rng(0)), distances)
