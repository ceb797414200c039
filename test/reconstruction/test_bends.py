# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from g2_recon.reconstruction.bends import bend_normals, fit_bend, onto_bend

SPACING = 0.2


def patch(count: int = 400, seed: int = 0, side: float = 1.2) -> np.ndarray:
    return (np.random.default_rng(seed).random((2, count)) - 0.5) * side


def fitted(x: np.ndarray, y: np.ndarray, z: np.ndarray, noise: float) -> tuple[np.ndarray, float]:
    return fit_bend(x, y, z, np.ones(len(x)), SPACING, noise)


@pytest.mark.parametrize("noise", [0.01, 0.03])
@pytest.mark.parametrize("seed", range(20))
def test_a_plane_with_noise_is_no_bend(noise: float, seed: int) -> None:
    x, y = patch(seed=seed)
    z = 0.01 * x + np.random.default_rng(seed + 100).normal(0, noise, len(x))
    assert fitted(x, y, z, noise)[1] == np.inf


@pytest.mark.parametrize("seed", range(5))
def test_a_paraboloid_is_found_with_its_coefficients(seed: int) -> None:
    x, y = patch(seed=seed)
    true = np.array([0.02, 0.05, -0.03, 0.4, 0.1, -0.2])
    z = np.random.default_rng(seed).normal(onto_bend(true, np.column_stack([x, y, x]))[:, 2], 0.01)
    coefficients, deviation = fitted(x, y, z, 0.01)
    # Five standard errors: 1 cm over the root of 400 points, over the spread of monomials of 60 cm at most.
    assert np.abs(coefficients - true)[:3].max() < 0.01
    assert np.abs(coefficients - true)[3:].max() < 0.05
    assert deviation == pytest.approx(0.01, rel=0.15)


def test_without_noise_the_fit_is_exact() -> None:
    x, y = patch()
    coefficients, deviation = fitted(x, y, 0.1 + 0.3 * x * x - 0.2 * x * y, 0.01)
    assert coefficients == pytest.approx([0.1, 0, 0, 0.3, -0.2, 0], abs=1e-6)
    assert deviation < 1e-4


def test_the_fit_is_that_of_weighted_least_squares() -> None:
    """A plain twin: without points off by 2.5 deviations, one round of lstsq."""
    x, y = patch()
    rng = np.random.default_rng(1)
    weights, z = rng.uniform(0.5, 2, 400), 0.3 * x * x + rng.uniform(-0.01, 0.01, 400)
    columns = np.column_stack([np.ones(400), x, y, x * x, x * y, y * y])
    root = np.sqrt(weights)
    expected = np.linalg.lstsq(columns * root[:, None], z * root)[0]
    assert fit_bend(x, y, z, weights, SPACING, 0.01)[0] == pytest.approx(expected, abs=1e-5)


def test_points_far_off_do_not_bend_the_bend() -> None:
    x, y = patch()
    z = 0.3 * x * x + np.random.default_rng(1).normal(0, 0.005, 400)
    z[:12] += 0.1
    coefficients, _ = fitted(x, y, z, 0.005)
    assert coefficients == pytest.approx([0, 0, 0, 0.3, 0, 0], abs=0.02)


@pytest.mark.parametrize("count", [0, 1, 2, 11])
def test_a_few_points_are_no_bend(count: int) -> None:
    x, y = patch(count)
    assert fitted(x, y, x * x, 0.0)[1] == np.inf


@pytest.mark.parametrize("shape", ["one place", "a line", "two places"])
def test_points_that_give_no_surface_give_no_number_that_is_not_finite(shape: str) -> None:
    x, y = patch()
    x, y = {"one place": (0 * x, 0 * y), "a line": (x, 0 * y), "two places": (np.sign(x), np.sign(x))}[shape]
    coefficients, _ = fitted(x, y, 0.01 * np.random.default_rng(0).normal(size=400), 0.001)
    assert np.isfinite(coefficients).all()


def test_normals_stand_on_the_bend_and_point_upwards() -> None:
    bends, x = np.random.default_rng(0).normal(size=(50, 6)), np.random.default_rng(1).normal(size=(50, 3))
    normals, step = bend_normals(bends, x), 1e-6
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1)
    assert (normals[:, 2] > 0).all()
    for axis in range(2):
        along = (onto_bend(bends, x + step * np.eye(3)[axis]) - onto_bend(bends, x - step * np.eye(3)[axis])) / step
        # Of central differences in double precision.
        assert np.einsum("ni,ni->n", along, normals) == pytest.approx(0, abs=1e-7)


def test_one_bend_for_all_points_is_the_same_as_one_each() -> None:
    bend, x = np.arange(6.0), np.random.default_rng(1).normal(size=(5, 3))
    assert onto_bend(bend, x).tolist() == onto_bend(np.tile(bend, (5, 1)), x).tolist()
    assert bend_normals(bend, x).tolist() == bend_normals(np.tile(bend, (5, 1)), x).tolist()
