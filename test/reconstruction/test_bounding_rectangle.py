# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from g2_recon.reconstruction.bounding_rectangle import bounding_rectangle


def turned(points: np.ndarray, angle: float) -> np.ndarray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return points @ np.array([[cosine, sine], [-sine, cosine]])


def area(points: np.ndarray) -> float:
    _, _, low, high = bounding_rectangle(*points.T.copy(), 0.0)
    return float(np.prod(high - low))


@pytest.mark.parametrize("seed", range(10))
def test_no_rectangle_at_any_angle_is_smaller(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(int(rng.integers(3, 60)), 2)) * (3, 1)
    areas = [np.prod(np.ptp(turned(points, angle), axis=0)) for angle in np.linspace(0, np.pi / 2, 5001)]
    # The best of these angles is off by at most 0.16 mrad, and the rectangle up to twice the length of a side times
    # this wider along the other.
    assert min(areas) * (1 - 2e-3) <= area(points) <= min(areas) * (1 + 1e-12)


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.2, np.pi / 2, 2.5, -0.7])
def test_a_grid_turned_by_any_angle_gets_its_own_rectangle(angle: float) -> None:
    grid = np.stack(np.meshgrid(np.arange(8.0), np.arange(4.0)), axis=-1).reshape(-1, 2)
    points = turned(grid, angle)
    cosine, sine, low, high = bounding_rectangle(*points.T.copy(), 0.0)
    assert sorted(high - low) == pytest.approx([3, 7])
    assert np.hypot(cosine, sine) == pytest.approx(1)
    along = points @ np.array([[cosine, -sine], [sine, cosine]])
    assert along.min(axis=0) == pytest.approx(low)
    assert along.max(axis=0) == pytest.approx(high)


@pytest.mark.parametrize("count", [1, 2, 5, 101, 1000])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.25])
def test_stray_points_beyond_each_side_are_counted_as_quantiles(count: int, share: float) -> None:
    points = np.random.default_rng(count).random((count, 2))
    cosine, sine, low, high = bounding_rectangle(*points.T.copy(), share)
    along = points @ np.array([[cosine, -sine], [sine, cosine]])
    assert low == pytest.approx(np.quantile(along, share, axis=0), abs=1e-12)
    assert high == pytest.approx(np.quantile(along, 1 - share, axis=0), abs=1e-12)


@pytest.mark.parametrize(
    ("points", "sides"),
    [
        ([(1, 2)], [0, 0]),
        ([(1, 2)] * 5, [0, 0]),
        ([(0, 0), (3, 4)], [0, 5]),
        ([(1, 0), (1, 2), (1, 7)], [0, 7]),
        ([(0, 0), (2, 2), (1, 1), (2, 2)], [0, np.sqrt(8)]),
    ],
)
def test_points_on_a_line_get_a_rectangle_without_width(points: list[tuple[float, float]], sides: list[float]) -> None:
    _, _, low, high = bounding_rectangle(*np.array(points, float).T.copy(), 0.0)
    assert sorted(high - low) == pytest.approx(sides, abs=1e-12)
