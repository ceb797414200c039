# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Tracking: one scan after the other laid on the latest keyframes, and whether that can be believed."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from statistics import median

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry import se2
from g2_recon.geometry.se2_kernels import compose, relative, weakest
from g2_recon.localization import likelihood
from g2_recon.localization.beams import INVALID, SURFACE, Beams
from g2_recon.localization.drawn_keyframes import DrawnKeyframes
from g2_recon.localization.keyframes import Keyframes
from g2_recon.localization.pairing import PAIR_SIGMA_M
from g2_recon.localization.tracking_kernels import FINE_RESOLUTION_M, is_near, match_on_latest, slid, wheel_sigma

Float = NDArray[np.float64]

# The keyframes that a scan is laid on, counted back from the latest. Where the wheels say where to look, fewer will do.
_FEW_REFERENCES = np.array([1, 2, 4, 7, 11, 16, 23, 32])
_REFERENCES = np.array([1, 2, 3, 4, 6, 9, 13, 18, 24, 32])
# They are drawn into cells of this size, blurred by this, m.
_RESOLUTION_M, _SIGMA_M = 0.1, 0.12
_GRID_CELLS = 500

# Search windows around a prediction: turns of 1 deg to either side, with and without odometry, and cells of 10 cm.
_TURNS, _TURNS_WITHOUT, _TURN, _SHIFTS = 20, 50, math.radians(1.0), 2
_SEARCH_BEAMS = 90
# Without odometry the best place is then looked for between the cells, and believed as much, m and rad.
_CLIMBS = 3
_FOUND_SIGMA = np.array([0.05, 0.05, 0.1])
# Where nothing was found the robot may have turned far between two scans: so many searches beside each other, of which
# the best few are matched.
_FAR_TURNS = np.radians([40.0, -40.0, 80.0, -80.0, 120.0, -120.0, 160.0, -160.0])
_FAR_MATCHED = 3

# Along the direction in which the surfaces hold a scan least, if they hold it with less than so many beams, it slides
# to where it fits best, in a grid of its own with cells blurred by this, m. m^2 away from the prediction cost so much
# of the likelihood, with and without odometry.
_WEAK = 10.0
_FINE_SIGMA_M, _FINE_CELLS = 0.06, 1000
_AWAY_WITH_ODOMETRY, _AWAY_WITHOUT = 10.0, 1.0
# Without odometry the robot is expected to move on as it did on average over the last scans; one alone errs too much.
_STEADY = 10

_ITERATIONS, _FEW_ITERATIONS = 10, 5

# A match is good if this share of the points that both scans can see is seen by both, contradictions counted twice, or
# if it is hardly worse than the ones before; below the other share it is not believed.
_GOOD, _FAIR, _AS_BEFORE, _MEMORY = 0.95, 0.85, 0.05, 20
LEAST_QUALITY = 0.6
# Another prediction has to be better by this than one that is likelier, or by this after a mere search.
_MARGIN, _SEARCH_MARGIN, _INLIER_MARGIN = 0.08, 0.02, 0.1
# A match from a start so near (m and rad) to where one has begun or ended would end there, too.
_SAME_START = np.array([0.05, 0.05, math.radians(1.0)])
# A match is not searched for where it lies within so many sigma of what the wheels say of the step; they are wrong
# where it lies so many off.
_LIKELY_SIGMAS, _DOUBTED_SIGMAS = 2.0, 1.0
# Over so many steps odometry may come late: it stands still while the robot drives, and then jumps.
_LATE = (2, 3, 4, 6, 8, 12)
_UNKNOWN = np.full(3, np.nan)
FEWEST_SURFACES = 10
"""A scan with fewer beams on surfaces says nothing about its pose."""


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a scan lies.

    pose: (3,) T_map_laser. information: (3, 3) of the match and the prediction. quality: share of agreement, 0 to 1.
    inliers: share of the beams in view of the references that have a partner. matched: whether it is believed.
    wheels_err: whether it is believed although the wheels say otherwise. hessian: (3, 3) that the match ended with, of
    scans and prediction. agreeing: how many points both scans see.
    """

    pose: Float
    information: Float
    quality: float
    inliers: float
    matched: bool
    wheels_err: bool = False
    hessian: Float = field(default_factory=lambda: np.zeros((3, 3)))
    agreeing: int = 0


class Tracker:
    """Lays scans on the latest keyframes.

    `segment` is the first keyframe that counts: where track was lost, a new segment begins.
    """

    def __init__(self, keyframes: Keyframes) -> None:
        self._keyframes = keyframes
        self.segment = 0
        # What a pair of points is trusted with in covariances, m; PAIR_SIGMA_M, against wheels and guesses, is more.
        self.pair_sigma = PAIR_SIGMA_M
        self._drawn = DrawnKeyframes(
            keyframes, cells=_GRID_CELLS, resolution=_RESOLUTION_M, sigma=_SIGMA_M, reach=_SHIFTS
        )
        self._finely_drawn = DrawnKeyframes(
            keyframes, cells=_FINE_CELLS, resolution=FINE_RESOLUTION_M, sigma=_FINE_SIGMA_M
        )
        self._velocity: Float = np.zeros(3)
        self._qualities: deque[float] = deque(maxlen=_MEMORY)
        # Of the latest scans: step of the odometry (NaN: unknown), and step that was found.
        self._history: deque[tuple[Float, Float]] = deque(maxlen=max(*_LATE, _STEADY))

    def moved(self) -> None:
        """To be called when keyframes were added or improved: what is drawn of them is out of date."""
        self._drawn.moved()
        self._finely_drawn.moved()

    def track(self, beams: Beams, last: Float, step: Float | None) -> Placement:
        """Place a scan, given the pose (3,) of the scan before and the step (3,) of the odometry since, if known."""
        predictions = self._predictions(step)
        likeliest, sigma = next(predictions)
        guess = compose(last, likeliest)
        quality = inliers = 0.0
        placement = None
        if np.count_nonzero(beams.kinds == SURFACE) >= FEWEST_SURFACES:
            best = self._best(beams, last, step, (likeliest, sigma), predictions)
            if best.matched:
                # The wheels have had their say in the match.
                placement = self._slid(beams, best, guess if step is None else best.pose, without=step is None)
                self._qualities.append(placement.quality)
                if step is not None and not is_near(placement.pose, guess, wheel_sigma(step), _DOUBTED_SIGMAS):
                    placement = replace(placement, wheels_err=True)
            quality, inliers = best.quality, best.inliers
        if placement is None:
            placement = Placement(guess, np.diag(1 / sigma**2), quality, inliers, False)
        found = relative(last, placement.pose)
        self._history.append((_UNKNOWN if step is None else step, found))
        self._velocity = found.copy()
        if step is None:
            self._velocity[:2] = np.mean([found[:2] for _, found in self._history][-_STEADY:], axis=0)
        return placement

    def _best(
        self,
        beams: Beams,
        last: Float,
        step: Float | None,
        first: tuple[Float, Float],
        others: Iterator[tuple[Float, Float]],
    ) -> Placement:
        """The match from the likeliest of the predicted steps, unless it is doubtful and another one is better."""
        likeliest, sigma = first
        guess = compose(last, likeliest)
        if step is None:
            best, margin = self._lay(beams, self._start(beams, guess, without=True), _FOUND_SIGMA), _MARGIN
            if self._good(best):
                return best
        else:
            best, margin = self._lay(beams, guess, sigma, few=True), _SEARCH_MARGIN
            if self._good(best) and is_near(best.pose, guess, wheel_sigma(step), _LIKELY_SIGMAS):
                return best
            others = chain([first], others)
        tried = [best.pose]
        for predicted, uncertainty in others:
            expected = compose(last, predicted)
            start = self._start(beams, expected, without=step is None)
            if not any(is_near(start, known, _SAME_START, 1.0) for known in tried):
                if step is None:
                    other = self._lay(beams, start, _FOUND_SIGMA)
                else:
                    other = self._lay(beams, start, uncertainty, expected)
                tried += [start, other.pose]
                if other.quality > best.quality + margin or _fits_better(other, best):
                    best = other
                if self._good(best):
                    return best
            margin = _MARGIN
        if not best.matched or (step is None and best.quality < _FAIR):
            searches = [self._search(beams, guess + (0.0, 0.0, turn), _TURNS) for turn in _FAR_TURNS]
            for start, _ in sorted(searches, key=lambda search: -search[1])[:_FAR_MATCHED]:
                other = self._lay(beams, start, _FOUND_SIGMA)
                if other.quality > max(best.quality, _FAIR) and not (best.matched and _agrees_less(other, best)):
                    best = other
        return best

    def _good(self, placement: Placement) -> bool:
        if placement.quality > _GOOD or placement.quality < _FAIR:
            return placement.quality > _GOOD
        settled = len(self._qualities) == _MEMORY
        return settled and bool(placement.quality > median(self._qualities) - _AS_BEFORE)

    def _predictions(self, step: Float | None) -> Iterator[tuple[Float, Float]]:
        """Steps (3,) since the last scan with their sigma (3,), the likeliest first."""
        if step is not None:
            # Wheels that stand still at once, slip or come late are not worth more than the speed that they contradict.
            sigma = wheel_sigma(step)
            yield step, np.hypot(sigma, step - self._velocity) if self._history else sigma
        way, turn = math.hypot(self._velocity[0], self._velocity[1]), abs(self._velocity[2])
        yield self._velocity, np.array([0.1 + 0.1 * way, 0.1 + 0.1 * way, 0.1 + 0.2 * turn])
        unsure = np.array([0.1, 0.1, 0.2])
        if step is not None:
            yield from ((late, unsure) for late in self._late(step))
        yield np.zeros(3), unsure

    def _late(self, step: Float) -> Iterator[Float]:
        """What is left of the way that odometry claims for the last few scans together, after what was found."""
        claimed, found = step, se2.IDENTITY
        for back, (before, was) in enumerate(reversed(self._history), start=2):
            if np.isnan(before).any():
                return
            claimed = compose(before, claimed)
            found = compose(was, found)
            if back in _LATE:
                yield relative(found, claimed)

    def _lay(
        self, beams: Beams, start: Float, sigma: Float, guess: Float | None = None, *, few: bool = False
    ) -> Placement:
        """Match from a start; the guess (the start, if none is given) with its sigma holds what the scan does not."""
        keyframes = self._keyframes
        spans, iterations = (_FEW_REFERENCES, _FEW_ITERATIONS) if few else (_REFERENCES, _ITERATIONS)
        latest = keyframes.latest
        pose, inliers, hessian, information, agreeing, quality = match_on_latest(
            start, start if guess is None else guess, sigma, self.pair_sigma, iterations,
            beams.points, beams.normals, beams.kinds, beams.first, beams.increment,
            spans, self.segment - latest, keyframes.poses[latest:], *keyframes.since(latest),
        )  # fmt: skip
        return Placement(pose, information, quality, inliers, quality >= LEAST_QUALITY, False, hessian, agreeing)

    def _start(self, beams: Beams, guess: Float, *, without: bool) -> Float:
        """The best place around a guess, to match from.

        Without odometry it is looked for between the cells, too, for it counts then, and the guess no longer: along a
        bare corridor the points that are on no surface, such as door frames, are all that there is, and the speed
        before, held on to, would run away.
        """
        start, _ = self._search(beams, guess, _TURNS_WITHOUT if without else _TURNS)
        if not without:
            return start
        drawn = self._drawn
        climbed: Float = likelihood.climb(
            drawn.grid,
            beams.points,
            beams.kinds,
            start,
            drawn.corner[0],
            drawn.corner[1],
            drawn.resolution,
            _TURN,
            _CLIMBS,
        )
        return climbed

    def _search(self, beams: Beams, guess: Float, turns: int) -> tuple[Float, float]:
        """The best place of the scan around a guess (3,), and its score."""
        drawn = self._drawn
        drawn.update(self.segment)
        used = max(1, np.count_nonzero(beams.kinds != INVALID) // _SEARCH_BEAMS)
        found: tuple[Float, float] = likelihood.search(
            drawn.grid, drawn.wide, beams.points, beams.kinds, guess,
            drawn.corner[0], drawn.corner[1], drawn.resolution, turns, _TURN, _SHIFTS, used,
        )  # fmt: skip
        return found

    def _slid(self, beams: Beams, placement: Placement, guess: Float, *, without: bool) -> Placement:
        """Slide along the direction that surfaces hold least, to where surfaces and corners fit the map best.

        Door frames, and the far end of a corridor of which a few beams speak, tell the way along it. guess: (3,) where
        the scan is expected to lie; without: odometry.
        """
        held, weak = weakest(placement.hessian)
        if held > _WEAK:
            return placement
        away = _AWAY_WITHOUT if without else _AWAY_WITH_ODOMETRY
        drawn = self._finely_drawn
        drawn.update(self.segment)
        pose, information = slid(
            placement.pose, placement.information, held, weak, guess, away,
            beams.points, beams.normals, beams.kinds, beams.increment, drawn.grid, drawn.corner[0], drawn.corner[1],
        )  # fmt: skip
        return replace(placement, pose=pose, information=information)


def _fits_better(one: Placement, other: Placement) -> bool:
    """Whether of two that agree alike the one has clearly more inliers."""
    return one.quality > other.quality - _SEARCH_MARGIN and one.inliers > other.inliers + _INLIER_MARGIN


def _agrees_less(one: Placement, other: Placement) -> bool:
    """Whether the one is no surer than the other: one that looks the other way has little in common to err about."""
    return one.quality < _GOOD or one.agreeing < other.agreeing
