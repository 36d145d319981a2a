"""What stands in front of the camera: the mesh, its ghost, the floor and the light."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkPolyData
from vtkmodules.vtkCommonMath import vtkMatrix4x4

from app.view.camera import VIEW_ANGLE, View
from app.view.drawing import actor_of, cells_of, share_of
from app.view.outline import Outline
from app.view.shading import COLLIDING_FACE, rgb
from app.view.waiting import BACKGROUND

if TYPE_CHECKING:
    from pyvista import BasePlotter

_FLOOR = {False: ("#d3d9e1", "#c2c9d3"), True: ("#2a2f37", "#1d2127")}
_GHOST = {False: "#6b7c93", True: "#c3d2e6"}
_GHOST_OPACITY = 0.4
_GHOST_NEAR, _GHOST_FAR = 0.004, 0.015
"""Distances from the body, in its height, at which the ghost begins to show and shows in full."""

_THROUGH_OPACITY = 0.22
_TO_THE_FRONT = -3.0e7  # in steps of a depth buffer of 24 bits: all of its range
_FLOOR_RADIUS = 0.62
_FLOOR_SIDES = 96

Float32Array = npt.NDArray[np.float32]


class Surface:
    """A triangle mesh of which everything but its faces may change at every frame.

    Parameters
    ----------
    faces : (F, 3) integer array
    n_vertices : V
    n_channels : C, 3 for opaque colours or 4 with how opaque each vertex is

    Attributes
    ----------
    vertices, normals : (V, 3) float32 arrays that VTK reads; write into them, then `touch`
    colours : (V, C) uint8 array, likewise
    """

    def __init__(self, faces: npt.NDArray[Any], n_vertices: int, n_channels: int = 3) -> None:
        self.vertices = np.zeros((n_vertices, 3), dtype=np.float32)
        self.normals = np.zeros((n_vertices, 3), dtype=np.float32)
        self.colours = np.full((n_vertices, n_channels), 200, dtype=np.uint8)
        points = vtkPoints()
        points.SetData(numpy_to_vtk(self.vertices))
        self.polydata = vtkPolyData()
        self.polydata.SetPoints(points)
        self.polydata.SetPolys(cells_of(faces))
        self._normals = numpy_to_vtk(self.normals)
        self._colours = numpy_to_vtk(self.colours)
        self.polydata.GetPointData().SetNormals(self._normals)
        self.polydata.GetPointData().SetScalars(self._colours)

    def touch(self, colours: bool = True) -> None:
        """Tell VTK that the arrays have new numbers in them."""
        points = self.polydata.GetPoints()
        points.GetData().Modified()
        points.Modified()
        self._normals.Modified()
        if colours:
            self._colours.Modified()
        self.polydata.Modified()


class Scene:
    """Fills a plotter's renderer, on the screen or off it.

    Parameters
    ----------
    plotter : empty
    faces : (F, 3) integer array
    n_vertices : V
    up_axis : 0, 1 or 2
    height : of the body, in the data's unit
    dark : for a dark theme
    """

    def __init__(
        self,
        plotter: BasePlotter,
        faces: npt.NDArray[Any],
        n_vertices: int,
        up_axis: int,
        height: float,
        dark: bool = False,
    ) -> None:
        self._renderer = plotter.renderer
        self._faces = faces
        self._up_axis = up_axis
        self._height = height
        self.surface = Surface(faces, n_vertices)
        self.body = actor_of(self.surface.polydata)
        self.body.GetMapper().SetScalarVisibility(True)
        shine = self.body.GetProperty()
        shine.SetAmbient(0.22)
        shine.SetDiffuse(0.92)
        shine.SetSpecular(0.1)
        shine.SetSpecularPower(18.0)

        self._ghost = Surface(faces, n_vertices, n_channels=4)
        self._ghost_actor = actor_of(self._ghost.polydata)
        self._ghost_actor.GetMapper().SetScalarVisibility(True)
        self._ghost_actor.ForceTranslucentOn()
        self._ghost_actor.GetProperty().SetAmbient(0.4)
        self._ghost_actor.GetProperty().SetDiffuse(0.7)
        self._ghost_actor.GetProperty().BackfaceCullingOn()
        self._ghost_actor.SetPickable(False)
        self._ghost_actor.SetVisibility(False)

        self._crossing = vtkPolyData()
        self._crossing.SetPoints(self.surface.polydata.GetPoints())
        self._crossing_actor = actor_of(self._crossing)
        self._crossing_actor.SetPickable(False)
        self._crossing_actor.SetVisibility(False)
        red = self._crossing_actor.GetProperty()
        red.SetColor(*share_of(COLLIDING_FACE))
        red.SetAmbient(0.55)
        red.SetDiffuse(0.5)
        # The same triangles are in the body: without an offset the two fight for each pixel.
        nearer = self._crossing_actor.GetMapper()
        nearer.SetResolveCoincidentTopologyToPolygonOffset()
        nearer.SetRelativeCoincidentTopologyPolygonOffsetParameters(-2.0, -4.0)

        # A collision on the far side, or inside a limb, shines through.
        self._through_actor = actor_of(self._crossing)
        self._through_actor.SetPickable(False)
        self._through_actor.SetVisibility(False)
        through = self._through_actor.GetProperty()
        through.SetColor(*share_of(COLLIDING_FACE))
        through.SetOpacity(_THROUGH_OPACITY)
        through.LightingOff()
        foremost = self._through_actor.GetMapper()
        foremost.SetResolveCoincidentTopologyToPolygonOffset()
        foremost.SetRelativeCoincidentTopologyPolygonOffsetParameters(0.0, _TO_THE_FRONT)

        self._floor_actor = actor_of(_disc(up_axis, _FLOOR_RADIUS * height))
        self._floor_actor.GetProperty().BackfaceCullingOn()
        self._shadow_actor = actor_of(self.surface.polydata)
        self._lift = 2e-3 * height
        for actor in (self._floor_actor, self._shadow_actor):
            actor.GetProperty().LightingOff()
            actor.SetPickable(False)
        self._actors = (
            self._floor_actor,
            self._shadow_actor,
            self.body,
            self._crossing_actor,
            self._ghost_actor,
            self._through_actor,
        )
        for actor in self._actors:
            self._renderer.AddActor(actor)
        self.outline = Outline(self._renderer)
        self._floor_shown = True
        self.set_dark(dark)

    def remove(self) -> None:
        """Take everything out of the renderer, for another scene."""
        for actor in self._actors:
            self._renderer.RemoveActor(actor)
        self.outline.remove()

    def set_dark(self, dark: bool) -> None:
        """Take the colours of the light or the dark theme."""
        bottom, top = BACKGROUND[dark]
        self._renderer.SetBackground(*share_of(bottom))
        self._renderer.SetBackground2(*share_of(top))
        self._renderer.SetGradientBackground(True)
        floor, shadow = _FLOOR[dark]
        self._floor_actor.GetProperty().SetColor(*share_of(floor))
        self._shadow_actor.GetProperty().SetColor(*share_of(shadow))
        self._ghost.colours[:, :3] = rgb(_GHOST[dark])
        self._ghost.touch()

    def show_floor(self, shown: bool) -> None:
        """Draw or hide the floor and the shadow on it."""
        self._floor_shown = shown
        self._floor_actor.SetVisibility(shown)
        self._shadow_actor.SetVisibility(shown)

    def set_plain_background(self, colour: str) -> None:
        """Put one colour, "#rrggbb", behind everything, as pictures to be cut out need it."""
        self._renderer.SetGradientBackground(False)
        self._renderer.SetBackground(*share_of(colour))

    def show(
        self,
        vertices: npt.NDArray[Any],
        normals: npt.NDArray[Any],
        colours: npt.NDArray[np.uint8] | None = None,
    ) -> None:
        """Put the mesh in another pose, in place.

        Parameters
        ----------
        vertices, normals : (V, 3) arrays
        colours : (V, 3) uint8 array; the last ones where None
        """
        self.surface.vertices[:] = vertices
        self.surface.normals[:] = normals
        if colours is not None:
            self.surface.colours[:] = colours
        self.surface.touch(colours is not None)
        if self.ghost_shown:
            self._fade_ghost()
        if self._floor_shown:
            self._lay_floor(float(self.surface.vertices[:, self._up_axis].min()))

    def paint(self, colours: npt.NDArray[np.uint8]) -> None:
        """Colour the mesh where it is; (V, 3) uint8 array."""
        self.surface.colours[:] = colours
        self.surface.touch()

    def show_ghost(
        self, vertices: npt.NDArray[Any] | None, normals: npt.NDArray[Any] | None = None
    ) -> None:
        """Draw a translucent second pose, or none; (V, 3) arrays."""
        if vertices is not None:
            self._ghost.vertices[:] = vertices
            self._ghost.normals[:] = normals
            self._fade_ghost()
        self._ghost_actor.SetVisibility(vertices is not None)

    def show_crossing(self, pairs: npt.NDArray[np.int32] | None) -> None:
        """Draw the faces that intersect another in red.

        Parameters
        ----------
        pairs : (P, 2) array, indices of faces; None for no face
        """
        chosen = np.unique(pairs) if pairs is not None else np.zeros(0, dtype=np.int32)
        if len(chosen):
            self._crossing.SetPolys(cells_of(self._faces[chosen]))
            self._crossing.Modified()
        self._crossing_actor.SetVisibility(len(chosen) > 0)
        self._through_actor.SetVisibility(len(chosen) > 0)

    def fit_outline(self, sharpness: float) -> None:
        """Let the outline follow the pose and the camera, just before a picture.

        Parameters
        ----------
        sharpness : device pixels per device-independent one
        """
        self.outline.fit(self.surface.vertices, self.surface.normals, sharpness)

    def look_like(self, other: Scene) -> None:
        """Show what another scene of the same mesh shows, from where it is looked at."""
        self.show(other.surface.vertices, other.surface.normals, other.surface.colours)
        self._crossing.SetPolys(other._crossing.GetPolys())
        if other.ghost_shown:
            self.show_ghost(other._ghost.vertices, other._ghost.normals)
        for actor, like in (
            (self._crossing_actor, other._crossing_actor),
            (self._through_actor, other._through_actor),
        ):
            actor.SetVisibility(like.GetVisibility())
        self.view = other.view

    @property
    def ghost_shown(self) -> bool:
        """Whether a second pose is drawn."""
        return bool(self._ghost_actor.GetVisibility())

    @property
    def n_crossing(self) -> int:
        """How many faces are drawn in red."""
        shown = self._crossing_actor.GetVisibility()
        return int(self._crossing.GetNumberOfPolys()) if shown else 0

    @property
    def view(self) -> View:
        """From where the camera looks."""
        camera = self._renderer.GetActiveCamera()
        return View(
            np.array(camera.GetPosition()),
            np.array(camera.GetFocalPoint()),
            np.array(camera.GetViewUp()),
        )

    @view.setter
    def view(self, view: View) -> None:
        camera = self._renderer.GetActiveCamera()
        camera.SetPosition(*view.position)
        camera.SetFocalPoint(*view.focus)
        camera.SetViewUp(*view.up)
        camera.SetViewAngle(VIEW_ANGLE)
        self._renderer.ResetCameraClippingRange()
        # Or else pyvista turns the camera to a view of its own at the first frame.
        self._renderer.camera_set = True

    def _fade_ghost(self) -> None:
        """Leave of the ghost what the body has moved away from.

        Where both lie on each other they would be seen in patches, by which is a hair nearer.
        """
        away = np.linalg.norm(self._ghost.vertices - self.surface.vertices, axis=1) / self._height
        share = np.clip((away - _GHOST_NEAR) / (_GHOST_FAR - _GHOST_NEAR), 0.0, 1.0)
        self._ghost.colours[:, 3] = np.rint(255.0 * _GHOST_OPACITY * share)
        self._ghost.touch()

    def _lay_floor(self, level: float) -> None:
        place = [0.0, 0.0, 0.0]
        place[self._up_axis] = level - self._lift
        low, high = self.surface.vertices.min(axis=0), self.surface.vertices.max(axis=0)
        for axis in range(3):
            if axis != self._up_axis:
                place[axis] = float(0.5 * (low[axis] + high[axis]))
        self._floor_actor.SetPosition(*place)
        flat = vtkMatrix4x4()
        flat.SetElement(self._up_axis, self._up_axis, 0.0)
        flat.SetElement(self._up_axis, 3, level - 0.5 * self._lift)
        self._shadow_actor.SetUserMatrix(flat)


def _disc(up_axis: int, radius: float) -> vtkPolyData:
    angle = np.linspace(0.0, 2.0 * np.pi, _FLOOR_SIDES, endpoint=False)
    points = np.zeros((_FLOOR_SIDES + 1, 3), dtype=np.float32)
    points[1:, (up_axis + 1) % 3] = radius * np.cos(angle)
    points[1:, (up_axis + 2) % 3] = radius * np.sin(angle)
    rim = np.arange(_FLOOR_SIDES)
    fan = np.stack([np.zeros_like(rim), rim + 1, (rim + 1) % _FLOOR_SIDES + 1], axis=1)
    disc = vtkPolyData()
    held = vtkPoints()
    held.SetData(numpy_to_vtk(points, deep=True))
    disc.SetPoints(held)
    disc.SetPolys(cells_of(fan))
    return disc
