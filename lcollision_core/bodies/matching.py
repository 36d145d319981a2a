"""Whether a mesh is of a model's topology, and can be encoded."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import PoseSetError, ShapeError, WrongScaleError
from lcollision_core.files import can_hold
from lcollision_core.meshes import Topology, body_size
from lcollision_core.meshes.outliers import LARGEST_SIZE, is_torn, scale_of
from lcollision_core.meshes.topology import FloatArray

_MOST_SIZE = 20.0
"""Of meshes whose edges are not scaled alike."""

_UNITS = (0.001, 0.01, 0.0254, 0.1, 0.3048, 1.0)
"""Metres in a millimetre, centimetre, inch, decimetre, foot and metre."""


def require_same_faces(topology: Topology, needed: Topology, source: str, model: str) -> None:
    """Refuse a mesh whose faces are not a model's, in any order.

    Parameters
    ----------
    topology : the mesh's
    needed : the model's
    source, model : names of the two in the message

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
                f"has {found} {noun}, the model {model!r} has {count}",
                "export it with the model's topology",
                where=source,
            )
    if topology != needed and not np.array_equal(
        sorted_faces(topology.faces), sorted_faces(needed.faces)
    ):
        raise PoseSetError(
            f"has other faces than the model {model!r}",
            "export it with the model's topology and vertex order",
            where=source,
        )


def sorted_faces(faces: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Turn each face until its least vertex comes first, then sort the faces."""
    turned = (np.arange(3) + faces.argmin(axis=1)[:, None]) % 3
    rows = np.take_along_axis(faces, turned, axis=1)
    return rows[np.lexsort(rows.T)]


def checked_mesh(
    vertices: npt.ArrayLike,
    reference: FloatArray,
    topology: Topology,
    model: str,
    scale: float = 1.0,
) -> FloatArray:
    """Return a mesh that a model can encode as a float64 array, in the data's unit.

    Parameters
    ----------
    vertices : (V, 3) array
    reference : (V, 3) array, the model's
    topology : of both
    model : its name
    scale : brings `vertices` into the data's unit

    Raises
    ------
    ShapeError : another shape, a coordinate that is not finite, or a scale that is not above 0.
    WrongScaleError : larger or smaller than the reference, as in another unit.
    PoseSetError : with its vertices in another order, or too far from the origin for its digits.
    """
    if not 0.0 < scale < np.inf:
        raise ShapeError.must_be("the scale", "a number above 0", f"{scale:g}")
    mesh = np.asarray(vertices, dtype=np.float64)
    if mesh.shape != reference.shape:
        raise ShapeError.must_be(f"a mesh of {model}", f"of shape {reference.shape}", mesh.shape)
    if not np.isfinite(mesh).all():
        vertex = int(np.flatnonzero(~np.isfinite(mesh).all(axis=1))[0])
        raise ShapeError("is not finite", where=f"vertex {vertex} (from 0)")
    if not can_hold(mesh, topology, np.float64):
        raise PoseSetError(
            "the mesh lies so far from the origin that its coordinates lose their digits",
            "move it nearer to the origin",
        )
    mesh = mesh * scale
    lengths, known = (topology.edge_lengths(one) for one in (mesh, reference))
    size, limit = scale_of(lengths, known), LARGEST_SIZE
    if size is None:
        # Not scaled uniformly: perhaps no pose, but no other unit unless it is far off.
        size, limit = body_size(mesh, topology) / body_size(reference, topology), _MOST_SIZE
    if not 1.0 / limit < size < limit:
        sentence = (
            f"the mesh is {float(f'{size:.3g}'):g} times as large as the body of {model!r}, "
            f"which is {body_size(reference, topology):.3g} tall in its own unit"
        )
        if not 0.0 < size < np.inf:
            raise PoseSetError(sentence, "export it again")
        factor = likely_factor(1.0 / size) * scale
        raise WrongScaleError(sentence, f"scale it by {factor:.6g}", factor=factor)
    if is_torn(lengths, size * known):
        raise PoseSetError(
            f"the edges of the mesh join other vertices than those of {model!r}, as if in "
            "another order",
            "export it with the model's vertex order",
        )
    return mesh


def likely_factor(measured: float) -> float:
    """Return the factor between two usual units that is nearest to a measured one.

    Parameters
    ----------
    measured : > 0, the measured ratio of sizes

    Returns
    -------
    factor : such as 1000, 39.3701 or 2.54; `measured`, to three digits, where none is within the
        sizes that bodies have
    """
    factors = np.array([one / other for one in _UNITS for other in _UNITS])
    distances = np.abs(np.log(factors / measured))
    if distances.min() > np.log(LARGEST_SIZE):
        return float(f"{measured:.3g}")
    return float(f"{factors[distances.argmin()]:.6g}")
