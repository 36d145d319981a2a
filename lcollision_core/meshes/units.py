"""The unit of length that all reports share, and which way is up."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import ShapeError


def _box(vertices: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) == 0:
        raise ShapeError(f"vertices must be a (V, 3) array with V > 0, got {vertices.shape}")
    points = np.asarray(vertices, dtype=np.float64)
    sides: npt.NDArray[np.float64] = points.max(axis=0) - points.min(axis=0)
    return sides


def height(vertices: npt.NDArray[Any]) -> float:
    """Return the height of a mesh: the longest side of its bounding box.

    Parameters
    ----------
    vertices : (V, 3) array, the reference mesh, in the file's unit

    Returns
    -------
    the height in the same unit; lengths in reports are divided by it

    Raises
    ------
    ShapeError : `vertices` is not (V, 3), or empty.
    """
    return float(_box(vertices).max())


def up_axis(vertices: npt.NDArray[Any]) -> int:
    """Return the axis along which a mesh is longest: 0, 1 or 2 for x, y or z.

    Parameters
    ----------
    vertices : (V, 3) array, the reference mesh

    Raises
    ------
    ShapeError : `vertices` is not (V, 3), or empty.
    """
    return int(_box(vertices).argmax())
