"""Vertex normals."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled
from lcollision_core.meshes.topology import meeting_corners

_SHARP = np.radians(60.0)
"""Angle between two faces at rest above which their edge is sharp."""

_LEAST_SINE = 1e-9
"""Least sine of a corner's angle; below it, the triangle's normal is mostly rounding error."""

Array = npt.NDArray[np.floating[Any]]
Real = TypeVar("Real", bound=np.floating[Any])


def vertex_normals(
    vertices: npt.NDArray[Real], faces: npt.NDArray[np.integer]
) -> npt.NDArray[Real]:
    """Return unit vertex normals: means of the face normals weighted by area.

    Parameters
    ----------
    vertices : (V, 3) array
    faces : (F, 3) integer array

    Returns
    -------
    normals : (V, 3) array of the vertices' type; 0 at a vertex whose faces have no area
    """
    normals = np.zeros_like(vertices)
    _add_face_normals(vertices, faces, normals)
    lengths = np.sqrt(np.einsum("ij,ij->i", normals, normals))[:, None]
    np.divide(normals, lengths, out=normals, where=lengths > 0.0)
    return normals


def corner_normals(
    posed: npt.NDArray[np.floating[Any]],
    faces: npt.NDArray[np.integer],
    rest: npt.NDArray[np.floating[Any]],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Return the normals of a mesh's corners, smooth except over edges that are sharp at rest.

    Parameters
    ----------
    posed : (V, 3) array, the pose to compute normals of
    faces : (F, 3) integer array
    rest : (V, 3) array; an edge is sharp if its faces meet at more than `_SHARP` there

    Returns
    -------
    normals : (N, 3) array of unit vectors; 0 where faces have no area
    of_corner : (F, 3) array, index of each corner's normal
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    flat = unit(_area_normals(rest, faces))
    first, second = meeting_corners(faces)
    is_smooth = np.einsum("ij,ij->i", flat[first[0] // 3], flat[second[0] // 3]) >= np.cos(_SHARP)
    links = first[:, is_smooth].ravel(), second[:, is_smooth].ravel()
    graph = coo_array((np.ones(len(links[0]), dtype=np.bool_), links), shape=(faces.size,) * 2)
    n, of_corner = connected_components(graph, directed=False)
    areas = np.repeat(_area_normals(posed, faces), 3, axis=0)
    sums = np.stack([np.bincount(of_corner, axis, n) for axis in areas.T], axis=1)
    return unit(sums.astype(np.float64)), of_corner.astype(np.int64).reshape(faces.shape)


def _area_normals(
    vertices: npt.NDArray[np.floating[Any]], faces: npt.NDArray[np.integer]
) -> npt.NDArray[np.float64]:
    """Return the (F, 3) face normals, each as long as twice the face's area."""
    a, b, c = (vertices[column].astype(np.float64) for column in faces.T)
    normals: npt.NDArray[np.float64] = np.cross(b - a, c - a)
    return normals


def unit(vectors: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Normalise (n, 3) vectors; those of length 0 stay."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    units = np.zeros_like(vectors)
    np.divide(vectors, lengths, out=units, where=lengths > 0.0)
    return units


def moved_normals(
    normals: npt.NDArray[np.float64],
    owners: npt.NDArray[np.integer],
    corners: npt.NDArray[np.integer],
    rest: npt.NDArray[np.float64],
    posed: npt.NDArray[np.float64],
) -> npt.NDArray[np.float64]:
    """Transform the normals of a mesh at rest along with its triangles.

    Each triangle maps a normal by the inverse transpose of its linear map from rest to pose; the
    result is the mean weighted by area. This preserves smooth, flat and hand-made normals, and
    copies of a vertex at a seam keep equal normals if all have the same triangles.

    Parameters
    ----------
    normals : (N, 3) array
    owners : (C,) index of the normal that each triangle moves
    corners : (C, 3) vertex indices of each triangle; the angle at the first must not be 0
    rest, posed : (V, 3) arrays

    Returns
    -------
    moved : (N, 3) array of unit vectors; a normal stays if none of its triangles changes shape or
        all are without area
    """
    old, new = _corner_frames(rest, corners), _corner_frames(posed, corners)
    changes = np.zeros(len(normals), dtype=np.bool_)
    changes[owners[(old != new).any(axis=(1, 2))]] = True
    counts = changes[owners] & ~_is_thin(old) & ~_is_thin(new)
    owners, old, new = owners[counts], old[counts], new[counts]
    # The map from the rows of `old` to those of `new` is new^T old^-T; its inverse transpose is
    # new^-1 old.
    turned = np.linalg.solve(new, old @ normals[owners][:, :, None])[:, :, 0]
    turned = unit(turned)
    turned *= np.square(new[:, 2]).sum(axis=1, keepdims=True)
    sums = np.stack([np.bincount(owners, axis, len(normals)) for axis in turned.T], axis=1)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    moved = normals.copy()
    np.divide(sums, lengths, out=moved, where=lengths > 0.0)
    return moved


def _corner_frames(
    vertices: npt.NDArray[np.float64], corners: npt.NDArray[np.integer]
) -> npt.NDArray[np.float64]:
    """Return three rows for each of C triangles, (C, 3, 3): two edges and a normal.

    The normal's length is the square root of twice the area, so that scaling a mesh scales all
    three rows alike.
    """
    at, to, back = (vertices[column] for column in corners.T)
    edges = np.stack([to - at, back - at], axis=1)
    across = np.cross(edges[:, 0], edges[:, 1])
    length = np.sqrt(np.linalg.norm(across, axis=1, keepdims=True))
    across = np.divide(across, length, out=np.zeros_like(across), where=length > 0.0)
    return np.concatenate([edges, across[:, None]], axis=1)


def _is_thin(frames: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    first, second, across = np.linalg.norm(frames, axis=2).T
    is_thin: npt.NDArray[np.bool_] = across**2 <= _LEAST_SINE * first * second
    return is_thin


@compiled
def _add_face_normals(vertices: Array, faces: npt.NDArray[np.integer], normals: Array) -> None:
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        a, b, c = vertices[i], vertices[j], vertices[k]
        ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for vertex in (i, j, k):
            normals[vertex, 0] += nx
            normals[vertex, 1] += ny
            normals[vertex, 2] += nz
