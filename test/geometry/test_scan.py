# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from g2_recon.errors import InputError
from g2_recon.geometry import sick_lms
from g2_recon.geometry.scan import Scan


def scan(ranges, **settings):
    return Scan(0.0, np.array(ranges, np.float32), -np.pi / 2, np.pi / 4, **settings)


def test_beams_run_counterclockwise_from_the_right():
    points, beams = scan([1, 1, 2, 1, 1]).points()
    assert points[[0, 2, 4]] == pytest.approx(np.array([[0, -1], [2, 0], [0, 1]]), abs=1e-7)
    assert beams.tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("no_measurement", [math.nan, math.inf, -math.inf, 0.0, -1.0, 0.05, 81.0])
def test_what_is_no_measurement_makes_no_point(no_measurement):
    points, beams = scan([1, no_measurement, 1], range_min=0.1, range_max=80.0).points()
    assert len(points) == 2
    assert beams.tolist() == [0, 2]


def test_limits_of_the_caller_count_beside_those_of_the_laser():
    assert scan([1, 5, 9], range_max=8.0).valid(range_min=2.0).tolist() == [False, True, False]


def test_the_ends_of_the_range_are_measurements():
    assert scan([0.5, 8.0], range_min=0.5, range_max=8.0).valid().all()


def test_each_beam_has_its_own_time():
    assert scan([1, 1, 1], time_increment=0.01).beam_stamps() == pytest.approx([0, 0.01, 0.02])


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_a_scan_without_a_finite_start_angle_is_refused(number):
    with pytest.raises(InputError, match="finite"):
        Scan(0.0, np.ones(3, np.float32), number, 0.1)


def test_a_scan_whose_beams_all_point_the_same_way_is_refused():
    with pytest.raises(InputError, match="increment"):
        Scan(0.0, np.ones(3, np.float32), 0.0, 0.0)


@pytest.mark.parametrize(
    ("largest", "threshold"), [(81.91, 50.0), (50.0, 50.0), (8.183, 8.183), (8.191, 8.183), (7.5, 50.0), (30.0, 50.0)]
)
def test_the_code_for_no_return_is_told_from_the_largest_reading(largest, threshold):
    assert sick_lms.no_return_threshold(np.array([1.0, largest])) == pytest.approx(threshold)


@pytest.mark.parametrize(
    ("count", "stated", "spacing"),
    [
        (180, math.pi / 179, math.radians(1)),
        (360, math.pi / 359, math.radians(0.5)),
        (181, math.pi / 180, math.pi / 180),
        (180, 0.004, 0.004),
        (180, -math.pi / 179, -math.radians(1)),
    ],
)
def test_the_one_known_mistake_in_beam_spacing_is_put_right(count, stated, spacing):
    assert sick_lms.beam_spacing(count, stated) == pytest.approx(spacing)
