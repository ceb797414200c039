# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from g2_recon.errors import InputError
from g2_recon.geometry.mesh import Mesh, TrueSurface
from g2_recon.recording.meshes import MESH_ENDINGS, write_mesh
from g2_recon.recording.surfaces import read_true_surface, write_true_surface

VERTICES = np.array([[0.1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3]])
SOUND = {"truth_vertices": VERTICES, "truth_faces": FACES, "clean": VERTICES}


def test_the_truth_comes_back(tmp_path: Path) -> None:
    write_true_surface(tmp_path / "t.npz", TrueSurface(VERTICES, FACES, VERTICES))
    surface = read_true_surface(tmp_path / "t.npz")
    np.testing.assert_array_equal(surface.vertices, VERTICES)
    np.testing.assert_array_equal(surface.faces, FACES)
    # float32 of a metre
    np.testing.assert_allclose(surface.seen, VERTICES, atol=1e-7)


def test_a_truth_may_say_nothing_of_what_was_seen(tmp_path: Path) -> None:
    write_true_surface(tmp_path / "t.npz", TrueSurface(VERTICES, FACES))
    assert read_true_surface(tmp_path / "t.npz").seen is None


def test_other_types_of_numbers_are_read(tmp_path: Path) -> None:
    np.savez(tmp_path / "t.npz", truth_vertices=VERTICES.astype(">f4"), truth_faces=FACES.astype(np.uint8))
    surface = read_true_surface(tmp_path / "t.npz")
    assert (surface.vertices.dtype, surface.faces.dtype) == (np.float64, np.int64)
    np.testing.assert_array_equal(surface.faces, FACES)


@pytest.mark.parametrize("ending", MESH_ENDINGS)
def test_a_mesh_is_a_truth_of_which_all_was_seen(tmp_path: Path, ending: str) -> None:
    write_mesh(tmp_path / f"m{ending}", Mesh(VERTICES, FACES, np.zeros(2, int)))
    surface = read_true_surface(tmp_path / f"m{ending}")
    assert len(surface.faces) == 2
    assert surface.seen is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"truth_vertices": None}, "no array 'truth_vertices'; expected truth_vertices, truth_faces, optional clean"),
        ({"truth_faces": None}, "no array 'truth_faces'"),
        ({"truth_vertices": VERTICES[:, :2]}, r"truth_vertices\.npy is .*not real numbers \(N, 3\)"),
        ({"truth_vertices": VERTICES.ravel()}, r"not real numbers \(N, 3\)"),
        ({"truth_vertices": VERTICES + 1j}, r"not real numbers \(N, 3\)"),
        ({"truth_vertices": VERTICES.astype(object)}, "not real numbers"),
        ({"truth_vertices": VERTICES * np.nan}, "not finite"),
        ({"truth_vertices": VERTICES * 1e12}, r"above 1e\+09 m"),
        ({"truth_vertices": VERTICES[:0]}, "a vertex that is not there"),
        ({"truth_faces": FACES.astype(float)}, "no whole numbers"),
        ({"truth_faces": FACES + 1}, "a vertex that is not there"),
        ({"truth_faces": FACES - 1}, "a vertex that is not there"),
        ({"truth_faces": np.full((1, 3), 2**64 - 1, np.uint64)}, "a vertex that is not there"),
        ({"truth_faces": FACES[:0]}, "holds no triangle"),
        ({"truth_faces": np.zeros((1, 4), int)}, "not real numbers"),
        ({"clean": np.full((2, 3), np.inf)}, "clean is empty, not finite"),
        ({"clean": VERTICES * 1e300}, "clean is empty, not finite"),
        ({"clean": VERTICES[:0]}, "clean is empty, not finite"),
        ({"clean": np.array(["a"])}, "not real numbers"),
    ],
)
def test_a_truth_that_is_none_is_told(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    arrays = {name: array for name, array in (SOUND | change).items() if array is not None}
    np.savez(tmp_path / "t.npz", **arrays)
    with pytest.raises(InputError, match=rf"t\.npz: .*{said}") as raised:
        read_true_surface(tmp_path / "t.npz")
    assert "\n" not in str(raised.value)


def test_a_damaged_file_is_read_or_told(tmp_path: Path) -> None:
    file = tmp_path / "t.npz"
    np.savez_compressed(file, **SOUND)
    content = file.read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(150):
        damaged = bytearray(content[: rng.integers(1, len(content) + 1)] if rng.random() < 0.3 else content)
        damaged[rng.integers(len(damaged))] = rng.integers(256)
        file.write_bytes(damaged)
        try:
            surface = read_true_surface(file)
        except InputError as error:
            assert "\n" not in str(error)
        else:
            assert surface.faces.max() < len(surface.vertices)


def test_a_member_that_claims_more_than_it_has_is_told_before_memory_is_taken(tmp_path: Path) -> None:
    np.savez(tmp_path / "t.npz", **SOUND)
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 3), }".ljust(117) + b"\n"
    with zipfile.ZipFile(tmp_path / "t.npz", "w") as archive:
        archive.writestr("truth_vertices.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
        archive.writestr("truth_faces.npy", b"")
    with pytest.raises(InputError, match=r"states 24000000000000 bytes"):
        read_true_surface(tmp_path / "t.npz")


def test_an_unknown_ending_is_told_with_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.npz, \.ply, \.obj, \.stl, \.glb"):
        read_true_surface(tmp_path / "t.doc")


@pytest.mark.parametrize("name", ["nowhere.npz", "nowhere.ply"])
def test_a_missing_file_is_told(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="nowhere"):
        read_true_surface(tmp_path / name)
