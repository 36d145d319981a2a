"""Vertex normals."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled

Array = npt.NDArray[np.floating[Any]]
Real = TypeVar("Real", bound=np.floating[Any])


def vertex_normals(
    vertices: npt.NDArray[Real], faces: npt.NDArray[np.integer]
) -> npt.NDArray[Real]:
    """Return the vertices' normals: the means of their faces' normals by area, of length 1.

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
