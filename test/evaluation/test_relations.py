# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import bz2
import gzip
import lzma

import numpy as np
import pytest

from g2_recon.errors import InputError
from g2_recon.evaluation.relations import read_relations, score_relations
from g2_recon.evaluation.trajectory_error import mean_position_error
from g2_recon.geometry import se2
from g2_recon.geometry.trajectory import Trajectory


@pytest.fixture
def drive():
    rng = np.random.default_rng(0)
    poses = [np.array([1.0, 2.0, 0.5])]
    for step in rng.normal(0, 0.2, (99, 3)):
        poses.append(se2.compose(poses[-1], step))
    return Trajectory.from_se2(np.arange(100.0), poses)


def relations_of(trajectory, first, second):
    relative = se2.relative(trajectory.planar()[first], trajectory.planar()[second])
    rows = np.zeros((len(first), 8))
    rows[:, 0], rows[:, 1] = trajectory.stamps[first], trajectory.stamps[second]
    rows[:, [2, 3, 7]] = relative
    return rows


def test_the_true_trajectory_has_no_error_wherever_its_map_begins(drive):
    relations = relations_of(drive, np.arange(0, 90, 5), np.arange(5, 95, 5))
    elsewhere = Trajectory.from_se2(drive.stamps, se2.compose([5, 6, 2.0], drive.planar()))
    score = score_relations(relations, elsewhere)
    assert score.relations == 18
    assert score.translation_mean == pytest.approx(0, abs=1e-9)
    assert score.rotation_mean == pytest.approx(0, abs=1e-6)


def test_a_known_error_is_measured(drive):
    relations = relations_of(drive, np.array([0, 10]), np.array([50, 60]))
    relations[:, 2] += 0.3
    relations[:, 3] -= 0.4
    relations[1, 7] += np.radians(2)
    score = score_relations(relations, drive)
    assert score.translation_mean == pytest.approx(0.5)
    assert score.translation_std == pytest.approx(0, abs=1e-9)
    assert score.rotation_mean == pytest.approx(1)


def test_relations_without_a_pose_near_their_stamps_are_counted(drive):
    relations = relations_of(drive, np.array([0, 10]), np.array([50, 60]))
    relations[1, 0] += 0.4
    score = score_relations(relations, drive)
    assert (score.relations, score.missed) == (1, 1)


def test_a_trajectory_of_another_time_is_refused(drive):
    relations = relations_of(drive, np.array([0]), np.array([50]))
    relations[:, :2] += 1e6
    with pytest.raises(InputError, match="none of the relations"):
        score_relations(relations, drive)


@pytest.mark.parametrize("text", ["1 2 3\n", "a b c d e f g h\n", "1 2 3 4 5 6 7 nan\n", ""])
def test_a_file_without_relations_is_refused(tmp_path, text):
    file = tmp_path / "some.relations"
    file.write_text(text)
    with pytest.raises(InputError, match=r"some\.relations"):
        read_relations(file)


PACKERS = {"gz": gzip.compress, "bz2": bz2.compress, "xz": lzma.compress}


def packed_relations(ending):
    rows = "\n".join(" ".join(map(str, row)) for row in np.random.default_rng(0).normal(size=(200, 8)))
    return PACKERS[ending](rows.encode())


@pytest.mark.parametrize("ending", PACKERS)
def test_a_packed_file_is_read(tmp_path, ending):
    file = tmp_path / f"some.relations.{ending}"
    file.write_bytes(packed_relations(ending))
    assert read_relations(file).shape == (200, 8)


@pytest.mark.parametrize("ending", PACKERS)
def test_a_cut_packed_file_is_said_with_advice(tmp_path, ending):
    file = tmp_path / f"some.relations.{ending}"
    file.write_bytes(packed_relations(ending)[:9000])
    with pytest.raises(InputError, match=r"some\.relations.*damaged.*again"):
        read_relations(file)


@pytest.mark.parametrize("ending", PACKERS)
def test_a_packed_file_with_changed_bytes_is_refused(tmp_path, ending):
    file = tmp_path / f"some.relations.{ending}"
    packed = packed_relations(ending)
    for start in range(0, len(packed), 997):
        file.write_bytes(packed[:start] + bytes(99) + packed[start + 99 :])
        with pytest.raises(InputError, match=r"some\.relations"):
            read_relations(file)


def test_a_missing_relations_file_is_said(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        read_relations(tmp_path / "nowhere.relations")


def test_the_mean_position_error_is_the_mean_distance_at_common_times(drive):
    beside = Trajectory.from_se2(drive.stamps[20:] + 0.0, drive.planar()[20:] + (0.03, 0.04, 0))
    assert mean_position_error(beside, drive) == pytest.approx(0.05)


def test_trajectories_without_common_time_are_refused(drive):
    with pytest.raises(InputError, match="no time in common"):
        mean_position_error(Trajectory.from_se2(drive.stamps + 1e4, drive.planar()), drive)
