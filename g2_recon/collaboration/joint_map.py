# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The maps of several sessions as one: their keyframes in one graph, with loops between them, refined together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry import se2
from g2_recon.geometry.session import Session
from g2_recon.localization import refinement
from g2_recon.localization.keyframes import Keyframes
from g2_recon.localization.loop_closure import LoopCloser
from g2_recon.progress import Progress, silent

Float = NDArray[np.float64]
Int = NDArray[np.int64]

# The first keyframe of a session is as far from the last one of the session before as after so long a way, m: what the
# graph expects of the step between them is worth nothing beside a loop.
_APART_M = 1000.0


def joined(fixed: Session, moving: Session, T_fixed_moving: Float, found: Int) -> Session:
    """One session of two, in the frame of the first, with loops between them.

    T_fixed_moving: (3,) as it is about. found: keyframes of the moving one that were found where it brings them; there
    loops are looked for first, and then, once the maps have been bent to fit there, everywhere.
    """
    both = _laid_together(fixed, moving, T_fixed_moving)
    keyframes = Keyframes()
    arrays = both.points, both.normals, both.kinds, both.firsts, both.increments
    keyframes.fill(both.poses, arrays)
    graph = LoopCloser()
    graph.resume(keyframes, both.local_maps, both.ways, both.loops, both.loop_information)
    begins = both.local_maps
    first = np.searchsorted(begins, len(fixed))
    surely = np.unique(np.searchsorted(begins, len(fixed) + found, side="right") - 1)
    for c in surely:
        graph.close(int(c), wide=False)
    graph.optimize()
    for c in range(int(first), len(begins)):
        graph.close(c)
    graph.optimize()
    step = se2.compose(graph.poses, se2.inverse(keyframes.poses[[local.reference for local in graph.maps]]))
    poses = se2.compose(step[np.searchsorted(begins, np.arange(len(both)), side="right") - 1], both.poses)
    loops = graph.credible()
    return replace(
        both,
        poses=poses,
        loops=np.array([loop[:2] for loop in loops], np.int64).reshape(-1, 2),
        loop_information=np.array([loop[3] for loop in loops]).reshape(-1, 3, 3),
    )


def refined(session: Session, *, progress: Progress = silent) -> Session:
    """The same session with all its keyframes laid on all that saw the same place, at once."""
    keyframes = Keyframes()
    arrays = session.points, session.normals, session.kinds, session.firsts, session.increments
    keyframes.fill(session.poses, arrays)
    poses = refinement.refine(keyframes, session.ways, session.wheel_steps, session.broken, progress=progress)
    return replace(session, poses=poses)


def _laid_together(fixed: Session, moving: Session, T_fixed_moving: Float) -> Session:
    """The keyframes and loops of two sessions one after the other."""
    beams = max(fixed.kinds.shape[1], moving.kinds.shape[1])
    both = {
        name: np.concatenate([_widened(getattr(fixed, name), beams), _widened(getattr(moving, name), beams)])
        for name in ("points", "normals", "kinds")
    }
    wheel_steps, broken = moving.wheel_steps.copy(), moving.broken.copy()
    wheel_steps[0], broken[0] = np.nan, True
    return Session(
        stamps=np.concatenate([fixed.stamps, moving.stamps]),
        poses=np.concatenate([fixed.poses, se2.compose(T_fixed_moving, moving.poses)]),
        **both,
        firsts=np.concatenate([fixed.firsts, moving.firsts]),
        increments=np.concatenate([fixed.increments, moving.increments]),
        ways=np.concatenate([fixed.ways, moving.ways + (fixed.ways[-1] + _APART_M)]),
        wheel_steps=np.concatenate([fixed.wheel_steps, wheel_steps]),
        broken=np.concatenate([fixed.broken, broken]),
        local_maps=np.concatenate([fixed.local_maps, moving.local_maps + len(fixed)]),
        loops=np.concatenate([fixed.loops, moving.loops + len(fixed.local_maps)]),
        loop_information=np.concatenate([fixed.loop_information, moving.loop_information]),
    )


def _widened(rows: NDArray[np.generic], beams: int) -> NDArray[np.generic]:
    """Rows (N, B, ...) with invalid beams (0) behind the last."""
    missing = beams - rows.shape[1]
    return np.pad(rows, [(0, 0), (0, missing), *[(0, 0)] * (rows.ndim - 2)])
