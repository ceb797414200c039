# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from g2_recon.geometry import se2
from g2_recon.geometry.scan import Scan
from g2_recon.localization.beams import CORNER, INVALID, POINT, SURFACE, beams, surface_normals

LIMITS = {"range_min": 0.1, "range_max": 40.0}
POSE = np.array([0.5, 0.3, 0.4])


def backwards(scan):
    """The same beams, measured in the other order."""
    last = float(scan.angles()[-1])
    return Scan(0.0, scan.ranges[::-1], last, -scan.angle_increment, 0.0, 80.0, scan.time_increment)


def test_beams_come_in_order_of_bearing_whatever_the_sign_of_the_increment(scan_of_room):
    scan = scan_of_room(POSE, beams=200, first=-1.0, increment=0.01)
    one, other = beams(scan, **LIMITS), beams(backwards(scan), **LIMITS)
    assert (np.diff(np.arctan2(one.points[:, 1], one.points[:, 0])) > 0).all()
    assert (one.first, one.increment) == (-1.0, 0.01)
    assert (other.first, other.increment) == pytest.approx((-1.0, 0.01))
    assert other.points == pytest.approx(one.points, abs=1e-12)
    assert other.normals == pytest.approx(one.normals, abs=1e-9)
    assert other.kinds.tolist() == one.kinds.tolist()


@pytest.mark.parametrize("turned", [False, True], ids=["forwards", "backwards"])
def test_an_upside_down_laser_gives_the_points_of_an_upright_one_in_mirrored_order(scan_of_room, turned):
    scan = scan_of_room(POSE, beams=200, first=-1.0, increment=0.01, upside_down=True)
    # Bearings from -1 to 0.99 on the laser are those from -0.99 to 1 in the room.
    upright = beams(scan_of_room(POSE, beams=200, first=-0.99, increment=0.01), **LIMITS)
    seen = beams(backwards(scan) if turned else scan, upside_down=True, **LIMITS)
    assert (seen.first, seen.increment) == pytest.approx((-0.99, 0.01))
    assert seen.points == pytest.approx(upright.points, abs=1e-5)
    assert seen.normals == pytest.approx(upright.normals, abs=1e-3)


@pytest.mark.parametrize("nothing", [np.nan, np.inf, -np.inf, 0.0, -1.0, 0.05, 50.0], ids=str)
def test_what_is_no_measurement_is_invalid_and_at_the_laser(scan_of_room, nothing):
    scan = scan_of_room(POSE)
    scan.ranges[[0, 50, 180]] = nothing
    seen = beams(scan, **LIMITS)
    assert np.flatnonzero(seen.kinds == INVALID).tolist() == [0, 50, 180]
    assert seen.points[[0, 50, 180]].tolist() == [[0, 0]] * 3
    assert seen.normals[[0, 50, 180]].tolist() == [[0, 0]] * 3
    assert np.isfinite(seen.normals).all()


def test_a_scan_without_beams_is_no_beams():
    seen = beams(Scan(0.0, np.empty(0, np.float32), -1.0, 0.01), **LIMITS)
    assert (len(seen.points), len(seen.normals), len(seen.kinds), seen.first) == (0, 0, 0, -1.0)


def test_normals_are_those_of_the_walls_and_point_to_the_laser(scan_of_room):
    seen = beams(scan_of_room(POSE, beams=361), **LIMITS)
    surface = seen.kinds == SURFACE
    assert surface.mean() > 0.9
    assert np.hypot(*seen.normals[surface].T) == pytest.approx(1)
    assert ((seen.normals * seen.points).sum(axis=1)[surface] < 0).all()
    in_room = se2.transform_points([0, 0, POSE[2]], seen.normals[surface])
    # All walls lie along an axis; float32 ranges and the corners leave a few that do not.
    assert np.mean(np.abs(in_room).max(axis=1) > 1 - 1e-6) > 0.85
    assert (seen.normals[~surface] == 0).all()


def test_beams_that_hit_this_and_that_are_on_no_surface():
    ranges = np.where(np.arange(100) % 2, 2.0, 5.0).astype(np.float32)
    seen = beams(Scan(0.0, ranges, -1.0, 0.02), **LIMITS)
    assert (seen.kinds == CORNER).all()
    assert (seen.normals == 0).all()


def plain_normals(points, kinds):
    """The twin of the kernel, by the eigenvectors of the scatter."""
    normals, found = np.zeros_like(points), kinds.copy()
    for i in np.flatnonzero(kinds):
        gap = min(max(0.15, 0.12 * np.hypot(*points[i])), 1.0)
        ends = []
        for way in (-1, 1):
            k = i
            while 0 <= k + way < len(points) and kinds[k + way]:
                near = abs(k + way - i) <= 4 or math.dist(points[i], points[k + way]) <= 0.08
                if not near or math.dist(points[k], points[k + way]) > gap:
                    break
                k += way
            ends.append(k)
        line = points[ends[0] : ends[1] + 1]
        if len(line) < 4:
            continue
        values, vectors = np.linalg.eigh(np.cov(line.T, bias=True))
        across, along = np.sqrt(np.maximum(values, 0))
        if across > 0.03 or across > 0.17 * along:
            continue
        normals[i] = -vectors[:, 0] * np.sign(vectors[:, 0] @ points[i])
        found[i] = 2
    return normals, found


@pytest.mark.parametrize("beams_of_it", [181, 1440], ids=["sparse", "dense"])
def test_normals_are_those_of_a_plain_twin(scan_of_room, beams_of_it):
    scan = scan_of_room((4.2, 0.5, 0.3), beams=beams_of_it, noise=0.01)
    scan.ranges[::17] = np.nan
    points = np.nan_to_num(scan.ranges)[:, None] * np.column_stack([np.cos(scan.angles()), np.sin(scan.angles())])
    kinds = scan.valid().astype(np.uint8)
    expected, expected_kinds = plain_normals(points, kinds)
    normals = surface_normals(points, kinds)
    assert kinds.tolist() == expected_kinds.tolist()
    assert normals == pytest.approx(expected, abs=1e-6)


# Half a metre and 30 degrees a second, while a scan takes a tenth of a second: 5 cm and 3 degrees.
TWIST = np.array([0.5, 0.1, math.radians(30)])
SCAN_S = 0.1


def driving(count, *, seconds=SCAN_S):
    """Poses (count, 3) of the laser from beam to beam, from POSE on: the exact arc of the twist."""
    times = np.arange(count) * seconds / count
    turn = TWIST[2] * times
    x = (np.sin(turn) * TWIST[0] - (1 - np.cos(turn)) * TWIST[1]) / TWIST[2]
    y = ((1 - np.cos(turn)) * TWIST[0] + np.sin(turn) * TWIST[1]) / TWIST[2]
    return se2.compose(POSE, np.column_stack([x, y, turn]))


@pytest.mark.parametrize("upside_down", [False, True], ids=["upright", "upside down"])
def test_a_scan_taken_on_the_way_lands_where_one_taken_standing_does(
    scan_of_room, off_the_walls_of_the_room, upside_down
):
    moving = scan_of_room(driving(361), beams=361, time_increment=SCAN_S / 361, upside_down=upside_down)
    still = beams(moving, upside_down=upside_down, **LIMITS)
    deskewed = beams(moving, upside_down=upside_down, twist=TWIST, **LIMITS)
    # The chord is taken for the arc up to the second order in the turn: 5 cm * 3 deg^2 / 24 is 6 um.
    assert off_the_walls_of_the_room(se2.transform_points(POSE, deskewed.points)).max() < 1e-5
    assert off_the_walls_of_the_room(se2.transform_points(POSE, still.points)).max() > 0.1
    standing = beams(scan_of_room(POSE, beams=361, upside_down=upside_down), upside_down=upside_down, **LIMITS)
    wall = (deskewed.kinds == SURFACE) & (standing.kinds == SURFACE)
    # Beam by beam the two look past one another by up to 3 deg, but for corners onto the same wall.
    same_wall = (deskewed.normals * standing.normals).sum(axis=1) > 1 - 1e-6
    assert same_wall[wall].mean() > 0.8
    through = ((deskewed.points - standing.points) * standing.normals).sum(axis=1)[wall & same_wall]
    assert np.median(np.abs(through)) < 1e-4


def test_beams_measured_clockwise_are_deskewed_with_their_own_times(scan_of_room, off_the_walls_of_the_room):
    moving = scan_of_room(driving(361), beams=361, first=np.pi / 2, increment=-np.pi / 360, time_increment=SCAN_S / 361)
    deskewed = beams(moving, twist=TWIST, **LIMITS)
    assert off_the_walls_of_the_room(se2.transform_points(POSE, deskewed.points)).max() < 1e-5


def test_a_scan_taken_in_no_time_is_not_deskewed(scan_of_room):
    scan = scan_of_room(POSE)
    assert beams(scan, twist=TWIST, **LIMITS).points.tolist() == beams(scan, **LIMITS).points.tolist()


def test_corners_are_told_from_walls_whose_beams_are_far_apart():
    # A wall 1 m to the left, seen up to 6 deg of its direction, and table legs before it.
    bearings = np.radians(np.arange(6, 90, 1.0))
    ranges = (1.0 / np.sin(bearings)).astype(np.float32)
    legs = np.array([4, 12, 40])
    ranges[legs] *= 0.8
    seen = beams(Scan(0.0, ranges, bearings[0], np.radians(1.0)), **LIMITS)
    assert np.flatnonzero(seen.kinds == CORNER).tolist() == legs.tolist()
    # Far along the wall its beams are 0.3 m and more apart.
    assert (seen.kinds[:4] == POINT).all()
