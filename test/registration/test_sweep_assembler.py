# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon import pipeline
from g2_recon.config import SimulationConfig, SweepConfig
from g2_recon.errors import InputError
from g2_recon.geometry import se3
from g2_recon.geometry.recording import Recording
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.registration.sweep_assembler import SweepAssembler
from g2_recon.simulation.simulator import simulate

MOUNT = se3.from_xyz_rpy([0.1, 0.0, 0.6, 0.0, 0.0, 0.0])
TIMES = np.arange(0.0, 2.0, 0.02)


def ahead(stamp, time_increment=0.0):
    """Three beams to the right, ahead and to the left, 2 m each."""
    return Scan(stamp, np.full(3, 2.0, np.float32), -np.pi / 2, np.pi / 2, time_increment=time_increment)


def assembler(angles=lambda t: 0.5 * t, *, pose=lambda t: np.eye(4), times=TIMES, **settings):
    """One that has had all angles and poses."""
    stage = SweepAssembler(SweepConfig(**settings), MOUNT)
    for stamp in times:
        stage.add_angle(stamp, angles(stamp))
        if pose is not None:
            stage.add_odometry(stamp, pose(stamp))
    return stage


def scanned(stage, stamps):
    for stamp in stamps:
        stage.add_scan(ahead(stamp))
    return stage.finish()


def first(trajectory, count):
    return Trajectory(trajectory.stamps[:count], trajectory.positions[:count], trajectory.quaternions[:count])


def test_beams_are_placed_by_the_tilt_at_their_own_time():
    stage = assembler(lambda t: 0.5 * t, min_tilt=0.1)
    for stamp in np.arange(0.0, 1.8, 0.1):
        stage.add_scan(ahead(stamp, time_increment=0.02))
    (sweep,) = stage.finish()
    beam = sweep.cloud.points[1 + 3 * 10]
    tilt = 0.5 * (1.0 + 0.02)
    # A positive angle turns the x axis down; the beams to the sides stay where they are.
    assert beam == pytest.approx([2 * np.cos(tilt), 0.0, -2 * np.sin(tilt)], abs=1e-6)
    assert sweep.cloud.points[0] == pytest.approx([0, -2, 0], abs=1e-6)
    assert not sweep.cloud.sensor.any()


def test_a_sweep_knows_where_its_mount_was():
    (sweep,) = scanned(assembler(pose=lambda t: se3.from_se2([3.0, 0, np.pi / 2])), np.arange(0.0, 1.9, 0.1))
    assert sweep.T_odom_mount == pytest.approx(se3.from_se2([3.0, 0, np.pi / 2]) @ MOUNT)


def test_without_odometry_a_sweep_has_no_pose():
    (sweep,) = scanned(assembler(pose=None), np.arange(0.0, 1.9, 0.1))
    assert sweep.T_odom_mount is None


def test_where_the_tilt_turns_round_another_sweep_begins():
    stage = assembler(lambda t: 0.5 - abs(t - 1.0) * 0.5)
    assert [len(sweep.cloud) for sweep in scanned(stage, np.arange(0.0, 1.95, 0.1))] == [33, 27]


def test_a_tilt_that_stands_still_makes_no_sweep():
    stage = assembler(lambda t: min(0.5 * t, 0.5))
    (sweep,) = scanned(stage, np.arange(0.0, 1.95, 0.1))
    assert len(sweep.cloud) == 33


def test_scans_wait_for_their_angles():
    stage = SweepAssembler(SweepConfig(), MOUNT)
    for stamp in np.arange(0.0, 1.0, 0.1):
        stage.add_scan(ahead(stamp))
    for stamp in TIMES:
        stage.add_angle(stamp, 0.6 * stamp)
    assert len(stage.finish()) == 1


@pytest.mark.parametrize(
    ("pose", "said"),
    [
        (lambda t: se3.from_se2([0.1 * t, 0, 0]), "moved 0.180 m"),
        (lambda t: se3.from_se2([0, 0, 0.05 * t]), "turned 5.16 deg"),
    ],
)
def test_a_sweep_during_which_the_robot_moved_is_refused_and_said_so(pose, said, caplog):
    stage = assembler(pose=pose)
    assert scanned(stage, np.arange(0.0, 1.85, 0.1)) == []
    assert stage.drops == {"sweeps in which the robot moved": 1}
    assert said in caplog.text


def test_a_sweep_in_which_the_tilt_jumps_is_refused(caplog):
    stage = assembler(lambda t: 0.5 * t + 0.3 * (t > 1.01))
    assert scanned(stage, np.arange(0.0, 1.85, 0.1)) == []
    assert stage.drops == {"sweeps in which the tilt jumped": 1}
    assert "jumps by 17." in caplog.text


def test_a_sweep_that_covers_little_is_refused():
    stage = assembler(lambda t: 0.1 * t)
    assert scanned(stage, np.arange(0.0, 1.85, 0.1)) == []
    assert stage.drops == {"sweeps in which the tilt covered too little": 1}


def test_what_is_not_finite_or_comes_twice_or_without_an_angle_is_counted():
    stage = assembler()
    stage.add_angle(np.nan, 0.0)
    stage.add_angle(0.5, np.inf)
    scanned(stage, [-1.0, 0.0, 0.0, 0.1, 0.05, 9.0])
    assert stage.drops["tilt angles that are not finite"] == 2
    assert stage.drops["scans older than the one before"] == 2
    assert stage.drops["scans without a tilt angle"] == 2


def test_memory_does_not_grow_with_sweeps():
    stage = SweepAssembler(SweepConfig(), MOUNT)
    for stamp in np.arange(0.0, 120.0, 0.05):
        stage.add_angle(stamp, abs(stamp % 4.0 - 2.0) * 0.4)
        stage.add_odometry(stamp, np.eye(4))
        stage.add_scan(ahead(stamp - 0.05))
        stage.take()
    assert len(stage._angles) < 400
    assert len(stage._odometry) < 400


@pytest.fixture(scope="module")
def simulation():
    return simulate(SimulationConfig(setup="sweeping", range_noise=0.0, mixed_pixels=False, horizontal_every=9))


def test_sweeps_of_the_simulated_robot_lie_on_the_surfaces(simulation):
    sweeps, guesses, drops = pipeline.assemble(simulation.recording, SweepConfig(min_range=0.0))
    assert len(sweeps) == 6
    assert drops == {}
    T_map_mount = simulation.trajectory.interpolate(guesses.stamps)[0] @ simulation.recording.T_base_tilt
    points = np.concatenate(
        [se3.transform_points(T, sweep.cloud.points) for T, sweep in zip(T_map_mount, sweeps, strict=True)]
    )
    # The laser counts whole millimetres.
    assert np.linalg.norm(points - simulation.clean_vertical, axis=1).max() < 0.001


def test_sweeps_of_the_simulated_robot_are_merged_better_than_odometry_has_them(simulation):
    sweeps, guesses, _ = pipeline.assemble(simulation.recording, SweepConfig())
    merged = pipeline.merge(sweeps[:3], SweepConfig(), guesses=first(guesses, 3))
    truth = simulation.trajectory.interpolate(guesses.stamps[:3])[0] @ simulation.recording.T_base_tilt

    def last(poses):
        return np.linalg.norm((se3.inverse(poses[0]) @ poses[2] - se3.inverse(truth[0]) @ truth[2])[:3, 3])

    assert last(merged.trajectory.matrices()) < 0.01 < last(guesses.matrices())


def test_a_recording_without_a_tilting_laser_is_refused():
    with pytest.raises(InputError, match="tilting laser"):
        pipeline.assemble(Recording(), SweepConfig())
