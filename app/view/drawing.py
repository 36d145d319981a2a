"""The few things of VTK that all that is drawn in the scene is made of."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from vtkmodules.util.numpy_support import numpy_to_vtkIdTypeArray
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper

from app.view.shading import rgb


def actor_of(polydata: vtkPolyData) -> vtkActor:
    """Return what draws a mesh or lines in the one colour of its property."""
    mapper = vtkPolyDataMapper()
    mapper.SetInputData(polydata)
    mapper.SetScalarVisibility(False)
    actor = vtkActor()
    actor.SetMapper(mapper)
    return actor


def cells_of(corners: npt.NDArray[Any]) -> vtkCellArray:
    """Return the triangles or lines between (N, 3) or (N, 2) places of points."""
    cells = vtkCellArray()
    n_cells, n_corners = corners.shape
    offsets = np.arange(0, n_corners * n_cells + 1, n_corners, dtype=np.int64)
    places = np.ascontiguousarray(corners, dtype=np.int64).ravel()
    # Copies, since VTK does not hold on to NumPy's memory.
    cells.SetData(
        numpy_to_vtkIdTypeArray(offsets, deep=True), numpy_to_vtkIdTypeArray(places, deep=True)
    )
    return cells


def share_of(colour: str) -> tuple[float, float, float]:
    """Return red, green and blue of "#rrggbb" from 0 to 1, as VTK wants them."""
    red, green, blue = (rgb(colour) / 255.0).tolist()
    return red, green, blue
