# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import simulated_sweeps

from g2_recon.config import SweepConfig
from g2_recon.errors import InputError
from g2_recon.geometry import se3
from g2_recon.geometry.cloud import Cloud
from g2_recon.registration.sweep_merger import SweepMerger

RING, STOPS = simulated_sweeps.ring()
CONFIG = SweepConfig()


def drive_round(config):
    """The merger after all sweeps of the ring, with odometry off by 10 cm and 3 deg a step; and what came of each."""
    rng = np.random.default_rng(0)
    merger, driven, placed = SweepMerger(config), np.eye(4), []
    for before, at in zip([STOPS[0], *STOPS], STOPS, strict=False):
        driven = driven @ se3.inverse(before) @ at @ simulated_sweeps.off_by(rng, 0.1, 3.0)
        placed.append(merger.add(Cloud(simulated_sweeps.sweep(RING, at, rng)), driven))
    return merger, placed


def last_to_first(merger):
    poses = merger.poses()
    found = se3.inverse(poses[0]) @ poses[-1]
    return simulated_sweeps.errors(found, se3.inverse(STOPS[0]) @ STOPS[-1])[0]


@pytest.fixture(scope="module")
def ring():
    return drive_round(CONFIG)


def test_a_ring_of_sweeps_closes(ring):
    merger, placed = ring
    assert [entry.quality for entry in placed] == ["first"] + ["good"] * 11
    assert merger.loops > 1
    assert last_to_first(merger) < 0.005  # m, half of the noise of one beam


def test_without_loops_the_ring_does_not_close_as_well(ring):
    merger, _ = drive_round(SweepConfig(loop_closure=False))
    assert merger.loops == 0
    assert last_to_first(merger) > last_to_first(ring[0])


def test_the_cloud_has_all_points_and_the_place_of_the_laser_for_each(ring):
    merger, _ = ring
    cloud = merger.cloud()
    assert len(cloud) == 12 * 36200
    assert len(np.unique(cloud.sensor.round(9), axis=0)) == 12
    # The corner of the map is the first sweep: the floor is as far down as the laser is up.
    assert np.percentile(cloud.points[:, 2], 1) == pytest.approx(-simulated_sweeps.HEIGHT_M, abs=0.05)


def test_sweeps_are_handed_out_and_those_that_later_ones_moved_anew():
    rng = np.random.default_rng(0)
    merger, driven, latest, renewed = SweepMerger(CONFIG), np.eye(4), {}, 0
    for number, (before, at) in enumerate(zip([STOPS[0], *STOPS], STOPS, strict=False)):
        driven = driven @ se3.inverse(before) @ at @ simulated_sweeps.off_by(rng, 0.1, 3.0)
        merger.add(Cloud(simulated_sweeps.sweep(RING, at, rng)[::3]), driven, stamp=float(number))
        newest = merger.renew()
        assert (newest.stamp, newest.piece, newest.revision) == (number, number, 0)
        latest[number] = newest
        for moved in iter(merger.renew, None):
            assert moved.revision == latest[moved.piece].revision + 1
            latest[moved.piece], renewed = moved, renewed + 1
    assert renewed and merger.to_renew == 0
    for index, told in latest.items():
        # The laser stands where it was told to be but for the correction that is not worth it, see SweepConfig.
        assert np.linalg.norm(told.cloud.sensor[0] - merger.poses()[index][:3, 3]) <= CONFIG.correction_distance


def test_whoever_comes_late_is_handed_all_sweeps_the_newest_first(ring):
    merger, _ = ring
    list(iter(merger.renew, None))
    merger.renew_all()
    again = list(iter(merger.renew, None))
    assert [entry.piece for entry in again] == [11, *range(11)]
    assert sum(len(entry.cloud) for entry in again) == len(merger.cloud())


def test_the_covariance_of_one_sweep_is_that_among_all(ring):
    merger, _ = ring
    assert merger.covariance(7) == pytest.approx(merger.covariances()[7], rel=1e-9, abs=1e-15)


def test_covariances_are_of_the_size_of_the_errors(ring):
    merger, _ = ring
    sigmas = np.sqrt(np.array([np.diag(each)[:3] for each in merger.covariances()]))
    poses, truth = merger.poses(), np.array(STOPS)
    off = (se3.inverse(poses[0]) @ poses)[:, :3, 3] - (se3.inverse(truth[0]) @ truth)[:, :3, 3]
    assert (np.abs(off[1:]) < 5 * sigmas[1:]).all()
    assert sigmas.max() < 0.05  # m; one sweep of the ring is held by few walls


def test_a_sweep_that_matches_none_is_placed_by_odometry_and_says_so(rooms_apart):
    merger = SweepMerger(CONFIG)
    merger.add(Cloud(rooms_apart.points[0]), np.eye(4))
    placed = merger.add(Cloud(rooms_apart.points[1]), rooms_apart.T)
    assert (placed.quality, placed.kept) == ("odometry", True)
    assert "on sweep 0: only" in placed.describe()
    assert merger.poses()[1] == pytest.approx(rooms_apart.T)


def test_without_odometry_a_sweep_that_matches_none_is_left_out_with_the_reason(rooms_apart):
    merger = SweepMerger(CONFIG)
    merger.add(Cloud(rooms_apart.points[0]))
    placed = merger.add(Cloud(rooms_apart.points[1]))
    assert (placed.quality, placed.kept, placed.number) == ("left out", False, 1)
    assert placed.reason
    assert merger.numbers == [0]


def test_without_odometry_a_sweep_is_found_around_the_one_before(room):
    merger = SweepMerger(CONFIG)
    merger.add(Cloud(room.points[0]))
    assert merger.add(Cloud(room.points[1])).quality == "good"
    assert simulated_sweeps.errors(merger.poses()[1], room.T)[0] < 0.003


def test_a_corridor_is_limited_with_odometry_and_left_out_without(corridor):
    merger = SweepMerger(CONFIG)
    merger.add(Cloud(corridor.points[0]), np.eye(4))
    placed = merger.add(Cloud(corridor.points[1]), corridor.T)
    assert placed.quality == "limited"
    assert placed.reason.startswith("left to odometry: along")
    merger.reset()
    merger.add(Cloud(corridor.points[0]))
    assert not merger.add(Cloud(corridor.points[1])).kept


def test_a_match_that_odometry_rules_out_is_not_believed(room):
    merger = SweepMerger(SweepConfig(odometry_distance=0.01, odometry_angle=0.01))
    merger.add(Cloud(room.points[0]), np.eye(4))
    placed = merger.add(Cloud(room.points[1]), room.T @ se3.from_xyz_rpy([0.5, 0, 0, 0, 0, 0]))
    assert placed.quality == "odometry"
    assert "standard deviations from where odometry has it" in placed.reason


def test_what_cannot_be_used_leaves_the_merger_as_it_was(room):
    merger = SweepMerger(CONFIG)
    merger.add(Cloud(room.points[0]), np.eye(4))
    for points, guess in ((np.empty((0, 3)), None), (room.points[1], np.zeros((4, 4)))):
        with pytest.raises(InputError):
            merger.add(Cloud(points), guess)
    assert len(merger) == 1
    assert merger.add(Cloud(room.points[1]), room.T).number == 1


def test_millimetres_are_warned_of(room, caplog):
    with pytest.raises(InputError, match="scale"):
        SweepMerger(CONFIG).add(Cloud(1000 * room.points[0]))
    assert "set scale to 0.001" in caplog.text


def test_points_that_are_nan_do_not_count(room):
    merger = SweepMerger(CONFIG)
    points = np.vstack([room.points[0], np.full((50, 3), np.nan)])
    merger.add(Cloud(points))
    assert len(merger.cloud()) == len(room.points[0])


def test_the_same_sweeps_give_the_same_poses(room):
    def merged():
        merger = SweepMerger(CONFIG)
        for points, guess in zip(room.points, (np.eye(4), room.T), strict=True):
            merger.add(Cloud(points), guess)
        return merger.poses()

    assert np.array_equal(merged(), merged())


def test_an_empty_merger_has_an_empty_cloud():
    merger = SweepMerger(CONFIG)
    assert len(merger.cloud()) == len(merger.poses()) == len(merger.covariances()) == 0
