"""What every mesh format holds, and the limits that every reader keeps."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.meshes.topology import Topology

MAX_FACES = 5_000_000
"""The most faces, and the most vertices, that a mesh file may hold.

Far above any posed body, and low enough that a file at the limit fits into memory. Counts are
compared with it before anything of that size is allocated.
"""

MAX_FILE_BYTES = 1 << 29
"""The largest mesh file that is read, in bytes: as text it takes some ten times that in memory."""


@dataclass(frozen=True, eq=False)
class Polygons:
    """The content of a mesh file before triangulation.

    Attributes
    ----------
    vertices : (V, 3) float64 array, in the file's order
    sizes : (P,) int64 array, corners of each polygon
    corners : (sum of sizes,) int64 array, vertex indices from 0, one polygon after the other
    notes : sentences on what was done to the file's content
    is_single : whether the file holds the coordinates as float32
    cut_of : of triangles that were cut already, ascending numbers of the polygons that they were
        cut from; None where each is one
    """

    vertices: npt.NDArray[np.float64]
    sizes: npt.NDArray[np.int64]
    corners: npt.NDArray[np.int64]
    notes: tuple[str, ...] = ()
    is_single: bool = False
    cut_of: npt.NDArray[np.int64] | None = None

    @classmethod
    def triangles(
        cls,
        vertices: npt.NDArray[np.float64],
        faces: npt.NDArray[np.int64],
        notes: tuple[str, ...] = (),
        is_single: bool = False,
        cut_of: npt.NDArray[np.int64] | None = None,
    ) -> Polygons:
        """Wrap (V, 3) vertices and (F, 3) faces."""
        sizes = np.full(len(faces), 3, dtype=np.int64)
        return cls(vertices, sizes, faces.reshape(-1), notes, is_single, cut_of)


def with_order_of(
    corners: npt.NDArray[np.float64], topology: Topology | None, note: str, is_single: bool
) -> Polygons | None:
    """Put the corners of triangles back into the vertex order of the mesh that they were cut from.

    Parameters
    ----------
    corners : (3 F, 3) array, three in turn for each triangle
    topology : of that mesh
    note : what to say of it
    is_single : whether the file holds them as float32

    Returns
    -------
    the triangles; None where corners of one vertex of the topology differ
    """
    if topology is None or len(corners) != 3 * topology.n_faces or len(topology.unused_vertices):
        return None
    order = topology.faces.reshape(-1)
    vertices = np.empty((topology.n_vertices, 3), dtype=np.float64)
    vertices[order] = corners
    if not np.array_equal(vertices[order], corners):
        return None
    return Polygons.triangles(vertices, topology.faces.astype(np.int64), (note,), is_single)


def first_at_each_position(points: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Return (n,) for each of (n, 3) points the index of the first at its coordinates."""
    # -0.0 becomes 0.0: equal coordinates, equal bits.
    bits = (np.ascontiguousarray(points, dtype=np.float64) + 0.0).view(np.uint64)
    order = np.lexsort(bits.T)
    is_new = np.ones(len(order), dtype=np.bool_)
    is_new[1:] = (bits[order[1:]] != bits[order[:-1]]).any(axis=1)
    first = np.empty_like(order)
    first[order] = order[is_new][np.cumsum(is_new) - 1]
    return first


def require_plausible_count(count: int, what: str) -> None:
    """Raise `MeshFileError` when a file announces fewer than none, or more than `MAX_FACES`."""
    if count < 0:
        raise MeshFileError(f"it is damaged: it announces {count} {what}")
    if count > MAX_FACES:
        raise MeshFileError(
            f"it holds {count} {what}, at most {MAX_FACES} can be read", "decimate the mesh"
        )


def read_rest(file: BinaryIO) -> bytes:
    """Read what is left of an open file, or raise `MeshFileError` above `MAX_FILE_BYTES`."""
    start = file.tell()
    size = file.seek(0, os.SEEK_END) - start
    if size > MAX_FILE_BYTES:
        raise MeshFileError(
            f"it is larger than {MAX_FILE_BYTES >> 20} MiB",
            "export it with smaller textures or none, decimate the mesh, or split the file",
        )
    file.seek(start)
    return file.read(size)
