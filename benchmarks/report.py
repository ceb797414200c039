# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What the benchmarks have in common: tables that are kept as JSON and put together as a page, and what they ran on."""

from __future__ import annotations

import json
import os
import platform
import re
import resource
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

Row = dict[str, Any]


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
    """Keep a table, with the machine that it was made on, as JSON: whole or, where it is cut off, as it was before."""
    part = path.with_suffix(".part")
    part.write_text(json.dumps({"machine": machine(), "table": asdict(table)}, indent=1) + "\n")
    part.replace(path)


def page(head: str, paths: Iterable[Path]) -> str:
    """Those of the tables in JSON files that are there, as one page under a head."""
    read = [json.loads(path.read_text()) for path in paths if path.exists()]
    where = sorted({entry["machine"] for entry in read})
    tables = [Table(**entry["table"]).markdown() for entry in read]
    return "\n".join([head, f"Here: {'; '.join(where)}.\n", *tables]).rstrip() + "\n"


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
