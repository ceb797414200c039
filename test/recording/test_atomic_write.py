# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest

from g2_recon.errors import InputError
from g2_recon.recording.files import atomic_write, read_bytes


def test_missing_parent_folders_are_made(tmp_path: Path) -> None:
    with atomic_write(tmp_path / "a" / "b" / "c.txt") as temporary:
        temporary.write_text("content")
    assert (tmp_path / "a" / "b" / "c.txt").read_text() == "content"


def test_after_a_fault_the_older_file_is_as_it_was_and_nothing_else_is_left(tmp_path: Path) -> None:
    target = tmp_path / "c.txt"
    target.write_text("older")
    with pytest.raises(ZeroDivisionError), atomic_write(target) as temporary:
        temporary.write_text("half")
        raise ZeroDivisionError
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("c.txt", "older")]


def test_a_folder_in_the_place_of_the_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"), atomic_write(tmp_path) as temporary:
        temporary.write_text("content")


def test_a_file_in_the_place_of_the_parent_folder_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("content")
    with pytest.raises(InputError, match="cannot be written"), atomic_write(tmp_path / "file" / "c.txt") as temporary:
        temporary.write_text("content")


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"c\.txt: cannot be read: No such file"):
        read_bytes(tmp_path / "c.txt")


def test_an_empty_file_is_told(tmp_path: Path) -> None:
    (tmp_path / "c.txt").touch()
    with pytest.raises(InputError, match="the file is empty"):
        read_bytes(tmp_path / "c.txt")
