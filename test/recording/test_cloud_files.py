# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud
from g2_recon.recording.clouds import read_cloud, write_cloud

DATA = Path(__file__).resolve().parents[2] / ".." / "shared" / "data"
ENDINGS = (".ply", ".pcd", ".xyz", ".csv", ".txt", ".npz")
PRECISION = {".pcd": 1e-6, ".ply": 0.0, ".npz": 0.0}  # m: float32 of some metres; nine decimals otherwise
PCD_HEADER = (
    "# .PCD v0.7\nVERSION 0.7\nFIELDS z rgb x y _\nSIZE 4 4 8 4 1\nTYPE F U F F U\nCOUNT 1 1 1 1 3\n"
    "WIDTH 2\nHEIGHT 2\nVIEWPOINT {viewpoint} 1 0 0 0\nPOINTS 4\nDATA {kind}\n"
)
PCD_ROWS = np.array(
    [(3, 9, 1, 2, (0, 0, 0)), (np.nan, 9, np.nan, np.nan, (0, 0, 0)), (6, 9, 4, 5, (0, 0, 0)), (9, 9, 7, 8, (0, 0, 0))],
    [("z", "<f4"), ("rgb", "<u4"), ("x", "<f8"), ("y", "<f4"), ("_", "u1", 3)],
)
PCD_POINTS = [[1, 2, 3], [np.nan] * 3, [4, 5, 6], [7, 8, 9]]


def _cloud(*, with_sensor: bool = True) -> Cloud:
    rng = np.random.default_rng(0)
    return Cloud(rng.uniform(-5, 5, (50, 3)), rng.uniform(-5, 5, (50, 3)) if with_sensor else None)


def _pcd(kind: str, body: bytes, viewpoint: str = "0 0 0") -> bytes:
    return PCD_HEADER.format(kind=kind, viewpoint=viewpoint).encode() + body


def _lzf_literals(data: bytes) -> bytes:
    """LZF without references: runs of at most 32 bytes."""
    runs = [data[start : start + 32] for start in range(0, len(data), 32)]
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


def _packed_rows() -> bytes:
    columns = b"".join(np.ascontiguousarray(PCD_ROWS[name]).tobytes() for name in PCD_ROWS.dtype.names or ())
    packed = _lzf_literals(columns)
    return np.array([len(packed), len(columns)], "<u4").tobytes() + packed


def _read(tmp_path: Path, name: str, content: bytes | str) -> Cloud:
    (tmp_path / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return read_cloud(tmp_path / name)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("with_sensor", [True, False])
def test_points_come_back(tmp_path: Path, ending: str, with_sensor: bool) -> None:
    written = _cloud(with_sensor=with_sensor)
    write_cloud(tmp_path / f"c{ending}", written)
    np.testing.assert_allclose(
        read_cloud(tmp_path / f"c{ending}").points, written.points, rtol=0, atol=PRECISION.get(ending, 1e-9)
    )


@pytest.mark.parametrize("ending", ENDINGS)
def test_sensor_positions_come_back(tmp_path: Path, ending: str) -> None:
    written = _cloud()
    write_cloud(tmp_path / f"c{ending}", written)
    sensor = read_cloud(tmp_path / f"c{ending}").sensor
    assert sensor is not None and written.sensor is not None
    np.testing.assert_allclose(sensor, written.sensor, rtol=0, atol=PRECISION.get(ending, 1e-9))


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_cloud_without_sensor_positions_comes_back_without(tmp_path: Path, ending: str) -> None:
    write_cloud(tmp_path / f"c{ending}", _cloud(with_sensor=False))
    assert read_cloud(tmp_path / f"c{ending}").sensor is None


@pytest.mark.parametrize("ending", ENDINGS)
def test_points_that_are_nan_are_kept(tmp_path: Path, ending: str) -> None:
    write_cloud(tmp_path / f"c{ending}", Cloud(np.array([[1.0, 2, 3], [np.nan] * 3])))
    assert np.isnan(read_cloud(tmp_path / f"c{ending}").points).all(axis=1).tolist() == [False, True]


@pytest.mark.parametrize("order", ["little", "big"])
def test_binary_ply_with_other_properties_in_any_order(tmp_path: Path, order: str) -> None:
    mark = "<" if order == "little" else ">"
    rows = np.array([(3, 255, 2, 1)], [("z", f"{mark}f4"), ("red", "u1"), ("y", f"{mark}f8"), ("x", f"{mark}i2")])
    header = (
        f"ply\nformat binary_{order}_endian 1.0\nelement vertex 1\n"
        "property float z\nproperty uchar red\nproperty double y\nproperty short x\nend_header\n"
    )
    assert _read(tmp_path, "c.ply", header.encode() + rows.tobytes()).points.tolist() == [[1, 2, 3]]


def test_text_ply_with_elements_around_the_points(tmp_path: Path) -> None:
    header = (
        "ply\nformat ascii 1.0\ncomment made up\nelement camera 1\nproperty float f\n"
        "element vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    assert _read(tmp_path, "c.ply", header + "9\n1 2 3\n4 5 6\n3 0 1 1\n").points.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_text_pcd_with_other_fields_in_any_order(tmp_path: Path) -> None:
    body = "3 9 1 2 0 0 0\nnan 9 nan nan 0 0 0\n6 9 4 5 0 0 0\n9 9 7 8 0 0 0\n"
    np.testing.assert_array_equal(_read(tmp_path, "c.pcd", _pcd("ascii", body.encode())).points, PCD_POINTS)


def test_binary_pcd_organized_and_with_padding(tmp_path: Path) -> None:
    np.testing.assert_array_equal(_read(tmp_path, "c.pcd", _pcd("binary", PCD_ROWS.tobytes())).points, PCD_POINTS)


def test_packed_pcd(tmp_path: Path) -> None:
    np.testing.assert_array_equal(
        _read(tmp_path, "c.pcd", _pcd("binary_compressed", _packed_rows())).points, PCD_POINTS
    )


@pytest.mark.parametrize("viewpoint", [[0, 0, 0], [1, 2, 3]])
def test_the_viewpoint_of_a_pcd_is_the_sensor(tmp_path: Path, viewpoint: list[int]) -> None:
    content = _pcd("binary", PCD_ROWS.tobytes(), " ".join(map(str, viewpoint)))
    sensor = _read(tmp_path, "c.pcd", content).sensor
    assert sensor is not None
    assert sensor.tolist() == [viewpoint] * 4


@pytest.mark.parametrize(
    "content",
    [
        "1 2 3\n4 5 6\n",
        "# made up\n1 2 3 255\n\n4 5 6 255\n",
        "x,y,z\n1,2,3\n4,5,6\n",
        '"Z";"X";"Y"\n3;1;2\n6;4;5\n',
        "//X Y Z Intensity\n1 2 3 9\n4 5 6 9\n",
        "\ufeff1\t2\t3\r\n4\t5\t6\r\n",
        "# y x z\n2 1 3\n5 4 6\n",
    ],
)
def test_text_tables_of_many_kinds(tmp_path: Path, content: str) -> None:
    assert _read(tmp_path, "c.csv", content).points.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_named_sensor_columns_are_taken_in_any_order(tmp_path: Path) -> None:
    sensor = _read(tmp_path, "c.csv", "vx,vy,vz,x,y,z\n7,8,9,1,2,3\n").sensor
    assert sensor is not None
    assert sensor.tolist() == [[7, 8, 9]]


def test_further_columns_without_names_are_no_sensor(tmp_path: Path) -> None:
    assert _read(tmp_path, "c.xyz", "1 2 3 0.1 0.2 0.3\n").sensor is None


def test_float32_and_column_order_arrays_are_read(tmp_path: Path) -> None:
    points = np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3))
    np.savez(tmp_path / "c.npz", points=points)
    assert read_cloud(tmp_path / "c.npz").points.tolist() == points.tolist()


PLY_HEADER = (
    "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\n{}end_header\n"
)


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        ("c.ply", "", "empty"),
        ("c.ply", "nonsense\n", "no end_header"),
        ("c.ply", PLY_HEADER.format(1, "") + 12 * "0", "no x, y and z"),
        ("c.ply", PLY_HEADER.format(999999999999, "property float z\n") + 12 * "0", "states 999999999999 points"),
        ("c.ply", PLY_HEADER.format(2, "property float z\n") + 12 * "0", "only 12 bytes"),
        ("c.ply", PLY_HEADER.format(-2, "property float z\n"), "no count"),
        ("c.ply", PLY_HEADER.format(1, "property list uchar int z\n"), "no vertex element"),
        ("c.ply", "ply\n" + 9999 * "comment long\n" + "end_header\n", "no end_header"),
        (
            "c.ply",
            PLY_HEADER.replace("binary_little_endian", "ascii").format(2, "property float z\n") + "1 2",
            "cannot",
        ),
        ("c.pcd", PCD_HEADER.format(kind="binary", viewpoint="0 0 0"), "states 4 points"),
        ("c.pcd", PCD_HEADER.format(kind="binary", viewpoint="a b c") + 92 * "0", "VIEWPOINT"),
        ("c.pcd", PCD_HEADER.format(kind="secret", viewpoint="0 0 0"), "data of kind"),
        ("c.pcd", PCD_HEADER.format(kind="ascii", viewpoint="0 0 0") + "1 2 3", "cannot be in"),
        ("c.pcd", PCD_HEADER.format(kind="ascii", viewpoint="0 0 0") + "one " * 28, "no number"),
        ("c.pcd", PCD_HEADER.format(kind="binary_compressed", viewpoint="0 0 0") + "0000", "ends before"),
        ("c.pcd", PCD_HEADER.replace("POINTS 4", "POINTS 5").format(kind="ascii", viewpoint="0 0 0"), "WIDTH times"),
        ("c.pcd", PCD_HEADER.replace("SIZE 4", "SIZE 3").format(kind="ascii", viewpoint="0 0 0"), "unknown type"),
        ("c.xyz", "1 2\n3 4\n", "no table"),
        ("c.xyz", "1 2 3\n4 5 six\n", "no table"),
        ("c.csv", "1,2,3\n4,,6\n", "no table"),
        ("c.csv", "latitude,longitude,height\n1,2,3\n", "no columns x, y and z"),
        ("c.xyz", "# nothing\n", "no point"),
        ("c.npz", "nonsense", "no sound NPZ"),
        ("c.doc", "1 2 3\n", "use one of .ply"),
    ],
)
def test_a_malformed_file_is_told(tmp_path: Path, name: str, content: str, what: str) -> None:
    with pytest.raises(InputError, match=what):
        _read(tmp_path, name, content)


def test_an_npz_without_points_is_told(tmp_path: Path) -> None:
    np.savez(tmp_path / "c.npz", other=np.zeros((2, 3)))
    with pytest.raises(InputError, match="no array 'points'"):
        read_cloud(tmp_path / "c.npz")


@pytest.mark.parametrize("points", [np.zeros((2, 4)), np.zeros((2, 3), complex), np.zeros(3)])
def test_an_npz_with_points_of_another_kind_is_told(tmp_path: Path, points: np.ndarray) -> None:
    np.savez(tmp_path / "c.npz", points=points)
    with pytest.raises(InputError, match=r"not real numbers \(N, 3\)"):
        read_cloud(tmp_path / "c.npz")


def test_an_npz_with_python_objects_is_not_unpickled(tmp_path: Path) -> None:
    np.savez(tmp_path / "c.npz", points=np.array([[None, None, None]]))
    with pytest.raises(InputError):
        read_cloud(tmp_path / "c.npz")


def test_an_npz_that_claims_more_than_it_has_is_told_before_memory_is_taken(tmp_path: Path) -> None:
    np.save(tmp_path / "points.npy", np.zeros((100, 3)))
    content = (tmp_path / "points.npy").read_bytes().replace(b"(100, 3), }         ", b"(999999999999, 3), }")
    with zipfile.ZipFile(tmp_path / "c.npz", "w") as archive:
        archive.writestr("points.npy", content)
    with pytest.raises(InputError, match="states 23999999999976 bytes"):
        read_cloud(tmp_path / "c.npz")


def test_an_unknown_ending_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.ply, \.pcd"):
        write_cloud(tmp_path / "c.doc", _cloud())


_SAMPLES = {
    "text.pcd": _pcd("ascii", b"3 9 1 2 0 0 0\n" * 4),
    "binary.pcd": _pcd("binary", PCD_ROWS.tobytes()),
    "packed.pcd": _pcd("binary_compressed", _packed_rows()),
    "binary.ply": (PLY_HEADER.format(2, "property float z\n") + 24 * "0").encode(),
    "text.ply": (
        PLY_HEADER.replace("binary_little_endian", "ascii").format(2, "property float z\n") + "1 2 3\n4 5 6\n"
    ).encode(),
    "table.csv": b"x,y,z,vx,vy,vz\n1,2,3,4,5,6\n",
    "table.xyz": b"# x y z\n1 2 3\n",
}


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    name=st.sampled_from(sorted(_SAMPLES)),
    position=st.integers(0, 400),
    removed=st.integers(0, 30),
    inserted=st.one_of(st.binary(max_size=8), st.sampled_from([b"99999999999", b"-1", b"nan", b"\n", b" "])),
)
def test_any_damage_gives_a_cloud_or_one_clear_line(
    tmp_path: Path, name: str, position: int, removed: int, inserted: bytes
) -> None:
    content = _SAMPLES[name]
    try:
        cloud = _read(tmp_path, name, content[:position] + inserted + content[position + removed :])
    except InputError as error:
        assert "\n" not in str(error)
    else:
        assert cloud.points.shape[1] == 3


@pytest.mark.parametrize(("name", "count"), [("room_scan1.pcd", 112_586), ("room_scan2.pcd", 112_624)])
def test_a_real_packed_sweep_is_read(name: str, count: int) -> None:
    file = DATA / "sweeps" / "pcl_room" / name
    if not file.exists():
        pytest.skip(f"{file} is not here")
    cloud = read_cloud(file)
    near = np.linalg.norm(cloud.points, axis=1) < 0.15
    assert (len(cloud), round(float(near.mean()), 3)) == (count, 0.157)  # share of the robot itself, as published


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("rows", [0, 4])
def test_a_pcd_that_claims_points_larger_than_any_is_told(tmp_path: Path, kind: str, rows: int) -> None:
    header = PCD_HEADER.format(kind=kind, viewpoint="0 0 0").replace("COUNT 1 1 1 1 3", "COUNT 1 1 1 1 86027267201")
    header = header.replace("HEIGHT 2", f"HEIGHT {rows // 2}").replace("POINTS 4", f"POINTS {rows}")
    with pytest.raises(InputError, match="86027267221 bytes each"):
        _read(tmp_path, "c.pcd", header.encode() + PCD_ROWS.tobytes())


def test_a_fault_of_an_npz_file_is_told_in_few_words(tmp_path: Path) -> None:
    np.savez(tmp_path / "c.npz", points=np.zeros(3, [(f"column_{index}", "f8") for index in range(300)]))
    with pytest.raises(InputError) as caught:
        read_cloud(tmp_path / "c.npz")
    assert len(str(caught.value).removeprefix(str(tmp_path))) < 400
