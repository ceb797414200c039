# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest

from g2_recon import pipeline
from g2_recon.config import G2ReconConfig, LocalizationConfig, SimulationConfig
from g2_recon.errors import InputError
from g2_recon.evaluation.trajectory_error import mean_position_error
from g2_recon.geometry.recording import Recording
from g2_recon.simulation.simulator import simulate


@pytest.fixture(scope="module")
def simulation():
    """The first 60 s of a drive."""
    whole = simulate(SimulationConfig(seed=3, horizontal_every=6, vertical_every=26))
    end = whole.recording.scans[0].stamp + 60
    recording = dataclasses.replace(
        whole.recording,
        scans=[scan for scan in whole.recording.scans if scan.stamp < end],
        scans_vertical=[scan for scan in whole.recording.scans_vertical if scan.stamp < end],
        drops={"broken message": 2},
    )
    return dataclasses.replace(whole, recording=recording)


@pytest.fixture(scope="module")
def result(simulation):
    return pipeline.run(simulation.recording, G2ReconConfig())


def test_the_trajectory_is_within_5_cm_of_the_truth(simulation, result):
    """The precision that the paper states for its localization."""
    assert mean_position_error(result.localization.trajectory, simulation.trajectory) < 0.05


def test_the_robot_drove_through_free_cells_of_the_map(result):
    localization = result.localization
    cells = localization.grid.at(localization.trajectory.positions[:, :2])
    # Where the robot set out nobody has looked from elsewhere yet; nothing is in its way.
    assert (cells == 0).mean() > 0.95
    assert not (cells == 100).any()


def test_keyframes_that_no_map_can_hold_cost_the_map_and_not_the_trajectory(simulation, monkeypatch, caplog):
    monkeypatch.setattr("g2_recon.localization.occupancy.MOST_CELLS", 10)
    recording = dataclasses.replace(simulation.recording, scans=simulation.recording.scans[:50])
    localization = pipeline.localize(recording, LocalizationConfig())
    assert localization.grid is None
    assert len(localization.trajectory) == 50
    assert "keyframes are not in the map" in caplog.text


def test_the_cloud_lies_on_the_true_surfaces(simulation, result):
    truth = simulation.clean_vertical[: len(result.registration.cloud)]
    error = np.linalg.norm(result.registration.cloud.points[: len(truth)] - truth, axis=1)
    assert np.median(error) < 0.05


def test_every_vertical_scan_is_placed_or_counted(simulation, result):
    dropped = sum(result.registration.drops.values())
    assert result.registration.scans + dropped == len(simulation.recording.scans_vertical)
    assert dropped <= 1


def test_drops_of_all_stages_are_counted_together(result):
    assert result.drops["broken message"] == 2


def test_without_odometry_the_way_is_found_too(simulation):
    blind = dataclasses.replace(simulation.recording, odometry=Recording().odometry)
    localization = pipeline.localize(blind, LocalizationConfig())
    assert mean_position_error(localization.trajectory, simulation.trajectory) < 0.05


def test_the_same_recording_gives_the_same_result(simulation, result):
    again = pipeline.run(simulation.recording, G2ReconConfig())
    assert again.reconstruction.mesh.vertices.tolist() == result.reconstruction.mesh.vertices.tolist()
    assert pipeline.summarize(again) == pipeline.summarize(result)


def test_a_recording_without_horizontal_scans_is_refused(simulation):
    with pytest.raises(InputError, match="horizontal"):
        pipeline.run(dataclasses.replace(simulation.recording, scans=[]), G2ReconConfig())


def test_a_recording_without_vertical_scans_is_refused(simulation):
    with pytest.raises(InputError, match="vertical"):
        pipeline.run(dataclasses.replace(simulation.recording, scans_vertical=[]), G2ReconConfig())


def late(scan):
    return dataclasses.replace(scan, stamp=scan.stamp + 1e6)


def blind(scan):
    return dataclasses.replace(scan, ranges=np.full_like(scan.ranges, np.nan))


@pytest.mark.parametrize(
    ("spoiled", "said"),
    [(late, "clocks of the two lasers"), (late, r"\(.*: \d+\)"), (blind, "no beam in range: ")],
    ids=["clocks differ", "counts are said", "no beam returns"],
)
def test_vertical_scans_that_cannot_be_placed_are_refused_with_the_reasons(simulation, result, spoiled, said):
    recording = dataclasses.replace(
        simulation.recording, scans_vertical=[spoiled(scan) for scan in simulation.recording.scans_vertical]
    )
    with pytest.raises(InputError, match=said):
        pipeline.register(recording, result.localization.trajectory, G2ReconConfig().registration)


def test_horizontal_scans_without_a_return_are_refused(simulation):
    recording = dataclasses.replace(
        simulation.recording, scans=[blind(scan) for scan in simulation.recording.scans[:50]]
    )
    with pytest.raises(InputError, match="max_range"):
        pipeline.localize(recording, LocalizationConfig())


def test_a_trajectory_that_many_scans_do_not_fit_is_called_doubtful(simulation, caplog):
    scans = simulation.recording.scans[:100]
    recording = dataclasses.replace(simulation.recording, scans=scans[:80] + [blind(scan) for scan in scans[80:]])
    assert pipeline.localize(recording, LocalizationConfig()).unmatched == 20
    assert "20 of 100 scans did not match" in caplog.text
    assert [record.levelname for record in caplog.records] == ["WARNING"]


def test_a_trajectory_that_the_scans_fit_is_not_called_doubtful(simulation, caplog):
    recording = dataclasses.replace(simulation.recording, scans=simulation.recording.scans[:100])
    pipeline.localize(recording, LocalizationConfig())
    assert not caplog.records


def test_a_laser_of_unknown_mounting_is_refused_rather_than_guessed(simulation):
    with pytest.raises(InputError, match=r"localization\.laser_pose"):
        pipeline.localize(dataclasses.replace(simulation.recording, T_base_laser=None), LocalizationConfig())


def test_a_mounting_pose_that_is_set_counts_before_the_recorded_one():
    recorded = np.eye(4)
    assert pipeline.mounting_pose("x", (), recorded) is recorded
    assert pipeline.mounting_pose("x", (1, 2, 3, 0, 0, 0), recorded)[:3, 3].tolist() == [1, 2, 3]
