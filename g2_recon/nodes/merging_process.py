# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A process beside the merger that makes maps, so that nothing that comes in has to wait for it.

A thread would not do: Python lets one thread run at a time, and what merges holds it for many milliseconds. It gets
pickled work on its input, gives pickled results on its output, and ends when its input does, as when the merger is
killed.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2_recon.collaboration.live_merger import StoredSweepWork, SweepPlace, Work
from g2_recon.collaboration.map_merger import JointMap
from g2_recon.config import LocalizationConfig
from g2_recon.errors import InputError
from g2_recon.geometry.occupancy_grid import OccupancyGrid
from g2_recon.joint_pipeline import grid_of
from g2_recon.localization.point_map import map_of_keyframes
from g2_recon.sweep_pipeline import place_sweeps


@dataclass(frozen=True, slots=True)
class Made:
    """A map of all robots, its grid and its points (N, 2), and how many seconds it took."""

    map: JointMap
    grid: OccupancyGrid | None
    points: NDArray[np.float64]
    seconds: float


@dataclass(frozen=True, slots=True)
class Placed:
    """Where robots that make sweeps lie, and how many seconds it took."""

    places: dict[str, SweepPlace]
    seconds: float


class MergingProcess:
    """Does one piece of work after the other; started with the first, and again where it has ended."""

    def __init__(self, settings: LocalizationConfig) -> None:
        """settings: for the spacing of points and the resolution of the grid."""
        self._settings = settings
        self._thread = ThreadPoolExecutor(1, "merging")
        self.process: subprocess.Popen[bytes] | None = None

    def submit(self, work: Work | StoredSweepWork) -> Future[Made | Placed]:
        """What becomes of work; its exception is an InputError where maps cannot be merged, or the process ended."""
        return self._thread.submit(self._do, work)

    def _do(self, work: Work | StoredSweepWork) -> Made | Placed:
        if self.process is None or self.process.poll() is not None:
            path = os.pathsep.join(filter(None, sys.path))
            self.process = subprocess.Popen(
                [sys.executable, "-m", __name__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=os.environ | {"PYTHONPATH": path},
            )
        assert self.process.stdin is not None and self.process.stdout is not None
        try:
            pickle.dump((work, self._settings), self.process.stdin, protocol=pickle.HIGHEST_PROTOCOL)
            self.process.stdin.flush()
            answer = pickle.load(self.process.stdout)
        except (OSError, EOFError, pickle.UnpicklingError) as error:
            self.process.kill()
            raise InputError("the process that merges has ended", advice="it is started again") from error
        if isinstance(answer, Made | Placed):
            return answer
        raise InputError(str(answer))

    def close(self) -> None:
        """End the process, whatever it does."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()
        self._thread.shutdown(cancel_futures=True)


def made(work: Work | StoredSweepWork, settings: LocalizationConfig) -> Made | Placed:
    """The map of all robots, and what shows it; or where those lie in it that make sweeps.

    Raises InputError where a map is too large to search.
    """
    began = time.monotonic()
    if isinstance(work, StoredSweepWork):
        return Placed(place_sweeps(work.copied()), time.monotonic() - began)
    merged = work.merged()
    session = merged.session
    points = map_of_keyframes(session.poses, session.points, session.kinds, settings.map_spacing)
    return Made(merged, grid_of(merged, settings), points, time.monotonic() - began)


def main() -> None:
    """Answer what comes in, until nothing does."""
    # Whoever interrupts a terminal ends the merger; that ends this.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Only answers go to the output, whatever a library may print.
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    with suppress(EOFError, BrokenPipeError):
        while True:
            work, settings = pickle.load(sys.stdin.buffer)
            try:
                answer: Made | Placed | str = made(work, settings)
            except Exception as error:
                answer = str(error) if isinstance(error, InputError) else f"internal error: {error!r}"
            pickle.dump(answer, output, protocol=pickle.HIGHEST_PROTOCOL)
            output.flush()


if __name__ == "__main__":
    # Pickled classes have to be of the module, not of the program.
    from g2_recon.nodes import merging_process

    merging_process.main()
