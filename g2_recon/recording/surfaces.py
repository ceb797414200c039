# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""True surfaces in and out: NPZ files, and mesh files where all of the surface was seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from g2_recon.errors import InputError
from g2_recon.geometry.mesh import TrueSurface
from g2_recon.recording.files import read_bytes, write_arrays
from g2_recon.recording.meshes import FARTHEST_M, MESH_ENDINGS, check_triangles, read_mesh
from g2_recon.recording.npz import parse_npz


def read_true_surface(path: str | Path) -> TrueSurface:
    """Read the truth of an .npz file, or of a mesh as read_mesh does.

    An NPZ file holds `truth_vertices` (V, 3) in metres, `truth_faces` (F, 3) of whole numbers and, where only a part
    of the surface was seen, `clean` (N, 3) in metres, the hits without noise. Raises InputError if the file cannot be
    read, is malformed, holds no triangle, or a number is not finite or out of its range.
    """
    ending = Path(path).suffix.lower()
    if ending in MESH_ENDINGS:
        return TrueSurface(*read_mesh(path))
    if ending != ".npz":
        known = ", ".join((".npz", *MESH_ENDINGS))
        raise InputError("has no ending that a true surface can have", where=path, advice=f"use one of {known}")
    content = read_bytes(path)
    try:
        arrays = parse_npz(content, ["truth_vertices", "truth_faces"], ["clean"])
    except InputError as error:
        raise InputError(str(error), where=path) from None
    if arrays["truth_faces"].dtype.kind == "f":
        raise InputError("truth_faces are no whole numbers", where=path, advice="export them as integers (F, 3)")
    vertices, faces = check_triangles(
        arrays["truth_vertices"].astype(np.float64), arrays["truth_faces"].astype(np.int64), path
    )
    if "clean" not in arrays:
        return TrueSurface(vertices, faces)
    seen = arrays["clean"].astype(np.float64)
    if len(seen) == 0 or not (np.abs(seen) <= FARTHEST_M).all():
        raise InputError(
            f"clean is empty, not finite or above {FARTHEST_M:g} m",
            where=path,
            advice="leave it out if all of the surface was seen",
        )
    return TrueSurface(vertices, faces, seen)


def write_true_surface(path: str | Path, surface: TrueSurface) -> None:
    """Write the truth as NPZ, `clean` as float32: it only tells what was seen.

    Raises InputError where the file system refuses.
    """
    seen = {} if surface.seen is None else {"clean": surface.seen.astype(np.float32)}
    write_arrays(path, truth_vertices=surface.vertices, truth_faces=surface.faces, **seen)
