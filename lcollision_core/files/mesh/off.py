"""Object File Format (OFF), as text.

It has its own reader because trimesh reorders the triangles of quads, drops truncated faces without
an error, and writes ten digits.
"""

from __future__ import annotations

import re
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.files.mesh.polygons import Polygons, read_rest, require_plausible_count
from lcollision_core.files.mesh.text import (
    decimals,
    number_rows,
    plain_lines,
    points,
    vertex_numbers,
)

_HEADER = re.compile(rb"\s*(?:ST)?C?N?OFF([^\n]*)", re.IGNORECASE)
_COUNTS = re.compile(rb"\s*(-?\d+)\s+(-?\d+)[^\n]*\n")
_HEAD_BYTES = 1 << 16


def read(file: BinaryIO, _: object = None) -> Polygons:
    """Read the vertices and faces; colours, normals and texture coordinates are ignored.

    Parameters
    ----------
    file : open binary file at its start

    Returns
    -------
    the polygons, vertices in the file's order

    Raises
    ------
    MeshFileError : there is no OFF header, or a vertex or face is missing or unreadable.
    """
    head = plain_lines(file.read(_HEAD_BYTES))
    n_vertices, n_faces, _ = _read_head(head)
    require_plausible_count(n_vertices, "vertices")
    require_plausible_count(n_faces, "faces")
    file.seek(0)
    data = plain_lines(read_rest(file))
    # The line of counts ends with the number of edges, which readers ignore.
    data = re.sub(rb"\n\s+", b"\n", data[_read_head(data)[2] :]).lstrip()
    ends = np.flatnonzero(np.frombuffer(data, dtype=np.uint8) == ord("\n")) + 1
    if len(ends) < n_vertices + n_faces:
        raise MeshFileError(
            f"it is truncated: it announces {n_vertices} vertices and {n_faces} faces but has only "
            f"{len(ends)} lines for them"
        )
    middle, end = (int(ends[n - 1]) if n else 0 for n in (n_vertices, n_vertices + n_faces))
    return Polygons(points(data[:middle], "vertex"), *_faces(data[middle:end]))


def _read_head(text: bytes) -> tuple[int, int, int]:
    """Return the counts of vertices and faces, and the end of their line."""
    header = _HEADER.match(text)
    if header is None or b"BINARY" in header[1].upper():
        raise MeshFileError("it does not start with OFF as a text OFF file does")
    counts = _COUNTS.match(text, header.start(1))
    if counts is None:
        raise MeshFileError("the counts of vertices and faces are missing after OFF")
    return int(counts[1]), int(counts[2]), counts.end()


def _faces(text: bytes) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    values, n_words = number_rows(text, "face", whole=True)
    starts = np.cumsum(n_words) - n_words
    announced = values[starts]
    is_count = (announced >= 0) & (announced == np.floor(announced))
    missing = np.flatnonzero(~(is_count & (announced < n_words)))
    if len(missing):
        face = missing[0]
        raise MeshFileError(
            f"announces {announced[face]:g} corners but has {n_words[face] - 1}",
            where=f"face {face} (from 0)",
        )
    sizes = announced.astype(np.int64)
    column = np.arange(len(values)) - np.repeat(starts, n_words)
    is_corner = (column > 0) & (column <= np.repeat(sizes, n_words))
    return sizes, vertex_numbers(values[is_corner], sizes)


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
