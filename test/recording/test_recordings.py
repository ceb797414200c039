# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from g2_recon.config import RecordingConfig
from g2_recon.errors import InputError
from g2_recon.geometry.recording import Recording
from g2_recon.geometry.scan import Scan
from g2_recon.recording.bags import write_bag, write_ros1_bag
from g2_recon.recording.recordings import read_recording

LOG = b"FLASER 2 1 2 0 0 0 0 0 0 1.5 host 0\n"
RECORDING = Recording(scans=[Scan(1.5, np.ones(2, np.float32), 0.0, 0.1, 0.0, 80.0)])


@pytest.mark.parametrize("name", ["a.log", "a.clf", "a.log.gz", "a.CLF.GZ"])
def test_a_carmen_log_is_known_by_its_ending(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(gzip.compress(LOG) if name.lower().endswith("gz") else LOG)
    assert read_recording(tmp_path / name).scans[0].stamp == 1.5


def test_a_rosbag2_directory_is_read(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", RECORDING)
    assert read_recording(tmp_path / "bag").scans[0].stamp == 1.5


def test_a_single_storage_file_is_read(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", RECORDING)
    assert read_recording(tmp_path / "bag" / "bag.mcap").scans[0].stamp == 1.5


def test_a_ros1_bag_is_read(tmp_path: Path) -> None:
    write_ros1_bag(tmp_path / "a.bag", RECORDING)
    assert read_recording(tmp_path / "a.bag").scans[0].stamp == 1.5


def test_the_config_reaches_the_bag(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", RECORDING)
    config = RecordingConfig(scan_topic="other", scan_vertical_topic="scan")
    assert len(read_recording(tmp_path / "bag", config).scans_vertical) == 1


@pytest.mark.parametrize("name", ["a.log", "a.bag", "a.mcap", "a.doc", "a"])
def test_a_missing_file_is_told(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="No such file or directory"):
        read_recording(tmp_path / name)


def test_an_unknown_ending_is_told_with_the_known_ones(tmp_path: Path) -> None:
    (tmp_path / "a.alog").write_bytes(LOG)
    with pytest.raises(InputError, match=r"rosbag2 directories, \.mcap, \.db3, \.bag bags and CARMEN logs"):
        read_recording(tmp_path / "a.alog")


def test_a_directory_that_is_no_bag_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is no bag"):
        read_recording(tmp_path)
