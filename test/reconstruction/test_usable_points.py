# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud
from g2_recon.reconstruction.usable_points import distinct_points, usable_points


def plane(count=3000):
    """Points of a square of 4 m in the plane z = 0, seen from 1 m above."""
    points = np.random.default_rng(0).uniform(0, 4, (count, 3)) * (1, 1, 0)
    return Cloud(points, points + (0, 0, 1.0))


def test_a_sound_cloud_is_taken_as_it_is():
    cloud = plane()
    assert usable_points(cloud, min_sensor_distance=0.5) == (cloud, {})


def test_points_that_are_not_finite_and_those_on_the_robot_are_left_out_and_counted():
    cloud = plane()
    cloud.points[:4] = np.nan
    cloud.sensor[4:7] = np.inf
    cloud.sensor[7:9] = cloud.points[7:9] + (0.0, 0.3, 0.39)
    usable, left_out = usable_points(cloud, min_sensor_distance=0.5, workers=2)
    assert left_out == {"not finite": 7, "nearer to the sensor than min_sensor_distance": 2}
    assert (usable.points == cloud.points[9:]).all()


def test_without_sensor_positions_nothing_is_near_the_sensor():
    assert usable_points(Cloud(plane().points), min_sensor_distance=0.5)[1] == {}


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.zeros((0, 3)), "0 distinct usable points"),
        (np.tile([[1.0, 2.0, 3.0]], (3000, 1)), "1 distinct usable points"),
        (np.outer(np.arange(3000.0), (0.01, 0.02, 0.03)), "one line"),
        (np.random.default_rng(0).uniform(-1e6, 1e6, (200, 3)), "m wide"),
    ],
)
def test_what_can_hold_no_surface_is_refused(points, reason):
    with pytest.raises(InputError, match=reason):
        usable_points(Cloud(points))


def test_a_surface_behind_many_equal_points_is_found():
    points = np.concatenate([np.zeros((2000, 3)), plane().points])
    assert distinct_points(points) == 3001
    assert len(usable_points(Cloud(points))[0]) == 5000
