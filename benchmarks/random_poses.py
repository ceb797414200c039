# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A simulated robot that is put down somewhere and looks around until it knows its place in a map."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from g2_recon.config import LocalizationConfig, SimulationConfig
from g2_recon.geometry import se2, se3
from g2_recon.geometry.session import Session
from g2_recon.localization.map_localizer import MapLocalizer
from g2_recon.simulation.building import Building, box, first_floor, surfaces
from g2_recon.simulation.lms200 import Lms200
from g2_recon.simulation.raycasting import cast
from g2_recon.simulation.robot import drive
from g2_recon.simulation.simulator import LASER_POSE
from g2_recon.simulation.tours import FULL_TOUR

Float = NDArray[np.float64]

LASER = np.array([LASER_POSE[0], LASER_POSE[1], LASER_POSE[5]])
HEIGHT_M = LASER_POSE[2]
CLEARANCE_M = 0.35
TURN, STEP_M, LEGS, LONGEST_LEG_M = math.radians(10.0), 0.1, 2, 3.0
WHEEL_NOISE = 0.02
PERIOD_S = 0.1


@dataclass(frozen=True, slots=True)
class Search:
    """How long a robot looked and what it found: scans before, s of the slowest, error (m, degrees; NaN: not sure)."""

    scans: int
    slowest: float
    metres: float
    degrees: float


class Floor:
    """The simulated floor for a robot that stands, seen from the map of the simulated drive."""

    def __init__(self, seed: int, *, boxes: int = 0) -> None:
        """boxes: of the size of people, that many stand around where there was nothing."""
        self.rng = np.random.default_rng(seed)
        self._T_building_map = drive(FULL_TOUR, SimulationConfig(), start=0.0, rest=1.0).trajectory.planar()[0]
        self._laser = Lms200.from_config(SimulationConfig())
        self._building: Building = first_floor()
        self._rectangles = surfaces(self._building)
        places = [self.somewhere()[:2] for _ in range(boxes)]
        put = tuple(box((x - 0.2, x + 0.2), (y - 0.2, y + 0.2), (0.0, 1.8)) for x, y in places)
        self._building = replace(self._building, placed=(*self._building.placed, *put))
        self._rectangles = surfaces(self._building)

    def somewhere(self) -> Float:
        """A random pose (3,) of the robot in the building, evenly over the free floor of the rooms."""
        rooms = [room for room in self._building.carved if room.low[2] == 0]
        areas = np.array([(r.high[0] - r.low[0]) * (r.high[1] - r.low[1]) for r in rooms])
        while True:
            room = rooms[self.rng.choice(len(rooms), p=areas / areas.sum())]
            place = self.rng.uniform(room.low[:2], room.high[:2])
            inside = any(
                part.low[0] <= place[0] <= part.high[0]
                and part.low[1] <= place[1] <= part.high[1]
                and part.low[2] <= HEIGHT_M <= part.high[2]
                for part in self._building.placed
            )
            if not inside and self._distances(place, np.arange(0.0, 2 * math.pi, 0.1)).min() > CLEARANCE_M:
                return np.array([*place, self.rng.uniform(-math.pi, math.pi)])

    def _distances(self, place: Float, headings: Float) -> Float:
        directions = np.column_stack([np.cos(headings), np.sin(headings), np.zeros(len(headings))])
        return cast(self._rectangles, np.tile([*place, HEIGHT_M], (len(headings), 1)), directions)

    def way(self, start: Float) -> Float:
        """Poses (N, 3): once around on the spot, then twice to where there is most room."""
        poses = [start]
        for _ in range(round(2 * math.pi / TURN)):
            poses.append(se2.compose(poses[-1], [0, 0, TURN]))
        for _ in range(LEGS):
            headings = np.arange(0.0, 2 * math.pi, 0.1)
            room = self._distances(poses[-1][:2], headings)
            wide = np.min([np.roll(room, shift) for shift in range(-4, 5)], axis=0)
            turn = float(se2.wrap_angle(headings[np.argmax(wide)] - poses[-1][2]))
            parts = max(1, math.ceil(abs(turn) / TURN))
            steps = [[0, 0, turn / parts]] * parts
            steps += [[STEP_M, 0, 0]] * int(max(0.0, min(LONGEST_LEG_M, wide.max() - 0.6)) / STEP_M)
            for step in steps:
                poses.append(se2.compose(poses[-1], step))
        return np.array(poses)

    def search(self, session: Session, settings: LocalizationConfig) -> Search:
        """Put the robot down somewhere, and let it go until it is sure."""
        localizer = MapLocalizer(settings, se3.from_xyz_rpy(LASER_POSE), session)
        way = self.way(self.somewhere())
        steps = se2.relative(way[:-1], way[1:]) * (1 + WHEEL_NOISE * self.rng.standard_normal((len(way) - 1, 3)))
        odometry, slowest = np.zeros(3), 0.0
        for index, pose in enumerate(way):
            odometry = se2.compose(odometry, steps[index - 1]) if index else odometry
            laser = se2.compose(pose, LASER)
            ranges = self._laser.measure(self._distances(laser[:2], laser[2] + self._laser.angles())[None], self.rng)[0]
            scan = replace(self._laser.scan(PERIOD_S * index, ranges, "laser"), time_increment=0.0)
            began = time.perf_counter()
            found = localizer.process(scan, odometry)
            slowest = max(slowest, time.perf_counter() - began)
            if found.matched:
                error = se2.relative(se2.relative(self._T_building_map, pose), found.pose)
                return Search(index, slowest, float(np.hypot(*error[:2])), math.degrees(abs(error[2])))
        return Search(len(way), slowest, math.nan, math.nan)


def searches(
    session: Session, settings: LocalizationConfig, count: int, *, seed: int = 0, boxes: int = 0
) -> list[Search]:
    """So many robots, one after the other."""
    floor = Floor(seed, boxes=boxes)
    return [floor.search(session, settings) for _ in range(count)]
