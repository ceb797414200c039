# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from rosbags import rosbag2
from rosbags.typesys import Stores, get_typestore

from g2_recon.errors import InputError
from g2_recon.geometry.recording import Recording
from g2_recon.geometry.scan import Scan
from g2_recon.recording.bags import messages, read_bag, write_bag, write_ros1_bag

SCANS = 2500
KINDS = ["mcap", "db3", "bag"]


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same recording in every kind of bag, two MCAP chunks long."""
    folder = tmp_path_factory.mktemp("intact")
    rng = np.random.default_rng(0)
    ranges = rng.uniform(1, 9, (SCANS, 180)).astype(np.float32)
    scans = [Scan(index / 10, row, 0.0, 0.01, 0.0, 80.0) for index, row in enumerate(ranges)]
    write_bag(folder / "drive", Recording(scans=scans))
    write_ros1_bag(folder / "drive.bag", Recording(scans=scans))
    store = get_typestore(Stores.ROS2_JAZZY)
    with rosbag2.Writer(folder / "sqlite", version=9, storage_plugin=rosbag2.StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/scan", "sensor_msgs/msg/LaserScan", typestore=store)
        for message in messages(folder / "drive"):
            writer.write(connection, message.stamp_ns, message.cdr)
    return {
        "mcap": folder / "drive" / "drive.mcap",
        "db3": folder / "sqlite" / "sqlite.db3",
        "bag": folder / "drive.bag",
    }


def _read_or_tell(path: Path) -> Recording | None:
    try:
        recording = read_bag(path)
        assert recording.scans
        return recording
    except InputError as error:
        assert str(path) in str(error)
        assert "\n" not in str(error) and len(str(error)) < 600
        return None


@pytest.mark.parametrize("kind", KINDS)
def test_the_intact_bag_is_read_whole(intact: dict[str, Path], kind: str) -> None:
    assert len(read_bag(intact[kind]).scans) == SCANS


@pytest.mark.parametrize("kind", KINDS)
def test_a_missing_bag_is_told(tmp_path: Path, kind: str) -> None:
    with pytest.raises(InputError, match="No such file"):
        read_bag(tmp_path / f"drive.{kind}")


@pytest.mark.parametrize("kind", KINDS)
def test_an_empty_file_is_told(tmp_path: Path, kind: str) -> None:
    (tmp_path / f"drive.{kind}").touch()
    with pytest.raises(InputError, match="the file is empty"):
        read_bag(tmp_path / f"drive.{kind}")


@pytest.mark.parametrize("kind", KINDS)
def test_garbage_with_the_right_ending_is_told(tmp_path: Path, kind: str) -> None:
    (tmp_path / f"drive.{kind}").write_bytes(np.random.default_rng(0).bytes(5000))
    with pytest.raises(InputError, match="damaged or no bag"):
        read_bag(tmp_path / f"drive.{kind}")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.00001, 0.0001, 0.1, 0.5, 0.9, 0.99999])
def test_a_cut_bag_is_read_with_a_drop_or_told(
    intact: dict[str, Path], tmp_path: Path, kind: str, share: float
) -> None:
    content = intact[kind].read_bytes()
    cut = tmp_path / f"drive.{kind}"
    cut.write_bytes(content[: int(len(content) * share)])
    recording = _read_or_tell(cut)
    assert recording is None or recording.drops or len(recording.scans) == SCANS


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_with_changed_bytes_is_read_or_told(intact: dict[str, Path], tmp_path: Path, kind: str) -> None:
    content = intact[kind].read_bytes()
    rng = np.random.default_rng(0)
    for index in range(12):
        changed = bytearray(content)
        first, last = [(0, 400), (0, len(content)), (len(content) - 3000, len(content))][index % 3]
        for position in rng.integers(first, last, 4):
            changed[position] = rng.choice([0, 255, rng.integers(256)])
        (tmp_path / f"drive.{kind}").write_bytes(changed)
        _read_or_tell(tmp_path / f"drive.{kind}")


def test_of_an_mcap_without_its_index_whole_chunks_are_kept(intact: dict[str, Path], tmp_path: Path) -> None:
    content = intact["mcap"].read_bytes()
    (tmp_path / "drive.mcap").write_bytes(content[: len(content) * 3 // 4])
    recording = read_bag(tmp_path / "drive.mcap")
    assert 1000 < len(recording.scans) < SCANS
    assert recording.drops == {"bag that was not closed properly (its end may be lost)": 1}


def test_messages_of_a_cut_mcap_end_early(intact: dict[str, Path], tmp_path: Path) -> None:
    content = intact["mcap"].read_bytes()
    (tmp_path / "drive.mcap").write_bytes(content[: len(content) * 3 // 4])
    assert 1000 < sum(1 for _ in messages(tmp_path / "drive.mcap")) < SCANS


def test_a_directory_without_metadata_is_read_with_a_drop(intact: dict[str, Path], tmp_path: Path) -> None:
    shutil.copytree(intact["mcap"].parent, tmp_path / "drive")
    (tmp_path / "drive" / "metadata.yaml").unlink()
    recording = read_bag(tmp_path / "drive")
    assert len(recording.scans) == SCANS
    assert recording.drops == {"bag that was not closed properly (its end may be lost)": 1}


@pytest.mark.parametrize("metadata", ["", "nonsense", "rosbag2_bagfile_information: 1", "\0", "[]", "a: {"])
def test_broken_metadata_does_not_lose_the_messages(intact: dict[str, Path], tmp_path: Path, metadata: str) -> None:
    shutil.copytree(intact["mcap"].parent, tmp_path / "drive")
    (tmp_path / "drive" / "metadata.yaml").write_text(metadata)
    assert len(read_bag(tmp_path / "drive").scans) == SCANS


def test_a_directory_whose_messages_are_missing_is_told(intact: dict[str, Path], tmp_path: Path) -> None:
    shutil.copytree(intact["mcap"].parent, tmp_path / "drive")
    (tmp_path / "drive" / "drive.mcap").unlink()
    with pytest.raises(InputError, match="missing"):
        read_bag(tmp_path / "drive")


def test_another_ending_is_told(tmp_path: Path) -> None:
    (tmp_path / "drive.zip").touch()
    with pytest.raises(InputError, match=r"use \.mcap, \.db3, \.bag"):
        read_bag(tmp_path / "drive.zip")
