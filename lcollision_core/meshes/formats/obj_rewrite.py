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
from lcollision_core.regular_files import read_regular

FloatArray = npt.NDArray[np.float64]

_BLANKS = rb"(?:[ \t\v\f]|\\(?:\r\n|\n|\r))"
_LEAST_SINE = 1e-9
"""Of the angle at a corner: below it, the direction of the triangle is rounding."""
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
    number that does not change. A normal keeps its number: it is the mean, by area, of the old
    one as each of the faces that use it turns and stretches, so that what was smooth, flat or
    weighted stays that. Programs that give faces of one direction a common normal, as Blender
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
    """Return the (N, 3) normals of an OBJ file whose vertices have moved to (V, 3) places.

    Each corner turns its normal as its face does, by the inverse transpose of the linear map that
    takes the triangle of the corner and its neighbours, and their normal, to the new ones.
    """
    has_normal = np.flatnonzero(held.corner_normals >= 0)
    owners = held.corner_normals[has_normal]
    if not len(owners):
        return held.normals
    old, new = (_corner_frames(held, points, has_normal) for points in (held.vertices, vertices))
    area = np.linalg.norm(new[:, 2], axis=1) ** 2
    is_thin = _is_thin(old) | _is_thin(new)
    changes = np.zeros(len(held.normals), dtype=np.bool_)
    changes[owners[(old != new).any(axis=(1, 2))]] = True
    counts = changes[owners] & ~is_thin
    owners, old, new, area = owners[counts], old[counts], new[counts], area[counts]
    # The map takes the rows of `old` to those of `new`: new^T old^-T, whose inverse transpose is
    # new^-1 old.
    turned = np.linalg.solve(new, old @ held.normals[owners][:, :, None])[:, :, 0]
    lengths = np.linalg.norm(turned, axis=1, keepdims=True)
    turned = np.divide(turned, lengths, out=np.zeros_like(turned), where=lengths > 0.0)
    n_normals = len(held.normals)
    sums = np.stack([np.bincount(owners, area * axis, n_normals) for axis in turned.T], axis=1)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    normals = held.normals.copy()
    np.divide(sums, lengths, out=normals, where=lengths > 0.0)
    return normals


def _corner_frames(
    held: ObjCorners, vertices: FloatArray, chosen: npt.NDArray[np.int64]
) -> FloatArray:
    """Return three rows for each of n corners, (n, 3, 3): two edges, and what stands on both.

    That is as long as the root of the triangle's doubled area, so that a mesh that is scaled has
    all three rows scaled alike.
    """
    sizes = held.sizes
    position = np.arange(len(held.corners))
    start = np.repeat(np.cumsum(sizes) - sizes, sizes)
    size = np.repeat(sizes, sizes)
    after, before = (start + (position - start + step) % size for step in (1, -1))
    at, to, back = (vertices[held.corners[index[chosen]]] for index in (position, after, before))
    edges = np.stack([to - at, back - at], axis=1)
    across = np.cross(edges[:, 0], edges[:, 1])
    length = np.sqrt(np.linalg.norm(across, axis=1, keepdims=True))
    across = np.divide(across, length, out=np.zeros_like(across), where=length > 0.0)
    return np.concatenate([edges, across[:, None]], axis=1)


def _is_thin(frames: FloatArray) -> npt.NDArray[np.bool_]:
    lengths = np.linalg.norm(frames, axis=2)
    is_thin: npt.NDArray[np.bool_] = (
        lengths[:, 2] ** 2 <= _LEAST_SINE * lengths[:, 0] * lengths[:, 1]
    )
    return is_thin
