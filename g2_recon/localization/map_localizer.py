# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Localization in a map that stays as it is: tracking, noticing that track is lost, finding the place again."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.config import LocalizationConfig
from g2_recon.geometry import se2
from g2_recon.geometry.se2_kernels import compose, relative
from g2_recon.geometry.session import Session
from g2_recon.localization.beams import SURFACE, Beams
from g2_recon.localization.collecting import Collector, latest
from g2_recon.localization.keyframes import Keyframes
from g2_recon.localization.localizer import Localizer
from g2_recon.localization.relocalization import GIVEN_M, GIVEN_RAD, Place, Schedule, WholeMap, fits_as_given, is_sure
from g2_recon.localization.tracking import FEWEST_SURFACES, Placement, Tracker
from g2_recon.progress import Progress, silent

Float = NDArray[np.float64]

# Scans are laid on so many keyframes, those that see the most of the same; they are chosen anew after such a way.
_REFERENCES, _CHOOSE_M, _CHOOSE_RAD = 25, 0.5, 0.2
# After so many scans in a row that do not match, the place is not known any more.
_PATIENCE = 5
# Below this score a match is not believed. One below the others, score and quality, is doubtful: after so many scans in
# a row, does another place fit? Each time that none does, it takes twice as many.
_LEAST_SCORE, _DOUBTFUL_SCORE, _DOUBTFUL_QUALITY, _DOUBTED_SCANS = 0.6, 0.8, 0.85, 5
# A doubted place is confirmed where the best of all is this near.
_CONFIRMED_M = 0.3
# A robot that was lost is back where its way led it if so many keyframes in a row fit as well as this so near.
_BACK_M, _BACK_RAD, _BACK_SCORE, _BACK_QUALITY, _BACK_KEYFRAMES = 0.5, np.radians(10.0), 0.7, 0.9, 3
# How unsure things are, m, m, rad: the map itself, a given pose, a doubtful match that is confirmed, a place that is
# not known, one where track was lost or a match is doubtful. How much is added for a step without a match, and for each
# metre and radian of it.
_MAP_SIGMA = np.array([0.015, 0.015, 0.003])
_GIVEN_SIGMA = np.array([0.5, 0.5, 0.2])
_CONFIRMED_SIGMA = np.array([0.1, 0.1, 0.05])
_UNKNOWN_SIGMA = np.array([1000.0, 1000.0, np.pi])
_LOST_SIGMA = np.array([5.0, 5.0, 0.5])
_DRIFT_FLOOR, _DRIFT_SHARE = np.array([0.01, 0.01, 0.01]), np.array([0.1, 0.1, 0.2])

_log = logging.getLogger(__name__)


class MapLocalizer(Localizer):
    """Tracks a robot in the map of a session, which it never changes.

    Memory does not grow but for the trajectory. Until the place is found, and after it is lost, scans are not matched,
    the pose follows the way of the robot, and its covariance grows.
    """

    def __init__(
        self, config: LocalizationConfig, T_base_laser: ArrayLike, session: Session, *, keep_scans: bool = False
    ) -> None:
        """`T_base_laser`: (4, 4) mounting pose. keep_scans: keep a pose of every scan, also where the robot stands.

        Raises InputError where the map is too large to search.
        """
        self._session = session
        self._map: WholeMap | None = None
        super().__init__(config, T_base_laser, keep_scans=keep_scans)

    def reset(self, pose: ArrayLike | None = None) -> None:
        """Forget where the robot is, and look for it; around `pose` (3,), if it is given, and then everywhere."""
        super().reset(se2.IDENTITY if pose is None else pose)
        self._take_keyframes(self._session)
        if self._map is None:
            self._map = WholeMap(self._keyframes)
        self._near = Keyframes()
        self._chosen_at: Float | None = None
        self._follower = Tracker(self._near)
        self._collector = Collector(self._config)
        self._T_map_collected: Float = self._start.copy()
        self._known = False
        self._spread: Float = np.diag(_UNKNOWN_SIGMA**2)
        self._schedule = Schedule()
        self._doubted, self._doubt_at = 0, _DOUBTED_SCANS
        self._doubtful = self._confirmed = False
        self._back = 0
        self._moved: Float = np.zeros(3)
        self._given = None if pose is None else self._start.copy()

    def set_pose(self, pose: ArrayLike) -> None:
        """The robot is near `pose` (3,), T_map_base, as somebody says: look for it around there."""
        self._given = se2.compose(np.asarray(pose, float), self._T_base_laser)

    @property
    def is_placed(self) -> bool:
        """Whether the place of the robot in the map is known."""
        return self._known

    def session(self) -> Session:
        """The session as it was given."""
        return self._session

    def finish(self, progress: Progress = silent) -> None:
        """Nothing: the map stays as it is."""

    def begin_refinement(self) -> None:
        """Nothing: the map stays as it is."""

    def _place(self, seen: Beams, step: Float | None) -> Placement:
        if self._given is not None:
            placement = self._look_around(self._given, seen)
        elif self._known:
            placement = self._follow_on(seen, step)
        else:
            placement = self._search(seen, step)
        self.unmatched += not placement.matched
        self._moved = np.abs(relative(self._last, placement.pose))
        return placement

    def _look_around(self, given: Float, seen: Beams) -> Placement:
        """Near a given pose; where nothing fits, that pose counts until scans have not matched for a while."""
        self._given = None
        self._spread = np.diag(_GIVEN_SIGMA**2)
        place = self._whole_map.around(given, seen, metres=GIVEN_M, radians=GIVEN_RAD)
        if place is not None and fits_as_given(place):
            return self._found(place)
        self._go_to(given)
        return Placement(given, np.diag(1 / _GIVEN_SIGMA**2), 0.0, 0.0, False)

    def _follow_on(self, seen: Beams, step: Float | None) -> Placement:
        placement = self._track(self._last, seen, step)
        score = self._whole_map.score(placement.pose, seen)
        if placement.matched and score < _LEAST_SCORE:
            guess = self._last if step is None else compose(self._last, step)
            placement = Placement(guess, np.zeros((3, 3)), placement.quality, placement.inliers, False)
        self._doubtful = score < _DOUBTFUL_SCORE or placement.quality < _DOUBTFUL_QUALITY
        self._lost = 0 if placement.matched else self._lost + 1
        self._doubted = self._doubted + 1 if self._doubtful else 0
        if self._lost >= _PATIENCE:
            self._lose(placement.pose)
        elif self._doubted >= self._doubt_at:
            self._doubted = 0
            self._doubt_at *= 2
            scan = Keyframes()
            scan.add(seen, placement.pose)
            places, whole = self._whole_map.places(scan, np.array([0]))
            if whole and is_sure(places):
                return self._found(places[0])
            off = np.inf if not places else np.hypot(*(places[0].pose - placement.pose)[:2])
            self._confirmed = bool(off < _CONFIRMED_M)
        elif not self._doubted:
            self._doubt_at = _DOUBTED_SCANS
            self._confirmed = False
        return placement

    def _track(self, last: Float, seen: Beams, step: Float | None) -> Placement:
        """Lay a scan on the keyframes that see the same."""
        guess = last if step is None else compose(last, step)
        moved = None if self._chosen_at is None else np.abs(relative(self._chosen_at, guess))
        if moved is None or np.hypot(moved[0], moved[1]) > _CHOOSE_M or moved[2] > _CHOOSE_RAD:
            self._chosen_at = guess
            # The tracker looks at the last ones first.
            rows = self._whole_map.seen_from(guess, seen, _REFERENCES)[::-1]
            self._near.fill(self._keyframes.poses[rows], tuple(array[rows] for array in self._keyframes.arrays))
            self._follower.moved()
        if not len(self._near) or np.count_nonzero(seen.kinds == SURFACE) < FEWEST_SURFACES:
            self._chosen_at = None
            return Placement(guess, np.zeros((3, 3)), 0.0, 0.0, False)
        return self._follower.track(seen, last, step)

    def _lose(self, pose: Float) -> None:
        """The place is not known any more; the way from here on is kept."""
        _log.warning("track is lost near x %.1f m, y %.1f m: looking for the place in the whole map", pose[0], pose[1])
        self._known = False
        self._spread = self._spread + np.diag(_LOST_SIGMA**2)
        self._collector.clear()
        self._T_map_collected = pose.copy()
        self._schedule = Schedule()
        self._back = 0

    def _search(self, seen: Beams, step: Float | None) -> Placement:
        """Collect scans and look for them in the whole map; meanwhile the pose follows the way."""
        kept = self._collector.add(seen, step)
        pose = compose(self._T_map_collected, self._collector.pose)
        place = self._back_at(pose, seen) or self._look_everywhere() if kept else None
        return self._found(place) if place is not None else Placement(pose, np.zeros((3, 3)), 0.0, 0.0, False)

    def _back_at(self, pose: Float, seen: Beams) -> Place | None:
        """The place near where the way led, once some keyframes in a row fit there."""
        if self._spread[0, 0] >= _UNKNOWN_SIGMA[0] ** 2:
            return None
        place = self._whole_map.around(pose, seen, metres=_BACK_M, radians=_BACK_RAD)
        fits = place is not None and place.score > _BACK_SCORE and place.quality > _BACK_QUALITY
        self._back = self._back + 1 if fits else 0
        return place if self._back >= _BACK_KEYFRAMES else None

    def _look_everywhere(self) -> Place | None:
        """The place by all that was collected, if it is sure; not looked for after every keyframe."""
        if not self._schedule.is_due():
            return None
        return self._whole_map.find(self._collector.keyframes, latest(len(self._collector.keyframes)))

    def _found(self, place: Place) -> Placement:
        _log.info("the place is found: x %.2f m, y %.2f m, yaw %.2f rad", *place.pose)
        self._go_to(place.pose)
        return Placement(place.pose, place.information, place.quality, place.inliers, True)

    def _go_to(self, pose: Float) -> None:
        """Go on tracking from a pose that does not follow from the one before."""
        self._known = True
        self._doubtful = self._confirmed = False
        self._lost = self._doubted = 0
        self._doubt_at = _DOUBTED_SCANS
        self._chosen_at = None
        self._follower = Tracker(self._near)
        self._collector.clear()
        # No velocity is meant by the way there.
        self._last = pose.copy()

    @property
    def _whole_map(self) -> WholeMap:
        assert self._map is not None
        return self._map

    def _grow_map(self, seen: Beams, placement: Placement, step: Float | None) -> bool:
        return False

    def _covariance(self, placement: Placement) -> Float:
        """Covariance (3, 3) of the present pose: of the match and the map, or grown since the last match."""
        if placement.matched:
            least = 1e-4 * np.eye(3)
            sigma = _MAP_SIGMA
            if self._doubtful:
                sigma = _CONFIRMED_SIGMA if self._confirmed else _LOST_SIGMA
            self._spread = np.linalg.inv(placement.information + least) + np.diag(sigma**2)
        else:
            way = np.hypot(self._moved[0], self._moved[1])
            drift = _DRIFT_FLOOR + _DRIFT_SHARE * (way, way, self._moved[2])
            self._spread = np.minimum(self._spread + np.diag(drift**2), _UNKNOWN_SIGMA[0] ** 2)
        return self._spread

    def _remember(self, stamp: float, seen: Beams, pose: Float, *, keyframe: bool) -> None:
        super()._remember(stamp, seen, pose, keyframe=keyframe)
        # Nothing will improve them.
        self._scans.clear()
