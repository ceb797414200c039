# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The maps of several sessions as one: their keyframes in one graph, with loops between them, refined together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry import se2
from g2_recon.geometry.session import Session, widened
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
    graph = LoopCloser()
    graph.resume(Keyframes.of_session(both), both.local_maps, both.ways, both.loops, both.loop_information)
    before, begins = graph.poses.copy(), both.local_maps
    first = np.searchsorted(begins, len(fixed))
    surely = np.unique(np.searchsorted(begins, len(fixed) + found, side="right") - 1)
    for c in surely:
        graph.close(int(c), wide=False)
    graph.optimize()
    for c in range(int(first), len(begins)):
        graph.close(c)
    graph.optimize()
    loops, information = graph.credible()
    poses = graph.carried_along(both.poses, before, both.broken)
    return replace(both, poses=poses, loops=loops, loop_information=information)


def refined(session: Session, *, progress: Progress = silent) -> Session:
    """The same session with all its keyframes laid on all that saw the same place, at once."""
    keyframes = Keyframes.of_session(session)
    poses = refinement.refine(keyframes, session.ways, session.wheel_steps, session.broken, progress=progress)
    return replace(session, poses=poses)


def _laid_together(fixed: Session, moving: Session, T_fixed_moving: Float) -> Session:
    """The keyframes and loops of two sessions one after the other."""
    beams = max(fixed.kinds.shape[1], moving.kinds.shape[1])
    both = {
        name: np.concatenate([widened(getattr(fixed, name), beams), widened(getattr(moving, name), beams)])
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
