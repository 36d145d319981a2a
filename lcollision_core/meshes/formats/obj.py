"""Wavefront OBJ.

An own reader, because the vertex order and count must survive: trimesh splits a vertex where its
texture coordinates or normals differ.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator, Sequence
from io import BytesIO
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.meshes.formats.polygons import Polygons, read_rest, require_few
from lcollision_core.meshes.formats.text import (
    blocks_of_lines,
    decimals,
    normalised_text,
    plain_decimals,
    plain_integers,
)

_SHORTEST_LINE = len(b"f 1 2 3\n")
_LARGEST = np.iinfo(np.int64).max


def read(file: BinaryIO, size: int) -> Polygons:
    """Read `v` and `f` lines; texture coordinates, normals, groups and materials are passed over.

    Parameters
    ----------
    file : open binary file at its start
    size : its size in bytes

    Returns
    -------
    the polygons, vertices in the file's order

    Raises
    ------
    MeshFileError : a vertex or face is not readable, named by its number from 0.
    """
    require_few(file, b"\nf", "faces", _SHORTEST_LINE, size)
    require_few(file, b"\nv ", "vertices", _SHORTEST_LINE, size)
    data = read_rest(file)
    if b"\0" in data:
        raise MeshFileError("it is not a text file, so no OBJ", "export the mesh again")
    data = normalised_text(data)
    if b"\\" in data:
        data = data.replace(b"\\\n", b" ")
    return _read_plain(data) or _read_any(data)


def _read_plain(data: bytes) -> Polygons | None:
    """Read what nearly all programs write, without a loop; None where anything else occurs."""
    text = np.frombuffer(data, dtype=np.uint8)
    starts = np.concatenate([[0], np.flatnonzero(text == ord("\n")) + 1])
    starts = starts[starts < len(text)]
    if not len(starts):
        return None
    first, second = text[starts], text[np.minimum(starts + 1, len(text) - 1)]
    is_vertex, is_face = first == ord("v"), first == ord("f")
    is_blank = (second <= ord(" ")) & (is_vertex | is_face)
    if ((first <= ord(" ")) & (first != ord("\n"))).any() or (second[is_blank] != ord(" ")).any():
        return None
    kind = np.where(is_blank, first, 0)
    bounds = np.concatenate([[0], np.flatnonzero(np.diff(kind)) + 1])
    ends = np.append(starts[bounds[1:]], len(text))
    lines = {
        keyword: b"".join(
            data[start:end]
            for start, end, found in zip(starts[bounds], ends, kind[bounds], strict=True)
            if found == ord(keyword)
        )
        for keyword in ("v", "f")
    }
    n_vertices, n_faces = (int(np.count_nonzero(kind == ord(keyword))) for keyword in ("v", "f"))
    vertices = _plain_vertices(lines["v"], n_vertices)
    faces = _plain_faces(lines["f"], n_faces)
    if vertices is None or faces is None:
        return None
    return Polygons(vertices, *faces)


def _plain_vertices(lines: bytes, n_vertices: int) -> npt.NDArray[np.float64] | None:
    # A word that is no number for each keyword, at every row's start and nowhere else.
    values = plain_decimals(lines.replace(b"v", b"nan"))
    if values is None or n_vertices == 0 or len(values) % n_vertices:
        return None
    table = values.reshape(n_vertices, -1)
    if table.shape[1] < 4 or not np.isnan(table[:, 0]).all() or np.isnan(table[:, 1:]).any():
        return None
    return np.ascontiguousarray(table[:, 1:4])


def _plain_faces(
    lines: bytes, n_faces: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]] | None:
    has_more = b"/" in lines
    if has_more:
        lines = re.sub(rb"(?<=[0-9])/[^\s]*", b"", lines)
    # OBJ counts from 1, so a zero for each keyword tells rows apart.
    named = plain_integers(lines.replace(b"f", b" 0 "))
    if named is None:
        return None
    rows = np.flatnonzero(named == 0)
    if len(rows) != n_faces or named[0] != 0 or (has_more and named.max() == _LARGEST):
        return None
    return np.diff(np.append(rows, len(named))) - 1, named[named != 0] - 1


def _read_any(data: bytes) -> Polygons:
    """Read line by line, and say what is wrong with which."""
    n_vertices = 0
    before = array("q")  # of each face, the vertices before it

    def lines_of(keyword: bytes) -> Iterator[bytes]:
        nonlocal n_vertices
        n_vertices = 0
        for line in BytesIO(data):
            start = line[:2]
            if start not in (b"v ", b"f "):
                words = line.split(None, 1)
                if not words or words[0] not in (b"v", b"f"):
                    continue
                line = words[0] + b" " + (words[1] if len(words) > 1 else b"")
                start = line[:2]
            n_vertices += start == b"v "
            if start == keyword:
                if keyword == b"f ":
                    before.append(n_vertices)
                yield line.partition(b"#")[0] if b"#" in line else line

    vertices, sizes, corners = [np.empty((0, 3))], [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    done = 0
    for block in blocks_of_lines(lines_of(b"f ")):
        counted = np.frombuffer(before, dtype=np.int64)[done : done + len(block)]
        block_sizes, block_corners = _parse_faces(block, done, counted)
        del counted  # or `before` could not grow
        sizes.append(block_sizes)
        corners.append(block_corners)
        done += len(block)
    done = 0
    for block in blocks_of_lines(lines_of(b"v ")):
        vertices.append(_parse_vertices(block, done))
        done += len(block)
    return Polygons(np.concatenate(vertices), np.concatenate(sizes), np.concatenate(corners))


def _table(lines: Sequence[bytes]) -> list[bytes] | None:
    """Return the words of all lines, or None unless every line has as many words as the first."""
    words = b" ".join(lines).split()
    columns = len(lines[0].split())
    keyword = lines[0][:1]
    # Keywords at every row's start, and as many as there are lines, leave no room for ragged rows.
    aligned = len(words) == columns * len(lines) and words[::columns].count(keyword) == len(lines)
    return words if aligned else None


def _parse_vertices(block: list[bytes], first: int) -> npt.NDArray[np.float64]:
    vertices = np.empty((len(block), 3), dtype=np.float64)
    words = _table(block)
    columns = len(block[0].split())
    if words is not None and columns >= 4:
        try:
            for axis in range(3):
                vertices[:, axis] = list(map(float, words[axis + 1 :: columns]))
        except ValueError:
            pass  # The walk below finds out which vertex it was.
        else:
            return vertices
    for row, line in enumerate(block):
        coordinates = line.split()[1:4]
        if len(coordinates) < 3:
            raise MeshFileError(
                f"has {len(coordinates)} coordinates, three are needed",
                where=f"vertex {first + row} (from 0)",
            )
        try:
            vertices[row] = list(map(float, coordinates))
        except ValueError as error:
            raise MeshFileError(
                f"has a coordinate that is no number: {b' '.join(coordinates)[:60]!r}",
                where=f"vertex {first + row} (from 0)",
            ) from error
    return vertices


def _parse_faces(
    block: list[bytes], first: int, vertices_before: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    sizes, named = _parse_any_faces(block, first)
    owner = np.repeat(np.arange(len(block)), sizes)
    zero = np.flatnonzero(named == 0)
    if len(zero):
        raise MeshFileError(
            "names vertex 0, but OBJ counts vertices from 1",
            where=f"face {first + owner[zero[0]]} (from 0)",
        )
    if (named < 0).any():
        counted = vertices_before[owner]
        outside = np.flatnonzero(named < -counted)
        if len(outside):
            raise MeshFileError(
                f"names vertex {named[outside[0]]}, but only {counted[outside[0]]} vertices "
                "come before it",
                where=f"face {first + owner[outside[0]]} (from 0)",
            )
        named = np.where(named < 0, counted + named + 1, named)
    return sizes, named - 1


def _parse_any_faces(
    block: list[bytes], start: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    rows = [line.split()[1:] for line in block]
    sizes = np.array([len(row) for row in rows], dtype=np.int64)
    try:
        named = [int(word.partition(b"/")[0]) for row in rows for word in row]
        return sizes, np.array(named, dtype=np.int64)
    except (ValueError, OverflowError) as error:
        raise _first_bad_face(block, start) from error


def _first_bad_face(block: list[bytes], start: int) -> MeshFileError:
    what = "has a corner that is no vertex number"
    for face, line in enumerate(block, start):
        for word in line.split()[1:]:
            try:
                np.int64(int(word.partition(b"/")[0]))
            except (ValueError, OverflowError):
                return MeshFileError(f"{what}: {word[:30]!r}", where=f"face {face} (from 0)")
    return MeshFileError(what, where="a face")


def encode(vertices: npt.NDArray[Any], faces: npt.NDArray[np.int32]) -> bytes:
    """Write triangles as OBJ text, each number as the shortest decimal that reads back the same.

    Parameters
    ----------
    vertices : (V, 3) float32 or float64 array
    faces : (F, 3) int32 array, indices from 0 (written from 1)
    """
    rows = "v %s %s %s\n" * len(vertices) % decimals(vertices)
    return (
        rows + "f %d %d %d\n" * len(faces) % tuple((faces.astype(np.int64) + 1).ravel().tolist())
    ).encode("ascii")
