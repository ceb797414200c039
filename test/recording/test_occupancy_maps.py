# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from matplotlib.image import imsave

from g2_recon.errors import InputError
from g2_recon.geometry.occupancy_grid import OccupancyGrid
from g2_recon.recording.occupancy_maps import read_map, write_map

ALL_VALUES = np.arange(-1, 101).astype(np.int8).reshape(6, 17)
SETTINGS = {
    "image": "map.pgm",
    "mode": "trinary",
    "resolution": "0.05",
    "origin": ["-1.5", "2.25", "0.5"],
    "negate": "0",
    "occupied_thresh": "0.65",
    "free_thresh": "0.196",
}


def grid_of(cells) -> OccupancyGrid:
    return OccupancyGrid(0.05, np.array([-1.5, 2.25, 0.5]), np.asarray(cells, np.int8))


def save(folder: Path, image: bytes, **changes) -> Path:
    """A map of that image with these settings changed; None leaves one out."""
    values = {name: value for name, value in (SETTINGS | changes).items() if value is not None}
    (folder / values.get("image", "map.pgm")).write_bytes(image)
    (folder / "map.yaml").write_text(yaml.safe_dump(values))
    return folder / "map.yaml"


def png(pixels, kind: int, *, more: bytes = b"") -> bytes:
    """A PNG of pixels (H, W, C) uint8 and of a color type, with more chunks before the pixels."""

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    pixels = np.asarray(pixels, np.uint8)
    rows = b"".join(b"\0" + row.tobytes() for row in pixels)
    head = struct.pack(">IIBBBBB", pixels.shape[1], pixels.shape[0], 8, kind, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + more + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    )


def test_a_map_that_was_decided_comes_back_as_it_was(tmp_path: Path) -> None:
    written = grid_of([[-1, 0, 100], [100, -1, 0]])
    write_map(tmp_path / "new" / "floor.yaml", written)
    read = read_map(tmp_path / "new" / "floor.yaml")
    np.testing.assert_array_equal(read.cells, written.cells)
    assert read.origin.tolist() == written.origin.tolist()
    assert read.resolution == written.resolution
    assert sorted(file.name for file in (tmp_path / "new").iterdir()) == ["floor.pgm", "floor.yaml"]


def test_every_value_comes_back_decided_by_the_thresholds(tmp_path: Path) -> None:
    write_map(tmp_path / "floor.yaml", grid_of(ALL_VALUES))
    expected = np.select([ALL_VALUES < 0, ALL_VALUES <= 20, ALL_VALUES >= 65], [-1, 0, 100], -1)
    np.testing.assert_array_equal(read_map(tmp_path / "floor.yaml").cells, expected)


def test_every_value_comes_back_from_a_raw_map(tmp_path: Path) -> None:
    write_map(tmp_path / "floor.yaml", grid_of(ALL_VALUES), mode="raw")
    np.testing.assert_array_equal(read_map(tmp_path / "floor.yaml").cells, ALL_VALUES)


def test_the_files_are_those_of_the_map_saver(tmp_path: Path) -> None:
    write_map(tmp_path / "floor.yaml", grid_of([[0, 100], [-1, 0], [100, 100]]))
    header, pixels = (tmp_path / "floor.pgm").read_bytes().split(b"\n255\n")
    assert header.split(b"\n")[0] == b"P5" and header.split(b"\n")[-1] == b"2 3"
    # The first row of the image is the last of the grid, where y is largest.
    assert list(pixels) == [0, 0, 205, 254, 254, 0]
    assert yaml.safe_load((tmp_path / "floor.yaml").read_text()) == {
        "image": "floor.pgm",
        "mode": "trinary",
        "resolution": 0.05,
        "origin": [-1.5, 2.25, 0.5],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }


def test_the_upper_row_of_the_image_has_the_largest_y(tmp_path: Path) -> None:
    path = save(tmp_path, b"P5 1 2 255\n" + bytes([0, 254]), origin=["0", "0", "0"])
    assert read_map(path).at([[0.025, 0.075], [0.025, 0.025]]).tolist() == [100, 0]


@pytest.mark.parametrize("name", ["floor", "floor.pgm", "floor.png"])
def test_a_name_that_is_not_of_a_yaml_file_is_told(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="yaml"):
        write_map(tmp_path / name, grid_of(ALL_VALUES))
    with pytest.raises(InputError, match="yaml"):
        read_map(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_map_without_cells_or_of_a_mode_that_pgm_has_not_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no cells"):
        write_map(tmp_path / "floor.yaml", grid_of(np.empty((0, 4))))
    with pytest.raises(InputError, match="scale"):
        write_map(tmp_path / "floor.yaml", grid_of(ALL_VALUES), mode="scale")
    assert list(tmp_path.iterdir()) == []


def test_an_older_map_stays_whole_where_the_new_one_cannot_be_written(tmp_path: Path) -> None:
    write_map(tmp_path / "floor.yaml", grid_of([[0, 100]]))
    before = (tmp_path / "floor.yaml").read_bytes()
    (tmp_path / "floor.pgm").unlink()
    (tmp_path / "floor.pgm").mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        write_map(tmp_path / "floor.yaml", OccupancyGrid(0.1, np.zeros(3), np.zeros((5, 5), np.int8)))
    assert (tmp_path / "floor.yaml").read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 2


PIXELS = [0, 50, 89, 90, 150, 205, 206, 254, 255]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, [100, 100, 100, -1, -1, -1, 0, 0, 0]),
        ({"mode": None}, [100, 100, 100, -1, -1, -1, 0, 0, 0]),
        ({"negate": "true"}, [0, -1, -1, -1, -1, 100, 100, 100, 100]),
        # (255 - 90) / 255 is 0.647 occupied: (0.647 - 0.196) / (0.65 - 0.196) of the way.
        ({"mode": "scale"}, [100, 100, 100, 99, 48, 0, 0, 0, 0]),
        ({"mode": "scale", "negate": "1"}, [0, 0, 34, 35, 86, 100, 100, 100, 100]),
        ({"mode": "raw"}, [0, 50, 89, 90, -1, -1, -1, -1, -1]),
        ({"mode": "raw", "negate": "1"}, [0, 50, 89, 90, -1, -1, -1, -1, -1]),
        ({"free_thresh": "0.25"}, [100, 100, 100, -1, -1, 0, 0, 0, 0]),
    ],
)
def test_pixels_mean_what_they_mean_to_nav2(tmp_path: Path, changes: dict, expected: list[int]) -> None:
    images = {
        "P5": b"P5 9 1 255\n" + bytes(PIXELS),
        "P2": b"P2 9 1 255 " + " ".join(map(str, PIXELS)).encode(),
        "16 bits": b"P5 9 1 65535 " + (257 * np.array(PIXELS)).astype(">u2").tobytes(),
        "gray PNG": png(np.reshape(PIXELS, (1, 9, 1)), 0),
        "color PNG": png(np.repeat(np.reshape(PIXELS, (1, 9, 1)), 3, axis=2), 2),
        "palette PNG": png(np.arange(9).reshape(1, 9, 1), 3, more=palette(PIXELS)),
    }
    for kind, image in images.items():
        assert read_map(save(tmp_path, image, **changes)).cells.tolist() == [expected], kind


def palette(grays: list[int]) -> bytes:
    body = b"PLTE" + bytes(gray for gray in grays for _ in range(3))
    return struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))


def test_transparent_pixels_are_unknown_in_mode_scale_and_averaged_in_mode_trinary(tmp_path: Path) -> None:
    image = png([[[0, 0, 0, 255], [0, 0, 0, 0], [255, 255, 255, 255]]], 6)
    assert read_map(save(tmp_path, image, mode="scale")).cells.tolist() == [[100, -1, 0]]
    # Opaque counts as white, as in Nav2: black is then 0.75 occupied.
    assert read_map(save(tmp_path, image)).cells.tolist() == [[100, 100, 0]]


def test_an_image_that_matplotlib_wrote_is_read(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    imsave(buffer, np.array([[0.0, 1.0]]), cmap="gray", vmin=0, vmax=1, format="png")
    assert read_map(save(tmp_path, buffer.getvalue())).cells.tolist() == [[100, 0]]


def test_comments_and_line_ends_in_an_image_are_skipped(tmp_path: Path) -> None:
    header = b"P%d # GIMP\r\n# 9 9\n 2\n#\n1 # w h\n255\n"
    assert read_map(save(tmp_path, header % 5 + bytes([0, 254]))).cells.tolist() == [[100, 0]]
    assert read_map(save(tmp_path, header % 2 + b"0 # 7 7\n\n254 #")).cells.tolist() == [[100, 0]]


def test_pixels_are_relative_to_the_greatest(tmp_path: Path) -> None:
    assert read_map(save(tmp_path, b"P2 3 1 10 0 10 6")).cells.tolist() == [[100, 0, -1]]


def test_the_image_may_be_anywhere(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images/a map.pgm").write_bytes(b"P5 1 1 255\n\0")
    for name in ("images/a map.pgm", str(tmp_path / "images/a map.pgm")):
        (tmp_path / "map.yml").write_text(yaml.safe_dump(SETTINGS | {"image": name}))
        assert read_map(tmp_path / "map.yml").cells.tolist() == [[100]]


def test_a_threshold_that_makes_unknown_cells_free_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    image = b"P5 2 1 255\n" + bytes([205, 254])
    read_map(save(tmp_path, image))
    assert not caplog.records
    assert read_map(save(tmp_path, image, free_thresh="0.25")).cells.tolist() == [[0, 0]]
    assert "free_thresh" in caplog.text


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"resolution": None}, "resolution"),
        ({"resolution": "0"}, "resolution"),
        ({"resolution": "-0.05"}, "resolution"),
        ({"resolution": ".nan"}, "resolution"),
        ({"resolution": ["1"]}, "resolution"),
        ({"origin": None}, "origin"),
        ({"origin": ["0", "0"]}, "origin"),
        ({"origin": ["0", "0", "1e999"]}, "origin"),
        ({"origin": "0"}, "origin"),
        ({"negate": None}, "negate"),
        ({"negate": "2"}, "negate"),
        ({"mode": "color"}, "mode"),
        ({"mode": ["raw"]}, "mode"),
        ({"occupied_thresh": "0.1"}, "thresh"),
        ({"free_thresh": "-0.1"}, "thresh"),
        ({"occupied_thresh": "1.5"}, "thresh"),
    ],
)
def test_settings_that_make_no_sense_are_told(tmp_path: Path, changes: dict, what: str) -> None:
    with pytest.raises(InputError, match=what):
        read_map(save(tmp_path, b"P5 1 1 255\n\0", **changes))


@pytest.mark.parametrize("image", ["", "missing.pgm", "/dev/zero", ".", "a\0b", "x" * 5000])
def test_an_image_that_is_no_file_is_told(tmp_path: Path, image: str) -> None:
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(SETTINGS | {"image": image}))
    with pytest.raises(InputError):
        read_map(tmp_path / "map.yaml")


@pytest.mark.parametrize(
    "image",
    [
        b"",
        b"P6 1 1 255\n\0\0\0",
        b"P5 1 1\n",
        b"P5 0 1 255\n",
        b"P5 2 2 255\n\0\0\0",
        b"P5 999999999 999999999 255\n",
        b"P2 30000 13000 255 0 0",
        b"P5 1 1 0\n\0",
        b"P5 1 1 65536\n\0\0",
        b"P5 1 1 7\n\x08",
        b"P2 1 1 7 8",
        b"P2 1 1 7 -1",
        b"P2 2 1 255 0",
        b"P2 1 1 255 nan",
        b"P2 1 1 255 zero",
        b"P5 " + b"# comment\n" * 1000,
        b"\x89PNG\r\n\x1a\n",
        png(np.zeros((2, 2, 1)), 0)[:44],
        png(np.zeros((2, 2, 1)), 0).replace(struct.pack(">II", 2, 2), struct.pack(">II", 1 << 30, 1 << 30)),
    ],
)
def test_an_image_that_is_damaged_is_told(tmp_path: Path, image: bytes) -> None:
    with pytest.raises(InputError) as error:
        read_map(save(tmp_path, image))
    assert "map.pgm" in str(error.value)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"- 1",
        b"\xff\xfe\x00",
        b"[" * 1500,
        b"a: &a [*a]",
        b"? {a: 1}\n: 2",
        b"a: " + b"x" * 100_000,
        b"a: &a {b: 1}\n" + b"".join(b"k%d: &k%d {<<: [*a, *a]}\n" % (i, i) for i in range(50)),
    ],
)
def test_yaml_that_is_no_map_is_told(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "map.yaml").write_bytes(content)
    with pytest.raises(InputError):
        read_map(tmp_path / "map.yaml")


any_header = st.tuples(
    st.sampled_from([b"P2", b"P5"]), *[st.sampled_from([b" 1", b"\n2", b" 255", b" 0", b"#\n300"])] * 3
)
any_image = st.one_of(
    st.binary(max_size=100),
    st.tuples(any_header.map(b"".join), st.binary(max_size=20)).map(b"".join),
    st.tuples(any_header.map(b"".join), st.text("0123456789 #.-e\n", max_size=40).map(str.encode)).map(b" ".join),
    st.tuples(st.integers(8, 60), st.binary(min_size=1, max_size=8)).map(lambda at: damaged(*at)),
)


def damaged(at: int, by: bytes) -> bytes:
    image = png(np.zeros((3, 3, 1)), 0)
    return image[:at] + by + image[at + len(by) :]


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(any_image, st.sampled_from(["trinary", "scale", "raw"]))
def test_any_image_gives_a_map_or_one_clear_line(tmp_path: Path, image: bytes, mode: str) -> None:
    try:
        read = read_map(save(tmp_path, image, mode=mode))
        assert read.cells.min() >= -1 and read.cells.max() <= 100
    except InputError as error:
        assert "\n" not in str(error)


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.one_of(
        st.binary(max_size=200),
        st.dictionaries(
            st.sampled_from(sorted(SETTINGS)),
            st.one_of(
                st.floats(), st.integers(), st.text(max_size=5), st.booleans(), st.lists(st.floats(), max_size=4)
            ),
        ).map(lambda changes: yaml.safe_dump(SETTINGS | changes).encode()),
    )
)
def test_any_settings_give_a_map_or_one_clear_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "map.pgm").write_bytes(b"P5 1 1 255\n\0")
    (tmp_path / "map.yaml").write_bytes(content)
    try:
        assert read_map(tmp_path / "map.yaml").cells.shape == (1, 1)
    except InputError as error:
        assert "\n" not in str(error)
