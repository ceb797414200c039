# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The registrar: vertical scans become points in the map frame (paper, section 2.2, first setup)."""

from __future__ import annotations

import heapq
import math
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.config import RegistrationConfig
from g2_recon.geometry.cloud import Cloud, concatenate
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.geometry.voxels import VoxelCounts, VoxelFilter, numbers_of_same_side, sided_voxel_numbers
from g2_recon.registration.corrected_trajectory import CorrectedTrajectory, Poses
from g2_recon.registration.placing import place_beams, pose_at
from g2_recon.registration.registered_cloud import RegisteredCloud

Float = NDArray[np.float64]

# Poses are kept this long for scans that come late, as messages of two lasers overtake each other.
_POSES_KEPT_S = 2.0
# Poses older than this are kept only where scans are, and looked through as often.
_ALL_POSES_KEPT_S = 60.0
# A piece has so many beams at most, so that it is quickly placed anew and handed on as one message.
_MOST_BEAMS = 3000
# Of so many latest scans the stamps are known, to tell when one comes again.
_STAMPS_KEPT = 10_000
# What a scan sees is known where pieces before the latest ones have points in the cube with this edge, m, seen from the
# same side. The latest ones do not count: a robot that turns in a room on its first visit sees much of it twice.
_KNOWN_CUBE_M, _LATEST_PIECES = 0.2, 30
# So many of the last scans that were needed tell whether the robot has moved on. A scan with more beams than so many
# times theirs is needed all the same: somebody may have stood in front of the laser.
_LAST_NEEDED, _FULLER = 8, 1.5


class _View(NamedTuple):
    """Where the robot was at a scan, position (3,) in m and quaternion (4,), and how many of its beams made points."""

    position: Float
    quaternion: Float
    beams: int


@dataclass(slots=True)
class _Piece:
    """Scans in a row that are placed anew together.

    cubes: numbers of those with a point; once the piece is `settled`, they are known.
    """

    scans: list[Scan] = field(default_factory=list)
    cubes: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    settled: bool = False
    beams: int = 0
    first: float = np.inf
    last: float = -np.inf
    revision: int = 0


class Registrar:
    """Places each beam of each vertical scan by the pose of the robot at the beam's own time.

    Scans and poses may come in any order. A scan waits until poses cover its last beam; `take` hands out what is done.

    With `keep_scans` the cloud follows the localizer: `follow` tells where its keyframes are now, and `renew` hands out
    anew, piece by piece, what has moved. A piece is the scans between two calls of `follow`, or fewer. It takes memory
    for each scan, up to `kept_scans`, and for the poses around it. A scan is handed out where the robot has moved by
    `scan_distance` or turned by `scan_angle` since the last ones that were, and where a share of `new_points` of what
    it sees lies where there was nothing. Others are counted: those that are `too_near`, those with `nothing_new`.
    """

    def __init__(self, config: RegistrationConfig, T_base_laser: ArrayLike, *, keep_scans: bool = False) -> None:
        """`T_base_laser`: (4, 4) mounting pose of the vertical laser. keep_scans: to place them anew later."""
        self._config = config
        self._T_base_laser = np.array(T_base_laser, float)
        self._keep_scans = keep_scans
        self.reset()

    def reset(self) -> None:
        """Forget poses, scans and counts."""
        self._trajectory = CorrectedTrajectory()
        # A heap by the time of the last beam; the count keeps scans of equal time in the order in which they came.
        self._waiting: list[tuple[float, int, Scan]] = []
        self._count = 0
        # A single stamp far ahead is a fault of a clock, and no reason to give up on others.
        self._newest_scan = self._second_newest_scan = -np.inf
        self._pose_ahead = np.nan
        self._stamps: dict[float, None] = {}
        self._done: list[RegisteredCloud] = []
        self._drops: Counter[str] = Counter()
        # The number of a piece is its place in the order in which they were begun; the last one is still open.
        self._pieces: dict[int, _Piece] = {}
        self._open = 0
        self._filter = self._new_filter()
        self._to_renew: dict[int, None] = {}
        self._kept = 0
        self._known = VoxelCounts()
        self._unsettled: list[int] = []
        self.released = 0
        # Of the last scans that were needed, as scans may overtake each other.
        self._needed: deque[_View] = deque(maxlen=_LAST_NEEDED)
        self.too_near = self.nothing_new = 0

    def configure(self, config: RegistrationConfig) -> None:
        """Take other settings for the scans that are not placed yet."""
        self._config = config

    @property
    def drops(self) -> dict[str, int]:
        """How many scans were given up and how many poses were not used, by reason."""
        return dict(self._drops)

    @property
    def waiting(self) -> int:
        """How many scans wait for a pose."""
        return len(self._waiting)

    @property
    def kept(self) -> int:
        """How many scans are kept to be placed anew. Those before them, `released`, stay where they are."""
        return self._kept

    @property
    def to_renew(self) -> int:
        """How many pieces wait to be placed anew."""
        return len(self._to_renew)

    def add_pose(self, stamp: float, T_map_base: ArrayLike) -> None:
        """Take note of the pose (4, 4) of the robot at a time in seconds; places the scans that waited for it."""
        if not (np.isfinite(stamp) and np.isfinite(T_map_base).all()):
            self._drops["pose that is not finite"] += 1
        elif self._is_far_ahead(stamp):
            self._drops["pose far ahead of all others"] += 1
        else:
            if self._trajectory.add(stamp, T_map_base):
                self._mark_moved()
            self._place_waiting()

    def add_scan(self, scan: Scan) -> None:
        """Place a scan, now or when its poses have come."""
        if scan.stamp in self._stamps:
            self._drops["duplicate: its stamp came before"] += 1
            return
        self._stamps[scan.stamp] = None
        if len(self._stamps) > _STAMPS_KEPT:
            del self._stamps[next(iter(self._stamps))]
        heapq.heappush(self._waiting, (scan.last_stamp, self._count, scan))
        self._count += 1
        self._second_newest_scan = max(self._second_newest_scan, min(self._newest_scan, scan.stamp))
        self._newest_scan = max(self._newest_scan, scan.stamp)
        self._place_waiting()

    def take(self) -> list[RegisteredCloud]:
        """The scans that were placed since the last call, in the order in which they were placed."""
        done, self._done = self._done, []
        return done

    def finish(self) -> list[RegisteredCloud]:
        """What `take` returns, after giving up on scans that still wait: no more poses will come."""
        for _, _, scan in self._waiting:
            late = scan.stamp > self._trajectory.last_stamp
            self._drops["after the last pose" if late else "before the first pose"] += 1
        self._waiting = []
        return self.take()

    def follow(self, keyframes: Trajectory) -> bool:
        """Take note of where the localizer has its keyframes (T_map_base) now; `renew` then hands out what has moved.

        False, and nothing is changed, where they are of another map than the poses: the registrar is to be reset.
        Raises InputError where a pose is not finite or not a rotation.
        """
        if not self._trajectory.follow(keyframes):
            return False
        self._mark_moved()
        return True

    def renew_all(self) -> None:
        """Have all pieces handed out anew, as for somebody who came late."""
        self.renew_pieces(self._pieces)

    def renew_pieces(self, numbers: Iterable[int]) -> None:
        """Have pieces, as far as they are kept, handed out anew, as for somebody who lacks them."""
        self._begin_piece()
        self._to_renew |= {number: None for number in numbers if number in self._pieces}

    def renew(self) -> RegisteredCloud | None:
        """The next piece that has moved, all of it, placed by what is known now; None where there is none."""
        if not self._to_renew:
            return None
        number = next(iter(self._to_renew))
        del self._to_renew[number]
        piece = self._pieces[number]
        piece.revision += 1
        poses = self._trajectory.between(piece.first, piece.last)
        clouds = [placed for scan in piece.scans if isinstance(placed := self._place(scan, poses), Cloud)]
        placed_anew = concatenate(clouds)
        self._see(piece, np.unique(sided_voxel_numbers(placed_anew, _KNOWN_CUBE_M)))
        cloud = self._thinned(placed_anew, self._new_filter())
        return RegisteredCloud(max(scan.stamp for scan in piece.scans), cloud, number, piece.revision)

    def _mark_moved(self) -> None:
        self._begin_piece()
        stamps, far = self._trajectory.moved(self._config.correction_distance, self._config.correction_angle)
        if not (far.any() and self._pieces):
            return
        spans = np.array([(piece.first, piece.last) for piece in self._pieces.values()])
        keyframe = np.searchsorted(stamps, spans, side="right") - 1
        # How many have moved before each; before the first keyframe nothing is moved.
        moved = np.concatenate([[0, 0], np.cumsum(far)])
        touched = moved[keyframe[:, 1] + 2] > moved[keyframe[:, 0] + 1]
        self._to_renew |= dict.fromkeys(np.array(list(self._pieces))[touched].tolist())

    def _is_far_ahead(self, stamp: float) -> bool:
        """Whether a pose is that of a clock that jumped, until another one says the same."""
        newest = max(self._trajectory.last_stamp, self._newest_scan)
        if not len(self._trajectory) or stamp <= newest + self._config.max_wait:
            return False
        confirmed = abs(stamp - self._pose_ahead) <= self._config.max_gap
        self._pose_ahead = stamp
        return not confirmed

    def _place_waiting(self) -> None:
        trajectory = self._trajectory
        while self._waiting and self._waiting[0][0] <= trajectory.last_stamp:
            self._register(heapq.heappop(self._waiting)[2])
        while self._waiting and self._second_newest_scan - self._waiting[0][2].stamp > self._config.max_wait:
            heapq.heappop(self._waiting)
            self._drops[f"no pose came for {self._config.max_wait:g} s"] += 1
        oldest = waiting = self._waiting[0][2].stamp if self._waiting else np.inf
        if self._keep_scans:
            self._thin_poses(min(trajectory.last_stamp, waiting) - _ALL_POSES_KEPT_S)
            oldest = min([waiting, *(piece.first for piece in list(self._pieces.values())[:1])])
        trajectory.drop_before(min(oldest, trajectory.last_stamp - _POSES_KEPT_S))

    def _thin_poses(self, until: float) -> None:
        """Keep poses before a time only where scans are that may be placed anew."""
        before = self._trajectory.thin_until
        if until < before + _ALL_POSES_KEPT_S:
            return
        recent = [piece for piece in self._pieces.values() if piece.last >= before]
        spans = [(scan.first_stamp, scan.last_stamp) for piece in recent for scan in piece.scans]
        self._trajectory.thin(until, spans)

    def _register(self, scan: Scan) -> None:
        """Place a scan and hand it out, or count why it cannot be placed."""
        first, last = scan.first_stamp, scan.last_stamp
        poses = self._trajectory.between(first, last)
        placed = self._place(scan, poses)
        if not isinstance(placed, Cloud):
            self._drops[placed] += 1
            return
        number = self._open
        if self._keep_scans:
            position, quaternion = pose_at(scan.stamp, *poses)
            view = _View(position, quaternion, len(placed))
            if any(self._shows_it_all(needed, view) for needed in self._needed):
                self.too_near += 1
                return
            sides = numbers_of_same_side(placed, _KNOWN_CUBE_M)
            known = np.count_nonzero(self._known.of(sides).any(axis=0))
            if len(placed) - known < self._config.new_points * len(placed):
                self.nothing_new += 1
                return
            self._needed.appendleft(view)
            # Points are counted under the first numbers only.
            number = self._keep(scan, first, last, sides[0])
        self._done.append(RegisteredCloud(scan.stamp, self._thinned(placed, self._filter), number))

    def _shows_it_all(self, needed: _View, view: _View) -> bool:
        """Whether there is nothing in one view that was not in another, as the robot has not moved on."""
        if math.dist(needed.position, view.position) >= self._config.scan_distance:
            return False
        angle = 2.0 * math.acos(min(abs(float(needed.quaternion @ view.quaternion)), 1.0))
        return angle < self._config.scan_angle and view.beams <= _FULLER * needed.beams

    def _place(self, scan: Scan, poses: Poses) -> Cloud | str:
        """The points of a scan, or why it cannot be placed."""
        in_laser, beams = scan.points(range_min=self._config.min_range, range_max=self._config.max_range)
        if not len(beams):
            return "no beam in range"
        times = scan.stamp + scan.time_increment * beams
        if times.min() < self._trajectory.first_stamp:
            return "before the first pose"
        points, sensor, known = place_beams(in_laser, times, *poses, self._T_base_laser, self._config.max_gap)
        return Cloud(points, sensor) if known.all() else f"no pose within {self._config.max_gap:g} s"

    def _keep(self, scan: Scan, first: float, last: float, cubes: NDArray[np.int64]) -> int:
        """Add a scan to the piece that is open, whose number this is; the oldest are released if there are too many."""
        if self._open in self._pieces and self._pieces[self._open].beams + len(scan.ranges) > _MOST_BEAMS:
            self._begin_piece()
        taken_by = self._open
        if taken_by not in self._pieces:
            self._pieces[taken_by] = _Piece()
            self._settle(taken_by)
        piece = self._pieces[taken_by]
        piece.scans.append(scan)
        piece.beams += len(scan.ranges)
        piece.first, piece.last = min(piece.first, first), max(piece.last, last)
        self._see(piece, np.union1d(piece.cubes, cubes))
        self._kept += 1
        while self._kept > self._config.kept_scans:
            number = next(iter(self._pieces))
            count = len(self._pieces.pop(number).scans)
            self._to_renew.pop(number, None)
            self._kept -= count
            self.released += count
            # A piece that is begun anew would replace what is released.
            self._open = max(self._open, number + 1)
        return taken_by

    def _settle(self, new: int) -> None:
        """A piece was begun; what the oldest of the latest ones sees is known from now on."""
        self._unsettled.append(new)
        if len(self._unsettled) > _LATEST_PIECES and (old := self._pieces.get(self._unsettled.pop(0))) is not None:
            old.settled = True
            self._known.add(old.cubes)

    def _see(self, piece: _Piece, cubes: NDArray[np.int64]) -> None:
        """What a piece sees is this now."""
        if piece.settled:
            self._known.add(piece.cubes, -1)
            self._known.add(cubes)
        piece.cubes = cubes

    def _begin_piece(self) -> None:
        if self._open in self._pieces:
            self._open += 1
            self._filter = self._new_filter()

    def _new_filter(self) -> VoxelFilter | None:
        return VoxelFilter(self._config.voxel) if self._config.voxel > 0 else None

    @staticmethod
    def _thinned(cloud: Cloud, voxels: VoxelFilter | None) -> Cloud:
        return cloud if voxels is None else cloud.select(voxels.first(cloud.points))
