"""The outline of one body part, drawn over whatever the colours of the mesh say."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pyvista as pv

from app.view.camera import VIEW_ANGLE
from app.view.surface import actor_of

if TYPE_CHECKING:
    from vtkmodules.vtkRenderingCore import vtkRenderer

Float32Array = npt.NDArray[np.float32]

_STROKES = ((1.4, "#ffffff", 9.0), (3.0, "#14171c", 6.0))
"""Width to each side, colour, and how much before the skin the border is drawn that lies in it,
both in device-independent pixels; the inner first: seen on any colour."""

_SMOOTHINGS = 4

_BORDER_WIDTH = 1.5
"""Times the width to one side: on the body a line of both sides would look heavier than the rim."""


@dataclass(frozen=True, eq=False)
class PartShape:
    """The region of the mesh that a body part is, whatever the pose.

    Attributes
    ----------
    ends : (P, 2) integer array, the mesh edges that the border of the part crosses
    fractions : (P, 1) float32 array, where: 0 at the first end, 1 at the second
    segments : (S, 2) integer array, pieces of the border between those P points
    vertices : (Q,) integer array, the vertices of faces that are all the part's
    faces : (F, 3) integer array, these faces, as indices into `vertices`
    """

    ends: npt.NDArray[np.int64]
    fractions: Float32Array
    segments: npt.NDArray[np.int64]
    vertices: npt.NDArray[np.int64]
    faces: npt.NDArray[np.int64]

    @classmethod
    def of(
        cls, attention_mask: npt.NDArray[Any], faces: npt.NDArray[Any], domain: int
    ) -> PartShape:
        """Find the vertices where a domain has the largest weight, and their border.

        Parameters
        ----------
        attention_mask : (K, V) array, each column sums to 1
        faces : (F, 3) integer array
        domain : index from 0
        """
        own = attention_mask[domain].astype(np.float64)
        others = np.delete(attention_mask, domain, axis=0).max(axis=0, initial=0.0)
        lead = _smooth(own - others, faces)
        if not (lead > 0.0).any():
            # It has the largest weight nowhere: its region is where its weight is large.
            lead = own - 0.5 * own.max()
        inside = (lead > 0.0)[faces]
        count = inside.sum(axis=1)
        crossed = np.flatnonzero((count == 1) | (count == 2))
        # The corner that is alone on its side: the border leaves the face by its two edges.
        alone = (inside[crossed] == (count[crossed] == 1)[:, None]).argmax(axis=1)
        corner, after, before = (
            faces[crossed, (alone + step) % 3].astype(np.int64) for step in range(3)
        )
        pairs = np.sort(np.stack([corner, after, corner, before], axis=1).reshape(-1, 2), axis=1)
        ends, index = np.unique(pairs, axis=0, return_inverse=True)
        at_first, at_second = lead[ends[:, 0]], lead[ends[:, 1]]
        fractions = (at_first / (at_first - at_second)).astype(np.float32)
        vertices, corners = np.unique(faces[count == 3], return_inverse=True)
        return cls(
            ends=ends,
            fractions=fractions[:, None],
            segments=index.reshape(-1, 2),
            vertices=vertices.astype(np.int64),
            faces=corners.reshape(-1, 3),
        )

    def border(self, vertices: Float32Array) -> Float32Array:
        """Return the (P, 3) points of the border on a (V, 3) pose."""
        first, second = vertices[self.ends[:, 0]], vertices[self.ends[:, 1]]
        points: Float32Array = first + self.fractions * (second - first)
        return points


class Outline:
    """Draws a part's border on the body and the rim of its silhouette, in a constant width.

    The rim is the part's own skin, a little larger, with only its back faces drawn: where
    the body does not hide it, it stands out round the part. The colours of the mesh do not change.

    Parameters
    ----------
    renderer : to draw in
    """

    def __init__(self, renderer: vtkRenderer) -> None:
        self._renderer = renderer
        self._shape: PartShape | None = None
        self._strokes = []
        for width, colour, nearer in _STROKES:
            border, shell = pv.PolyData(), pv.PolyData()
            line = actor_of(border, color=colour, lighting=False)
            # Only its far side is seen, beside the part.
            rim = actor_of(shell, color=colour, lighting=False, culling="front")
            for actor in (line, rim):
                actor.SetVisibility(False)
                renderer.AddActor(actor)
            self._strokes.append((width, nearer, border, shell, line, rim))

    @property
    def is_shown(self) -> bool:
        """Whether a part is outlined."""
        return self._shape is not None

    def show(self, shape: PartShape | None) -> None:
        """Outline a part from the next `fit` on, or none."""
        self._shape = shape
        for _, _, border, shell, *actors in self._strokes:
            if shape is not None:
                border.points = np.zeros((len(shape.ends), 3), dtype=np.float32)
                border.SetLines(pv.CellArray.from_regular_cells(shape.segments))
                shell.points = np.zeros((len(shape.vertices), 3), dtype=np.float32)
                shell.SetPolys(pv.CellArray.from_regular_cells(shape.faces))
            for actor in actors:
                actor.SetVisibility(shape is not None)

    def fit(self, vertices: Float32Array, normals: Float32Array, sharpness: float) -> None:
        """Follow the pose and the camera.

        Parameters
        ----------
        vertices, normals : (V, 3) float32 arrays
        sharpness : device pixels per device-independent one
        """
        shape = self._shape
        if shape is None:
            return
        border = shape.border(vertices)
        skin, outward = vertices[shape.vertices], normals[shape.vertices]
        eye = np.array(self._renderer.GetActiveCamera().GetPosition(), dtype=np.float32)
        middle = np.concatenate([border, skin]).mean(axis=0)
        distance = float(np.linalg.norm(eye - middle))
        n_pixels = max(1, self._renderer.GetSize()[1]) / sharpness
        pixel = 2.0 * distance * np.tan(np.radians(0.5 * VIEW_ANGLE)) / n_pixels
        for width, nearer, lines, shell, line, _ in self._strokes:
            lines.points = border + np.float32(nearer * pixel / distance) * (eye - border)
            shell.points = skin + np.float32(width * pixel) * outward
            line.prop.line_width = _BORDER_WIDTH * width * sharpness


def _smooth(values: npt.NDArray[np.float64], faces: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Average (V,) values over the faces round each vertex, which smooths a border between them."""
    corners = faces.ravel()
    n_faces = np.maximum(np.bincount(corners, minlength=len(values)), 1)
    for _ in range(_SMOOTHINGS):
        of_faces = np.repeat(values[faces].mean(axis=1), 3)
        values = np.bincount(corners, of_faces, minlength=len(values)) / n_faces
    return values
