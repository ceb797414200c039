# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Kernels that are compiled the first time ever: in a process beside the node, which answers meanwhile."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from threading import Lock

# What is compiled late in each part of g2_recon.warm_up tells whether all of it was.
_LATE_IN_SMOOTHING = "localization.pose_graph:solve_window", "localization.likelihood:search"
_LATE_IN_SUBMAPS = "reconstruction.flat_submaps:_lay_flat", "reconstruction.bends:fit_bend"
_LATE = {
    "tracking": ("localization.smoothing:_lay_on_earlier", *_LATE_IN_SMOOTHING),
    "smoothing": _LATE_IN_SMOOTHING,
    "localization": ("localization.loop_closure:register", "localization.branch_and_bound:find_places"),
    "registration": ("registration.placing:pose_at",),
    "reconstruction": (
        "reconstruction.advancing_front:_advance",
        "reconstruction.mesh_repair:_next_along",
        *_LATE_IN_SUBMAPS,
    ),
    "submaps": _LATE_IN_SUBMAPS,
}

# A tenth of the processor for what no message waits for, where others want it, too; and less for the kernels of loops:
# a robot takes minutes until it closes one, and a mesh would wait for them.
_NICENESS = 10
_NICENESS_OF_LOOPS = 19


class KernelCompiler:
    """Compiles parts of g2_recon.warm_up, one after the other, as far as Numba does not have them on its disk."""

    def __init__(self, parts: Sequence[str], held_for: str = "") -> None:
        """Begin with the first one. All but that which messages are held for let others go first.

        Where all nodes of a robot start for the first time, poses would else wait for the kernels of a mesh.
        """
        self._held_for = held_for
        self._parts = [part for part in parts if not are_cached(part)]
        self._process: subprocess.Popen[bytes] | None = None
        self._to_be_lowered = False
        # Other threads of a node may ask, too.
        self._asking = Lock()
        self.parts_left()

    def parts_left(self) -> Sequence[str]:
        """What is not compiled yet; to be asked now and then, so that the next one begins when one is done."""
        with self._asking:
            if self._process is not None and self._process.poll() is not None:
                # Where it failed, the node compiles what it needs.
                self._process = None
                self._parts.pop(0)
            if self._process is None and self._parts:
                self._process = subprocess.Popen(
                    [sys.executable, "-m", "g2_recon.warm_up", self._parts[0]], start_new_session=True
                )
                self._to_be_lowered = self._parts[0] != self._held_for
            if self._process is not None and self._to_be_lowered:
                niceness = _NICENESS_OF_LOOPS if self._parts[0] == "localization" else _NICENESS
                self._to_be_lowered = not _let_others_go_first(self._process.pid, niceness)
            return tuple(self._parts)

    def close(self) -> None:
        """Give up what is not done."""
        with self._asking:
            self._parts.clear()
            if self._process is not None:
                # With what it has begun itself.
                with suppress(ProcessLookupError):
                    os.killpg(self._process.pid, signal.SIGKILL)
                self._process.wait()
            self._process = None


def _let_others_go_first(session: int, niceness: int) -> bool:
    """Lower the priority of the process that leads a session, of what it starts from now on, and of the session.

    False where it is to be tried again later.
    """
    with suppress(AttributeError, OSError):
        # Not raised, where that of the node is even lower.
        os.setpriority(os.PRIO_PROCESS, session, max(niceness, os.getpriority(os.PRIO_PROCESS, session)))
    try:
        # Linux may share the processor among sessions first (sched(7), autogroup).
        Path(f"/proc/{session}/autogroup").write_text(str(niceness))
    except BlockingIOError:
        # For all users but root, it takes one such change in 0.1 s.
        return False
    except OSError:
        pass
    return True


def are_cached(part: str) -> bool:
    """Whether Numba has the kernels of a part on its disk; true also where it does not tell."""
    return all(map(_is_cached, _LATE[part]))


def _is_cached(name: str) -> bool:
    module, kernel = name.split(":")
    try:
        return bool(getattr(import_module(f"g2_recon.{module}"), kernel)._cache._cache_file._load_index())
    except (AttributeError, OSError):
        return True
