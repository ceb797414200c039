# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import errno
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from g2_recon.errors import JournalError
from g2_recon.recording import journal as module
from g2_recon.recording.journal import Journal

ROOT = Path(__file__).parents[2]
PAYLOADS = [b"", b"one", bytes(300), b"g2recon journal 1\n" * 3, b"last"]
within_a_test = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def write(path, payloads=PAYLOADS) -> list[int]:
    """Where the records of a new journal end."""
    path.unlink(missing_ok=True)
    journal = Journal(path)
    ends = [path.stat().st_size]
    for payload in payloads:
        journal.append(payload)
        ends.append(path.stat().st_size)
    journal.close()
    return ends


def read(path) -> list[bytes]:
    journal = Journal(path)
    found = list(journal.records())
    journal.close()
    return found


def test_records_come_back_in_their_order(tmp_path):
    write(tmp_path / "new/folder/a.journal")
    assert read(tmp_path / "new/folder/a.journal") == PAYLOADS


@given(payloads=st.lists(st.binary(max_size=50)), more=st.lists(st.binary(max_size=50)))
@within_a_test
def test_a_journal_is_gone_on_with(tmp_path, payloads, more):
    write(tmp_path / "a", payloads)
    journal = Journal(tmp_path / "a")
    for payload in more:
        journal.append(payload)
    assert list(journal.records()) == payloads + more
    journal.close()
    assert read(tmp_path / "a") == payloads + more


@given(length=st.integers(min_value=0))
@within_a_test
def test_after_any_cut_all_records_before_it_come_back_and_writing_goes_on(tmp_path, length):
    path = tmp_path / "a"
    ends = write(path)
    length %= ends[-1] + 1
    os.truncate(path, length)
    whole = PAYLOADS[: max(sum(end <= length for end in ends) - 1, 0)]
    journal = Journal(path)
    assert list(journal.records()) == whole
    journal.append(b"new")
    journal.close()
    assert read(path) == [*whole, b"new"]
    assert not path.with_name("a.damaged").exists()


@given(position=st.integers(min_value=0), change=st.integers(min_value=1, max_value=255))
@within_a_test
def test_after_any_changed_byte_all_records_before_it_come_back_and_none_that_was_not_written(
    tmp_path, position, change
):
    path = tmp_path / "a"
    ends = write(path)
    position %= ends[-1]
    content = bytearray(path.read_bytes())
    content[position] ^= change
    path.write_bytes(content)
    if position < ends[0]:
        with pytest.raises(JournalError, match="is no journal"):
            Journal(path)
        assert path.read_bytes() == content
        return
    hit = next(index for index, (begin, end) in enumerate(pairwise(ends)) if begin <= position < end)
    journal = Journal(path)
    found = list(journal.records())
    assert found[:hit] == PAYLOADS[:hit]
    # A damaged payload costs this record, a damaged head those behind it, too.
    assert found[hit:] in (PAYLOADS[hit + 1 :], [])
    assert journal.damaged == 1
    journal.append(b"new")
    journal.close()
    assert read(path) == [*found, b"new"]


@given(content=st.binary(max_size=100))
@within_a_test
def test_whatever_lies_behind_records_is_no_record(tmp_path, content):
    path = tmp_path / "a"
    write(path)
    with path.open("ab") as file:
        file.write(content)
    assert read(path) == PAYLOADS


def test_what_lies_behind_damage_is_kept_beside(tmp_path):
    path = tmp_path / "a"
    ends = write(path)
    content = bytearray(path.read_bytes())
    content[ends[1]] ^= 1
    path.write_bytes(content)
    assert read(path) == PAYLOADS[:1]
    assert (tmp_path / "a.damaged").read_bytes() == content[ends[1] :]


def test_a_length_that_no_record_has_is_damage(tmp_path):
    path = tmp_path / "a"
    write(path)
    numbers = module._NUMBERS.pack(module.MOST_BYTES + 1, 0)
    with path.open("ab") as file:
        file.write(numbers + module._CHECK.pack(module.crc32(numbers)))
    assert read(path) == PAYLOADS
    assert (tmp_path / "a.damaged").stat().st_size == 12


def test_a_file_of_somebody_else_is_left_alone(tmp_path):
    (tmp_path / "a").write_text("my only copy")
    with pytest.raises(JournalError, match="is no journal"):
        Journal(tmp_path / "a")
    assert (tmp_path / "a").read_text() == "my only copy"


@pytest.mark.parametrize("kind", ["folder", "link", "pipe", "under a file"])
def test_what_is_no_file_is_refused(tmp_path, kind):
    path = tmp_path / "a"
    if kind == "folder":
        path.mkdir()
    elif kind == "link":
        path.symlink_to(tmp_path / "b")
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.write_text("")
        path = path / "a"
    with pytest.raises(JournalError, match=r"cannot be written|is no file"):
        Journal(path)
    assert not (tmp_path / "b").exists()


def test_only_one_process_has_a_journal_open(tmp_path):
    journal = Journal(tmp_path / "a")
    with pytest.raises(JournalError, match="in use by another process; give each robot a folder of its own"):
        Journal(tmp_path / "a")
    journal.close()
    Journal(tmp_path / "a").close()


def test_a_cleared_journal_is_empty_and_can_be_gone_on_with_and_what_was_in_it_is_kept(tmp_path):
    write(tmp_path / "a")
    journal = Journal(tmp_path / "a")
    journal.clear()
    journal.append(b"new")
    journal.sync()
    journal.close()
    assert read(tmp_path / "a") == [b"new"]
    assert read(tmp_path / "a.before") == PAYLOADS


def test_it_is_brought_to_the_disk_in_another_thread_whatever_becomes_of_it_meanwhile(tmp_path):
    journal = Journal(tmp_path / "a")
    with ThreadPoolExecutor(1) as disk:
        syncs = [disk.submit(journal.sync) for _ in range(200)]
        for number in range(20):
            journal.append(b"some")
            journal.clear()
            journal.rewrite([bytes([number])])
        journal.close()
    assert [sync.exception() for sync in syncs] == [None] * 200


def test_all_records_are_rewritten_at_once(tmp_path):
    write(tmp_path / "a")
    journal = Journal(tmp_path / "a")
    journal.rewrite([b"few"])
    journal.append(b"more")
    assert list(journal.records()) == [b"few", b"more"]
    with pytest.raises(JournalError, match="in use by another process"):
        Journal(tmp_path / "a")
    journal.close()
    assert read(tmp_path / "a") == [b"few", b"more"]
    assert [file.name for file in tmp_path.iterdir()] == ["a"]


def test_a_rewriting_that_fails_changes_nothing(tmp_path):
    write(tmp_path / "a")
    journal = Journal(tmp_path / "a")

    def fail():
        yield b"few"
        raise JournalError("no more")

    with pytest.raises(JournalError, match="no more"):
        journal.rewrite(fail())
    assert list(journal.records()) == PAYLOADS
    assert [file.name for file in tmp_path.iterdir()] == ["a"]


def test_on_a_full_disk_the_error_says_so_and_all_before_is_there(tmp_path):
    """The limit on the size of a file tears a record as a full disk does."""
    path = tmp_path / "a"
    code = f"""
import resource
from g2_recon.errors import JournalError
from g2_recon.recording.journal import Journal
journal = Journal({str(path)!r})
journal.append(b"whole")
resource.setrlimit(resource.RLIMIT_FSIZE, (journal._end + 40, resource.RLIM_INFINITY))
try:
    journal.append(bytes(100))
except JournalError as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert (
        done.stdout == f"{path}: cannot be written: {os.strerror(errno.EFBIG)}; choose another folder or make room\n"
    ), done
    assert read(path) == [b"whole"]


def test_a_writer_that_is_killed_loses_at_most_the_record_that_it_was_writing(tmp_path):
    path = tmp_path / "a"
    code = f"""
from g2_recon.recording.journal import Journal
journal = Journal({str(path)!r})
for number in range(1_000_000):
    journal.append(number.to_bytes(4, "little") * (1 + number % 500))
    print(number, flush=True)
"""
    writer = subprocess.Popen(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, text=True
    )
    assert writer.stdout is not None
    said = -1
    for line in writer.stdout:
        said = int(line)
        if said == 500:
            writer.kill()
    writer.wait()
    found = read(path)
    assert said + 1 <= len(found) <= said + 2
    assert found == [number.to_bytes(4, "little") * (1 + number % 500) for number in range(len(found))]


def copied(journal, left_out, meanwhile=()):
    """The journal after a copy without these records took its place, and others were appended meanwhile."""
    copy = journal.copy_without({span.begin for payload, span in journal.located() if payload in left_out})
    for payload in meanwhile:
        journal.append(payload)
    copy.write()
    return journal.adopt(copy)


def test_a_copy_without_some_records_takes_the_place_of_the_journal_with_what_was_appended_meanwhile(tmp_path):
    write(tmp_path / "a")
    journal = Journal(tmp_path / "a")
    before = dict(journal.located())
    places = copied(journal, {b"one", b"last"}, [b"meanwhile"])
    kept = [payload for payload in PAYLOADS if payload not in (b"one", b"last")]
    assert list(journal.records()) == [*kept, b"meanwhile"]
    now = dict(journal.located())
    assert {payload: places[before[payload].begin] for payload in kept} == {payload: now[payload] for payload in kept}
    journal.append(b"later")
    with pytest.raises(JournalError, match="in use by another process"):
        Journal(tmp_path / "a")
    journal.close()
    assert read(tmp_path / "a") == [*kept, b"meanwhile", b"later"]
    assert [file.name for file in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("taken", [False, True])
def test_a_writer_that_is_killed_at_any_byte_of_a_copy_loses_nothing(tmp_path, taken):
    """Until the copy takes the place of the journal it lies beside, cut anywhere; from then on it is the journal."""
    path = tmp_path / "a"
    write(path)
    journal = Journal(path)
    copy = journal.copy_without({span.begin for payload, span in journal.located() if payload == b"one"})
    copy.write()
    beside = next(file for file in tmp_path.iterdir() if file.name != "a")
    content = beside.read_bytes()
    if taken:
        journal.adopt(copy)
    else:
        # As the end of the process does.
        copy.discard()
    kept = [payload for payload in PAYLOADS if payload != b"one"]
    journal.close()
    for length in range(len(content) + 1):
        if not taken:
            beside.write_bytes(content[:length])
        assert read(path) == (kept if taken else PAYLOADS)
        assert [file.name for file in tmp_path.iterdir()] == ["a"]


def test_a_copy_that_is_given_up_leaves_nothing(tmp_path):
    write(tmp_path / "a")
    journal = Journal(tmp_path / "a")
    copy = journal.copy_without(())
    copy.write()
    copy.discard()
    with pytest.raises(JournalError, match="the copy was not written"):
        journal.adopt(copy)
    journal.append(b"new")
    assert list(journal.records()) == [*PAYLOADS, b"new"]
    assert [file.name for file in tmp_path.iterdir()] == ["a"]
