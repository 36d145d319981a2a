"""Object File Format (OFF), text form."""

from __future__ import annotations

import re
from io import BytesIO
from itertools import islice
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.meshes.formats.polygons import Polygons, read_rest, require_plausible_count
from lcollision_core.meshes.formats.text import (
    blocks_of_lines,
    decimals,
    normalised_text,
    numbers,
    plain_integers,
)

_HEADER = re.compile(rb"\s*(?:#[^\n]*\n\s*)*(?:ST)?C?N?OFF\b([^\n]*)", re.IGNORECASE)
_COUNTS = re.compile(rb"(?:\s*(?:#[^\n]*\n)?)*(-?\d+)\s+(-?\d+)")
_HEAD_BYTES = 1 << 16


def read(file: BinaryIO) -> Polygons:
    """Read the vertices and faces; colours, normals and texture coordinates are passed over.

    Parameters
    ----------
    file : open binary file at its start

    Returns
    -------
    the polygons, vertices in the file's order

    Raises
    ------
    MeshFileError : the header is no OFF header, or a vertex or face is missing or not readable.
    """
    head = normalised_text(file.read(_HEAD_BYTES))
    header = _HEADER.match(head)
    if header is None or b"BINARY" in header[1].upper():
        raise MeshFileError("it does not start with OFF as a text OFF file does")
    counts = _COUNTS.match(head, header.start(1))
    if counts is None:
        raise MeshFileError("the counts of vertices and faces are missing after OFF")
    n_vertices, n_faces = int(counts[1]), int(counts[2])
    require_plausible_count(n_vertices, "vertices")
    require_plausible_count(n_faces, "faces")
    file.seek(0)
    data = normalised_text(read_rest(file))[counts.end() :]
    # The rest of the line of counts is the number of edges, which readers ignore.
    data = data.partition(b"\n")[2]
    if b"#" in data:
        data = re.sub(rb"#[^\n]*", b"", data)
    n_lines = sum(1 for line in BytesIO(data) if line.strip())
    if n_lines < n_vertices + n_faces:
        raise MeshFileError(
            f"it is truncated: it announces {n_vertices} vertices and {n_faces} faces but has only "
            f"{n_lines} lines for them"
        )
    lines = (line for line in BytesIO(data) if line.strip())
    vertices = [np.empty((0, 3))]
    for block in blocks_of_lines(islice(lines, n_vertices)):
        vertices.append(_vertices(block, sum(map(len, vertices))))
    sizes, corners = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for block in blocks_of_lines(islice(lines, n_faces)):
        block_sizes, block_corners = _faces(block, sum(map(len, sizes)))
        sizes.append(block_sizes)
        corners.append(block_corners)
    return Polygons(np.concatenate(vertices), np.concatenate(sizes), np.concatenate(corners))


def _vertices(lines: list[bytes], first: int) -> npt.NDArray[np.float64]:
    words = b" ".join(lines).split()
    if len(words) != 3 * len(lines):
        rows = [line.split() for line in lines]
        short = next((i for i, row in enumerate(rows) if len(row) < 3), None)
        if short is not None:
            raise MeshFileError(
                f"has {len(rows[short])} coordinates, three are needed",
                where=f"vertex {first + short} (from 0)",
            )
        words = [word for row in rows for word in row[:3]]
    return numbers(words, "the vertices").reshape(-1, 3)


def _faces(lines: list[bytes], first: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    table = plain_integers(b"\n".join(lines))
    if table is not None and len(table) == 4 * len(lines) and (table[::4] == 3).all():
        return table[::4], table.reshape(-1, 4)[:, 1:].reshape(-1)
    sizes = np.empty(len(lines), dtype=np.int64)
    corners: list[int] = []
    for face, line in enumerate(lines):
        row = line.split()
        try:
            size = int(row[0])
            named = list(map(int, row[1 : 1 + max(size, 0)]))
        except ValueError as error:
            raise MeshFileError(
                "has a corner that is no vertex number", where=f"face {first + face} (from 0)"
            ) from error
        if size < 0 or len(named) < size:
            raise MeshFileError(
                f"announces {size} corners but has {len(named)}",
                where=f"face {first + face} (from 0)",
            )
        sizes[face] = size
        corners += named
    try:
        return sizes, np.array(corners, dtype=np.int64)
    except OverflowError as error:
        raise MeshFileError("a face has a vertex number that is far too large") from error


def encode(vertices: npt.NDArray[Any], faces: npt.NDArray[np.int32]) -> bytes:
    """Write triangles as OFF text, each number as the shortest decimal that reads back the same.

    Parameters
    ----------
    vertices : (V, 3) float32 or float64 array
    faces : (F, 3) int32 array, indices from 0
    """
    header = f"OFF\n{len(vertices)} {len(faces)} 0\n"
    rows = "%s %s %s\n" * len(vertices) % decimals(vertices)
    return (header + rows + "3 %d %d %d\n" * len(faces) % tuple(faces.ravel().tolist())).encode(
        "ascii"
    )
