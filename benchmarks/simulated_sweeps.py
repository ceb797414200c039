# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Sweeps of a tilting laser in simulated rooms, each with the pose that it was taken from."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g2_recon.geometry import se3
from g2_recon.simulation.building import CEILING, Building, Rectangles, box, cabinet, door, room, surfaces
from g2_recon.simulation.raycasting import cast

Float = NDArray[np.float64]

BEAMS, TILTS = 181, 200
RANGE_NOISE_M = 0.01
HEIGHT_M = 0.75
RING_STOPS = 12


def sweep(
    rectangles: Rectangles, T_building_laser: Float, rng: np.random.Generator, *, noise: float = RANGE_NOISE_M
) -> Float:
    """Points (36200, 3) in metres in the frame of the laser: 200 tilts, 40 deg up to 70 deg down, of 181 beams."""
    tilts, beams = np.radians(np.linspace(-40.0, 70.0, TILTS)), np.radians(np.linspace(-90.0, 90.0, BEAMS))
    tilt, beam = (grid.ravel() for grid in np.meshgrid(tilts, beams, indexing="ij"))
    rays = np.column_stack([np.cos(tilt) * np.cos(beam), np.sin(beam), -np.sin(tilt) * np.cos(beam)])
    ranges = cast(rectangles, np.tile(T_building_laser[:3, 3], (len(rays), 1)), rays @ T_building_laser[:3, :3].T)
    measured = ranges + rng.normal(0.0, noise, len(ranges))
    return np.asarray(measured[:, None] * rays)[np.isfinite(measured)]


def stop(x: float, y: float, yaw: float = 0.0) -> Float:
    """T_building_laser (4, 4) of a laser that stands upright on the floor; degrees."""
    return se3.from_xyz_rpy([x, y, HEIGHT_M, 0.0, 0.0, math.radians(yaw)])


def off_by(rng: np.random.Generator, metres: float, degrees: float) -> Float:
    """A transform (4, 4) of that length along the floor in a random direction, and so much yaw to a random side."""
    way = rng.uniform(-math.pi, math.pi)
    yaw = math.radians(degrees) * rng.choice([-1.0, 1.0])
    return se3.from_xyz_rpy([metres * math.cos(way), metres * math.sin(way), 0.0, 0.0, 0.0, yaw])


def furnished_room() -> Rectangles:
    """16 m x 7 m x 2.8 m with four boxes."""
    furniture = (
        cabinet((0.0, 0.6), (1.0, 3.0)),
        cabinet((6.0, 7.2), (0.0, 0.5), 1.0),
        cabinet((10.0, 10.8), (6.3, 7.0), 2.0),
        cabinet((13.0, 13.8), (2.5, 3.3), 0.8),
    )
    return surfaces(_building((16.0, 7.0), [room((0.0, 16.0), (0.0, 7.0))], furniture))


def bare_corridor() -> Rectangles:
    """A straight corridor 2.4 m wide whose ends are out of sight."""
    return surfaces(_building((400.0, 2.4), [room((0.0, 400.0), (0.0, 2.4))], ()))


def ring() -> tuple[Rectangles, list[Float]]:
    """A corridor round a block of four rooms, and 12 stops on the way round it, each seen from its middle."""
    size, wide = 16.0, 2.2
    inner = size - wide
    rooms = [
        room((0.0, size), (0.0, wide)),
        room((0.0, size), (inner, size)),
        room((0.0, wide), (0.0, size)),
        room((inner, size), (0.0, size)),
        room((wide + 0.12, 7.94), (wide + 0.12, 7.94)),
        room((8.06, inner - 0.12), (wide + 0.12, 7.94)),
        room((wide + 0.12, 7.94), (8.06, inner - 0.12)),
        room((8.06, inner - 0.12), (8.06, inner - 0.12)),
    ]
    doors = [
        door((4.0, 4.9), (wide, wide + 0.12)),
        door((inner - 0.12, inner), (4.6, 5.5)),
        door((10.4, 11.3), (inner - 0.12, inner)),
        door((wide, wide + 0.12), (9.6, 10.5)),
    ]
    furniture = (
        cabinet((6.6, 7.6), (0.0, 0.4)),
        cabinet((size - 0.4, size), (7.0, 8.4), 1.2),
        cabinet((5.2, 6.0), (size - 0.4, size), 1.9),
        cabinet((0.0, 0.4), (4.4, 5.6), 0.9),
        cabinet((11.0, 12.2), (wide - 0.3, wide), 1.5),
    )
    middle = wide / 2
    corners = [(middle, middle), (size - middle, middle), (size - middle, size - middle), (middle, size - middle)]
    stops = []
    for side, (start, end) in enumerate(zip(corners, [*corners[1:], corners[0]], strict=True)):
        for part in range(RING_STOPS // 4):
            x, y = np.array(start) + (np.array(end) - np.array(start)) * part / (RING_STOPS // 4)
            stops.append(stop(x, y, 90.0 * side))
    return surfaces(_building((size, size), [*rooms, *doors], furniture)), stops


def _building(size: tuple[float, float], carved: list, placed: tuple) -> Building:  # type: ignore[type-arg]
    block = box((-0.3, size[0] + 0.3), (-0.3, size[1] + 0.3), (-0.2, CEILING + 0.3))
    return Building(block, tuple(carved), placed)


def errors(T_estimate: Float, T_truth: Float) -> tuple[float, float]:
    """Metres and degrees between two transforms (4, 4)."""
    apart = se3.inverse(T_truth) @ T_estimate
    angle = math.degrees(Rotation.from_matrix(apart[:3, :3]).magnitude())
    return float(np.linalg.norm(apart[:3, 3])), angle


def two_rooms(rng: np.random.Generator) -> tuple[Rectangles, list[Float]]:
    """Two furnished rooms of random size with a wall between and no door, and a stop in each, 1 m from walls."""
    depth = rng.uniform(4.0, 8.0, 2)
    width = rng.uniform(4.0, 8.0, 2)
    begin = (0.0, width[0] + 0.12)
    rooms = [room((begin[k], begin[k] + width[k]), (0.0, depth[k])) for k in range(2)]
    furniture = []
    for k in range(2):
        for _ in range(3):
            wide, deep, high = rng.uniform(0.4, 1.2), rng.uniform(0.3, 0.6), rng.uniform(0.4, 2.0)
            at = begin[k] + rng.uniform(0.0, width[k] - wide)
            side = (0.0, deep) if rng.random() < 0.5 else (depth[k] - deep, depth[k])
            furniture.append(cabinet((at, at + wide), side, high))
    stops = [
        stop(begin[k] + rng.uniform(1.0, width[k] - 1.0), rng.uniform(1.0, depth[k] - 1.0), rng.uniform(-180, 180))
        for k in range(2)
    ]
    return surfaces(_building((begin[1] + width[1], max(depth)), rooms, tuple(furniture))), stops
