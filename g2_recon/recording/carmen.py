# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""CARMEN logs: text, a message a line, as most published 2D SLAM recordings come.

FLASER n r1 .. rn x y theta odom_x odom_y odom_theta ipc_stamp host logger_stamp
ODOM x y theta tv rv accel ipc_stamp host logger_stamp
ROBOTLASER1 type start_angle field_of_view angle_step max_range accuracy remission_mode n r1 .. rn
    m remission1 .. remissionm laser_x laser_y laser_theta robot_x robot_y robot_theta
    tv rv forward_safety side_safety turn_axis ipc_stamp host logger_stamp
"""

from __future__ import annotations

import logging
import math
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry import sick_lms
from g2_recon.geometry.recording import Recording
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.progress import Progress, silent
from g2_recon.recording.files import read_bytes
from g2_recon.recording.packing import unpack

CARMEN_ENDINGS = (".log", ".clf")

_log = logging.getLogger(__name__)

_MAX_BEAMS = 100_000

_FIELDS_AFTER_RANGES = 9
"""Of a FLASER line with a stamp: two poses, stamp, host, logger stamp."""

_FIELDS_AFTER_RANGES_UNSTAMPED = 6
_ROBOTLASER_FIELDS_BEFORE_RANGES = 8
_ROBOTLASER_FIELDS_AFTER_REMISSIONS = 14
_ODOM_FIELDS = 10


class _Reading(NamedTuple):
    """What one laser line says; ranges as logged."""

    stamp: float
    ranges: NDArray[np.float64]
    angle_min: float
    angle_increment: float
    range_max: float
    odometry: NDArray[np.float64]


@dataclass
class _Rows:
    """Lines with the same number of fields, as texts of numbers only, to be parsed at once."""

    lines: list[int] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)

    def add(self, line: int, tokens: list[str]) -> None:
        self.lines.append(line)
        self.texts.append(" ".join(tokens))


def read_carmen(path: str | Path, *, progress: Progress = silent) -> Recording:
    """Read a CARMEN log, plain or packed by gzip or bzip2 (told by its content).

    Scans are those of the FLASER lines, in file order, stamped with the IPC stamp (third field from the end); a log
    without FLASER lines gives those of its ROBOTLASER1 lines. Lines without a stamp are numbered at the scan rate of
    the laser. Readings that mean "no return" (sick_lms.no_return_threshold) become +inf. `scan_odometry` is the
    odometry that each laser line carries; `odometry` that of the ODOM lines, or of the laser lines if there are none.

    T_base_laser is the identity: the published relations of these logs, and so all figures, treat the laser as the
    robot, and the logs do not say where the laser is mounted.

    Lines that cannot be used are counted in `drops`, as is a packed file that ends early. Raises InputError if the
    file cannot be read or holds no usable laser line.
    """
    text, complaint = unpack(read_bytes(path), where=path)
    drops: Counter[str] = Counter([complaint] if complaint else [])
    lines = text.decode("latin-1").split("\n")
    progress("read log", 0, len(lines))
    readings = _read_flaser(lines, drops) or _read_robotlaser(lines, drops)
    if not readings:
        reasons = "".join(f", {count} {reason}" for reason, count in drops.items())
        raise InputError(
            f"holds no usable FLASER or ROBOTLASER1 line{reasons}", where=path, advice="is it a CARMEN log?"
        )
    odometry = _read_odometry(lines, drops)
    stamps = np.array([reading.stamp for reading in readings])
    scan_odometry = np.array([reading.odometry for reading in readings])
    if len(odometry) == 0:
        known = np.isfinite(scan_odometry).all(axis=1)
        odometry = Trajectory.from_se2(stamps[known], scan_odometry[known])
    backwards = int((np.diff(stamps) < 0).sum())
    if backwards:
        drops["scans stamped earlier than the one before (kept, in file order)"] = backwards
    for reason, count in drops.items():
        _log.warning("%s: %d %s", path, count, reason)
    progress("read log", len(lines), len(lines))
    return Recording(
        scans=_make_scans(readings),
        odometry=odometry,
        scan_odometry=scan_odometry,
        T_base_laser=np.eye(4),
        drops=dict(drops),
    )


def _read_flaser(lines: list[str], drops: Counter[str]) -> list[_Reading]:
    """The scans of the FLASER lines in file order."""
    stamped: dict[int, _Rows] = {}
    unstamped: dict[int, _Rows] = {}
    for number, line in enumerate(lines):
        if not line.startswith("FLASER"):
            continue
        tokens = line.split()
        count = _count(tokens, 1)
        after = len(tokens) - 2 - count
        if count and after == _FIELDS_AFTER_RANGES:
            row = tokens[2 : count + 2] + tokens[count + 5 : count + 9]
            stamped.setdefault(count, _Rows()).add(number, row)
        elif count and after == _FIELDS_AFTER_RANGES_UNSTAMPED:
            row = [*tokens[2 : count + 2], *tokens[count + 5 : count + 8], "0"]
            unstamped.setdefault(count, _Rows()).add(number, row)
        else:
            drops["malformed FLASER lines"] += 1
    if stamped and unstamped:
        drops["FLASER lines without a stamp among ones with"] += sum(len(rows.lines) for rows in unstamped.values())
    found: list[tuple[int, _Reading]] = []
    for count, rows in (stamped or unstamped).items():
        spacing = sick_lms.beam_spacing(count, sick_lms.FIELD_OF_VIEW / max(count - 1, 1))
        numbers, table = _parse(rows, drops, "malformed FLASER lines")
        found += [
            (number, _Reading(row[-1], row[:count], -math.pi / 2, spacing, math.inf, row[count : count + 3]))
            for number, row in zip(numbers, table, strict=True)
        ]
    readings = [reading for _, reading in sorted(found, key=lambda item: item[0])]
    return readings if stamped else _number_at_scan_rate(readings)


def _number_at_scan_rate(readings: list[_Reading]) -> list[_Reading]:
    """The readings stamped by their index and the scan rate of the laser at their beam spacing."""
    return [
        reading._replace(
            stamp=index / sick_lms.SCAN_RATE_HZ[0.5 if math.degrees(reading.angle_increment) < 0.75 else 1.0]
        )
        for index, reading in enumerate(readings)
    ]


def _read_robotlaser(lines: list[str], drops: Counter[str]) -> list[_Reading]:
    """The scans of the ROBOTLASER1 lines in file order."""
    readings: list[_Reading] = []
    for line in lines:
        if line.startswith("ROBOTLASER1"):
            reading = _robotlaser_reading(line.split()[1:])
            if reading is None:
                drops["malformed ROBOTLASER1 lines"] += 1
            else:
                readings.append(reading)
    return readings


def _robotlaser_reading(tokens: list[str]) -> _Reading | None:
    """One ROBOTLASER1 line without its name; the pose taken is the laser's, as T_base_laser is the identity."""
    count = _count(tokens, _ROBOTLASER_FIELDS_BEFORE_RANGES - 1)
    first_pose = _ROBOTLASER_FIELDS_BEFORE_RANGES + count
    if not count or len(tokens) <= first_pose or not tokens[first_pose].isdecimal():
        return None
    first_pose += 1 + int(tokens[first_pose])
    if len(tokens) != first_pose + _ROBOTLASER_FIELDS_AFTER_REMISSIONS:
        return None
    try:
        numbers = np.array([*tokens[1:5], tokens[-3], *tokens[first_pose : first_pose + 3]], float)
        ranges = np.array(tokens[_ROBOTLASER_FIELDS_BEFORE_RANGES : _ROBOTLASER_FIELDS_BEFORE_RANGES + count], float)
    except ValueError:
        return None
    start, _, step, range_max, stamp = numbers[:5].tolist()
    if not (np.isfinite(numbers[:5]).all() and step != 0 and range_max > 0):
        return None
    return _Reading(stamp, ranges, start, sick_lms.beam_spacing(count, step), range_max, numbers[5:])


def _read_odometry(lines: list[str], drops: Counter[str]) -> Trajectory:
    """The poses of the ODOM lines that have a stamp."""
    rows = _Rows()
    for number, line in enumerate(lines):
        if line.startswith("ODOM"):
            tokens = line.split()
            if len(tokens) == _ODOM_FIELDS:
                rows.add(number, [*tokens[1:4], tokens[-3]])
            else:
                drops["malformed ODOM lines"] += 1
    _, table = _parse(rows, drops, "malformed ODOM lines")
    good = np.isfinite(table).all(axis=1)
    if not good.all():
        drops["malformed ODOM lines"] += int((~good).sum())
    return Trajectory.from_se2(table[good, 3], table[good, :3]) if len(table) else Trajectory.from_se2([], [])


def _parse(rows: _Rows, drops: Counter[str], reason: str) -> tuple[list[int], NDArray[np.float64]]:
    """Line numbers and numbers (N, fields) of the rows; those whose fields or stamp (the last) are no numbers drop."""
    if not rows.texts:
        return [], np.empty((0, 4))
    try:
        numbers, table = rows.lines, np.loadtxt(rows.texts, ndmin=2, comments=None)
    except ValueError:
        parsed = [(number, _floats(text)) for number, text in zip(rows.lines, rows.texts, strict=True)]
        sound = [(number, values) for number, values in parsed if values is not None]
        drops[reason] += len(parsed) - len(sound)
        numbers = [number for number, _ in sound]
        table = np.array([values for _, values in sound]).reshape(len(sound), len(rows.texts[0].split()))
    stamped = np.isfinite(table[:, -1])
    if not stamped.all():
        drops[reason] += int((~stamped).sum())
        numbers = [number for number, good in zip(numbers, stamped, strict=True) if good]
    return numbers, table[stamped]


def _floats(text: str) -> list[float] | None:
    try:
        return [float(token) for token in text.split()]
    except ValueError:
        return None


def _count(tokens: list[str], index: int) -> int:
    """The number of beams that a field states; 0 if it states none that can be."""
    text = tokens[index] if len(tokens) > index else ""
    return int(text) if text.isascii() and text.isdecimal() and len(text) <= 6 and int(text) <= _MAX_BEAMS else 0


def _make_scans(readings: list[_Reading]) -> list[Scan]:
    """Scans with REP-117 ranges: what means "no return" in this log, or passes the stated limit, is +inf."""
    threshold = min(_no_return_threshold(readings), min(reading.range_max for reading in readings))
    return [
        Scan(
            stamp=float(reading.stamp),
            ranges=np.where(reading.ranges >= threshold, np.inf, reading.ranges).astype(np.float32),
            angle_min=reading.angle_min,
            angle_increment=reading.angle_increment,
            range_max=threshold,
        )
        for reading in readings
    ]


def _no_return_threshold(readings: list[_Reading]) -> float:
    largest = [np.max(reading.ranges, initial=0.0, where=np.isfinite(reading.ranges)) for reading in readings]
    return sick_lms.no_return_threshold(np.array(largest))
