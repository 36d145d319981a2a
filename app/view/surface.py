"""Meshes that change with every picture, and the actors that draw them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pyvista as pv
from vtkmodules.vtkRenderingCore import vtkPolyDataMapper


class Surface:
    """A triangle mesh; everything but its faces may change with every picture.

    Parameters
    ----------
    faces : (F, 3) integer array
    n_vertices : V
    n_channels : C, 3 for opaque colours or 4 with the opacity of each vertex

    Attributes
    ----------
    vertices, normals : (V, 3) float32 arrays that VTK reads and that are written in place
    colours : (V, C) uint8 array, likewise
    """

    def __init__(self, faces: npt.NDArray[Any], n_vertices: int, n_channels: int = 3) -> None:
        points = np.zeros((n_vertices, 3), dtype=np.float32)
        self.polydata = pv.PolyData.from_regular_faces(points, faces)
        data = self.polydata.point_data
        data.active_normals = points.copy()
        data.set_scalars(np.full((n_vertices, n_channels), 200, dtype=np.uint8), "colours")
        self.vertices, self.normals = self.polydata.points, data.active_normals
        self.colours = data["colours"]

    def draw(self, faces: npt.NDArray[np.integer]) -> None:
        """Draw other (F, 3) faces of the same vertices from now on."""
        self.polydata.SetPolys(pv.CellArray.from_regular_cells(faces))
        # Or else what picks would find the faces before.
        self.polydata.DeleteCells()


def actor_of(polydata: pv.PolyData, coloured: bool = False, **look: Any) -> pv.Actor:
    """Return what draws a mesh or lines, and is not picked.

    Parameters
    ----------
    coloured : by the mesh's active scalars, instead of one colour
    look : see `pyvista.Property`
    """
    mapper = vtkPolyDataMapper()
    mapper.SetInputData(polydata)
    mapper.SetScalarVisibility(coloured)
    actor = pv.Actor(mapper, pv.Property(interpolation="Gouraud", **look))
    actor.SetPickable(False)
    return actor


def body_actor(polydata: pv.PolyData, coloured: bool = True, **look: Any) -> pv.Actor:
    """Return what draws a body: `actor_of` with a body's shine."""
    shine = {"ambient": 0.22, "diffuse": 0.92, "specular": 0.1, "specular_power": 18}
    return actor_of(polydata, coloured, **shine, **look)
