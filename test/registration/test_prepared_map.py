# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.config import SweepConfig
from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud
from g2_recon.registration.prepared_map import count_beams, prepare_map

CONFIG = SweepConfig()


def count_plainly(beams, sensors, points, corner, edge, behind):
    for sensor, point in zip(sensors, points, strict=True):
        length = np.linalg.norm(point - sensor)
        for step in range(int((length - behind) / edge)):
            place = sensor + (step + 0.5) * edge / length * (point - sensor)
            cube = tuple(np.floor((place - corner) / edge).astype(int))
            beams[cube] = min(255, int(beams[cube]) + 1)


def test_the_kernel_that_counts_beams_does_what_plain_numpy_does():
    rng = np.random.default_rng(0)
    sensors, points = rng.uniform(0.0, 1.0, (40, 3)), rng.uniform(0.0, 6.0, (40, 3))
    found, plain = np.zeros((2, 31, 31, 31), np.uint8)
    for beams, count in ((found, count_beams), (plain, count_plainly)):
        count(beams, sensors, points, np.full(3, -0.01), 0.2, 0.3)
    assert found.any()
    np.testing.assert_array_equal(found, plain)


def wall(x=4.0, at=(0.0, 0.0, 1.0)):
    """A wall of 4 m x 2 m across x, a point each 4 cm, seen from one place."""
    y, z = (grid.ravel() for grid in np.meshgrid(np.arange(-2, 2, 0.04), np.arange(0, 2, 0.04)))
    points = np.column_stack([np.full_like(y, x), y, z])
    return Cloud(points, np.tile(at, (len(points), 1)))


def test_what_lies_before_a_wall_was_looked_through_and_what_lies_behind_it_was_not():
    prepared = prepare_map(wall(), CONFIG)
    places = np.array([[2.0, 0.0, 1.0], [3.0, 0.5, 1.2], [4.5, 0.0, 1.0], [2.0, 3.0, 1.0], [-9.0, 0.0, 1.0]])
    assert prepared.seen_through(places, 0.0).tolist() == [True, True, False, False, False]


def test_what_is_farther_from_its_laser_than_counts_is_left_out():
    cloud = wall(x=8.0)
    assert prepare_map(cloud, CONFIG).points[:, 0] == pytest.approx(8.0)
    with pytest.raises(InputError):
        prepare_map(cloud, SweepConfig(max_range=5.0))


def test_a_cloud_that_does_not_say_where_it_was_seen_from_is_refused():
    with pytest.raises(InputError, match="seen from"):
        prepare_map(Cloud(wall().points), CONFIG)


def test_a_map_that_is_absurdly_large_is_refused():
    cloud = wall()
    far = Cloud(np.concatenate([cloud.points, cloud.points + 5000.0]), np.concatenate([cloud.sensor] * 2) + 0.0)
    far.sensor[len(cloud) :] += 5000.0
    with pytest.raises(InputError, match="too large"):
        prepare_map(far, CONFIG)
