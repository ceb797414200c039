# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Occupancy grids as the map_server of Nav2 reads and writes them: an image and a YAML file that says what it means."""

from __future__ import annotations

import io
import logging
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.occupancy_grid import FREE, MOST_CELLS, OCCUPIED, UNKNOWN, OccupancyGrid
from g2_recon.recording.cloud_tables import CUT_SHORT, text_table
from g2_recon.recording.files import atomic_write, check_exists, read_bytes

Float = NDArray[np.float64]

_log = logging.getLogger(__name__)

MODES = ("trinary", "scale", "raw")

_FREE_PIXEL, _UNKNOWN_PIXEL, _OCCUPIED_PIXEL = 254, 205, 0
_OCCUPIED_THRESHOLD = 0.65
# As in ROS 1. The map_saver of Nav2 writes 0.25, with which its own gray of the unknown, (255 - 205) / 255 = 0.19608
# occupied, is read back as free.
_FREE_THRESHOLD = 0.196

_MOST_YAML_BYTES = 1 << 16
# Few bytes of a PNG can claim to be any number of pixels, and a pixel takes up to 16 bytes while it is read.
_MOST_PNG_PIXELS = 1 << 26
_PNG = b"\x89PNG\r\n\x1a\n"
_PALETTE = 3
_GAP = rb"(?:\s|#[^\r\n]*[\r\n])+"
_PGM_HEADER = re.compile(rb"P([25])" + 3 * (_GAP + rb"(\d{1,9})") + rb"\s")


@dataclass(frozen=True)
class _Meaning:
    """What the YAML file says about the image."""

    image: Path
    mode: str
    resolution: float
    origin: Float
    negate: bool
    occupied_threshold: float
    free_threshold: float


def write_map(path: str | Path, grid: OccupancyGrid, *, mode: str = "trinary") -> None:
    """Write a grid as `path`, a YAML file, and a PGM image of the same name beside it.

    In mode trinary cells up to 20 % are free and those from 65 % on occupied; raw keeps each value. Mode scale needs an
    image with transparency, which PGM is not. Raises InputError where the path does not end in .yaml, the grid has no
    cells, or a file cannot be written.
    """
    target = _yaml_path(path)
    if not grid.cells.size:
        raise InputError("the map has no cells", where=path, advice="map something first")
    values = np.arange(256).astype(np.uint8).view(np.int8)
    if mode == "trinary":
        free, occupied = round(100 * _FREE_THRESHOLD), round(100 * _OCCUPIED_THRESHOLD)
        pixels = np.where(values >= occupied, _OCCUPIED_PIXEL, np.where(values <= free, _FREE_PIXEL, _UNKNOWN_PIXEL))
        pixels[values < 0] = _UNKNOWN_PIXEL
    elif mode == "raw":
        pixels = np.where(values < 0, 255, values)
    else:
        raise InputError(f"a PGM image cannot be of mode {mode!r}", where=path, advice="use trinary or raw")
    image = target.with_suffix(".pgm")
    meaning = {
        "image": image.name,
        "mode": mode,
        "resolution": float(grid.resolution),
        "origin": grid.origin.tolist(),
        "negate": 0,
        "occupied_thresh": _OCCUPIED_THRESHOLD,
        "free_thresh": _FREE_THRESHOLD,
    }
    height, width = grid.cells.shape
    # Both are written before either takes its place.
    with atomic_write(target) as temporary_yaml, atomic_write(image) as temporary_image:
        temporary_yaml.write_text(yaml.safe_dump(meaning, sort_keys=False, default_flow_style=None), encoding="utf-8")
        with temporary_image.open("wb") as file:
            file.write(f"P5\n# {grid.resolution:g} m a pixel\n{width} {height}\n255\n".encode("ascii"))
            # An image begins at the top, a grid at the bottom.
            file.write(pixels.astype(np.uint8)[grid.cells[::-1].view(np.uint8)].tobytes())


def read_map(path: str | Path) -> OccupancyGrid:
    """The grid of a YAML file and the image that it names, PGM (P2, P5) or PNG, understood as Nav2 does.

    Raises InputError where a file cannot be read, is malformed or cut short, or the map is absurdly large.
    """
    meaning = _read_meaning(_yaml_path(path))
    check_exists(meaning.image)
    if not meaning.image.is_file():
        raise InputError("is no file", where=meaning.image, advice=f"it is the image of {path}")
    content = read_bytes(meaning.image)
    try:
        cells = _png_cells(content, meaning) if content.startswith(_PNG) else _pgm_cells(content, meaning)
    except InputError as error:
        raise InputError(str(error), where=meaning.image) from None
    return OccupancyGrid(meaning.resolution, meaning.origin, np.ascontiguousarray(cells[::-1]))


def _yaml_path(path: str | Path) -> Path:
    target = Path(path)
    if target.suffix.lower() not in (".yaml", ".yml"):
        raise InputError("is no name of a map", where=path, advice="name the file that ends in .yaml")
    return target


def _read_meaning(path: Path) -> _Meaning:
    check_exists(path)
    if path.stat().st_size > _MOST_YAML_BYTES:
        raise InputError("is too large for the YAML file of a map", where=path, advice="name the one beside the image")
    try:
        # Its scalars are plain text and nothing is merged, so nothing in the file can blow up.
        values = yaml.load(read_bytes(path).decode("utf-8"), yaml.BaseLoader)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"is no YAML: {error}", where=path, advice="expected the settings of a map") from None
    if not isinstance(values, dict):
        raise InputError("holds no settings", where=path, advice="expected image, resolution, origin, ...")
    try:
        return _parse_meaning(values, path)
    except InputError as error:
        raise InputError(str(error), where=path, advice="see the map_server of Nav2") from None


def _parse_meaning(values: dict[Any, Any], path: Path) -> _Meaning:
    image = values.get("image")
    if not isinstance(image, str) or not image or "\0" in image:
        raise InputError("names no image")
    mode = values.get("mode", "trinary")
    if mode not in MODES:
        raise InputError(f"the mode is none of {', '.join(MODES)}")
    negate = {"0": False, "false": False, "no": False, "1": True, "true": True, "yes": True}.get(
        str(values.get("negate")).lower()
    )
    if negate is None:
        raise InputError("negate is neither 0 nor 1")
    origin = values.get("origin")
    if not isinstance(origin, list) or len(origin) != 3:
        raise InputError("the origin is not a list of x, y, yaw")
    resolution, occupied, free = (
        _number(values.get(name), name) for name in ("resolution", "occupied_thresh", "free_thresh")
    )
    if resolution <= 0:
        raise InputError(f"the resolution is {resolution} m")
    if not 0 <= free < occupied <= 1:
        raise InputError(f"the thresholds are not 0 <= free_thresh {free} < occupied_thresh {occupied} <= 1")
    place = np.array([_number(value, "a number of the origin") for value in origin])
    return _Meaning(path.parent / image, mode, resolution, place, negate, occupied, free)


def _number(value: object, name: str) -> float:
    try:
        number = float(value) if isinstance(value, str) else math.nan
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{name} is missing or no finite number")
    return number


def _pgm_cells(content: bytes, meaning: _Meaning) -> NDArray[np.int8]:
    """The cells (H, W) of a PGM image, from the top."""
    header = _PGM_HEADER.match(content)
    if header is None:
        raise InputError("is neither a gray PGM nor a PNG image", advice="convert it to PGM")
    kind, width, height, most = (int(number) for number in header.groups())
    _check_size(width, height, MOST_CELLS)
    if not 0 < most < 1 << 16:
        raise InputError(f"states pixels up to {most}", advice="the image is damaged")
    count = width * height
    if kind == 2:
        body = re.sub(rb"#[^\r\n]*", b"", content[header.end() :])
        pixels = text_table(body, {"pixel": 0}, count, 1)["pixel"]
    else:
        dtype = np.dtype("u1" if most < 256 else ">u2")
        if len(content) - header.end() < count * dtype.itemsize:
            raise InputError(f"has fewer than {count} pixels", advice=CUT_SHORT)
        pixels = np.frombuffer(content, dtype, count, header.end())
    if not ((pixels >= 0) & (pixels <= most)).all():
        raise InputError(f"has a pixel that is not from 0 to {most}", advice="the image is damaged")
    table = _cells(np.arange(most + 1) / most, meaning)
    usual = meaning.mode == "trinary" and not meaning.negate and most == 255
    if usual and table[_UNKNOWN_PIXEL] == FREE and (pixels == _UNKNOWN_PIXEL).any():
        _log.warning(
            "%s: the gray of unknown cells counts as free, for Nav2 too, as free_thresh is %g; with %g it does not",
            meaning.image,
            meaning.free_threshold,
            _FREE_THRESHOLD,
        )
    return table[pixels.astype(np.uint16)].reshape(height, width)


def _png_cells(content: bytes, meaning: _Meaning) -> NDArray[np.int8]:
    """The cells (H, W) of a PNG image, from the top."""
    # Here, since it takes longer to load than most maps do, and few maps are PNG.
    from matplotlib.image import imread

    _check_size(int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big"), _MOST_PNG_PIXELS)
    try:
        image = np.asarray(imread(io.BytesIO(content), format="png"))
    except Exception as error:  # what a damaged image raises is not written down anywhere
        raise InputError(f"cannot be decoded: {error}", advice="the image is damaged") from None
    if image.ndim == 2:
        return _cells(image, meaning)
    # Colors from a palette are given with an alpha that the file need not have.
    opaque = image.shape[2] < 4 or (content[25] == _PALETTE and b"tRNS" not in content.partition(b"IDAT")[0])
    # In mode trinary Nav2 takes the mean of alpha and colors.
    channels = image if meaning.mode == "trinary" and not opaque else image[..., :3]
    cells = _cells(channels.mean(axis=2), meaning)
    if meaning.mode == "scale" and not opaque:
        cells[image[..., 3] < 1] = UNKNOWN
    return cells


def _check_size(width: int, height: int, most: int) -> None:
    if not 0 < width * height <= most:
        raise InputError(f"states {width} x {height} pixels", advice=f"a map has from 1 to {most}")


def _cells(brightness: NDArray[np.floating[Any]], meaning: _Meaning) -> NDArray[np.int8]:
    """The cells for brightnesses from 0 to 1, by the rules of the map_server of Nav2."""
    if meaning.mode == "raw":
        values = np.rint(255 * brightness)
        return np.where(values <= OCCUPIED, values, UNKNOWN).astype(np.int8)
    occupied = brightness if meaning.negate else 1 - brightness
    free_threshold, occupied_threshold = meaning.free_threshold, meaning.occupied_threshold
    if meaning.mode == "trinary":
        between: Any = UNKNOWN
    else:
        between = np.rint((occupied - free_threshold) / (occupied_threshold - free_threshold) * 100)
    known = np.where(occupied > occupied_threshold, OCCUPIED, FREE)
    sure = (occupied > occupied_threshold) | (occupied < free_threshold)
    return np.where(sure, known, between).astype(np.int8)
