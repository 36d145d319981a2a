"""The scene: the mesh, its ghost, the floor and the light."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pyvista as pv

from app.view.actors import (
    FaceHighlight,
    Marks,
    MotionMarks,
    Outline,
    PartShape,
    Patch,
    Surface,
    TexturedBody,
    body_actor,
    make_actor,
)
from app.view.camera import VIEW_ANGLE, FloatArray, View
from app.view.shading import COLLIDING_FACE, NAMED_FACE, UNCOUNTED_FACE

if TYPE_CHECKING:
    from app.view.shading import Theme
    from app.work.frames import PoseFrame
    from lcollision_core.bodies import Body

_GHOST_OPACITY = 0.4
_GHOST_NEAR, _GHOST_FAR = 0.004, 0.015
"""Normalised distances from the body at which the ghost starts to appear and is fully shown."""

_FLOOR_RADIUS = 0.62


class Scene:
    """Draw a body in a plotter's renderer, on or off screen.

    Parameters
    ----------
    plotter : its content is removed
    model : of the poses to show
    theme : whose colours are used

    Attributes
    ----------
    crossing, uncounted : faces of colliding pairs, and of pairs that do not count
    selection : faces selected in a list
    motion : onion skins and the motion path of a point
    patch : of a grip, over the colours of the mesh
    """

    def __init__(self, plotter: pv.BasePlotter, model: Body, theme: Theme) -> None:
        self._renderer = plotter.renderer
        self._renderer.RemoveAllViewProps()
        self._faces, self._up = model.faces, np.array(model.up)
        self.surface = Surface(model.faces, model.n_vertices)
        self.body = body_actor(self.surface.polydata)
        self.body.SetPickable(True)
        self._model = model
        self._textured: TexturedBody | None = None
        self._hidden: npt.NDArray[np.bool_] | None = None

        self._ghost = Surface(model.faces, model.n_vertices, n_channels=4)
        self._ghost_actor = make_actor(
            self._ghost.polydata, True, ambient=0.4, diffuse=0.7, culling="back"
        )
        self._ghost_actor.ForceTranslucentOn()
        self._ghost_actor.SetVisibility(False)

        self.uncounted = FaceHighlight(self.surface, model.faces, UNCOUNTED_FACE, 1)
        self.crossing = FaceHighlight(self.surface, model.faces, COLLIDING_FACE, 2)
        self.selection = FaceHighlight(self.surface, model.faces, NAMED_FACE, 3)
        self._highlights = (self.uncounted, self.crossing, self.selection)

        # Several bodies stand beside each other: their floor is as wide as they are.
        extents = np.ptp(model.without_ground(model.reference), axis=0)
        radius = _FLOOR_RADIUS * max(model.body_size, *np.delete(extents, model.up_axis))
        disc = pv.Disc(inner=0.0, outer=radius, normal=self._up, c_res=96)
        self._floor = make_actor(disc, lighting=False, culling="back")
        self._shadow = make_actor(self.surface.polydata, lighting=False)
        self._lift = 2e-3 * model.body_size
        self._ground: float | None = None
        self._sinks = self._is_shown = False
        for actor in (
            *(self._floor, self._shadow, self.body),
            *(highlight.visible_actor for highlight in self._highlights),
            self._ghost_actor,
            *(highlight.occluded_actor for highlight in self._highlights),
        ):
            self._renderer.AddActor(actor)
        self.outline = Outline(self._renderer)
        self.patch = Patch(model.space)
        self.patch.lie_on(self.surface.polydata)
        self.patch.paint_on(self.body)
        self.marks = Marks(self._renderer, model.body_size, self._up)
        self.motion = MotionMarks(self._renderer, model, theme)
        self.set_theme(theme)

    def set_theme(self, theme: Theme) -> None:
        """Apply the colours of a theme."""
        self._renderer.set_background(theme.sky_bottom, top=theme.sky_top)
        self._floor.prop.color, self._shadow.prop.color = theme.floor, theme.shadow
        self._ghost.colours[:, :3] = pv.Color(theme.ghost).int_rgb
        self.patch.set_colour(theme.accent)
        self.motion.set_theme(theme)

    def show_floor(self, shown: bool) -> None:
        """Draw or hide the floor and the shadow on it."""
        for actor in (self._floor, self._shadow):
            actor.SetVisibility(shown)

    def set_ground(self, level: float | None, *, sinks: bool = False) -> None:
        """Fix the height of the floor.

        Parameters
        ----------
        level : its height; None lays it beneath each pose, or starts anew if it `sinks`
        sinks : whether the floor goes down to the lowest pose shown from now on, as for a motion
        """
        self._ground, self._sinks = level, sinks
        # With `sinks`, wait for the next pose: the current one may be from before the motion.
        if self._is_shown and not sinks and self._floor.GetVisibility():
            self._lay_floor()

    def set_plain_background(self, colour: str) -> None:
        """Set a background of one colour, "#rrggbb", for example for transparent pictures."""
        self._renderer.set_background(colour)

    def show(
        self,
        vertices: npt.NDArray[Any],
        normals: npt.NDArray[Any],
        colours: npt.NDArray[np.uint8] | None = None,
    ) -> None:
        """Show a pose.

        Parameters
        ----------
        vertices, normals : (V, 3) arrays
        colours : (V, 3) uint8 array; the previous ones if None
        """
        self._is_shown = True
        self.surface.vertices[:] = vertices
        self.surface.normals[:] = normals
        if colours is not None:
            self.paint(colours)
        if self._textured is not None and self.is_textured:
            self._textured.follow(self.surface)
        if self.ghost_shown:
            self._fade_ghost()
        if self._floor.GetVisibility():
            self._lay_floor()

    def paint(self, colours: npt.NDArray[np.uint8]) -> None:
        """Colour the mesh, by a (V, 3) uint8 array, without moving it."""
        self.surface.colours[:] = colours

    def show_textured(self, textured: bool) -> None:
        """Draw the body textured, if it has an appearance, or in the colours of `paint`."""
        if textured == self.is_textured:
            return
        if textured and self._textured is None:
            if self._model.appearance is None:
                return
            look = self._model.appearance
            hidden = None
            if self._hidden is not None:
                hidden = _rows_in(look.vertices[look.faces], self._faces[self._hidden])
            self._textured = TexturedBody(look, self.patch, hidden)
            for actor in self._textured.actors:
                self._renderer.AddActor(actor)
        assert self._textured is not None
        if textured:
            self._textured.follow(self.surface)
        self._textured.set_visible(textured)
        self.body.SetVisibility(not textured)

    def show_contacts(self, frame: PoseFrame) -> None:
        """Ring the points of a frame where contact stops it and where it stands, unless hidden."""
        self.marks.show_contacts(self._drawn(frame.contacts, frame.vertices))
        self.marks.show_standing(self._drawn(frame.standing, frame.vertices))

    def _drawn(self, points: FloatArray, vertices: npt.NDArray[np.float32]) -> FloatArray:
        if self._hidden is None:
            return points
        nearest = [int(np.linalg.norm(vertices - point, axis=1).argmin()) for point in points]
        return points[np.isin(nearest, self._faces[~self._hidden])]

    @property
    def is_textured(self) -> bool:
        """Whether the body is drawn textured."""
        return not self.body.GetVisibility()

    def hide_faces(self, hidden: npt.NDArray[np.bool_] | None) -> None:
        """Hide faces, a (F,) bool array; None shows all."""
        self._hidden = hidden
        visible_faces = self._faces if hidden is None else self._faces[~hidden]
        for surface in (self.surface, self._ghost):
            surface.draw(visible_faces)
        for highlight in self._highlights:
            highlight.hide(hidden)
        if self._textured is not None:
            textured = self.is_textured
            self.show_textured(False)
            for actor in self._textured.actors:
                self._renderer.RemoveActor(actor)
            self._textured = None
            self.show_textured(textured)

    def show_ghost(
        self, vertices: npt.NDArray[Any] | None, normals: npt.NDArray[Any] | None = None
    ) -> None:
        """Draw a translucent second pose, (V, 3) arrays, or none."""
        if vertices is not None:
            self._ghost.vertices[:] = vertices
            self._ghost.normals[:] = normals
            self._fade_ghost()
        self._ghost_actor.SetVisibility(vertices is not None)

    def outline_domain(self, domain: int | None) -> None:
        """Outline a domain, given by its index from 0, or none."""
        faces = self._faces if self._hidden is None else self._faces[~self._hidden]
        shape = None if domain is None else PartShape.of(self._model.attention_mask, faces, domain)
        self.outline.show(shape)

    def fit_to_screen(self, device_pixel_ratio: float) -> None:
        """Fit outline, patch, marks and shadow to the pose and camera, just before a picture.

        Parameters
        ----------
        device_pixel_ratio : physical pixels per device-independent pixel
        """
        # Use plain arrays: pyvista treats slices of its own arrays as the whole.
        vertices, normals = np.asarray(self.surface.vertices), np.asarray(self.surface.normals)
        self.outline.fit(vertices, normals, device_pixel_ratio)
        self.patch.fit(device_pixel_ratio)
        self.marks.fit(self.view, device_pixel_ratio)
        # Hide the shadow from below, where the floor is culled too.
        is_above = (self.view.position - self._floor.position) @ self._up > 0.0
        self._shadow.SetVisibility(bool(is_above and self._floor.GetVisibility()))

    def copy_from(self, other: Scene) -> None:
        """Copy the content and the camera of another scene of the same mesh."""
        self.hide_faces(other._hidden)
        self.show_textured(other.is_textured)
        self.show(other.surface.vertices, other.surface.normals, other.surface.colours)
        if other.ghost_shown:
            self.show_ghost(other._ghost.vertices, other._ghost.normals)
        self.crossing.copy_from(other.crossing)
        self.uncounted.copy_from(other.uncounted)
        self.view = other.view

    @property
    def ghost_shown(self) -> bool:
        """Whether a second pose is drawn."""
        return bool(self._ghost_actor.GetVisibility())

    @property
    def view(self) -> View:
        """The camera."""
        camera = self._renderer.camera
        return View(*(np.array(at) for at in (camera.position, camera.focal_point, camera.up)))

    @view.setter
    def view(self, view: View) -> None:
        camera = self._renderer.camera
        camera.position, camera.focal_point, camera.up = view.position, view.focus, view.up
        camera.view_angle = VIEW_ANGLE
        self._renderer.ResetCameraClippingRange()
        # Otherwise pyvista resets the camera to a default view in the first picture.
        self._renderer.camera_set = True

    def turn_camera(self, degrees: float) -> None:
        """Turn the camera around its focus, about its up direction."""
        self._renderer.camera.Azimuth(degrees)
        self._renderer.ResetCameraClippingRange()

    def _fade_ghost(self) -> None:
        """Show the ghost only where the body has moved away from it.

        If both coincided, patches of either would show at random.
        """
        away = np.linalg.norm(self._ghost.vertices - self.surface.vertices, axis=1)
        away /= self._model.body_size
        visible = np.clip((away - _GHOST_NEAR) / (_GHOST_FAR - _GHOST_NEAR), 0.0, 1.0)
        self._ghost.colours[:, 3] = np.rint(255.0 * _GHOST_OPACITY * visible)

    def _lay_floor(self) -> None:
        low, high = self.surface.vertices.min(axis=0), self.surface.vertices.max(axis=0)
        up, centre = self._up, 0.5 * (low + high)
        level = min(float(low @ up), float(high @ up))
        if self._sinks:
            self._ground = level if self._ground is None else min(level, self._ground)
        level = level if self._ground is None else self._ground
        self._floor.position = centre + (level - self._lift - centre @ up) * up
        flat = np.eye(4)
        flat[:3, :3] -= np.outer(up, up)
        flat[:3, 3] = (level - 0.5 * self._lift) * up
        self._shadow.user_matrix = flat


def _rows_in(
    rows: npt.NDArray[np.integer], wanted: npt.NDArray[np.integer]
) -> npt.NDArray[np.bool_]:
    """Return a mask of the (n, 3) rows that are among the (m, 3) `wanted` rows."""
    kind = np.dtype((np.void, 3 * np.dtype(np.int64).itemsize))
    one, other = (
        np.ascontiguousarray(entries, dtype=np.int64).view(kind) for entries in (rows, wanted)
    )
    is_in: npt.NDArray[np.bool_] = np.isin(one[:, 0], other[:, 0])
    return is_in
