# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import gzip
from pathlib import Path

import numpy as np
import pytest

from g2_recon.errors import InputError
from g2_recon.recording.slam6d import from_left_handed, left_handed, read_3d, read_3d_pose

SWEEPS = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "sweeps" / "3dtk"
real = pytest.mark.skipif(not SWEEPS.exists(), reason="the sweeps of 3DTK are not here")


def test_right_up_forward_in_centimetres_becomes_forward_left_up_in_metres(tmp_path):
    file = tmp_path / "scan000.3d"
    file.write_text("100 20 300\n-50 -10 0\n")
    assert read_3d(file).points == pytest.approx(np.array([[3.0, -1.0, 0.2], [0.0, 0.5, -0.1]]))


def test_columns_after_the_third_are_left_out(tmp_path):
    file = tmp_path / "scan000.3d"
    file.write_text("100 20 300 255\n1 2 3 4\n")
    assert read_3d(file).points.shape == (2, 3)


def test_a_packed_scan_is_read_as_the_plain_one(tmp_path):
    (tmp_path / "a.3d").write_text("100 20 300\n")
    (tmp_path / "a.3d.gz").write_bytes(gzip.compress(b"100 20 300\n"))
    assert np.array_equal(read_3d(tmp_path / "a.3d").points, read_3d(tmp_path / "a.3d.gz").points)


@pytest.mark.parametrize("content", [b"1 2\n", b"1 2 three\n", b"1 2 3\n4 5\n", b"\xff\xfe", b"\n"])
def test_what_is_no_table_of_points_is_one_clear_error(tmp_path, content):
    file = tmp_path / "scan000.3d"
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"scan000\.3d"):
        read_3d(file)


def test_a_packed_scan_that_is_cut_off_is_one_clear_error(tmp_path):
    file = tmp_path / "scan000.3d.gz"
    file.write_bytes(gzip.compress(b"100 20 300\n" * 5000)[:-20])
    with pytest.raises(InputError, match="cut short"):
        read_3d(file)


@pytest.mark.parametrize("name", ["scan000.3d", "scan000.3d.gz"])
def test_the_pose_lies_beside_the_scan(tmp_path, name):
    (tmp_path / "scan000.pose").write_text("10 20 300\n0 90 0\n")
    T = read_3d_pose(tmp_path / name)
    assert T[:3, 3] == pytest.approx([3.0, -0.1, 0.2])
    # From z to x for them is from forward to the right: a turn to the right about our z.
    assert T[:3, :3] == pytest.approx(np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]), abs=1e-12)


def test_a_scan_without_a_pose_has_none(tmp_path):
    assert read_3d_pose(tmp_path / "scan000.3d") is None


@pytest.mark.parametrize("text", ["1 2 3", "1 2 3\n4 5 nan", "a b c d e f"])
def test_a_pose_that_is_none_is_one_clear_error(tmp_path, text):
    (tmp_path / "scan000.pose").write_text(text)
    with pytest.raises(InputError, match=r"scan000\.pose"):
        read_3d_pose(tmp_path / "scan000.3d")


def test_transforms_of_points_agree_in_both_conventions():
    rng = np.random.default_rng(0)
    matrix = left_handed(np.array([120.0, -30.0, 50.0, 10.0, -25.0, 40.0]))
    theirs = rng.uniform(-100, 100, (20, 3))
    moved = theirs @ matrix[:3, :3].T + matrix[:3, 3]

    def ours(points):
        return 0.01 * np.column_stack([points[:, 2], -points[:, 0], points[:, 1]])

    T = from_left_handed(matrix)
    assert ours(theirs) @ T[:3, :3].T + T[:3, 3] == pytest.approx(ours(moved))


@real
def test_the_odometry_of_a_real_scan_is_what_slam6d_started_from():
    first_line = (SWEEPS / "scan002.frames").read_text().split("\n\n")[-1].splitlines()[0]
    matrix = np.array(first_line.split()[:16], float).reshape(4, 4).T
    # Six digits are written.
    assert read_3d_pose(SWEEPS / "scan002.3d.gz") == pytest.approx(from_left_handed(matrix), abs=1e-4)


@real
def test_a_real_scan_is_read_whole():
    assert read_3d(SWEEPS / "scan000.3d.gz").points.shape == (81360, 3)
