# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from g2_recon.errors import InputError
from g2_recon.geometry.session import LastScan, ScanPoses, Session, SessionGrowth
from g2_recon.recording import session_journal as module
from g2_recon.recording.journal import Journal
from g2_recon.recording.records import pack
from g2_recon.recording.session_journal import SessionJournal

FIELDS = [field.name for field in dataclasses.fields(Session)]
OF_KEYFRAMES = [name for name in module._OF_KEYFRAMES if name != "poses"]
N = 6


def session(count=N, *, moved=0.0, beams=5) -> Session:
    rng = np.random.default_rng(0)
    whole = Session(
        stamps=100.0 + np.arange(N),
        poses=rng.normal(size=(N, 3)) + moved,
        points=rng.normal(size=(N, beams, 2)).astype(np.float32),
        normals=np.zeros((N, beams, 2), np.float32),
        kinds=np.ones((N, beams), np.uint8),
        firsts=np.full(N, -1.5),
        increments=np.full(N, 0.01),
        ways=np.arange(float(N)),
        wheel_steps=np.full((N, 3), np.nan),
        broken=np.arange(N) == 2,
        local_maps=np.array([0, 2, 4]),
        loops=np.array([[0, 2]]),
        loop_information=np.eye(3)[None] * 400,
    )
    some = {name: getattr(whole, name)[:count] for name in [*OF_KEYFRAMES, "poses"]}
    begins = whole.local_maps[whole.local_maps < count]
    loops = whole.loops[: int(len(begins) == 3)]
    return Session(**some, local_maps=begins, loops=loops, loop_information=whole.loop_information[: len(loops)])


def scans(first, last) -> ScanPoses:
    """One scan a keyframe."""
    owners = np.arange(first, last)
    return ScanPoses(200.0 + owners, owners, np.outer(owners, [0.1, 0.2, 0.3]))


def growth(first, last, *, moved=0.0, graph=True) -> SessionGrowth:
    """What comes between so many keyframes and so many."""
    now = session(last, moved=moved)
    return SessionGrowth(
        first=first,
        poses=now.poses,
        graph=(now.local_maps, now.loops, now.loop_information) if graph else None,
        scans=scans(first, last),
        last=LastScan(200.0 + last, np.full(3, 0.1 * last), np.array([1.0, np.nan, 2.0])),
        **{name: getattr(now, name)[first:] for name in OF_KEYFRAMES},
    )


def opened(path) -> tuple[SessionJournal, Journal]:
    journal = Journal(path)
    try:
        return SessionJournal(journal), journal
    except InputError:
        journal.close()
        raise


def read(path) -> SessionJournal:
    found, journal = opened(path)
    journal.close()
    return found


def write(path, *growths) -> list[int]:
    """Where the records of each growth end."""
    path.unlink(missing_ok=True)
    log, journal = opened(path)
    ends = [path.stat().st_size]
    for new in growths:
        log.write(new)
        ends.append(path.stat().st_size)
    journal.close()
    return ends


def assert_same(found: Session, expected: Session) -> None:
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


def test_a_session_that_grows_comes_back_as_it_is(tmp_path):
    write(tmp_path / "a", growth(0, 1), growth(1, 2), growth(2, 5), growth(5, 6))
    found = read(tmp_path / "a")
    assert_same(found.session, session())
    np.testing.assert_array_equal(found.scans.offsets, scans(0, 6).offsets)
    assert (found.keyframes, found.scan_count, found.left_out) == (6, 6, 0)
    assert found.last.stamp == 206.0
    np.testing.assert_array_equal(found.last.pose, np.full(3, 0.1 * 6))
    np.testing.assert_array_equal(found.last.odometry, [1.0, np.nan, 2.0])


def test_a_robot_that_stands_is_noted_once_a_second(tmp_path):
    standing = growth(2, 2, graph=False)
    later = [
        dataclasses.replace(standing, last=dataclasses.replace(standing.last, stamp=202.0 + 0.1 * step))
        for step in range(1, 21)
    ]
    ends = write(tmp_path / "a", growth(0, 2), *later)
    assert sum(end > before for before, end in pairwise(ends[1:])) == 2
    assert read(tmp_path / "a").last.stamp == pytest.approx(204.0)


def test_keyframes_that_are_moved_come_back_where_they_are(tmp_path):
    write(tmp_path / "a", growth(0, 3), growth(3, 6, moved=0.5))
    assert_same(read(tmp_path / "a").session, session(moved=0.5))


def test_while_loops_are_being_closed_the_graph_of_before_counts(tmp_path):
    write(tmp_path / "a", growth(0, 3), growth(3, 6, graph=False))
    found = read(tmp_path / "a").session
    assert (len(found), found.local_maps.tolist(), len(found.loops)) == (6, [0, 2], 0)


def test_a_session_is_gone_on_with_after_each_start(tmp_path):
    write(tmp_path / "a", growth(0, 2))
    for first in (2, 3, 4, 5):
        log, journal = opened(tmp_path / "a")
        assert (log.keyframes, log.scan_count) == (first, first)
        log.write(growth(first, first + 1, moved=0.1 * first))
        journal.close()
    assert_same(read(tmp_path / "a").session, session(moved=0.5))


def test_scans_with_different_numbers_of_beams_are_of_one_session(tmp_path):
    now = session(beams=3)
    wide = dataclasses.replace(
        growth(1, 2),
        **{
            name: np.pad(getattr(growth(1, 2), name), [(0, 0), (0, 4), (0, 0)][: 3 if name != "kinds" else 2])
            for name in ("points", "normals", "kinds")
        },
    )
    narrow = dataclasses.replace(
        growth(0, 1), **{name: getattr(now, name)[:1] for name in ("points", "normals", "kinds")}
    )
    write(tmp_path / "a", narrow, wide)
    found = read(tmp_path / "a").session
    assert found.kinds.tolist() == [[1, 1, 1] + [0] * 6, [1] * 5 + [0] * 4]


def test_scans_in_a_map_that_is_there_already_come_back_with_it(tmp_path):
    log, journal = opened(tmp_path / "a")
    log.begin(session())
    log.write(dataclasses.replace(growth(6, 6, graph=False), scans=scans(4, 6)))
    journal.close()
    found = read(tmp_path / "a")
    assert_same(found.session, session())
    assert found.scans.owners.tolist() == [4, 5]


def test_a_cleared_journal_begins_anew(tmp_path):
    write(tmp_path / "a", growth(0, 6))
    log, journal = opened(tmp_path / "a")
    log.clear()
    assert log.session is None and not len(log.scans) and log.last is None
    log.write(growth(0, 2))
    journal.close()
    assert_same(read(tmp_path / "a").session, session(2))


@given(length=st.integers(min_value=0))
@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_after_any_cut_there_is_a_sound_session_of_what_was_before(tmp_path, length):
    path = tmp_path / "a"
    ends = write(path, growth(0, 2), growth(2, 4, moved=0.1), growth(4, 6, moved=0.2))
    length %= ends[-1] + 1
    path.write_bytes(path.read_bytes()[:length])
    found = read(path)
    complete = 2 * max(sum(end <= length for end in ends) - 1, 0)
    count = 0 if found.session is None else len(found.session)
    assert complete <= count <= complete + 2
    assert complete <= len(found.scans) <= count


def test_behind_a_damaged_record_nothing_is_taken_but_a_copy_is_kept(tmp_path):
    path = tmp_path / "a"
    ends = write(path, growth(0, 2), growth(2, 4), growth(4, 6))
    content = bytearray(path.read_bytes())
    content[ends[1] + 30] ^= 1
    path.write_bytes(content)
    found = read(path)
    assert_same(found.session, session(2))
    assert found.left_out > 1
    assert (tmp_path / "a.damaged").read_bytes() == content
    assert read(path).left_out == 0


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        (module._KEYFRAMES, {"first": [3]}),
        (module._KEYFRAMES, {"first": [-1]}),
        (module._POSES, {"first": [6], "poses": np.zeros((1, 3))}),
        (module._POSES, {"first": [-1], "poses": np.zeros((1, 3))}),
        (module._SCANS, {"stamps": [1.0], "owners": [6], "offsets": np.zeros((1, 3))}),
        (module._SCANS, {"stamps": [1.0], "owners": [-2], "offsets": np.zeros((1, 3))}),
        (module._SCANS, {"stamps": [np.nan], "owners": [0], "offsets": np.zeros((1, 3))}),
        (module._SCANS, {"stamps": [1.0], "owners": [0], "offsets": np.full((1, 3), 1e9)}),
        (module._LAST, {"stamp": [np.nan], "pose": np.zeros(3), "odometry": np.zeros(3)}),
        (module._LAST, {"stamp": [1.0], "pose": np.full(3, np.nan), "odometry": np.zeros(3)}),
        (module._LAST, {"stamp": [1.0], "pose": np.zeros(3), "odometry": np.full(3, np.inf)}),
    ],
)
def test_a_record_that_does_not_fit_those_before_is_left_out(tmp_path, kind, change):
    path = tmp_path / "a"
    write(path, growth(0, 6))
    values = {name: getattr(session(), name) for name in module._OF_KEYFRAMES} if kind == module._KEYFRAMES else {}
    journal = Journal(path)
    journal.append(
        pack(kind, module._LAYOUTS[kind], {name: np.array(array) for name, array in (values | change).items()})
    )
    journal.close()
    found = read(path)
    assert found.left_out == 1
    assert_same(found.session, session())


def test_sound_records_that_are_no_session_are_refused(tmp_path):
    write(tmp_path / "a", dataclasses.replace(growth(0, 6), increments=np.zeros(6)))
    with pytest.raises(InputError, match="increments of a session"):
        read(tmp_path / "a")


def test_no_memory_is_taken_for_one_keyframe_that_is_too_wide(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MOST_BYTES", N * 5 * 17)
    write(tmp_path / "a", growth(0, 5))
    assert len(read(tmp_path / "a").session) == 5
    monkeypatch.setattr(module, "MOST_BYTES", N * 5 * 17 - 1)
    write(tmp_path / "a", growth(0, 5), growth(5, 6))
    found = read(tmp_path / "a")
    assert (len(found.session), found.left_out) == (5, 4)
