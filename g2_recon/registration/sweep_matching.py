# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""One sweep laid on another (paper, section 2.2, second setup), and whether the result is to be believed.

Three methods share this interface. Whatever the method says of itself does not count: a match is judged by what the
two sweeps say where they lie on each other.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g2_recon.config import SweepConfig
from g2_recon.geometry import se3
from g2_recon.registration import gicp_alignment, kiss_alignment, paper_alignment
from g2_recon.registration.agreement import Agreement, agreement
from g2_recon.registration.coarse_alignment import candidates
from g2_recon.registration.prepared_sweep import PreparedSweep

Float = NDArray[np.float64]

METHODS: dict[str, ModuleType] = {"gicp": gicp_alignment, "kiss": kiss_alignment, "paper": paper_alignment}

# Of neighboring points this many say about as much as one: they share the errors of a beam, a tilt and a voxel.
_ALIKE = 20.0
# No match is surer than this, at the laser and, as an angle, at the distance of the points.
_SUREST_M = 0.001
_SMALLEST_RESIDUAL_M = 0.002
_HELD_STEPS = 3
# Times the last gate: pairs of a guess that is good.
_NEAR = 3.0
# Share of inliers at a guess from which on it is good, looked for among one point in so many.
_NEARLY, _GLANCE = 0.5, 8
# Two places this far apart that fit about equally well: neither is to be believed.
_SAME_M, _SAME_RAD = 0.1, math.radians(3.0)
_EQUALLY_WELL = 0.97
# Without a search no match turns a sweep further than this.
_FARTHEST_TURN_RAD = math.radians(30.0)
_STRAIGHT = 0.97
_AXES = "xyz"


@dataclass(frozen=True, slots=True)
class Match:
    """Where a moving sweep lies as seen from a fixed one.

    T: T_fixed_moving (4, 4); along weak directions, that of the guess. information: (6, 6) inverse covariance of a
    step of T, metres along the axes of the fixed sweep, then radians about them, the order of ROS; nothing along weak
    directions. overlap, inlier_share, residual (m): see agreement.Agreement. weak: directions in which the sweeps do
    not hold each other, in words. refused: why the match is not to be believed; empty if it is.
    """

    T: Float
    information: Float
    overlap: float
    inlier_share: float
    residual: float
    weak: tuple[str, ...]
    refused: str

    @property
    def quality(self) -> str:
        """`good`, `limited` (some directions are left to odometry) or `refused`."""
        return "refused" if self.refused else "limited" if self.weak else "good"

    def but_refused(self, why: str) -> Match:
        """The same match, refused."""
        return dataclasses.replace(self, refused=why)


def match(moving: PreparedSweep, fixed: PreparedSweep, T_guess: Float, config: SweepConfig) -> Match:
    """Lay a sweep on another from a guess T_fixed_moving (4, 4); where that is refused, from other places around it.

    Raises InputError where the guess is not finite or no rotation.
    """
    guess = se3.orthonormal(T_guess)
    metres = float(np.linalg.norm(guess[:3, 3]))
    if metres > 2 * config.max_range + config.search + config.first_gate:
        why = f"sweeps {metres:.0f} m apart see nothing in common"
        return Match(guess, np.zeros((6, 6)), 0.0, 0.0, math.inf, (), why)
    # A wide gate can lead away from a guess that is good, and a narrow one misses what is far.
    gates = [_NEAR * config.last_gate, config.first_gate]
    if agreement(moving, fixed, guess, step=_GLANCE).inlier_share < _NEARLY:
        gates.reverse()
    first = _match_from(guess, moving, fixed, guess, gates[0], config)
    if first.quality != "good":
        first = max(first, _match_from(guess, moving, fixed, guess, gates[1], config), key=_preference)
    if not first.refused or not (config.search or config.search_angle):
        return first
    gate = _NEAR * config.last_gate
    found = [_match_from(start, moving, fixed, guess, gate, config) for start in _places(moving, fixed, guess, config)]
    return _best([first, *found])


def match_at(moving: PreparedSweep, fixed: PreparedSweep, T_guess: Float, config: SweepConfig) -> Match:
    """Lay a sweep on another from a guess (4, 4) that is good, and look nowhere else."""
    return _match_from(T_guess, moving, fixed, T_guess, _NEAR * config.last_gate, config)


def matches_anywhere(moving: PreparedSweep, fixed: PreparedSweep, T_guess: Float, config: SweepConfig) -> list[Match]:
    """All matches to be believed around a guess (4, 4) that may be far off, the best first.

    Places are tried as far around it as `search` and `search_angle` say; what a match leaves open is left to its place.
    """
    found = [match_at(moving, fixed, place, config) for place in _places(moving, fixed, T_guess, config)]
    return sorted((match for match in found if not match.refused), key=_preference, reverse=True)


def _best(found: Sequence[Match]) -> Match:
    """The match that has most for it; refused where another one, elsewhere, has about as much."""
    best = max(found, key=_preference)
    for other in found:
        rivals = not best.refused and _preference(other)[:2] == _preference(best)[:2]
        if rivals and _support(other) > _EQUALLY_WELL * _support(best) and not _same_place(best.T, other.T):
            metres = float(np.linalg.norm(other.T[:3, 3] - best.T[:3, 3]))
            return best.but_refused(f"it fits about as well at another place, {metres:.1f} m from there")
    return best


def _places(moving: PreparedSweep, fixed: PreparedSweep, guess: Float, config: SweepConfig) -> list[Float]:
    """Where the moving sweep may lie around the guess, each place once."""
    places: list[Float] = []
    for candidate in candidates(moving, fixed, guess, config):
        place = se3.orthonormal(gicp_alignment.roughly(moving, fixed, candidate, config.first_gate))
        if not any(_same_place(place, other) for other in places):
            places.append(place)
    return places


def _match_from(
    start: Float, moving: PreparedSweep, fixed: PreparedSweep, guess: Float, gate: float, config: SweepConfig
) -> Match:
    """The match that the method finds from one start; what it leaves open is left to the guess."""
    T = se3.orthonormal(METHODS[config.method].align(moving, fixed, start, gate, config.last_gate))
    seen = agreement(moving, fixed, T)
    strong, weak = (
        seen.directions[:, seen.shares >= config.weak_share],
        seen.directions[:, seen.shares < config.weak_share],
    )
    if weak.size and strong.size:
        T = _held(T, guess, weak, seen.radius)
        for _ in range(_HELD_STEPS):
            T = _stepped(T, agreement(moving, fixed, T), strong, seen.radius)
        seen = agreement(moving, fixed, T)
    return Match(
        T=T,
        information=_information(seen, strong, seen.radius),
        overlap=min(seen.overlap, 1.0),
        inlier_share=seen.inlier_share,
        residual=seen.residual,
        weak=tuple(_in_words(direction) for direction in weak.T),
        refused=_why_refused(seen, T, guess, strong.shape[1], config),
    )


def _why_refused(seen: Agreement, T: Float, guess: Float, strong: int, config: SweepConfig) -> str:
    """What speaks against a match; empty if nothing does."""
    metres = float(np.linalg.norm(T[:3, 3] - guess[:3, 3]))
    radians = float(np.linalg.norm(_rotation_vector(T[:3, :3] @ guess[:3, :3].T)))
    if seen.overlap < config.min_overlap:
        return f"only {seen.overlap:.0%} of the points overlap, less than min_overlap ({config.min_overlap:.0%})"
    if seen.inlier_share < config.min_inliers:
        return (
            f"only {seen.inlier_share:.0%} of what both should see is on the same surface, less than min_inliers "
            f"({config.min_inliers:.0%})"
        )
    if seen.residual > config.max_residual:
        return f"surfaces are {seen.residual:.3f} m apart, more than max_residual ({config.max_residual:g} m)"
    if strong < 3:
        return f"the sweeps hold each other in {strong} of 6 directions only"
    if metres > max(config.search, config.first_gate) or radians > max(config.search_angle, _FARTHEST_TURN_RAD):
        return f"it is {metres:.1f} m and {math.degrees(radians):.0f} deg from the guess"
    return ""


def _preference(found: Match) -> tuple[bool, bool, float]:
    """A wrong place may hold a sweep less than the right one: what is missing there is what would hold it."""
    return not found.refused, not found.weak, _support(found)


def _support(found: Match) -> float:
    return found.overlap * found.inlier_share


def _same_place(T: Float, other: Float) -> bool:
    apart = se3.inverse(T) @ other
    turned = Rotation.from_matrix(apart[:3, :3]).magnitude()
    return bool(np.linalg.norm(apart[:3, 3]) < _SAME_M and turned < _SAME_RAD)


def _held(T: Float, guess: Float, weak: Float, radius: float) -> Float:
    """T with its step from the guess taken back along weak directions (6, W), radians counted as metres at `radius`."""
    step = np.concatenate([T[:3, 3] - guess[:3, 3], _rotation_vector(T[:3, :3] @ guess[:3, :3].T) * radius])
    return _moved(guess, step - weak @ (weak.T @ step), radius)


def _stepped(T: Float, seen: Agreement, strong: Float, radius: float) -> Float:
    """T after one Gauss-Newton step of point-to-plane ICP along strong directions (6, S) only."""
    scaling = np.repeat([1.0, 1.0 / radius], 3)
    hessian = strong.T @ (seen.hessian * np.outer(scaling, scaling)) @ strong
    gradient = strong.T @ (seen.gradient * scaling)
    return _moved(T, -strong @ np.linalg.lstsq(hessian, gradient, rcond=None)[0], radius)


def _moved(T: Float, step: Float, radius: float) -> Float:
    result = np.eye(4)
    result[:3, :3] = Rotation.from_rotvec(step[3:] / radius).as_matrix() @ T[:3, :3]
    result[:3, 3] = T[:3, 3] + step[:3]
    return result


def _rotation_vector(rotation: Float) -> Float:
    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())


def _information(seen: Agreement, strong: Float, radius: float) -> Float:
    """Information (6, 6) of a match along strong directions (6, S); never surer than _SUREST_M."""
    if not strong.size or not math.isfinite(seen.residual):
        return np.zeros((6, 6))
    scaling = np.repeat([1.0, 1.0 / radius], 3)
    variance = _ALIKE * max(seen.residual, _SMALLEST_RESIDUAL_M) ** 2
    hessian = strong.T @ (seen.hessian * np.outer(scaling, scaling)) @ strong / variance
    covariance = np.linalg.pinv(hessian, hermitian=True) + _SUREST_M**2 * np.eye(strong.shape[1])
    unscaled = strong / scaling[:, None]
    return np.asarray(unscaled @ np.linalg.inv(covariance) @ unscaled.T)


def _in_words(direction: Float) -> str:
    """Such as `along x`, `about z` or `along (0.87, 0.50, 0.00)`, in the frame of the fixed sweep."""
    way, turn = direction[:3], direction[3:]
    kind, vector = ("along", way) if way @ way >= turn @ turn else ("about", turn)
    vector = vector / np.linalg.norm(vector)
    axis = int(np.argmax(np.abs(vector)))
    if abs(vector[axis]) > _STRAIGHT:
        return f"{kind} {_AXES[axis]}"
    vector = vector * np.sign(vector[axis]) + 0.0
    return f"{kind} ({', '.join(f'{value:.2f}' for value in vector)})"
