"""Whether a number format can hold a mesh at its location, for reading and writing."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.mesh_formats import MESH_FORMATS
from lcollision_core.meshes.topology import Topology

SINGLE_PRECISION = (
    *(f".{name}" for name, held in MESH_FORMATS.items() if held.is_single),
    *(".vrm", ".pc2", ".mdd"),
)
"""Formats that hold only float32; the others hold either precision."""

LARGEST_RATIO = 0.01
"""Largest rounding step of a coordinate, relative to a short edge: beyond it, faces lose their
shape, and results for a mesh do not hold for its file."""

_SHORT_EDGES = 10.0
"""Per cent of the edges that are at most as long as a short edge."""


def rounding_step(
    vertices: npt.NDArray[Any], topology: Topology, dtype: npt.DTypeLike
) -> tuple[float, float]:
    """Return the largest rounding step of a mesh's coordinates, and its ratio to a short edge.

    Parameters
    ----------
    vertices : (V, 3) finite array; those that no face uses do not count
    topology : of the mesh
    dtype : float32 or float64, which the coordinates are to be stored in

    Returns
    -------
    step : in the mesh's unit
    ratio : the step over the length that a tenth of the edges have at most, those without length
        aside; 0 where no edge has one
    """
    used = np.asarray(vertices, dtype=np.float64)[topology.picked]
    farthest = float(np.abs(used).max())
    # Beyond the largest number there is none to step to.
    nearer = min(farthest, float(np.finfo(dtype).max) / 2.0)
    step = float(np.spacing(np.asarray(nearer, dtype=dtype)))
    # Measured as fractions of that, as no square of such a fraction overflows.
    points = np.zeros((topology.n_vertices, 3))
    points[topology.picked] = used / (farthest or 1.0)
    lengths = topology.edge_lengths(points)
    lengths = lengths[lengths > 0.0]
    if not len(lengths):
        return step, 0.0
    return step, step / farthest / float(np.percentile(lengths, _SHORT_EDGES))


def can_hold(vertices: npt.NDArray[Any], topology: Topology, dtype: npt.DTypeLike) -> bool:
    """Tell whether rounding to a number format preserves the shape of a mesh at its location.

    Parameters and terms are those of `rounding_step`.
    """
    return rounding_step(vertices, topology, dtype)[1] <= LARGEST_RATIO


def as_stored(
    path: str | os.PathLike[str], vertices: npt.NDArray[Any], topology: Topology
) -> npt.NDArray[Any]:
    """Round vertices to what a mesh file of them holds.

    Parameters
    ----------
    path : its extension says the format
    vertices : (V, 3) finite array
    topology : of the mesh

    Returns
    -------
    stored : (V, 3) float32 array for formats of single precision, else as `vertices` is

    Raises
    ------
    MeshFileError : the rounding steps exceed `LARGEST_RATIO` of a short edge, or a coordinate
        exceeds the format.
    """
    suffix = Path(path).suffix.lower()
    dtype = np.float32 if suffix in SINGLE_PRECISION else np.float64
    if float(np.abs(vertices).max()) > float(np.finfo(dtype).max):
        raise MeshFileError.unwritable(
            path, f"a coordinate exceeds float32, which {suffix} stores", "write .ply or .obj"
        )
    stored = np.asarray(vertices, dtype) if dtype is np.float32 else np.asarray(vertices)
    # Already rounded: not rounded again.
    if stored.dtype != vertices.dtype or stored.dtype == np.float64:
        step, ratio = rounding_step(vertices, topology, dtype)
        if ratio > LARGEST_RATIO:
            advice = "write .obj, .ply or .off, or move" if dtype is np.float32 else "move"
            raise MeshFileError.unwritable(
                path,
                f"so far from the origin {suffix} rounds coordinates to "
                f"steps of {step:.2g}, {ratio:.0%} of a short edge",
                f"{advice} the mesh nearer to the origin",
            )
    return stored
