"""Whether a mesh is of a model's topology."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import PoseSetError
from lcollision_core.meshes import Topology


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
