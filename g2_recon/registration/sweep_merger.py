# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The sweep merger: stop-and-go sweeps become one cloud (paper, section 2.2, second setup)."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.config import SweepConfig
from g2_recon.geometry import se3
from g2_recon.geometry.cloud import Cloud, concatenate
from g2_recon.registration import sweep_graph
from g2_recon.registration.prepared_sweep import PreparedSweep, implausible_scale, prepare
from g2_recon.registration.registered_cloud import RegisteredCloud
from g2_recon.registration.sweep_graph import Edge
from g2_recon.registration.sweep_matching import Match, match

Float = NDArray[np.float64]

_log = logging.getLogger(__name__)

# Standard deviations of odometry beyond which a match is not believed.
_CREDIBLE = 5.0
# Only on so many of the nearest sweeps are places around the guess tried.
_SEARCHED = 2


@dataclass(frozen=True, slots=True)
class PlacedSweep:
    """What came of one sweep.

    number: in the order in which sweeps were added, those left out too. kept: whether it is in the cloud. quality:
    `first`, `good`, `limited` (matches leave some directions to odometry), `odometry` (no match is to be believed) or
    `left out`. reason: what limited it, in words. matches: with which sweeps it was matched, by number, also refused.
    """

    number: int
    kept: bool
    quality: str
    reason: str
    matches: tuple[tuple[int, Match], ...] = ()

    def describe(self) -> str:
        """One line of words and numbers."""
        believed = [found for _, found in self.matches if not found.refused]
        if not believed:
            return f"{self.quality}: {self.reason}" if self.reason else self.quality
        best = max(believed, key=lambda found: found.overlap)
        text = (
            f"{self.quality}, {len(believed)} of {len(self.matches)} matches; the best overlaps by {best.overlap:.0%}, "
            f"{best.inlier_share:.0%} inliers, {1000 * best.residual:.0f} mm apart"
        )
        return f"{text}; {self.reason}" if self.reason else text


class SweepMerger:
    """Lays each new sweep on those before it and keeps all poses consistent.

    The map is the frame of the guesses; without guesses, the frame of the first sweep. `renew` hands out the sweeps
    in the cloud, and anew those that later ones have moved.
    """

    def __init__(self, config: SweepConfig) -> None:
        """See SweepConfig for the settings."""
        self._config = config
        self.reset()

    def reset(self) -> None:
        """Forget all sweeps."""
        self._sweeps: list[PreparedSweep] = []
        self._numbers: list[int] = []
        self._guesses: list[Float | None] = []
        self._poses: Float = np.empty((0, 4, 4))
        self._edges: list[Edge] = []
        self._stamps: list[float] = []
        # The poses by which sweeps were handed out, and how often.
        self._told: Float = np.empty((0, 4, 4))
        self._revisions: list[int] = []
        self._to_renew: dict[int, None] = {}
        self._added = 0

    def __len__(self) -> int:
        return len(self._sweeps)

    @property
    def numbers(self) -> list[int]:
        """Which of the added sweeps are in the cloud."""
        return list(self._numbers)

    @property
    def loops(self) -> int:
        """How many matches there are beyond those that hold the sweeps together."""
        between = {(edge.first, edge.second) for edge in self._edges}
        return max(len(between) - len(self) + 1, 0) if len(self) else 0

    def poses(self) -> Float:
        """T_map_sweep (N, 4, 4) of the sweeps in the cloud, as known now."""
        return self._poses.copy()

    def covariances(self) -> Float:
        """Covariances (N, 6, 6) of the poses as seen from the first sweep: x y z (m), angles about them (rad)."""
        return sweep_graph.covariances(self._poses, self._edges, range(len(self)))

    def covariance(self, index: int) -> Float:
        """That (6, 6) of one of the sweeps in the cloud, for a fraction of the time."""
        return np.asarray(sweep_graph.covariances(self._poses, self._edges, [index])[0])

    def cloud(self) -> Cloud:
        """All points that count, in the map frame, each with where its laser was."""
        return concatenate([self.placed(index) for index in range(len(self))])

    def placed(self, index: int) -> Cloud:
        """The points of one of the sweeps in the cloud in the map frame, each with where its laser was."""
        points = se3.transform_points(self._poses[index], self._sweeps[index].measured)
        return Cloud(points, np.tile(self._poses[index][:3, 3], (len(points), 1)))

    @property
    def to_renew(self) -> int:
        """How many sweeps wait to be handed out."""
        return len(self._to_renew)

    @property
    def released(self) -> int:
        """How many sweeps are kept no more: none."""
        return 0

    def renew_all(self) -> None:
        """Have all sweeps handed out anew, as for somebody who came late."""
        self.renew_pieces(range(len(self)))

    def renew_pieces(self, numbers: Iterable[int]) -> None:
        """Have sweeps, as far as there are such, handed out anew, as for somebody who lacks them."""
        self._to_renew |= {number: None for number in numbers if 0 <= number < len(self)}

    def renew(self) -> RegisteredCloud | None:
        """The next sweep that is new, or that others have moved, where it is known to lie now; None for none.

        The newest comes first. A sweep is a piece; its revision is 0 at first.
        """
        if not self._to_renew:
            return None
        index = len(self) - 1 if len(self) - 1 in self._to_renew else next(iter(self._to_renew))
        del self._to_renew[index]
        self._revisions[index] += 1
        self._told[index] = self._poses[index]
        return RegisteredCloud(self._stamps[index], self.placed(index), index, self._revisions[index])

    def add(self, sweep: Cloud, T_map_guess: ArrayLike | None = None, *, stamp: float = 0.0) -> PlacedSweep:
        """Place a sweep, points in the frame of its laser, with a guess (4, 4) by odometry where there is one.

        stamp: s, goes with what `renew` hands out.

        Without a match that is to be believed it is placed by odometry; without odometry either it is left out.
        Raises InputError, and leaves everything as it was, where the sweep cannot be used or the guess is no transform.
        """
        guess = None if T_map_guess is None else se3.orthonormal(T_map_guess)
        warning = implausible_scale(sweep.points, self._config)
        if warning:
            _log.warning("sweep %d: %s", self._added, warning)
        prepared = prepare(sweep, self._config)
        number, self._added = self._added, self._added + 1
        if not len(self):
            self._keep(prepared, number, guess, stamp, np.eye(4) if guess is None else guess, [])
            return PlacedSweep(number, True, "first", "")
        step = self._driven(guess)
        predicted = self._poses[-1] @ (np.eye(4) if step is None else step)
        matches = self._matched(prepared, predicted, None if step is None else self._odometry(0, 1, step))
        believed = [(index, found) for index, found in matches if not found.refused]
        named = tuple((self._numbers[index], found) for index, found in matches)
        if not believed and step is None:
            return PlacedSweep(number, False, "left out", _reasons(named), named)
        last, new = len(self) - 1, len(self)
        edges = [Edge(index, new, found.T, found.information) for index, found in believed]
        if step is not None:
            edges.append(self._odometry(last, new, step))
        best = max(believed, key=lambda pair: (not pair[1].weak, pair[1].overlap), default=None)
        start = self._poses[-1] @ edges[-1].T if best is None else self._poses[best[0]] @ best[1].T
        self._keep(prepared, number, guess, stamp, start, edges)
        if best is None:
            return PlacedSweep(number, True, "odometry", _reasons(named), named)
        if any(not found.weak for _, found in believed):
            return PlacedSweep(number, True, "good", "", named)
        weak = ", ".join(dict.fromkeys(word for _, found in believed for word in found.weak))
        return PlacedSweep(number, True, "limited", f"left to odometry: {weak}", named)

    def _driven(self, guess: Float | None) -> Float | None:
        """How the robot moved since the last sweep in the cloud, by odometry."""
        before = self._guesses[-1]
        return None if guess is None or before is None else sweep_graph.relative(before, guess)

    def _matched(self, prepared: PreparedSweep, predicted: Float, odometry: Edge | None) -> list[tuple[int, Match]]:
        """The sweep laid on those near where it must be; a match that is good makes the guess for the next ones."""
        distances = np.linalg.norm(self._poses[:, :3, 3] - predicted[:3, 3], axis=1)
        near = [int(i) for i in np.argsort(distances, kind="stable") if distances[i] <= self._config.max_distance]
        if not self._config.loop_closure:
            near = [len(self) - 1]
        matches: list[tuple[int, Match]] = []
        config, sure, driven = self._config, False, predicted
        for count, index in enumerate(near[: self._config.neighbors]):
            if sure or count >= _SEARCHED:
                config = self._config.model_copy(update={"search": 0.0, "search_angle": 0.0})
            found = match(prepared, self._sweeps[index], sweep_graph.relative(self._poses[index], predicted), config)
            if not found.refused:
                found = found.but_refused(self._against_odometry(self._poses[index] @ found.T, driven, found, odometry))
            matches.append((index, found))
            if not sure and found.quality == "good":
                predicted, sure = self._poses[index] @ found.T, True
        return matches

    def _against_odometry(self, pose: Float, driven: Float, found: Match, odometry: Edge | None) -> str:
        """Why a match that puts the sweep at a pose cannot be, by odometry that has it at `driven`; empty if it can."""
        if odometry is None:
            return f"without odometry nothing says where it is {', '.join(found.weak)}" if found.weak else ""
        apart = Edge(0, 1, np.eye(4), odometry.information)
        sigmas = sweep_graph.deviation(np.stack([driven, pose]), apart)
        return f"it is {sigmas:.0f} standard deviations from where odometry has it" if sigmas > _CREDIBLE else ""

    def _odometry(self, first: int, second: int, step: Float) -> Edge:
        return sweep_graph.odometry_edge(
            first, second, step, per_metre=self._config.odometry_distance, angle=self._config.odometry_angle
        )

    def _keep(
        self, sweep: PreparedSweep, number: int, guess: Float | None, stamp: float, pose: Float, edges: list[Edge]
    ) -> None:
        self._sweeps.append(sweep)
        self._numbers.append(number)
        self._guesses.append(guess)
        self._stamps.append(stamp)
        self._revisions.append(-1)
        self._to_renew[len(self) - 1] = None
        self._poses = np.concatenate([self._poses, pose[None]])
        self._told = np.concatenate([self._told, pose[None]])
        self._edges += edges
        if edges:
            self._poses = sweep_graph.optimize(self._poses, self._edges)
            self._mark_moved()

    def _mark_moved(self) -> None:
        """What lies elsewhere than where it was handed out is handed out anew."""
        far = np.linalg.norm((self._poses - self._told)[:, :3, 3], axis=1) > self._config.correction_distance
        # The norm of the difference of two rotations is sqrt(2) times the angle between them, where that is small.
        turned = np.linalg.norm((self._poses - self._told)[:, :3, :3], axis=(1, 2)) / math.sqrt(2)
        far |= turned > self._config.correction_angle
        self._to_renew |= dict.fromkeys(np.flatnonzero(far).tolist())


def _reasons(matches: tuple[tuple[int, Match], ...]) -> str:
    if not matches:
        return "no sweep before it is near enough to be matched with"
    return "; ".join(f"on sweep {number}: {found.refused}" for number, found in matches if found.refused)
