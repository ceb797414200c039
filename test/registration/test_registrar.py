# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.config import RegistrationConfig, SimulationConfig
from g2_recon.geometry import se3
from g2_recon.geometry.scan import Scan
from g2_recon.registration.registrar import Registrar
from g2_recon.simulation.simulator import simulate

UP = se3.from_xyz_rpy([0, 0, 0.5, 0, -np.pi / 2, 0])


def scan(stamp, ranges=(1.0, 1.0, 1.0), time_increment=0.0):
    return Scan(stamp, np.array(ranges, np.float32), -np.pi / 2, np.pi / 2, time_increment=time_increment)


def moving(x):
    return se3.from_se2([x, 0.0, 0.0])


def registrar(**settings):
    return Registrar(RegistrationConfig(**settings), UP)


def test_a_vertical_scan_stands_across_the_way_of_the_robot():
    stage = registrar()
    stage.add_pose(0.0, moving(3.0))
    stage.add_scan(scan(0.0))
    (registered,) = stage.take()
    assert registered.cloud.points == pytest.approx(np.array([[3, -1, 0.5], [3, 0, 1.5], [3, 1, 0.5]]), abs=1e-6)
    assert registered.cloud.sensor == pytest.approx(np.tile([3, 0, 0.5], (3, 1)))


def test_each_beam_is_placed_by_the_pose_at_its_own_time():
    stage = registrar(max_gap=2.0)
    stage.add_pose(0.0, moving(0.0))
    stage.add_pose(1.0, moving(1.0))
    stage.add_scan(scan(0.0, time_increment=0.25))
    (registered,) = stage.take()
    assert registered.cloud.points[:, 0] == pytest.approx([0, 0.25, 0.5])
    assert registered.cloud.sensor[:, 0] == pytest.approx([0, 0.25, 0.5])


def test_a_scan_waits_for_the_pose_of_its_last_beam():
    stage = registrar(max_gap=10.0)
    stage.add_pose(0.0, moving(0))
    stage.add_scan(scan(0.5, time_increment=0.5))
    assert stage.take() == []
    stage.add_pose(1.4, moving(1))
    assert stage.take() == []
    stage.add_pose(1.5, moving(1))
    assert len(stage.take()) == 1
    assert stage.waiting == 0


def test_scans_may_come_in_any_order():
    stage = registrar()
    for stamp in (0.0, 0.1, 0.2, 0.3):
        stage.add_pose(stamp, moving(stamp))
    for stamp in (0.25, 0.05, 0.15):
        stage.add_scan(scan(stamp))
    assert [registered.stamp for registered in stage.take()] == [0.25, 0.05, 0.15]


@pytest.mark.parametrize(
    ("stamp", "reason"), [(-1.0, "before the first pose"), (0.75, "no pose within 0.5 s"), (5.0, "after the last pose")]
)
def test_a_scan_without_a_pose_is_dropped_and_counted_by_reason(stamp, reason):
    stage = registrar()
    stage.add_pose(0.0, moving(0))
    stage.add_pose(2.0, moving(1))
    stage.add_scan(scan(stamp))
    assert stage.finish() == []
    assert stage.drops == {reason: 1}


def test_a_scan_is_given_up_when_much_newer_ones_wait_too():
    stage = registrar(max_wait=1.0)
    stage.add_pose(0.0, moving(0))
    for stamp in (0.5, 1.0, 1.6):
        stage.add_scan(scan(stamp))
    assert stage.drops == {"no pose came for 1 s": 1}
    assert stage.waiting == 2


@pytest.mark.parametrize("ranges", [(np.nan, np.inf, -np.inf), (0.0, 0.0, 0.0), (0.1, 99.0, -1.0)])
def test_a_scan_without_a_measurement_is_counted(ranges):
    stage = registrar()
    stage.add_pose(0.0, moving(0))
    stage.add_scan(scan(0.0, ranges))
    assert stage.take() == []
    assert stage.drops == {"no beam in range": 1}


def test_memory_does_not_grow_with_time():
    stage = registrar()
    for index in range(3000):
        stage.add_pose(index * 0.01, moving(0))
        stage.add_scan(scan(index * 0.01))
        stage.take()
    assert len(stage._poses) < 300


def test_after_a_reset_nothing_is_left():
    stage = registrar()
    stage.add_pose(0.0, moving(0))
    stage.add_scan(scan(0.0))
    stage.reset()
    assert stage.take() == []
    stage.add_scan(scan(0.0))
    assert stage.take() == []


def test_with_the_true_trajectory_points_lie_on_the_surfaces():
    simulation = simulate(SimulationConfig(range_noise=0.0, mixed_pixels=False, vertical_every=400))
    recording, truth = simulation.recording, simulation.trajectory
    stage = Registrar(RegistrationConfig(), recording.T_base_laser_vertical)
    for scan_vertical in recording.scans_vertical:
        nearby = np.abs(truth.stamps - scan_vertical.stamp) < 0.1
        for stamp, T_map_base in zip(truth.stamps[nearby], truth.matrices()[nearby], strict=True):
            stage.add_pose(stamp, T_map_base)
        stage.add_scan(scan_vertical)
    points = np.concatenate([registered.cloud.points for registered in stage.take()])
    assert stage.drops == {}
    error = np.linalg.norm(points - simulation.clean_vertical, axis=1)
    # The laser counts whole millimetres.
    assert error.max() < 0.001
