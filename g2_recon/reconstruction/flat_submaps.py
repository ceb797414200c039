# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Submaps of flat clusters: a lattice fitted to the cluster's rectangle, trained in batches, laid onto its surface."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from g2_recon.progress import Progress, silent
from g2_recon.reconstruction.bends import fit_bend
from g2_recon.reconstruction.som import best_matching_units

Float = NDArray[np.float64]
Int = NDArray[np.int64]

# A final neighborhood of one lattice step would shrink each map by about a cell.
_WIDTH_END = 0.35
# Of the extent of a cluster along each side of its rectangle, the share that stray points may have beyond it.
_STRAY = 0.01
# What is thinner than this many sigmas of noise, or than this share of the spacing, is explained by its plane or bend.
_THIN_NOISE = 1.35
_THIN_SPACING = 0.01
# The elements of a symmetric matrix.
_PAIRS = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]


@dataclass(frozen=True, slots=True)
class FlatSubmaps:
    """The maps of all clusters.

    vertices: (V, 3) neurons on the surface, m. normals: (V, 3) of the surface there. center: (V, 3) a point on the
    tangent plane of each neuron. submap: (V,). faces: (F, 3) triangles of all cells, counterclockwise seen from the
    free side. hits: (V,) how many points each neuron has. bent: (K,) whether a submap lies on a bend. bmu: (N,) the
    neuron of each point.
    """

    vertices: Float
    normals: Float
    center: Float
    submap: Int
    faces: Int
    hits: Int
    bent: NDArray[np.bool_]
    bmu: Int


def train_submaps(
    points: Float,
    weights: Float,
    label: Int,
    plane_center: Float,
    plane_normal: Float,
    thickness: Float,
    *,
    spacing: float,
    noise: float,
    epochs: int,
    workers: int = 0,
    progress: Progress = silent,
) -> FlatSubmaps:
    """One map a cluster (paper, section 3.2), with cells of about `spacing` metres.

    points: (N, 3), weights: (N,) area that each stands for, label: (N,) cluster, all >= 0. plane_center, plane_normal:
    (K, 3) and thickness: (K,) of the clusters.
    """
    order = np.argsort(label, kind="stable")
    members = np.split(order, np.cumsum(np.bincount(label, minlength=len(plane_center)))[:-1])
    thin = max(_THIN_SPACING * spacing, _THIN_NOISE * noise)

    def train(number: int) -> tuple[Float, Float, Float, Int, Int, Int, bool]:
        own = members[number]
        axes = frame_of(plane_normal[number])
        inside = (points[own] - plane_center[number]) @ axes.T
        turn, low, high = bounding_rectangle(inside[:, :2])
        local = np.column_stack([inside[:, :2] @ turn.T, inside[:, 2]])
        rows, columns = (max(2, round(float(side) / spacing)) for side in high - low)
        neurons = _sheet(low, high, rows, columns)
        bmu, hits = _train_batch(local, weights[own], neurons, rows, columns, epochs, _WIDTH_END)
        bend = fit_bend(local, weights[own], spacing=spacing, noise=noise)
        bent = bend is not None and bend.deviation < thin
        if bend is not None and bent:
            normal, offset = bend.normals(neurons), bend.onto(neurons)
        elif thickness[number] < thin:
            normal, offset = np.tile([0.0, 0.0, 1.0], (len(neurons), 1)), neurons * [1.0, 1.0, 0.0]
        else:
            normal, offset = _local_planes(local, weights[own], bmu, neurons, rows, columns)
        neurons = neurons - np.einsum("ij,ij->i", neurons - offset, normal)[:, None] * normal
        back = np.vstack([turn @ axes[:2], axes[2]])
        return (
            neurons @ back + plane_center[number],
            normal @ back,
            offset @ back + plane_center[number],
            _triangles(neurons, rows, columns),
            hits,
            bmu,
            bent,
        )

    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        parts = []
        for done, part in enumerate(pool.map(train, range(len(members))), start=1):
            parts.append(part)
            progress("training", done, len(members))
    sizes = np.array([len(part[0]) for part in parts])
    first = np.r_[0, np.cumsum(sizes)[:-1]]
    bmu = np.empty(len(points), np.int64)
    for number, part in enumerate(parts):
        bmu[members[number]] = part[5] + first[number]
    return FlatSubmaps(
        vertices=np.concatenate([part[0] for part in parts]),
        normals=np.concatenate([part[1] for part in parts]),
        center=np.concatenate([part[2] for part in parts]),
        submap=np.repeat(np.arange(len(parts)), sizes),
        faces=np.concatenate([part[3] + start for part, start in zip(parts, first, strict=True)]),
        hits=np.concatenate([part[4] for part in parts]),
        bent=np.array([part[6] for part in parts]),
        bmu=bmu,
    )


def frame_of(normal: Float) -> Float:
    """A right-handed frame (3, 3), rows x, y, z, whose z axis is the unit normal (3,)."""
    helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
    x = np.cross(helper, normal)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal])


def bounding_rectangle(points: Float) -> tuple[Float, Float, Float]:
    """The smallest rectangle around points (N, 2): turn (2, 2) into its axes, and its low and high corner there.

    One side of the smallest rectangle lies on the convex hull (Freeman and Shapira, 1975).
    """
    try:
        hull = points[ConvexHull(points).vertices]
    except QhullError:  # all on a line, or fewer than three
        hull = points
    side = np.roll(hull, -1, axis=0) - hull
    angle = np.unique(np.mod(np.arctan2(side[:, 1], side[:, 0]), np.pi / 2).round(9))
    cos, sin = np.cos(angle), np.sin(angle)
    along = hull[:, :1] * cos + hull[:, 1:] * sin
    across = hull[:, 1:] * cos - hull[:, :1] * sin
    best = int(np.argmin(np.ptp(along, axis=0) * np.ptp(across, axis=0)))
    turn = np.array([[cos[best], sin[best]], [-sin[best], cos[best]]])
    low, high = np.quantile(points @ turn.T, [_STRAY, 1 - _STRAY], axis=0)
    return turn, low, high


def _sheet(low: Float, high: Float, rows: int, columns: int) -> Float:
    """A flat lattice (rows * columns, 3) in the middle of the cells that divide a rectangle."""
    x = low[0] + (high[0] - low[0]) * (np.arange(rows) + 0.5) / rows
    y = low[1] + (high[1] - low[1]) * (np.arange(columns) + 0.5) / columns
    return np.column_stack([np.repeat(x, columns), np.tile(y, rows), np.zeros(rows * columns)])


def _triangles(neurons: Float, rows: int, columns: int) -> Int:
    """Two triangles (F, 3) a cell, cut along the shorter diagonal, counterclockwise seen from +z."""
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b = number[:-1, :-1].ravel(), number[1:, :-1].ravel()
    c, d = number[1:, 1:].ravel(), number[:-1, 1:].ravel()
    along_ac = np.linalg.norm(neurons[a] - neurons[c], axis=1) <= np.linalg.norm(neurons[b] - neurons[d], axis=1)
    first = np.where(along_ac, np.stack([a, b, c]), np.stack([a, b, d]))
    second = np.where(along_ac, np.stack([a, c, d]), np.stack([b, c, d]))
    return np.concatenate([first.T, second.T]).astype(np.int64)


@numba.njit(cache=True, nogil=True, fastmath=True)
def _train_batch(points, weights, neurons, rows, columns, epochs, width_end):  # type: ignore[no-untyped-def]
    """Batch rule; the neighborhood of a rectangular lattice is separable, rows first, then columns.

    neurons (n, 3) are changed in place. Returns the best matching unit of each point and the points of each neuron.
    """
    count = rows * columns
    sums, by_rows = np.empty((count, 4)), np.empty((count, 4))
    kernel = np.empty(max(rows, columns))
    width_start = max(max(rows, columns) / 2.0, width_end)
    for epoch in range(epochs):
        width = width_start * (width_end / width_start) ** (epoch / max(epochs - 1, 1))
        for d in range(len(kernel)):
            kernel[d] = np.exp(-0.5 * (d / width) ** 2)
        bmu = best_matching_units(points, neurons)
        sums[:] = 0.0
        for i in range(len(points)):
            m, w = bmu[i], weights[i]
            sums[m, 0] += w * points[i, 0]
            sums[m, 1] += w * points[i, 1]
            sums[m, 2] += w * points[i, 2]
            sums[m, 3] += w
        by_rows[:] = 0.0
        for r in range(rows):
            for s in range(rows):
                h = kernel[abs(r - s)]
                if h > 1e-7:
                    for c in range(columns):
                        for k in range(4):
                            by_rows[r * columns + c, k] += h * sums[s * columns + c, k]
        for r in range(rows):
            for c in range(columns):
                x = y = z = total = 0.0
                for s in range(columns):
                    h = kernel[abs(c - s)]
                    if h > 1e-7:
                        j = r * columns + s
                        x += h * by_rows[j, 0]
                        y += h * by_rows[j, 1]
                        z += h * by_rows[j, 2]
                        total += h * by_rows[j, 3]
                if total > 1e-9:
                    j = r * columns + c
                    neurons[j, 0], neurons[j, 1], neurons[j, 2] = x / total, y / total, z / total
    bmu = best_matching_units(points, neurons)
    hits = np.zeros(count, np.int64)
    for i in range(len(points)):
        hits[bmu[i]] += 1
    return bmu, hits


def _local_planes(
    points: Float, weights: Float, bmu: Int, neurons: Float, rows: int, columns: int
) -> tuple[Float, Float]:
    """Normal (n, 3) and a point (n, 3) of the plane through the data of each neuron and its eight neighbors.

    Where these do not give one that lies about as the cluster does, the plane of the cluster, z = 0.
    """
    count = rows * columns
    normal, offset = np.tile([0.0, 0.0, 1.0], (count, 1)), np.zeros((count, 3))
    columns_of_moments = [weights, *(weights * points[:, a] for a in range(3))]
    columns_of_moments += [weights * points[:, a] * points[:, b] for a, b in _PAIRS]
    moments = np.stack([np.bincount(bmu, column, count) for column in columns_of_moments], axis=1)
    padded = np.pad(moments.reshape(rows, columns, -1), ((1, 1), (1, 1), (0, 0)))
    shifted = [padded[a : a + rows, b : b + columns] for a in range(3) for b in range(3)]
    around = np.sum(shifted, axis=0).reshape(count, -1)
    total = np.maximum(around[:, 0], 1e-12)
    mean = around[:, 1:4] / total[:, None]
    scatter = np.empty((count, 3, 3))
    for column, (a, b) in enumerate(_PAIRS, start=4):
        scatter[:, a, b] = scatter[:, b, a] = around[:, column] / total - mean[:, a] * mean[:, b]
    fitted = np.linalg.eigh(scatter)[1][:, :, 0]
    fitted *= np.where(fitted[:, 2] < 0, -1.0, 1.0)[:, None]
    used = (np.bincount(bmu, minlength=count) > 0) & (fitted[:, 2] > 0.7) & (around[:, 0] > 0)
    normal[used], offset[used] = fitted[used], mean[used]
    return normal, offset
