# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Mapping that goes on in the map of a session: in a new segment, until the place of the robot is found."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.config import LocalizationConfig
from g2_recon.geometry import se2
from g2_recon.geometry.session import Session
from g2_recon.localization.beams import Beams
from g2_recon.localization.collecting import latest
from g2_recon.localization.localizer import Localizer
from g2_recon.localization.relocalization import GIVEN_M, GIVEN_RAD, Place, Schedule, WholeMap, fits_as_given
from g2_recon.localization.tracking import Placement

Float = NDArray[np.float64]

# Until the place is found nothing is known of it, m, m, rad; how unsure the map is in itself.
_UNKNOWN_SIGMA = np.array([1000.0, 1000.0, np.pi])
_MAP_SIGMA = np.array([0.015, 0.015, 0.003])
# After so many keyframes without a place it is said that there is none.
_SAID_AFTER = 40

_log = logging.getLogger(__name__)


class ResumedLocalizer(Localizer):
    """A localizer that begins with the map of a session.

    What it sees from the first scan on is mapped, in a new segment that lies somewhere. After new keyframes the place
    of the segment is looked for in the map; once it is sure, the segment is moved there, and loops can tie it to the
    map. Where it never is, the map stays in two parts that do not know of each other.
    """

    def __init__(
        self, config: LocalizationConfig, T_base_laser: ArrayLike, session: Session, *, keep_scans: bool = False
    ) -> None:
        """`T_base_laser`: (4, 4) mounting pose. keep_scans: see Localizer.

        Raises InputError where the map is too large to search.
        """
        self._session = session
        super().__init__(config, T_base_laser, keep_scans=keep_scans)

    def reset(self, pose: ArrayLike | None = None) -> None:
        """Start again with the map of the session, with the robot near `pose` (3,), if given, and then anywhere."""
        self.resume(self._session, se2.IDENTITY if pose is None else pose)
        self._given = None if pose is None else self._start.copy()
        self._map: WholeMap | None = WholeMap(self._keyframes.snapshot())
        self._loops.apart = len(self._loops.maps)
        self._schedule = Schedule()
        self._placed_by: Place | None = None

    def set_pose(self, pose: ArrayLike) -> None:
        """The robot is near `pose` (3,), T_map_base, as somebody says: a new segment begins there."""
        self._given = se2.compose(np.asarray(pose, float), self._T_base_laser)
        if self._map is None:
            self._map = WholeMap(self._keyframes.snapshot())
            self._schedule = Schedule()
            self._finish_local_map(1)
            self._loops.apart = len(self._loops.maps)
            self._tracker.segment = len(self._keyframes)
            self._last = self._given.copy()

    @property
    def is_placed(self) -> bool:
        """Whether the place of the robot in the map of the session is known."""
        return self._map is None

    def _close_loops(self) -> bool:
        placed = self._map is not None and self._find_place(self._map)
        return super()._close_loops() or placed

    def _find_place(self, whole: WholeMap) -> bool:
        """Look for the latest keyframes in the map of the session, and move their segment there."""
        count, segment = len(self._keyframes), self._tracker.segment
        place = self._near_given(whole, self._given) if self._given is not None else None
        if place is None and self._schedule.is_due():
            place = whole.find(self._keyframes, latest(count, segment))
        if place is None:
            if count - segment == _SAID_AFTER:
                _log.warning(
                    "the place of the robot in the map of the session is not sure after %d keyframes: mapping goes on "
                    "in a segment of its own until it is",
                    _SAID_AFTER,
                )
            return False
        _log.info("the place is found: x %.2f m, y %.2f m, yaw %.2f rad", *place.pose)
        # Loops that are being closed move the poses, too.
        self._take_loops()
        poses = self._keyframes.poses
        step = se2.compose(place.pose, se2.inverse(poses[-1]))
        poses[segment:] = se2.compose(step, poses[segment:])
        self._loops.carry(segment, step)
        self._tracker.moved()
        self._loops.apart = 0
        self._map = None
        self._placed_by = place
        return True

    def _near_given(self, whole: WholeMap, given: Float) -> Place | None:
        """The place of the latest keyframe near a pose that was given."""
        self._given = None
        points, normals, kinds, firsts, increments = self._keyframes.since(len(self._keyframes) - 1)
        seen = Beams(points[0], normals[0], kinds[0], float(firsts[0]), float(increments[0]))
        place = whole.around(given, seen, metres=GIVEN_M, radians=GIVEN_RAD)
        return place if place is not None and fits_as_given(place) else None

    def _covariance(self, placement: Placement) -> Float:
        """As of a Localizer; nothing is known until the place is found."""
        if self._map is not None:
            return np.diag(_UNKNOWN_SIGMA**2)
        if self._placed_by is not None:
            known = np.linalg.inv(self._placed_by.information) + np.diag(_MAP_SIGMA**2)
            self._uncertainty.take_back(len(self._keyframes) - 1, known)
            self._placed_by = None
        return super()._covariance(placement)
