# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""One door to every kind of recording."""

from __future__ import annotations

from pathlib import Path

from g2_recon.config import RecordingConfig
from g2_recon.errors import InputError
from g2_recon.geometry.recording import Recording
from g2_recon.progress import Progress, silent
from g2_recon.recording.bags import BAG_ENDINGS, read_bag
from g2_recon.recording.carmen import CARMEN_ENDINGS, read_carmen
from g2_recon.recording.files import check_exists

_DEFAULTS = RecordingConfig()
_SUPPORTED = (
    "supported are rosbag2 directories, "
    f"{', '.join(BAG_ENDINGS)} bags and CARMEN logs ({', '.join(CARMEN_ENDINGS)}, also with .gz or .bz2)"
)


def read_recording(path: str | Path, config: RecordingConfig = _DEFAULTS, *, progress: Progress = silent) -> Recording:
    """Read what one robot recorded, whatever kind of file it is in: see bags.read_bag and carmen.read_carmen.

    Raises InputError if the path does not exist, its kind is not known, or it holds no usable scan.
    """
    source = Path(path)
    check_exists(source)
    if source.is_dir() or source.suffix.lower() in BAG_ENDINGS:
        return read_bag(source, config, progress=progress)
    unpacked = Path(source.stem) if source.suffix.lower() in (".gz", ".bz2") else source
    if unpacked.suffix.lower() in CARMEN_ENDINGS:
        return read_carmen(source, progress=progress)
    raise InputError("is no kind of recording that is known", where=path, advice=_SUPPORTED)
