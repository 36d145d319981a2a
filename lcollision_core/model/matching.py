"""Whether a mesh is of a model's topology, and fit to be encoded."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import PoseSetError, ShapeError
from lcollision_core.meshes import Topology, height
from lcollision_core.meshes.likeness import LARGEST_SIZE, is_torn, scale_of
from lcollision_core.meshes.topology import FloatArray

_MOST_SIZE = 20.0
"""Of meshes whose edges are not scaled alike."""


def require_same_faces(topology: Topology, needed: Topology, source: str, model: str) -> None:
    """Refuse a mesh whose faces are not a model's, in whatever order they come.

    Parameters
    ----------
    topology : the mesh's
    needed : the model's
    source, model : what the sentence calls the two

    Raises
    ------
    PoseSetError : another number of vertices or faces, or other faces.
    """
    for noun, found, count in (
        ("vertices", topology.n_vertices, needed.n_vertices),
        ("faces", topology.n_faces, needed.n_faces),
    ):
        if found != count:
            raise PoseSetError(
                f"{source} has {found} {noun}, the model {model!r} has {count}; export it with "
                f"the model's topology"
            )
    if topology != needed and not np.array_equal(
        _sorted_faces(topology.faces), _sorted_faces(needed.faces)
    ):
        raise PoseSetError(
            f"{source} has other faces than the model {model!r}; export it with the model's "
            f"topology and vertex order"
        )


def _sorted_faces(faces: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Turn each face until its least vertex comes first, then sort the faces."""
    turned = (np.arange(3) + faces.argmin(axis=1)[:, None]) % 3
    rows = np.take_along_axis(faces, turned, axis=1)
    return rows[np.lexsort(rows.T)]


def checked_mesh(
    vertices: npt.ArrayLike, reference: FloatArray, topology: Topology, model: str
) -> FloatArray:
    """Return a mesh that a model can encode as a float64 array.

    Parameters
    ----------
    vertices : (V, 3) array, in the data's unit
    reference : (V, 3) array, the model's
    topology : of both
    model : its name

    Raises
    ------
    ShapeError : another shape, or a coordinate that is not finite.
    PoseSetError : larger or smaller than the reference, as in another unit, or with its vertices
        in another order.
    """
    mesh = np.asarray(vertices, dtype=np.float64)
    if mesh.shape != reference.shape:
        raise ShapeError(f"a mesh of {model} has shape {reference.shape}, got {mesh.shape}")
    if not np.isfinite(mesh).all():
        vertex = int(np.flatnonzero(~np.isfinite(mesh).all(axis=1))[0])
        raise ShapeError(f"vertex {vertex} (from 0) is not finite")
    lengths, known = (topology.edge_lengths(one) for one in (mesh, reference))
    scale, limit = scale_of(lengths, known), LARGEST_SIZE
    if scale is None:
        # Not scaled as a whole: not a pose perhaps, but no other unit unless it is far off.
        scale, limit = height(mesh, topology) / height(reference, topology), _MOST_SIZE
    if not 1.0 / limit < scale < limit:
        advice = f"scale it by {1.0 / scale:.3g}" if 0.0 < scale < np.inf else "export it again"
        raise PoseSetError(
            f"the mesh is {scale:.3g} times as large as the body of {model!r}, which is "
            f"{height(reference, topology):.3g} tall in its own unit; {advice}"
        )
    if is_torn(lengths, scale * known):
        raise PoseSetError(
            f"the mesh has other vertices joined than the body of {model!r}, as if they came in "
            f"another order; export it with the model's vertex order"
        )
    return mesh
