# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What a user of the command sees on the terminal: a progress bar a stage and a closing table."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import Progress as RichProgress
from rich.table import Table
from rich.text import Text


class StageProgress:
    """A progress bar a stage, and the seconds that each took."""

    def __init__(self, bars: RichProgress) -> None:
        self._bars = bars
        self._tasks: dict[str, TaskID] = {}
        self._since = time.perf_counter()
        self.seconds: dict[str, float] = {}

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Move the bar of a stage; a stage starts when the one before it was last heard of."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._since
        self._since = now
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=total)
        self._bars.update(self._tasks[stage], completed=done, total=total)


@contextmanager
def stages(console: Console) -> Iterator[StageProgress]:
    """Progress bars on standard error while the block runs."""
    columns = (
        TextColumn("{task.description:<16}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with RichProgress(*columns, console=console) as bars:
        yield StageProgress(bars)


def print_table(title: str, rows: Mapping[str, Any], progress: StageProgress, console: Console) -> None:
    """Rows of names and values under a title, and below them the seconds that each stage took."""
    table = Table(title=title, show_header=False, title_justify="left")
    table.add_column()
    table.add_column(justify="right")
    for name, value in rows.items():
        table.add_row(Text(name), Text(str(value)))
    table.add_section()
    for stage, seconds in progress.seconds.items():
        table.add_row(stage, f"{seconds:.2f} s")
    table.add_row("in all", f"{sum(progress.seconds.values()):.2f} s")
    console.print(table)


def print_paths(paths: Mapping[str, Path], console: Console) -> None:
    """A line for each file or folder that was written, its path as it is: no markup, no line breaks."""
    for name, path in paths.items():
        console.print(f"{name}: {path}", markup=False, highlight=False, soft_wrap=True)
