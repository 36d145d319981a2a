"""An OBJ file again, with other positions: the rest of it stays byte for byte."""

from __future__ import annotations

import os
import re
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError, ShapeError
from lcollision_core.meshes.atomic import atomic_write
from lcollision_core.meshes.formats.obj import ObjCorners, read_corners
from lcollision_core.meshes.formats.polygons import MAX_FILE_BYTES
from lcollision_core.meshes.formats.text import decimals
from lcollision_core.meshes.normals import moved_normals
from lcollision_core.regular_files import read_regular

FloatArray = npt.NDArray[np.float64]

_BLANKS = rb"(?:[ \t\v\f]|\\(?:\r\n|\n|\r))"
_WORD = rb"[^\s\\]+"
_THREE = re.compile(
    rb"(?:(?<=[\r\n])|\A(?:\xef\xbb\xbf)?)(?P<head>%(b)s*(?P<kind>vn?)%(b)s+)"
    rb"(%(w)s)(%(b)s+)(%(w)s)(%(b)s+)(%(w)s)" % {b"b": _BLANKS, b"w": _WORD}
)


def rewrite_obj(
    path: str | os.PathLike[str], source: str | os.PathLike[str], vertices: npt.NDArray[Any]
) -> None:
    """Write an OBJ file again, whole or not at all, with other positions: see `rewritten`.

    Raises
    ------
    ShapeError : `vertices` are not those of the source.
    MeshFileError : the source cannot be read, or the file cannot be written.
    """
    try:
        data = rewritten(read_regular(source, MAX_FILE_BYTES), vertices)
    except (MeshFileError, OSError) as error:
        raise MeshFileError.unreadable(source, error, "check the file") from error
    with atomic_write(path) as file:
        file.write(data)


def rewritten(data: bytes, vertices: npt.NDArray[Any]) -> bytes:
    """Replace the coordinates of an OBJ file's `v` and `vn` lines.

    What stands behind the coordinates, such as vertex colours, stays, and so does the text of a
    number that does not change. A normal keeps its number and moves with the corners that use it:
    see `moved_normals`. Programs that give faces of one direction a common normal, as Blender
    does, leave such faces one where the pose turns them apart.

    Parameters
    ----------
    data : the bytes of an OBJ file
    vertices : (V, 3) finite array, in the file's order; written with the shortest decimals that
        read back as the same numbers

    Returns
    -------
    the bytes of the new file

    Raises
    ------
    ShapeError : another shape.
    MeshFileError : the file cannot be read.
    """
    held = read_corners(data)
    if vertices.shape != held.vertices.shape:
        raise ShapeError.must_be(
            "vertices for this OBJ file", f"of shape {held.vertices.shape}", vertices.shape
        )
    points = np.asarray(vertices, np.float64)
    new = {b"v": points, b"vn": _moved_normals(held, points)}
    old = {b"v": held.vertices, b"vn": held.normals}
    texts = {kind: decimals(rows) for kind, rows in new.items()}
    is_kept = {kind: (rows == old[kind]).all(axis=1).tolist() for kind, rows in new.items()}
    counts = dict.fromkeys(new, 0)

    def replaced(line: re.Match[bytes]) -> bytes:
        kind = line["kind"]
        row = counts[kind]
        counts[kind] += 1
        if row >= len(is_kept[kind]) or is_kept[kind][row]:
            return line[0]
        x, y, z = (word.encode("ascii") for word in texts[kind][3 * row : 3 * row + 3])
        start = line[0][: line.start("kind") - line.start()] + line["head"].lstrip()
        return b"".join((start, x, line[4], y, line[6], z))

    result = _THREE.sub(replaced, data)
    again = read_corners(result)
    if not np.array_equal(again.vertices, points) or not np.array_equal(
        again.corners, held.corners
    ):
        raise MeshFileError(
            "its lines of vertices are not written as other programs write them",
            "export the mesh again",
        )
    return result


def _moved_normals(held: ObjCorners, vertices: FloatArray) -> FloatArray:
    sizes, position = held.sizes, np.arange(len(held.corners))
    start, size = np.repeat(np.cumsum(sizes) - sizes, sizes), np.repeat(sizes, sizes)
    beside = [held.corners[start + (position - start + step) % size] for step in (1, -1)]
    corners = np.stack([held.corners, *beside], axis=1)[held.corner_normals >= 0]
    owners = held.corner_normals[held.corner_normals >= 0]
    return moved_normals(held.normals, owners, corners, held.vertices, vertices)
