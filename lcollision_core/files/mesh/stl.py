"""STL, binary and text: triangles that repeat their corners' coordinates.

It has its own reader because trimesh reads a truncated text file as an empty one, and refuses a
binary one with data after its triangles.
"""

from __future__ import annotations

import os
import re
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.files.mesh.polygons import (
    Polygons,
    first_at_each_position,
    read_rest,
    require_plausible_count,
    with_order_of,
)
from lcollision_core.files.mesh.text import number_rows
from lcollision_core.meshes.normals import unit
from lcollision_core.meshes.topology import Topology

_HEADER_BYTES = 84
_CORNER = re.compile(rb"\bvertex\s([^\n\r]*)")
_TRIANGLE = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_JOINED = "STL stores no shared vertices; corners at equal coordinates were joined"
_REORDERED = "STL stores no shared vertices; corners were put back into the set's vertex order"


def read(file: BinaryIO, topology: Topology | None = None) -> Polygons:
    """Read the triangles and join their corners to shared vertices.

    Parameters
    ----------
    file : open binary file at its start
    topology : expected connectivity, with the same order of faces. If all corners of each of its
        vertices agree, its vertex order is restored. Otherwise corners at equal coordinates become
        one vertex, numbered by first appearance.

    Returns
    -------
    the triangles, in the file's order

    Raises
    ------
    MeshFileError : the file is truncated or not STL.
    """
    size = os.fstat(file.fileno()).st_size
    head = file.read(_HEADER_BYTES)
    n_triangles = int.from_bytes(head[80:], "little") if len(head) == _HEADER_BYTES else -1
    is_text = head.lstrip()[:5].lower() == b"solid"
    expected = _HEADER_BYTES + n_triangles * _TRIANGLE.itemsize
    # A binary file may start with "solid" too, so check for its exact size first.
    if n_triangles >= 0 and (expected == size or (not is_text and expected < size)):
        require_plausible_count(n_triangles, "triangles")
        body = file.read(n_triangles * _TRIANGLE.itemsize)
        corners = np.frombuffer(body, dtype=_TRIANGLE)["corners"].astype(np.float64)
    elif is_text:
        file.seek(0)
        corners = _text_corners(read_rest(file))
    elif n_triangles >= 0:
        raise MeshFileError(
            f"it is truncated or not an STL file: it announces {n_triangles} triangles, which take "
            f"{expected} bytes, but has {size}"
        )
    else:
        raise MeshFileError(f"it has {size} bytes, too few for an STL file")
    # Turn -0.0 into 0.0, as equal corners are merged.
    points = corners.reshape(-1, 3) + 0.0
    is_single = not (is_text and expected != size)
    ordered = with_order_of(points, topology, _REORDERED, is_single)
    return ordered or _joined(points, is_single)


def _text_corners(data: bytes) -> npt.NDArray[np.float64]:
    data = data.lower()
    n_facets, has_end = data.count(b"endfacet"), b"endsolid" in data
    require_plausible_count(n_facets, "triangles")
    rows = _CORNER.findall(data)
    if len(rows) != 3 * n_facets or not has_end:
        raise MeshFileError(
            f"it is truncated or damaged: it has {n_facets} complete triangles, {len(rows)} "
            f"corners and {'an' if has_end else 'no'} end line"
        )
    del data
    corners, sizes = number_rows(b"\n".join([*rows, b""]), "corner")
    ragged = np.flatnonzero(sizes != 3)
    if len(ragged):
        raise MeshFileError(
            f"corner {ragged[0] % 3} of triangle {ragged[0] // 3} (from 0) has "
            f"{sizes[ragged[0]]} coordinates, three are needed"
        )
    return corners


def _joined(points: npt.NDArray[np.float64], is_single: bool) -> Polygons:
    first = first_at_each_position(points)
    is_first = first == np.arange(len(first))
    number = np.cumsum(is_first) - 1
    faces = number[first].reshape(-1, 3)
    return Polygons.triangles(points[is_first], faces, (_JOINED,), is_single)


def encode(vertices: npt.NDArray[Any], faces: npt.NDArray[np.int32]) -> bytes:
    """Write triangles as binary STL, float32, in the order of `faces`.

    Parameters
    ----------
    vertices : (V, 3) float32 or float64 array; STL keeps float32 only
    faces : (F, 3) int32 array, indices from 0
    """
    triangles = np.zeros(len(faces), dtype=_TRIANGLE)
    corners = vertices.astype(np.float32)[faces]
    triangles["corners"] = corners
    exact = corners.astype(np.float64)
    normals = np.cross(exact[:, 1] - exact[:, 0], exact[:, 2] - exact[:, 0])
    triangles["normal"] = unit(normals)
    header = b"binary STL".ljust(80, b"\0") + len(faces).to_bytes(4, "little")
    return header + triangles.tobytes()
