# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from g2_recon.errors import InputError
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.recording.trajectories import read_tum, write_tum


def _trajectory(stamps: list[float]) -> Trajectory:
    poses = np.random.default_rng(0).uniform(-3, 3, (len(stamps), 3))
    return Trajectory.from_se2(stamps, poses)


def test_a_trajectory_comes_back(tmp_path: Path) -> None:
    written = _trajectory([0.5, 1.25, 3.0])
    write_tum(tmp_path / "t.tum", written)
    read = read_tum(tmp_path / "t.tum")
    np.testing.assert_allclose(read.matrices(), written.matrices(), atol=1e-9)  # m; nine decimals are written


def test_stamps_of_this_century_come_back_exactly(tmp_path: Path) -> None:
    stamps = [1134865053.892206, 1134865053.8922062, 1731745824.658001]
    write_tum(tmp_path / "t.tum", _trajectory(stamps))
    assert read_tum(tmp_path / "t.tum").stamps.tolist() == stamps


def test_poses_keep_their_order_when_stamps_step_backwards(tmp_path: Path) -> None:
    write_tum(tmp_path / "t.tum", _trajectory([2.0, 1.0, 3.0]))
    assert read_tum(tmp_path / "t.tum").stamps.tolist() == [2.0, 1.0, 3.0]


def test_comments_and_empty_lines_are_skipped(tmp_path: Path) -> None:
    (tmp_path / "t.tum").write_text("# a comment\n\n1 0 0 0 0 0 0 1\n# another\n2 0 0 0 0 0 0 1\n")
    assert len(read_tum(tmp_path / "t.tum")) == 2


def test_quaternions_are_normalized(tmp_path: Path) -> None:
    (tmp_path / "t.tum").write_text("1 0 0 0 0 0 0.6 0.6\n")
    assert np.linalg.norm(read_tum(tmp_path / "t.tum").quaternions) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ("", "empty"),
        ("# only a comment\n", "no pose"),
        ("1 2 3\n", "3 numbers a line"),
        ("1 0 0 0 0 0 0 1\n1 0 0\n", "no trajectory"),
        ("1 0 0 0 0 0 0 one\n", "no trajectory"),
        ("1 0 0 0 0 0 0 1\n1 nan 0 0 0 0 0 1\n", "pose 2 is not finite"),
        ("1 0 0 0 0 0 0 0\n", "not of unit length"),
    ],
)
def test_a_malformed_file_is_told(tmp_path: Path, content: str, what: str) -> None:
    (tmp_path / "t.tum").write_text(content)
    with pytest.raises(InputError, match=what):
        read_tum(tmp_path / "t.tum")


def test_a_pose_that_is_not_finite_is_not_written(tmp_path: Path) -> None:
    broken = Trajectory(np.array([1.0]), np.full((1, 3), np.nan), np.array([[0.0, 0, 0, 1]]))
    with pytest.raises(InputError, match="not finite"):
        write_tum(tmp_path / "t.tum", broken)
    assert list(tmp_path.iterdir()) == []


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.one_of(st.binary(max_size=200), st.text("0123456789.-+enaif# \n", max_size=200).map(str.encode)))
def test_any_content_gives_a_trajectory_or_one_clear_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "t.tum").write_bytes(content)
    try:
        assert np.isfinite(read_tum(tmp_path / "t.tum").matrices()).all()
    except InputError as error:
        assert "\n" not in str(error)
