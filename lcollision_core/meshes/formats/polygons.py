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
    """

    vertices: npt.NDArray[np.float64]
    sizes: npt.NDArray[np.int64]
    corners: npt.NDArray[np.int64]
    notes: tuple[str, ...] = ()
    is_single: bool = False

    @classmethod
    def triangles(
        cls,
        vertices: npt.NDArray[np.float64],
        faces: npt.NDArray[np.int64],
        notes: tuple[str, ...] = (),
        is_single: bool = False,
    ) -> Polygons:
        """Wrap (V, 3) vertices and (F, 3) faces."""
        sizes = np.full(len(faces), 3, dtype=np.int64)
        return cls(vertices, sizes, faces.reshape(-1), notes, is_single)


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


def triangulate(polygons: Polygons) -> tuple[npt.NDArray[np.int64], tuple[str, ...]]:
    """Cut every polygon into the fan of triangles round its first corner.

    The cut depends on the order of the corners alone, never on their positions, so that all poses
    of a set are cut alike.

    Parameters
    ----------
    polygons : the content of a file

    Returns
    -------
    faces : (F, 3) int64 array, in the order of the polygons
    notes : a sentence for each kind of polygon that was cut

    Raises
    ------
    MeshFileError : a polygon has fewer than three corners.
    """
    sizes = polygons.sizes
    too_small = np.flatnonzero(sizes < 3)
    if len(too_small):
        face = int(too_small[0])
        raise MeshFileError(
            f"has {sizes[face]} corners, three are needed", where=f"face {face} (from 0)"
        )
    quads = int((sizes == 4).sum())
    larger = int((sizes > 4).sum())
    if not quads and not larger:
        return polygons.corners.reshape(-1, 3), ()
    notes = []
    if quads:
        notes.append(
            "1 quad was triangulated" if quads == 1 else f"{quads} quads were triangulated"
        )
    if larger:
        notes.append(
            "1 polygon of more than four corners was triangulated"
            if larger == 1
            else f"{larger} polygons of more than four corners were triangulated"
        )
    triangles_each = sizes - 2
    first_corner = np.repeat(np.cumsum(sizes) - sizes, triangles_each)
    first_triangle = np.repeat(np.cumsum(triangles_each) - triangles_each, triangles_each)
    step = np.arange(len(first_corner)) - first_triangle
    fan = np.stack([first_corner, first_corner + step + 1, first_corner + step + 2], axis=1)
    return polygons.corners[fan], tuple(notes)


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
