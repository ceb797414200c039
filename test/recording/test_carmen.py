# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import bz2
import gzip
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from g2_recon.errors import InputError
from g2_recon.geometry.recording import Recording
from g2_recon.recording.carmen import read_carmen

DATA = Path(__file__).resolve().parents[2] / ".." / "shared" / "data"


def _flaser(ranges: list[object], *, odom: str = "1 2 0.5", tail: str = "100.25 host 0.1") -> str:
    return f"FLASER {len(ranges)} {' '.join(map(str, ranges))} 9 9 9 {odom} {tail}\n"


def _read(tmp_path: Path, text: str) -> Recording:
    (tmp_path / "drive.log").write_text(text)
    return read_carmen(tmp_path / "drive.log")


def _real(name: str) -> Path:
    file = DATA / name
    if not file.exists():
        pytest.skip(f"{file} is not here")
    return file


@pytest.mark.parametrize(
    ("beams", "step_deg", "last_deg"),
    [(180, 1.0, 89.0), (181, 1.0, 90.0), (360, 0.5, 89.5), (361, 0.5, 90.0), (91, 2.0, 90.0)],
)
def test_beams_are_spread_as_the_laser_does(tmp_path: Path, beams: int, step_deg: float, last_deg: float) -> None:
    angles = np.degrees(_read(tmp_path, _flaser([1.0] * beams)).scans[0].angles())
    assert (angles[0], angles[1] - angles[0], angles[-1]) == pytest.approx((-90.0, step_deg, last_deg))


def test_the_stamp_is_the_third_field_from_the_end(tmp_path: Path) -> None:
    text = _flaser([1, 2, 3], tail="976052857.337530 nohost 0.000246")
    assert _read(tmp_path, text).scans[0].stamp == 976052857.337530


def test_ranges_are_kept_as_float32(tmp_path: Path) -> None:
    ranges = _read(tmp_path, _flaser([1.25, 0.0, "NaN"])).scans[0].ranges
    np.testing.assert_array_equal(ranges, np.array([1.25, 0.0, np.nan], np.float32))


@pytest.mark.parametrize("code", [50.0, 51.06, 81.83, 81.91])
def test_codes_of_an_80_m_log_mean_no_return(tmp_path: Path, code: float) -> None:
    assert _read(tmp_path, _flaser([1.0, code, 20.0])).scans[0].ranges.tolist() == [1.0, math.inf, 20.0]


def test_codes_of_an_8_m_log_mean_no_return_even_beside_nan(tmp_path: Path) -> None:
    ranges = _read(tmp_path, _flaser([1.0, 8.183, 8.191, "NaN"])).scans[0].ranges
    assert np.isinf(ranges).tolist() == [False, True, True, False]


def test_the_odometry_of_each_scan_is_that_of_its_line(tmp_path: Path) -> None:
    recording = _read(tmp_path, _flaser([1, 2], odom="1 2 0.5") + _flaser([1, 2], odom="3 4 nan"))
    np.testing.assert_array_equal(recording.scan_odometry, [[1, 2, 0.5], [3, 4, np.nan]])


def test_odometry_comes_from_the_odom_lines(tmp_path: Path) -> None:
    odom = "ODOM 1 2 0.5 0 0 0 7.5 host 0.1\n"
    odometry = _read(tmp_path, odom + _flaser([1, 2])).odometry
    assert (odometry.stamps.tolist(), odometry.planar().tolist()) == ([7.5], [pytest.approx([1, 2, 0.5])])


def test_without_odom_lines_odometry_comes_from_the_scans(tmp_path: Path) -> None:
    odometry = _read(tmp_path, _flaser([1, 2])).odometry
    assert (odometry.stamps.tolist(), odometry.planar().tolist()) == ([100.25], [pytest.approx([1, 2, 0.5])])


def test_scans_keep_file_order_and_steps_back_in_time_are_counted(tmp_path: Path) -> None:
    recording = _read(tmp_path, "".join(_flaser([1, 2], tail=f"{stamp} host 0") for stamp in (5, 4, 6)))
    assert [scan.stamp for scan in recording.scans] == [5, 4, 6]
    assert recording.drops == {"scans stamped earlier than the one before (kept, in file order)": 1}


def test_scans_with_different_beam_counts_keep_file_order(tmp_path: Path) -> None:
    recording = _read(tmp_path, _flaser([1] * 2) + _flaser([2] * 3) + _flaser([3] * 2))
    assert [scan.ranges[0] for scan in recording.scans] == [1, 2, 3]


@pytest.mark.parametrize(("beams", "rate"), [(181, 75.0), (361, 37.5)])
def test_lines_without_stamps_are_numbered_at_the_scan_rate(tmp_path: Path, beams: int, rate: float) -> None:
    recording = _read(tmp_path, _flaser([1.0] * beams, tail="") * 3)
    assert [scan.stamp for scan in recording.scans] == pytest.approx([0, 1 / rate, 2 / rate])


def test_other_lines_are_skipped(tmp_path: Path) -> None:
    others = "# comment\nPARAM robot_x 1 host 0\nSYNC tag 0 host 0\nNEFF 12.5\n\nRLASER 1 1.0\n"
    assert _read(tmp_path, others + _flaser([1, 2])).drops == {}


@pytest.mark.parametrize(
    "line",
    [
        "FLASER\n",
        "FLASER x 1 2 3\n",
        "FLASER 3 1 2 3 0 0 0\n",
        "FLASER 99999999 1 2 3\n",
        _flaser([1, "bad"]),
        _flaser([1, 2], tail="nan host 0"),
        _flaser([1, 2])[:20],
    ],
)
def test_a_malformed_scan_line_is_counted_and_the_others_are_kept(tmp_path: Path, line: str) -> None:
    recording = _read(tmp_path, _flaser([1, 2]) + line.rstrip("\n") + "\n" + _flaser([3, 4]))
    assert [scan.ranges[0] for scan in recording.scans] == [1, 3]
    assert recording.drops == {"malformed FLASER lines": 1}


def test_malformed_odom_lines_are_counted(tmp_path: Path) -> None:
    lines = "ODOM 1 2\nODOM 1 2 bad 0 0 0 7 host 0\nODOM 1 2 nan 0 0 0 7 host 0\nODOM 1 2 3 0 0 0 7 host 0\n"
    recording = _read(tmp_path, lines + _flaser([1, 2]))
    assert (recording.drops, len(recording.odometry)) == ({"malformed ODOM lines": 3}, 1)


def test_robotlaser_lines_are_read_where_there_are_no_flaser_lines(tmp_path: Path) -> None:
    line = "ROBOTLASER1 0 -1.5 3.0 0.75 30 0.01 0 5 1 2 3 31 5 2 7 7 1 2 3 4 5 6 0 0 0 0 0 12.5 host 0.1\n"
    scan = _read(tmp_path, line).scans[0]
    assert scan.ranges.tolist() == [1, 2, 3, math.inf, 5]
    assert (scan.stamp, scan.angle_min, scan.angle_increment) == (12.5, -1.5, 0.75)


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress])
def test_a_packed_log_is_told_by_its_content(tmp_path: Path, pack: object) -> None:
    assert callable(pack)
    (tmp_path / "drive.log").write_bytes(pack(_flaser([1, 2]).encode()))
    assert len(read_carmen(tmp_path / "drive.log").scans) == 1


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress])
def test_of_a_cut_packed_log_the_start_is_kept(tmp_path: Path, pack: object) -> None:
    assert callable(pack)
    ranges = np.random.default_rng(0).uniform(1, 9, (2000, 180))
    packed = pack("".join(_flaser(list(row)) for row in ranges).encode())
    (tmp_path / "drive.log").write_bytes(packed[: len(packed) * 3 // 4])
    recording = read_carmen(tmp_path / "drive.log")
    assert 1000 < len(recording.scans) < 2000
    assert recording.drops["packed file that ends early (the rest is lost)"] == 1


def test_several_gzip_members_are_one_log(tmp_path: Path) -> None:
    (tmp_path / "drive.log").write_bytes(gzip.compress(_flaser([1, 2]).encode()) * 2)
    assert len(read_carmen(tmp_path / "drive.log").scans) == 2


@pytest.mark.parametrize(
    "content", [b"", b"ODOM 1 2 3 0 0 0 7 host 0\n", b"\x1f\x8bnonsense", b"BZhnonsense", b"\0\xff"]
)
def test_a_log_without_a_scan_is_told(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "drive.log").write_bytes(content)
    with pytest.raises(InputError, match=r"drive\.log"):
        read_carmen(tmp_path / "drive.log")


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(position=st.integers(0, 200), removed=st.integers(0, 30), inserted=st.binary(max_size=8))
def test_any_damage_gives_a_recording_or_one_clear_line(
    tmp_path: Path, position: int, removed: int, inserted: bytes
) -> None:
    content = (_flaser([1, 2, 3]) * 2 + "ODOM 1 2 3 0 0 0 7 host 0\n").encode()
    (tmp_path / "drive.log").write_bytes(content[:position] + inserted + content[position + removed :])
    try:
        assert read_carmen(tmp_path / "drive.log").scans
    except InputError as error:
        assert "\n" not in str(error)


@pytest.mark.parametrize(
    ("name", "scans", "beams", "odometry"),
    [
        ("carmen/aces.clf.bz2", 7374, 180, 7375),
        ("carmen/intel.clf.bz2", 13631, 180, 26915),
        ("carmen/mit-killian_stamped.clf.gz", 17480, 180, 17480),
        ("carmen/mit-csail.clf.bz2", 1988, 361, 1988),
        ("carmen/laserazosSM3.log.gz", 778, 361, 778),
        ("corrected/belgioioso-corrected.log.gz", 395, 361, 4442),
        ("corrected/edmonton-corrected.log.gz", 340, 180, 6351),
        ("corrected/seattle-corrected.log.gz", 241, 361, 19311),
    ],
)
def test_a_published_log_is_read_whole(name: str, scans: int, beams: int, odometry: int) -> None:
    recording = read_carmen(_real(name))
    assert (len(recording.scans), len(recording.odometry)) == (scans, odometry)
    assert {len(scan.ranges) for scan in recording.scans} == {beams}


def test_the_intel_log_steps_back_in_time_631_times() -> None:
    drops = read_carmen(_real("carmen/intel.clf.bz2")).drops
    assert drops == {"scans stamped earlier than the one before (kept, in file order)": 631}
