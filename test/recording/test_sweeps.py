# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud
from g2_recon.recording.clouds import write_cloud
from g2_recon.recording.sweeps import SWEEP_ENDINGS, read_sweep

POINTS = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])


@pytest.mark.parametrize("ending", [ending for ending in SWEEP_ENDINGS if not ending.startswith(".3d")])
def test_any_cloud_is_a_sweep_with_the_laser_at_its_origin(tmp_path, ending):
    write_cloud(tmp_path / f"a{ending}", Cloud(POINTS))
    sweep = read_sweep(tmp_path / f"a{ending}")
    assert sweep.name == f"a{ending}"
    assert sweep.cloud.points == pytest.approx(POINTS)
    assert np.array_equal(sweep.T_file_laser, np.eye(4))
    assert sweep.T_map_file is None


def test_the_laser_is_where_all_points_were_seen_from(tmp_path):
    write_cloud(tmp_path / "a.npz", Cloud(POINTS, np.tile([1.0, 1.0, 0.5], (2, 1))))
    sweep = read_sweep(tmp_path / "a.npz")
    assert sweep.cloud.points == pytest.approx(POINTS - [1.0, 1.0, 0.5])
    assert sweep.T_file_laser[:3, 3] == pytest.approx([1.0, 1.0, 0.5])


def test_points_seen_from_many_places_stay_where_they_are(tmp_path):
    write_cloud(tmp_path / "a.npz", Cloud(POINTS, POINTS + 1.0))
    assert read_sweep(tmp_path / "a.npz").cloud.points == pytest.approx(POINTS)


def test_a_scan_of_3dtk_comes_with_its_pose(tmp_path):
    (tmp_path / "scan000.3d").write_text("100 20 300\n")
    (tmp_path / "scan000.pose").write_text("0 0 100\n0 0 0\n")
    assert read_sweep(tmp_path / "scan000.3d").T_map_file[:3, 3] == pytest.approx([1.0, 0.0, 0.0])


def test_another_ending_is_one_clear_error(tmp_path):
    with pytest.raises(InputError, match="ending"):
        read_sweep(tmp_path / "a.jpg")
