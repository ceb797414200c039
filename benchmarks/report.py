# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What the benchmarks have in common: tables that are kept as JSON and put together as a page, and what they ran on."""

from __future__ import annotations

import json
import logging
import multiprocessing
import os
import platform
import re
import resource
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

log = logging.getLogger("benchmarks")

Row = dict[str, Any]

_ONE_THREAD = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


@dataclass(frozen=True, slots=True)
class Table:
    """A table: sections of rows, each row a value a column."""

    title: str
    note: str
    sections: dict[str, list[Row]]
    pictures: list[str] = field(default_factory=list)

    def markdown(self) -> str:
        """As in docs/benchmarks.md."""
        lines = [f"## {self.title}", "", self.note, ""]
        for title, rows in self.sections.items():
            if not rows:
                continue
            columns = list(dict.fromkeys(column for row in rows for column in row))
            lines += [f"### {title}", ""] if title else []
            lines += ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
            lines += ["| " + " | ".join(str(row.get(column, "")) for column in columns) + " |" for row in rows]
            lines.append("")
        lines += [line for picture in self.pictures for line in (f"![{Path(picture).stem}]({picture})", "")]
        return "\n".join(lines)


def save(path: Path, table: Table) -> None:
    """Keep a table, with the machine that it was made on, as JSON: whole or, where it is cut off, as it was before.

    Its single results are not needed any more then.
    """
    part = path.with_suffix(".part")
    part.write_text(json.dumps({"machine": machine(), "table": asdict(table)}, indent=1) + "\n")
    part.replace(path)
    results_of(path).unlink(missing_ok=True)


def results_of(path: Path) -> Path:
    """Where the results of single cases are while the table of a JSON file is being made."""
    return path.with_suffix(".partial.jsonl")


def each(function: Callable[..., Any], cases: Iterable[tuple[Any, ...]], *, jobs: int, table: Path) -> list[Any]:
    """What a function makes of each case, its arguments, in their order; with several jobs in processes of one thread.

    The function is one of a module, or a partial of one, so that another process finds it; what it returns can be JSON.
    Each result is kept beside the JSON file of the table as soon as it is there, lest an interruption lose all.
    """
    cases = list(cases)
    results: list[Any] = [None] * len(cases)
    kept = results_of(table)

    def keep(index: int, result: Any) -> None:
        results[index] = result
        shown = [str(part) for part in cases[index]]
        with kept.open("a") as file:
            file.write(json.dumps([shown, result]) + "\n")
        log.info("%s: %s", table.stem, ", ".join(shown))

    if jobs <= 1:
        for index, case in enumerate(cases):
            keep(index, function(*case))
        return results
    os.environ.update(_ONE_THREAD)
    # Threads of Numba do not live on in a process that is forked.
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        places = {pool.submit(function, *case): index for index, case in enumerate(cases)}
        for done in as_completed(places):
            keep(places[done], done.result())
    return results


def page(head: str, paths: Iterable[Path]) -> str:
    """Those of the tables in JSON files that are there, as one page under a head."""
    read = [json.loads(path.read_text()) for path in paths if path.exists()]
    made: dict[str, list[str]] = {}
    for entry in read:
        made.setdefault(entry["machine"], []).append(entry["table"]["title"])
    here = [machine + (f" ({', '.join(titles)})" if len(made) > 1 else "") for machine, titles in sorted(made.items())]
    tables = [Table(**entry["table"]).markdown() for entry in read]
    return "\n".join([head, f"Here: {'; '.join(here)}.\n", *tables]).rstrip() + "\n"


def machine() -> str:
    """What this ran on, in words."""
    info = Path("/proc/cpuinfo")
    models = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line]
    model = models[0] if models else platform.processor()
    return f"{os.cpu_count()} cores of {model}, Python {platform.python_version()}, NumPy {np.__version__}"


def peak_mb() -> float:
    """Largest memory of this process so far; getrusage on Linux counts that of the process that started it, too."""
    status = Path("/proc/self/status")
    if status.exists():
        return float(re.search(r"VmHWM:\s+(\d+) kB", status.read_text())[1]) / 1024  # type: ignore[index]
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
