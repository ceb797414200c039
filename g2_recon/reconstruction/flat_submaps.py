# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Submaps of flat clusters: a lattice fitted to the cluster's rectangle, trained in batches, laid onto its surface."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count as count_up
from threading import Lock
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.chunks import in_chunks
from g2_recon.geometry.sorting import sort_by_counting
from g2_recon.kernels import kernel
from g2_recon.progress import Progress, silent
from g2_recon.reconstruction.batch_training import train_sheet
from g2_recon.reconstruction.bends import bend_normals, fit_bend, onto_bend
from g2_recon.reconstruction.bounding_rectangle import bounding_rectangle
from g2_recon.reconstruction.lattice import Kind, Lattice, make_lattice
from g2_recon.reconstruction.triangulation import split_cells

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Of the extent of a cluster along each side of its rectangle, the share that stray points may have beyond it.
_STRAY = 0.01
# What is thinner than this many sigmas of noise, or than this share of the spacing, is explained by its plane or bend.
_THIN_NOISE = 1.35
_THIN_SPACING = 0.01
# What is narrower than this share of the spacing is a line, such as a scan with none beside it. It stands for the
# surface on both sides of it: its map is this share of the spacing wide.
_LINE, _LINE_WIDTH = 0.25, 0.5
# The plane of a neuron tilts by less than 45 deg against that of its cluster.
_LEAST_UPRIGHT = 0.7
# A symmetric matrix from its upper half.
_SYMMETRIC = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]


@dataclass(frozen=True, slots=True)
class FlatSubmaps:
    """The maps of all clusters.

    vertices: (V, 3) neurons on the surface, m. normals: (V, 3) of the surface there. center: (V, 3) a point on the
    tangent plane of each neuron. submap: (V,). faces: (F, 3) triangles of all cells, counterclockwise seen from the
    free side. hits: (V,) how many points each neuron has. covered: (V,) whether it has any, or on a line the one across
    has. bent: (K,) whether a submap lies on a bend. bmu: (N,) the neuron of each point.
    """

    vertices: Float
    normals: Float
    center: Float
    submap: Int
    faces: Int
    hits: Int
    covered: NDArray[np.bool_]
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
    lattice: Kind = "rectangular",
    workers: int = 0,
    progress: Progress = silent,
) -> FlatSubmaps:
    """One map a cluster (paper, section 3.2), with cells of about `spacing` metres.

    points: (N, 3), weights: (N,) area that each stands for, label: (N,) cluster, all >= 0, each with a point or more.
    plane_center, plane_normal: (K, 3) and thickness: (K,) of the clusters. The result does not depend on `workers`.
    """
    count = len(plane_center)
    order, begin = sort_by_counting(label, count)
    weights = weights[order]
    hexagonal = lattice == "hexagonal"
    flat = _Flat(np.empty((3, len(points))), _frames(plane_normal), np.empty((count, 2)), np.empty((count, 2)))
    bends, across, bmu = np.empty((count, 6)), np.empty(count), np.empty(len(points), np.int64)

    def lay_flat(k: int) -> None:
        own = slice(begin[k], begin[k + 1])
        _lay_flat(points, order[own], plane_center[k], flat.frames[k], *flat.points[:, own], flat.low[k], flat.high[k])

    _for_each(lay_flat, begin, workers)
    neurons, sheets = _sheets(lattice, flat, spacing)
    done, one_at_a_time = count_up(1), Lock()

    def train(k: int) -> None:
        own, first = slice(begin[k], begin[k + 1]), sheets.first[k]
        x, y, z = flat.points[:, own]
        rows, columns = sheets.shape[k]
        sheet = neurons[first : first + rows * columns]
        train_sheet(x, y, z, weights[own], sheet, rows, columns, hexagonal, epochs, bmu[own])
        bmu[own] += first
        bends[k], across[k] = fit_bend(x, y, z, weights[own], spacing, noise)
        with one_at_a_time:
            progress("training", next(done), count)

    _for_each(train, begin, workers)
    thin = max(_THIN_SPACING * spacing, _THIN_NOISE * noise)
    submap, bent = sheets.submap, across < thin
    # The plane of the cluster, where nothing better is known.
    normals, center = np.tile([0.0, 0.0, 1.0], (len(neurons), 1)), neurons * [1.0, 1.0, 0.0]
    on_bend, rough = bent[submap], (~bent & (thickness >= thin))[submap]
    normals[on_bend] = bend_normals(bends[submap[on_bend]], neurons[on_bend])
    center[on_bend] = onto_bend(bends[submap[on_bend]], neurons[on_bend])
    _take_local_planes(normals, center, rough, flat.points, weights, bmu, sheets)
    neurons = neurons - np.einsum("vi,vi->v", neurons - center, normals)[:, None] * normals
    hits = np.bincount(bmu, minlength=len(neurons))
    covered = _widen_lines(neurons, hits > 0, flat, sheets, spacing)
    frames, origin = flat.frames[submap], plane_center[submap]
    vertices = _turned(neurons, frames) + origin
    neuron_of_point = np.empty(len(points), np.int64)
    neuron_of_point[order] = bmu
    return FlatSubmaps(
        vertices=vertices,
        normals=_turned(normals, frames),
        center=_turned(center, frames) + origin,
        submap=submap,
        faces=_triangles(sheets, vertices),
        hits=hits,
        covered=covered,
        bent=bent,
        bmu=neuron_of_point,
    )


class _Flat(NamedTuple):
    """Clusters in frames of their own.

    points: (3, N) m, cluster by cluster. frames: (K, 3, 3), rows x, y, z, whose z axis is the normal of the plane and
    whose x and y axes are those of the smallest rectangle. low, high: (K, 2) corners of that, m.
    """

    points: Float
    frames: Float
    low: Float
    high: Float


class _Sheets(NamedTuple):
    """The lattices of all clusters, one after the other.

    submap: (V,) of each neuron. first: (K,) the first neuron of each. shape: (K, 2) rows and columns. lattices: K.
    """

    submap: Int
    first: Int
    shape: Int
    lattices: list[Lattice]


def _for_each(work: Callable[[int], None], begin: Int, workers: int) -> None:
    """Do the work of each cluster, in parallel, that of the largest first; begin: (K + 1,) of their points."""
    largest_first = np.argsort(-np.diff(begin), kind="stable").tolist()
    in_chunks(lambda place, _: work(largest_first[place]), len(largest_first), workers or os.cpu_count() or 1, chunk=1)


def _frames(normals: Float) -> Float:
    """Right-handed frames (K, 3, 3), rows x, y, z, whose z axes are the unit normals (K, 3)."""
    x = np.cross(np.eye(3)[np.argmin(np.abs(normals), axis=1)], normals)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(normals, x), normals], axis=1)


@kernel
def _lay_flat(points, order, center, frame, x, y, z, low, high):  # type: ignore[no-untyped-def]
    """Turn the frame (3, 3) of a cluster to the smallest rectangle around it; see _Flat.

    order: (n,) which of points (N, 3) it has. frame, their coordinates in it, x, y, z (n,), and the corners of the
    rectangle, low and high (2,), are filled in.
    """
    for i in range(len(order)):
        p = order[i]
        a, b, c = points[p, 0] - center[0], points[p, 1] - center[1], points[p, 2] - center[2]
        x[i] = a * frame[0, 0] + b * frame[0, 1] + c * frame[0, 2]
        y[i] = a * frame[1, 0] + b * frame[1, 1] + c * frame[1, 2]
        z[i] = a * frame[2, 0] + b * frame[2, 1] + c * frame[2, 2]
    cosine, sine, own_low, own_high = bounding_rectangle(x, y, _STRAY)
    low[0], low[1], high[0], high[1] = own_low[0], own_low[1], own_high[0], own_high[1]
    for i in range(len(order)):
        x[i], y[i] = cosine * x[i] + sine * y[i], cosine * y[i] - sine * x[i]
    for axis in range(3):
        one, other = frame[0, axis], frame[1, axis]
        frame[0, axis], frame[1, axis] = cosine * one + sine * other, cosine * other - sine * one


def _sheets(kind: Kind, flat: _Flat, spacing: float) -> tuple[Float, _Sheets]:
    """A flat lattice for each rectangle, its neurons (V, 3) in the middle of the cells that divide it."""
    step = spacing * np.array([math.sqrt(0.75) if kind == "hexagonal" else 1.0, 1.0])
    shape = np.maximum(2, np.rint((flat.high - flat.low) / step)).astype(np.int64)
    known = {each: make_lattice(kind, *each) for each in set(map(tuple, shape.tolist()))}
    lattices = [known[rows, columns] for rows, columns in shape.tolist()]
    sizes = shape.prod(axis=1)
    submap = np.repeat(np.arange(len(shape)), sizes)
    first = np.cumsum(sizes) - sizes
    row, column = np.divmod(np.arange(len(submap)) - first[submap], shape[submap, 1])
    # Rows of a hexagonal lattice are shifted by half a step against each other, and so by a quarter from the middle.
    shift = 0.5 * (row % 2) - 0.25 if kind == "hexagonal" else 0.0
    share = (np.column_stack([row, column + shift]) + 0.5) / shape[submap]
    place = flat.low[submap] + (flat.high - flat.low)[submap] * share
    return np.column_stack([place, np.zeros(len(place))]), _Sheets(submap, first, shape, lattices)


def _take_local_planes(
    normals: Float, center: Float, which: Mask, points: Float, weights: Float, bmu: Int, sheets: _Sheets
) -> None:
    """Put the planes through the data of neurons `which` (V,) and their eight neighbors into normals, center (V, 3).

    Only where a neuron has data and the plane lies about as the cluster does.
    """
    chosen = which[bmu]
    (x, y, z), w, bmu = points[:, chosen], weights[chosen], bmu[chosen]
    products = [w, w * x, w * y, w * z, w * x * x, w * x * y, w * x * z, w * y * y, w * y * z, w * z * z]
    moments = np.stack([np.bincount(bmu, product, len(which)) for product in products], axis=1).astype(float)
    number = np.flatnonzero(which & (moments[:, 0] > 0))
    around = _sums_of_neighbors(moments, sheets, number)
    mean = around[:, 1:4] / around[:, :1]
    scatter = (around[:, 4:] / around[:, :1])[:, _SYMMETRIC] - mean[:, :, None] * mean[:, None, :]
    fitted = np.linalg.eigh(scatter)[1][:, :, 0]
    fitted *= np.where(fitted[:, 2:] < 0, -1.0, 1.0)
    upright = fitted[:, 2] > _LEAST_UPRIGHT
    normals[number[upright]], center[number[upright]] = fitted[upright], mean[upright]


def _widen_lines(neurons: Float, covered: Mask, flat: _Flat, sheets: _Sheets, spacing: float) -> Mask:
    """Move the two rows of neurons (V, 3) of a map on a line apart, in place; covered (V,) where one of the two was."""
    narrow = flat.high - flat.low < _LINE * spacing
    covered = covered.copy()
    for axis in range(2):
        lines = narrow[:, axis] & ~narrow[:, 1 - axis]
        number = np.flatnonzero(lines[sheets.submap])
        own = sheets.submap[number]
        columns = sheets.shape[own, 1]
        side = np.divmod(number - sheets.first[own], columns)[axis]
        across = number + (1 - 2 * side) * (columns if axis == 0 else 1)
        middle = 0.5 * (neurons[number, axis] + neurons[across, axis])
        neurons[number, axis] = middle + (side - 0.5) * _LINE_WIDTH * spacing
        covered[number] |= covered[across]
    return covered


def _sums_of_neighbors(values: Float, sheets: _Sheets, number: Int) -> Float:
    """Sums (n, m) of values (V, m) over neurons `number` (n,) and up to eight around each in its lattice."""
    own = sheets.submap[number]
    rows, columns = sheets.shape[own].T
    row, column = np.divmod(number - sheets.first[own], columns)
    sums = np.zeros((len(number), values.shape[1]))
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            there = (row + down >= 0) & (row + down < rows) & (column + right >= 0) & (column + right < columns)
            sums[there] += values[(number + down * columns + right)[there]]
    return sums


def _triangles(sheets: _Sheets, vertices: Float) -> Int:
    """Triangles (F, 3) of all lattices, counterclockwise seen from the free side; whole cells are cut."""
    pairs = list(zip(sheets.lattices, sheets.first, strict=True))
    cells = np.concatenate([lattice.cells + first for lattice, first in pairs])
    triangles = np.concatenate([lattice.triangles + first for lattice, first in pairs])
    return np.concatenate([split_cells(vertices, cells), triangles])


def _turned(vectors: Float, frames: Float) -> Float:
    """Vectors (V, 3) out of frames (V, 3, 3)."""
    return np.einsum("va,vai->vi", vectors, frames)
