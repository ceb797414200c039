# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
import zipfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from g2_recon.errors import InputError
from g2_recon.geometry.session import Session
from g2_recon.recording import sessions
from g2_recon.recording.sessions import read_session, write_session

FIELDS = [field.name for field in dataclasses.fields(Session)]


@pytest.fixture
def session():
    rng = np.random.default_rng(0)
    normals = np.zeros((6, 5, 2), np.float32)
    normals[:, :3, 0] = 1
    wheel_steps = rng.normal(size=(6, 3))
    wheel_steps[0] = np.nan
    return Session(
        stamps=100.0 + np.arange(6.0),
        poses=rng.normal(size=(6, 3)),
        points=rng.normal(size=(6, 5, 2)).astype(np.float32),
        normals=normals,
        kinds=np.tile(np.array([2, 2, 4, 1, 0], np.uint8), (6, 1)),
        firsts=np.full(6, -1.5),
        increments=np.full(6, 0.01),
        ways=np.arange(6.0),
        wheel_steps=wheel_steps,
        broken=np.array([False, False, True, False, False, False]),
        local_maps=np.array([0, 2, 4]),
        loops=np.array([[0, 2]]),
        loop_information=np.eye(3)[None] * 400,
    )


@pytest.fixture
def saved(session, tmp_path):
    write_session(tmp_path / "session.npz", session)
    return tmp_path / "session.npz"


def arrays_of(session):
    return {name: getattr(session, name) for name in FIELDS} | {"session_version": np.array([sessions.VERSION])}


def test_a_session_comes_back_to_the_last_bit(session, saved):
    found = read_session(saved)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(found, name), getattr(session, name), err_msg=name)
        assert getattr(found, name).dtype == getattr(session, name).dtype
        assert getattr(found, name).flags.writeable


def test_the_same_session_gives_the_same_bytes(session, saved, tmp_path):
    write_session(tmp_path / "again.npz", read_session(saved))
    assert (tmp_path / "again.npz").read_bytes() == saved.read_bytes()


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("poses", lambda a: a * np.nan, "poses of a session are not finite"),
        ("poses", lambda a: a + 1e6, "poses of a session are not finite or above"),
        ("points", lambda a: a + np.float32(np.inf), "points of a session"),
        ("normals", lambda a: a * 2, "normals of a session"),
        ("kinds", lambda a: a + 1, "kinds of a session are 0, 1, 2 or 4"),
        ("increments", lambda a: a * 0, "increments of a session"),
        ("increments", lambda a: -a, "increments of a session"),
        ("firsts", lambda a: a + 1e9, "firsts of a session"),
        ("stamps", lambda a: a * np.inf, "stamps of a session"),
        ("ways", lambda a: a[::-1].copy(), "ways of a session do not grow"),
        ("wheel_steps", lambda a: a + np.inf, "wheel_steps of a session"),
        ("local_maps", lambda a: a + 1, "local_maps of a session"),
        ("local_maps", lambda a: a * 3, "a local map of a session has no keyframe"),
        ("local_maps", lambda a: a[:0], "local_maps of a session"),
        ("loops", lambda a: a[:, ::-1].copy(), "loops of a session"),
        ("loops", lambda a: a + 7, "loops of a session"),
        ("loop_information", lambda a: -a, "loop_information of a session is no information"),
        ("loop_information", lambda a: a + np.triu(a + 1, 1), "loop_information of a session is no information"),
        ("poses", lambda a: a[:-1], "not .N, 3. as the other arrays have it"),
        ("points", lambda a: a[:, :-1], "not .N, B, 2. as the other arrays have it"),
        ("poses", lambda a: a.astype(np.float32), "not float64"),
        ("poses", lambda a: a.astype(object), "not float64"),
        ("stamps", lambda a: a[:, None], "not float64 .N,."),
        ("broken", lambda a: a.view(np.uint8), "not bool"),
        ("session_version", lambda a: a + 1, "is a session of version 2, not 1"),
    ],
)
def test_what_cannot_be_used_is_refused_with_file_and_reason(session, tmp_path, name, change, said):
    arrays = arrays_of(session)
    np.savez(tmp_path / "bad.npz", **(arrays | {name: change(arrays[name])}))
    with pytest.raises(InputError, match=rf"bad\.npz: .*{said}"):
        read_session(tmp_path / "bad.npz")


@pytest.mark.parametrize("name", [*FIELDS, "session_version"])
def test_an_array_that_is_missing_is_named(session, tmp_path, name):
    np.savez(tmp_path / "bad.npz", **{key: array for key, array in arrays_of(session).items() if key != name})
    with pytest.raises(InputError, match=f"has no array '{name}'"):
        read_session(tmp_path / "bad.npz")


def test_a_session_without_keyframes_is_refused(session, tmp_path):
    with pytest.raises(InputError, match="a session without keyframes"):
        dataclasses.replace(
            session,
            **{name: getattr(session, name)[:0] for name in FIELDS if name != "local_maps"},
        )


def test_truth_values_are_nothing_else(saved, tmp_path):
    with zipfile.ZipFile(saved) as before, zipfile.ZipFile(tmp_path / "bad.npz", "w") as after:
        for name in before.namelist():
            content = before.read(name)
            after.writestr(name, content[:-1] + b"\x07" if name == "broken.npy" else content)
    with pytest.raises(InputError, match="neither true nor false"):
        read_session(tmp_path / "bad.npz")


def test_what_claims_more_than_a_session_may_have_takes_no_memory(saved, tmp_path, monkeypatch):
    monkeypatch.setattr(sessions, "MOST_BYTES", 600)
    with pytest.raises(InputError, match="more than any session"):
        read_session(saved)
    # Each array is small enough, all together are not; a file of zeros is small.
    monkeypatch.setattr(sessions, "MOST_BYTES", 100_000)
    arrays = {name: np.zeros((200, 30, *shape), kind) for name, kind, shape in (
        ("points", np.float32, (2,)), ("normals", np.float32, (2,)), ("kinds", np.uint8, ()))}  # fmt: skip
    rest = {name: np.zeros(200) for name in ("stamps", "firsts", "increments", "ways")}
    rest |= {name: np.zeros((200, 3)) for name in ("poses", "wheel_steps")}
    np.savez_compressed(tmp_path / "big.npz", session_version=np.array([1]), broken=np.zeros(200, bool),
                        local_maps=np.array([0]), loops=np.zeros((0, 2), int), loop_information=np.zeros((0, 3, 3)),
                        **arrays, **rest)  # fmt: skip
    assert (tmp_path / "big.npz").stat().st_size < 100_000
    with pytest.raises(InputError, match="more than the 100000 bytes that all may have"):
        read_session(tmp_path / "big.npz")


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=st.floats(0, 1), value=st.integers(0, 255), cut=st.booleans())
def test_a_damaged_file_gives_a_session_or_a_reason(saved, tmp_path, place, value, cut):
    content = bytearray(saved.read_bytes())
    at = int(place * (len(content) - 1))
    if cut:
        del content[at:]
    else:
        content[at] = value
    (tmp_path / "bad.npz").write_bytes(bytes(content))
    try:
        assert len(read_session(tmp_path / "bad.npz")) == 6
    except InputError as error:
        assert "bad.npz" in str(error)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(InputError, match=r"none\.npz: cannot be read"):
        read_session(tmp_path / "none.npz")
