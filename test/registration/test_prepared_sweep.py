# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.config import SweepConfig
from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud
from g2_recon.registration import prepared_sweep
from g2_recon.registration.prepared_sweep import flatten, implausible_scale, middles_of_cubes, prepare, usable

CONFIG = SweepConfig()


def wall(seed=0, at=2.8, noise=0.01):
    """4 m x 2 m, 1 cm of noise, beside the border of cubes of 14 cm at 20 x 0.14 = 2.8 m."""
    rng = np.random.default_rng(seed)
    return np.column_stack([at + rng.normal(0, noise, 8000), rng.uniform(-2, 2, 8000), rng.uniform(-1, 1, 8000)])


def flatten_plainly(points, counts, keys, steps):
    result, flat = points.copy(), np.zeros(len(points), bool)
    around = [x * steps[0] + y * steps[1] + z for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
    for row, key in enumerate(keys):
        near = np.flatnonzero(np.isin(keys, key + np.array(around)))
        center = np.average(points[near], axis=0, weights=counts[near])
        covariance = np.cov(points[near].T, aweights=counts[near], bias=True) if len(near) > 1 else np.zeros((3, 3))
        values, vectors = np.linalg.eigh(covariance)
        if len(near) >= prepared_sweep._FEWEST_ON_PLANE and values[0] <= prepared_sweep._FLAT * values[1]:
            result[row] -= vectors[:, 0] * (vectors[:, 0] @ (points[row] - center))
            flat[row] = True
    return result, flat


def test_the_kernel_that_flattens_does_what_plain_numpy_does():
    rng = np.random.default_rng(3)
    cells = rng.integers(0, 6, (120, 3)) + 1
    # Half a block, half a wall.
    cells[cells[:, 0] < 4, 2] = 1
    cells = np.unique(cells, axis=0)
    steps = np.array([64, 8])
    keys = cells @ np.array([64, 8, 1])
    order = np.argsort(keys)
    points = cells[order] + rng.uniform(0, 1, cells.shape) * [1, 1, 0.05]
    counts = rng.integers(1, 20, len(cells)).astype(float)
    found, flat = flatten(points, counts, keys[order], steps)
    expected, expected_flat = flatten_plainly(points, counts, keys[order], steps)
    assert found == pytest.approx(expected, abs=1e-9)
    assert flat.tolist() == expected_flat.tolist()
    assert flat.any() and not flat.all()


@pytest.mark.parametrize(("edge", "size"), [(0.14, 3.0), (0.01, 190.0)])
def test_the_kernel_that_sorts_points_into_cubes_does_what_plain_numpy_does(edge, size):
    points = np.random.default_rng(4).uniform(-size, size, (2000, 3)) * [1, 1, 0.1]
    cells, cube, count = np.unique(np.floor(points / edge), axis=0, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(cube.reshape(-1), column) for column in points.T], axis=1) / count[:, None]
    found_means, found_count, keys, steps = middles_of_cubes(points, edge)
    assert found_means == pytest.approx(means, abs=1e-9)
    assert found_count.tolist() == count.tolist()
    assert (np.diff(keys) > 0).all()
    # Numbers and cubes say the same: how many steps it is from the first cube.
    assert (keys - keys[0]).tolist() == ((cells - cells[0]) @ [*steps, 1]).astype(int).tolist()


@pytest.mark.parametrize("at", [2.8, 2.805, 2.82, 2.87])
def test_a_wall_is_where_its_points_are_wherever_the_cubes_begin(at):
    points = prepare(wall(at=at), CONFIG).points
    # A millimetre: 1 cm of noise over the 100 and more points around each.
    assert np.median(points[:, 0]) == pytest.approx(at, abs=0.001)
    assert points[:, 0].std() < 0.004


def test_no_two_points_are_left_in_one_cube_and_normals_are_unit():
    sweep = prepare(wall(), CONFIG)
    assert len(sweep.points) < 2 * (4 / 0.14 + 2) * (2 / 0.14 + 2)
    assert np.linalg.norm(sweep.normals, axis=1) == pytest.approx(1.0)


def test_what_was_looked_through_is_known_and_what_is_behind_or_beside_is_not():
    sweep = prepare(wall(), CONFIG)
    places = np.array([[1.0, 0, 0], [2.0, 0.3, 0.1], [2.75, 0, 0], [3.5, 0, 0], [-1.0, 0, 0], [1.0, 3.0, 0]])
    assert sweep.seen_through(places, 0.15).tolist() == [True, True, False, False, False, False]


def test_the_image_of_ranges_has_the_nearest_point_of_each_direction_and_those_beside_it():
    points = np.array([[3.0, 0, 0], [2.0, 0, 0], [5.0, 5.0, 0]])
    image = prepared_sweep._nearest(points)
    assert np.nanmin(image) == 2.0
    assert int(np.isfinite(image).sum()) == 2


def test_points_that_do_not_count_are_left_out():
    points = np.vstack([wall(), [[np.nan, 0, 0], [np.inf, 0, 0], [0.05, 0, 0], [300, 0, 0]]])
    assert len(usable(points, CONFIG)) == 8000


def test_one_point_a_million_times_is_no_sweep():
    with pytest.raises(InputError, match="1000000 points fills 1 voxels"):
        prepare(np.tile([1.0, 2.0, 0.5], (1_000_000, 1)), CONFIG)


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (np.empty((0, 3)), "no point"),
        (np.full((9, 3), np.nan), "finite"),
        (np.zeros((9, 3)), "0.2 to 30 m"),
        (np.zeros((9, 2)), r"\(N, 3\)"),
        (1000 * wall(), "set scale, such as 0.001"),
        (np.full((9, 3), 1e100), "set scale"),
    ],
)
def test_a_sweep_without_a_point_that_counts_is_refused_with_the_reason(points, said):
    with pytest.raises(InputError, match=said):
        prepare(points, CONFIG)


def test_millimetres_are_warned_of_and_scaled_by_a_setting():
    assert "scale to 0.001" in implausible_scale(1000 * wall(), CONFIG)
    assert implausible_scale(wall(), CONFIG) == ""
    millimetres = SweepConfig(scale=0.001)
    assert implausible_scale(1000 * wall(), millimetres) == ""
    assert prepare(1000 * wall(), millimetres).points == pytest.approx(prepare(wall(), CONFIG).points, abs=1e-9)


def test_a_cloud_is_a_sweep_too():
    assert np.array_equal(prepare(Cloud(wall()), CONFIG).points, prepare(wall(), CONFIG).points)
