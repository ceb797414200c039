# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Where one sweep may lie on another, from a poor guess: correlation of what stands upright, seen from above.

As E. Olson, "Real-time correlative scan matching", ICRA 2009: all headings and shifts in a window are tried, shifts at
once by Fourier transforms. A robot stands level, so height, roll and pitch stay as they were guessed.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from g2_recon.config import SweepConfig
from g2_recon.geometry import se3
from g2_recon.registration.prepared_sweep import PreparedSweep

Float = NDArray[np.float64]

_CELL_M = 0.2
_BLUR_CELLS = 1.0
_YAW_STEP = math.radians(4.0)
# Normals this level belong to walls; the walls along x and those along y are told apart.
_LEVEL = 0.5
_CANDIDATES = 8
_APART_M, _APART_RAD = 0.6, math.radians(10.0)


def candidates(moving: PreparedSweep, fixed: PreparedSweep, T_guess: Float, config: SweepConfig) -> list[Float]:
    """Guesses T_fixed_moving (4, 4) within the window of `search` and `search_angle` around one, the best first."""
    walls = np.abs(fixed.normals[:, 2]) < _LEVEL
    placed = se3.transform_points(T_guess, moving.points)
    normals = moving.normals @ T_guess[:3, :3].T
    upright = np.abs(normals[:, 2]) < _LEVEL
    if not walls.any() or not upright.any():
        return []
    center = T_guess[:2, 3]
    arms = placed[upright, :2] - center
    reach = float(np.abs(arms).max() * math.sqrt(2)) + config.search + _CELL_M
    low = center - reach
    size = fft.next_fast_len(2 * math.ceil(reach / _CELL_M) + 1, real=True)
    target = np.conj(_transformed(fixed.points[walls, :2], fixed.normals[walls, :2], low, size, blur=True))

    steps = max(1, math.floor(config.search_angle / _YAW_STEP)) if config.search_angle else 0
    window = math.ceil(config.search / _CELL_M)
    shifts = np.arange(-window, window + 1)
    scored: list[tuple[float, float, Float]] = []
    for yaw in _YAW_STEP * np.arange(-steps, steps + 1):
        turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        source = _transformed(arms @ turn.T + center, normals[upright, :2] @ turn.T, low, size, blur=False)
        # Correlation at shift s is where target(cell + s) meets source(cell).
        scores = fft.irfft2((np.conj(target) * np.conj(source)).sum(axis=0), (size, size))[np.ix_(shifts, shifts)]
        peaks = np.argwhere(scores == ndimage.maximum_filter(scores, 5))
        scored += [(float(scores[i, j]), float(yaw), _CELL_M * shifts[[i, j]].astype(float)) for i, j in peaks]
    scored.sort(key=lambda entry: -entry[0])
    return [_moved(T_guess, yaw, shift) for yaw, shift in _distinct(scored)]


def _transformed(places: Float, normals: Float, low: Float, size: int, *, blur: bool) -> NDArray[np.complex128]:
    """Fourier transforms (2, size, size / 2 + 1) of the images of walls by the axis that they face."""
    cells = np.floor((places - low) / _CELL_M).astype(np.int64)
    inside = ((cells >= 0) & (cells < size)).all(axis=1)
    images = np.zeros((2, size, size))
    for axis in range(2):
        which = cells[inside & (normals[:, axis] ** 2 >= normals[:, 1 - axis] ** 2)]
        # A cell counts once, whatever the height of the wall in it and how near the laser was.
        images[axis, which[:, 0], which[:, 1]] = 1.0
        if blur:
            images[axis] = ndimage.gaussian_filter(images[axis], _BLUR_CELLS)
    return np.asarray(fft.rfft2(images))


def _distinct(scored: list[tuple[float, float, Float]]) -> list[tuple[float, Float]]:
    """The best heading and shift of each place."""
    taken: list[tuple[float, Float]] = []
    for _, yaw, shift in scored:
        if len(taken) == _CANDIDATES:
            break
        if all(abs(yaw - y) >= _APART_RAD or np.linalg.norm(shift - s) >= _APART_M for y, s in taken):
            taken.append((yaw, shift))
    return taken


def _moved(T: Float, yaw: float, shift: Float) -> Float:
    """A transform turned on the spot about the vertical axis and shifted along the floor."""
    result = se3.from_xyz_rpy([0, 0, 0, 0, 0, yaw]) @ T
    result[:3, 3] = T[:3, 3] + [*shift, 0.0]
    return result
