"""Faces of a mesh in a colour of their own, also where something is in front of them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pyvista as pv

from app.view.surface import Surface, actor_of

_THROUGH_OPACITY = 0.22
_TO_THE_FRONT = -3.0e7  # in steps of a depth buffer of 24 bits: all of its range


class FaceHighlight:
    """Some faces of a surface, drawn over it; they follow its vertices.

    Parameters
    ----------
    surface : whose vertices are drawn
    faces : (F, 3) array, all faces of the mesh
    colour : "#rrggbb"
    layer : of two highlights of one face, that of the higher layer is seen; from 1

    Attributes
    ----------
    hidden : (F,) array, whether each face is drawn neither here nor on the body; None for none
    nearer, through : actors to be added to a renderer; what lies behind something, as on the far
        side or inside a limb, shines through
    """

    def __init__(
        self, surface: Surface, faces: npt.NDArray[np.int32], colour: str, layer: int
    ) -> None:
        self._faces = faces
        self.hidden: npt.NDArray[np.bool_] | None = None
        self._polydata = pv.PolyData()
        self._polydata.SetPoints(surface.polydata.GetPoints())
        self.nearer = actor_of(self._polydata, color=colour, ambient=0.55, diffuse=0.5)
        self.through = actor_of(
            self._polydata, color=colour, opacity=_THROUGH_OPACITY, lighting=False
        )
        # The same triangles are in the body: without an offset, rounding decides which is seen.
        for actor, offset in (
            (self.nearer, (-1.0 * layer, -2.0 * layer)),
            (self.through, (0.0, _TO_THE_FRONT)),
        ):
            actor.mapper.SetResolveCoincidentTopologyToPolygonOffset()
            actor.mapper.SetRelativeCoincidentTopologyPolygonOffsetParameters(*offset)
            actor.SetVisibility(False)

    def show(self, faces: npt.NDArray[np.integer] | None) -> None:
        """Draw faces, given by number in an array of any shape, None for no face."""
        chosen = np.unique(faces) if faces is not None else np.empty(0, dtype=np.int64)
        if self.hidden is not None:
            chosen = chosen[~self.hidden[chosen]]
        if len(chosen):
            self._polydata.SetPolys(pv.CellArray.from_regular_cells(self._faces[chosen]))
        self._set_visible(len(chosen) > 0)

    def look_like(self, other: FaceHighlight) -> None:
        """Show the faces that another one of the same mesh shows."""
        self._polydata.SetPolys(other._polydata.GetPolys())
        self._set_visible(other.n_faces > 0)

    @property
    def n_faces(self) -> int:
        """How many faces are drawn."""
        return int(self._polydata.GetNumberOfPolys()) if self.nearer.GetVisibility() else 0

    def _set_visible(self, visible: bool) -> None:
        for actor in (self.nearer, self.through):
            actor.SetVisibility(visible)
