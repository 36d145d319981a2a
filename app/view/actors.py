"""What a scene draws of a body: its surface and textures, the patch, marks and outlines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pyvista as pv
from scipy.sparse.csgraph import dijkstra
from vtkmodules.vtkCommonDataModel import vtkDataObject
from vtkmodules.vtkRenderingCore import (
    vtkActor2D,
    vtkPolyDataMapper,
    vtkPolyDataMapper2D,
    vtkTexture,
)

from app.view.camera import VIEW_ANGLE, Pixel, View, pixel_length, places_of
from app.view.shading import CONTACT, rgb
from lcollision_core.files.scene.appearance import LEAST_SEEN, Appearance, Material, Texture, Wrap

if TYPE_CHECKING:
    import pyvista as pv
    from vtkmodules.vtkRenderingCore import vtkRenderer, vtkUniforms

    from app.view.shading import Theme
    from app.work.frames import PoseFrame
    from lcollision_core.bodies import Body
    from lcollision_core.posing import Grip, PoseSpace


class Surface:
    """A triangle mesh whose vertices, normals and colours may change with every picture.

    Parameters
    ----------
    faces : (F, 3) integer array
    n_vertices : V
    n_channels : C, 3 for opaque colours or 4 with the opacity of each vertex

    Attributes
    ----------
    vertices, normals : (V, 3) float32 arrays that VTK reads; write to them in place
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
        # Otherwise a picker would find the previous faces.
        self.polydata.DeleteCells()


def make_actor(polydata: pv.PolyData, coloured: bool = False, **properties: Any) -> pv.Actor:
    """Return an actor that draws a mesh or lines and cannot be picked.

    Parameters
    ----------
    coloured : whether to colour by the mesh's active scalars, instead of one colour
    properties : properties of `pyvista.Property`
    """
    mapper = vtkPolyDataMapper()
    mapper.SetInputData(polydata)
    mapper.SetScalarVisibility(coloured)
    actor = pv.Actor(mapper, pv.Property(interpolation="Gouraud", **properties))
    actor.SetPickable(False)
    return actor


def body_actor(polydata: pv.PolyData, **properties: Any) -> pv.Actor:
    """Return an actor for a body: `make_actor` with a body's lighting."""
    shine = {"ambient": 0.22, "diffuse": 0.92, "specular": 0.1, "specular_power": 18}
    return make_actor(polydata, True, **shine, **properties)


_ALONG = 0.85
"""Factor on the length of a path along edges, to approximate the shorter one across faces."""

_FAR, _BEYOND = 3.0, 1.5
"""Distances, in radii, assigned to points that are not painted, and up to which they are
measured."""

_FRAGMENT = """
  float straight = distance(patchVC.xyz, patchMiddle.xyz) / patchMiddle.w;
  float fromMiddle = max(straight, patchVC.w);
  float pixel = clamp(fwidth(fromMiddle), 1e-6, 2.0 * fwidth(straight) + 1e-6);
  float inward = (1.0 - fromMiddle) / pixel / patchLook.w;
  if (patchMiddle.w > 0.0 && inward > -2.0) {
    float falloff = clamp(1.0 - fromMiddle * fromMiddle, 0.0, 1.0);
    vec3 lit = fragOutput0.rgb;
    // White is seen on any body part's colour, the theme's accent on skin.
    float tint = max(lit.r, max(lit.g, lit.b)) - min(lit.r, min(lit.g, lit.b));
    vec3 fill = mix(patchLook.rgb, vec3(1.0), smoothstep(0.12, 0.3, tint));
    lit = mix(lit, fill, inward > 0.0 ? 0.15 + 0.55 * falloff * falloff : 0.0);
    lit = mix(lit, vec3(0.08, 0.09, 0.11), clamp(2.0 - abs(inward), 0.0, 1.0));
    lit = mix(lit, vec3(1.0), clamp(1.7 - abs(inward - 1.7), 0.0, 1.0));
    fragOutput0.rgb = lit;
  }
  //VTK::DepthPeeling::Impl
"""
"""A fill that falls off like the weights, and a rim, white inside dark, of constant width."""


class Patch:
    """Paint the patch of a grip over the colours of surfaces, smooth at any face size.

    Distances are those of the rest pose, in which grips are made.

    Parameters
    ----------
    space : of the poses that the surfaces show
    """

    def __init__(self, space: PoseSpace) -> None:
        self._space, rest_vertices = space, space.rest_vertices
        self._along = np.column_stack([rest_vertices, np.full(len(rest_vertices), _FAR)])
        self._surfaces: list[tuple[pv.PolyData, npt.NDArray[np.intp] | None]] = []
        self._uniforms: list[vtkUniforms] = []
        self._look = [0.0, 0.0, 0.0, 1.0]
        self._middle = [0.0, 0.0, 0.0, 0.0]
        self._grip: Grip | None = None

    def lie_on(self, polydata: pv.PolyData, vertices: npt.NDArray[np.intp] | None = None) -> None:
        """Add the distances that `paint_on` needs to a surface.

        Parameters
        ----------
        polydata : the surface
        vertices : (P,) array, the body's vertex at each of its points; None for all in order
        """
        self._surfaces.append((polydata, vertices))
        polydata.point_data["patch"] = self._along_of(vertices)

    def paint_on(self, actor: pv.Actor) -> None:
        """Paint on the actor of a surface, or of a part of one."""
        actor.mapper.MapDataArrayToVertexAttribute(
            "patchMC", "patch", vtkDataObject.FIELD_ASSOCIATION_POINTS, -1
        )
        shading = actor.GetShaderProperty()
        for replace, block, text in (
            (shading.AddVertexShaderReplacement, "Dec", "in vec4 patchMC;\nout vec4 patchVC;\n"),
            (shading.AddVertexShaderReplacement, "Impl", "  patchVC = patchMC;\n"),
            (shading.AddFragmentShaderReplacement, "Dec", "in vec4 patchVC;\n"),
        ):
            place = f"//VTK::Normal::{block}"
            replace(place, True, f"{place}\n{text}", False)
        # Insert after lighting and textures.
        place = "//VTK::DepthPeeling::Impl"
        shading.AddFragmentShaderReplacement(place, True, _FRAGMENT, False)
        self._uniforms.append(shading.GetFragmentCustomUniforms())
        self._set_uniforms()

    def set_colour(self, colour: str) -> None:
        """Set the fill colour, "#rrggbb", used where the surface is not coloured."""
        self._look[:3] = (rgb(colour) / 255.0).tolist()

    def show(self, grip: Grip | None) -> bool:
        """Paint a grip, or none; return whether it differs from the previous one."""
        if grip is self._grip:
            return False
        self._grip = grip
        middle = [0.0, 0.0, 0.0, 0.0]
        if grip is not None:
            middle = [*self._along[grip.vertex, :3].tolist(), grip.radius]
            # Measure somewhat beyond the rim, which lies between two vertices.
            beyond = _BEYOND * grip.radius
            graph = self._space.surface_graph
            along = dijkstra(graph, directed=False, indices=grip.vertex, limit=beyond)
            self._along[:, 3] = np.minimum(_ALONG * along / grip.radius, _FAR)
            for polydata, vertices in self._surfaces:
                polydata.point_data["patch"][:] = self._along_of(vertices)
        self._middle = middle
        self._set_uniforms()
        return True

    def fit(self, device_pixel_ratio: float) -> None:
        """Scale the rim to a screen's device pixel ratio."""
        self._look[3] = device_pixel_ratio
        self._set_uniforms()

    def _along_of(self, vertices: npt.NDArray[np.intp] | None) -> npt.NDArray[np.float32]:
        along = self._along if vertices is None else self._along[vertices]
        return along.astype(np.float32)

    def _set_uniforms(self) -> None:
        for uniforms in self._uniforms:
            uniforms.SetUniform4f("patchMiddle", self._middle)
            uniforms.SetUniform4f("patchLook", self._look)


_WRAPPED = {
    Wrap.REPEAT: "{at}",
    # Clamp to the middle of the last pixel, which would otherwise blend into the first.
    Wrap.MIRROR: "clamp(1.0 - abs(1.0 - mod({at}, 2.0)), {half}, 1.0 - {half})",
    Wrap.CLAMP: "clamp({at}, {half}, 1.0 - {half})",
}
"""GLSL expressions of the wrap modes: VTK wraps both directions of a texture in the same way."""


class TexturedBody:
    """Draw a mesh with its appearance: an actor for each material, on shared points.

    Parameters
    ----------
    appearance : of the mesh
    patch : to be painted on it
    hidden : (F,) bool array, the faces that are not drawn; None draws all

    Attributes
    ----------
    actors : to be added to a renderer, in this order: blended ones come last
    """

    def __init__(
        self,
        appearance: Appearance,
        patch: Patch,
        hidden: npt.NDArray[np.bool_] | None = None,
    ) -> None:
        self._vertices = appearance.vertices
        self._surface = Surface(appearance.faces, len(self._vertices), n_channels=4)
        self._surface.colours[:] = appearance.colours
        polydata = self._surface.polydata
        polydata.active_texture_coordinates = appearance.uv
        patch.lie_on(polydata, self._vertices)
        textures: dict[Texture, vtkTexture] = {}
        blended: list[pv.Actor] = []
        self.actors: list[pv.Actor] = []
        for number, material in enumerate(appearance.materials):
            is_own = appearance.material_of == number
            faces = appearance.faces[is_own if hidden is None else is_own & ~hidden]
            if not len(faces):
                continue
            part = pv.PolyData()
            part.ShallowCopy(polydata)
            part.SetPolys(pv.CellArray.from_regular_cells(faces))
            actor = _actor_of(part, material)
            if material.texture is not None:
                if material.texture not in textures:
                    textures[material.texture] = _texture_of(material.texture)
                actor.SetTexture(textures[material.texture])
            patch.paint_on(actor)
            (blended if material.is_blended else self.actors).append(actor)
        self.actors += blended

    def follow(self, surface: Surface) -> None:
        """Copy the pose of the mesh."""
        self._surface.vertices[:] = np.asarray(surface.vertices)[self._vertices]
        self._surface.normals[:] = np.asarray(surface.normals)[self._vertices]

    def set_visible(self, visible: bool) -> None:
        """Show or hide all actors."""
        for actor in self.actors:
            actor.SetVisibility(visible)


def _actor_of(polydata: pv.PolyData, material: Material) -> pv.Actor:
    actor = body_actor(polydata, culling=None if material.is_double_sided else "back")
    actor.prop.lighting = material.is_lit
    if not material.is_lit:
        actor.prop.ambient, actor.prop.diffuse = 0.0, 1.0
    # Draw blended materials as opaque ones, with depth writes: layered hair, and skin marked as
    # blended, then look right without sorting.
    actor.ForceOpaqueOn()
    seen = f"  if (fragOutput0.a < {max(material.cutoff, LEAST_SEEN * material.is_blended):.6f})"
    seen += " discard;\n"
    if not material.is_blended:
        seen += "  fragOutput0.a = 1.0;\n"
    shader = actor.GetShaderProperty()
    place = "//VTK::TCoord::Impl"
    shader.AddFragmentShaderReplacement(place, True, f"{place}\n{seen}", False)
    if material.texture is not None:
        height, width = material.texture.pixels.shape[:2]
        ats = (("tcoordVCVSOutput.x", width), ("tcoordVCVSOutput.y", height))
        u, v = (
            _WRAPPED[wrap].format(at=at, half=f"{0.5 / size:.9f}")
            for wrap, (at, size) in zip(material.texture.wrap, ats, strict=True)
        )
        read = "texture(actortexture, {})"
        shader.AddFragmentShaderReplacement(
            read.format("tcoordVCVSOutput"), False, read.format(f"vec2({u}, {v})"), True
        )
    return actor


def _texture_of(texture: Texture) -> vtkTexture:
    # VTK mistakes an image of one column for one row.
    pixels = np.repeat(texture.pixels, 2 if texture.pixels.shape[1] == 1 else 1, axis=1)
    height, width = pixels.shape[:2]
    image = pv.ImageData(dimensions=(width, height, 1))
    image.point_data.set_scalars(pixels.reshape(-1, 4), "pixels")
    made = vtkTexture()
    made.SetInputData(image)
    made.SetColorModeToDirectScalars()
    made.SetWrap(vtkTexture.Repeat)
    made.SetInterpolate(texture.is_smooth)
    made.SetMipmap(texture.has_mipmaps)
    return made


FloatArray = npt.NDArray[np.float64]

PIN_RADIUS = 7.0
"""Radius of a pin's dot with its rim, in device-independent pixels."""

ARROW_LENGTH = 70.0
"""Length of the arrows along the axes, in device-independent pixels."""

AXIS_COLOURS = ("#e5484d", "#46a758", "#3e7bfa")
"""Colours of the body's left, front and up axes."""

_CONTACT_RADIUS, _STANDING_RADIUS = 6.0, 4.5
_APART = 16.0
"""Least distance between two contact marks, in pixels; nearer contacts share one."""

_TARGET_RADIUS = 0.018
"""Radius of the ring round a target and of its shadow, in normalised length."""

_DARK, _LIGHT = "#14171c", "#ffffff"
_SIDES = 24


class Marks:
    """Draw pins, handles, contacts, standing points, a drag's target with its shadow, and arrows.

    Parameters
    ----------
    renderer : to draw in
    body_size : in the data's unit
    up : (3,) unit vector
    """

    def __init__(self, renderer: vtkRenderer, body_size: float, up: FloatArray) -> None:
        self._renderer, self._body_size, self._up = renderer, body_size, up
        self.pins = self.handles = self._contacts = self._standing = np.zeros((0, 3))
        self._handle_colours: tuple[str, ...] = ()
        self._handle: int | None = None
        self._line: FloatArray | None = None
        self._arrows: tuple[FloatArray, FloatArray] | None = None
        self._colours: tuple[str, ...] = ()
        self._flat = pv.PolyData()
        mapper = vtkPolyDataMapper2D()
        mapper.SetInputData(self._flat)
        mapper.SetScalarModeToUseCellData()
        self._actor = vtkActor2D()
        self._actor.SetMapper(mapper)
        self._actor.SetVisibility(False)
        renderer.AddViewProp(self._actor)

    def show_pins(self, places: npt.NDArray[Any], colours: Sequence[str]) -> None:
        """Draw dots at (P, 3) points, in colours "#rrggbb"."""
        self.pins, self._colours = np.asarray(places, dtype=np.float64), tuple(colours)

    def show_handles(
        self, places: npt.NDArray[Any], colours: Sequence[str], pointed: int | None
    ) -> None:
        """Draw open dots at (H, 3) points, in colours "#rrggbb"; the `pointed` one is filled."""
        self.handles, self._handle_colours = np.asarray(places, dtype=np.float64), tuple(colours)
        self._handle = pointed

    def show_contacts(self, places: npt.NDArray[Any]) -> None:
        """Draw rings at (C, 3) points, one for several that are close on the screen."""
        self._contacts = np.asarray(places, dtype=np.float64)

    def show_standing(self, places: npt.NDArray[Any]) -> None:
        """Draw small rings at (S, 3) points that stay on the ground."""
        self._standing = np.asarray(places, dtype=np.float64)

    def show_target(self, line: FloatArray | None) -> None:
        """Draw the target of a drag and its height above the ground, or none.

        Parameters
        ----------
        line : (3, 3) array: the dragged point, its target, and the point on the ground below that
        """
        self._line = line

    def show_arrows(self, origin: FloatArray | None, axes: FloatArray) -> None:
        """Draw arrows from a point along the rows of (3, 3) axes, or none."""
        self._arrows = None if origin is None else (origin, axes)

    def arrow_at(self, place: Pixel, view: View, size: Pixel) -> int | None:
        """Return the index of the axis whose arrow is at an image position, or None."""
        if self._arrows is None:
            return None
        start, *tips = self._arrow_places(view, size)
        away = []
        for tip in tips:
            along = tip - start
            share = float(np.clip((place - start) @ along / max(along @ along, 1e-9), 0.25, 1.0))
            away.append(float(np.linalg.norm(start + share * along - place)))
        nearest = int(np.argmin(away))
        return nearest if away[nearest] <= PIN_RADIUS else None

    def _arrow_places(self, view: View, size: Pixel) -> FloatArray:
        assert self._arrows is not None
        origin, axes = self._arrows
        length = ARROW_LENGTH * pixel_length(view, origin, size)
        return places_of(view, origin + length * np.concatenate([np.zeros((1, 3)), axes]), size)

    def pin_at(self, place: Pixel, view: View, size: Pixel) -> int | None:
        """Return the index of the pin whose dot is at an image position, or None."""
        return _dot_at(self.pins, place, view, size)

    def handle_at(self, place: Pixel, view: View, size: Pixel) -> int | None:
        """Return the index of the handle at an image position, or None."""
        return _dot_at(self.handles, place, view, size)

    def fit(self, view: View, device_pixel_ratio: float) -> None:
        """Build the shapes for the camera, just before a picture.

        Parameters
        ----------
        device_pixel_ratio : physical pixels per device-independent pixel
        """
        width, height = self._renderer.GetSize()
        size = width / device_pixel_ratio, height / device_pixel_ratio
        shapes: list[tuple[FloatArray, str]] = []
        if self._line is not None:
            shapes += self._target_shapes(self._line, view, size)
        if self._arrows is not None:
            start, *tips = self._arrow_places(view, size)
            for tip, colour in zip(tips, AXIS_COLOURS, strict=True):
                shapes += [(_arrow(start, tip, 2.6), _DARK), (_arrow(start, tip, 1.6), colour)]
        for place in places_of(view, self._standing, size):
            for inner, inset, colour in ((1.5, -1.0, _DARK), (2.5, 0.0, _LIGHT)):
                shapes.append((_ring(place, inner, _STANDING_RADIUS - inset), colour))
        for place in _thinned(places_of(view, self._contacts, size)):
            for inner, inset, colour in ((1.8, -1.2, _DARK), (3.0, 0.0, CONTACT)):
                shapes.append((_ring(place, inner, _CONTACT_RADIUS - inset), colour))
        dots = places_of(view, self.handles, size)
        for index, (place, own) in enumerate(zip(dots, self._handle_colours, strict=True)):
            for inner, outer, colour in ((2.0, 7.0, _DARK), (3.0, 6.0, own), (4.2, 4.8, _LIGHT)):
                shapes.append((_ring(place, inner * (index != self._handle), outer), colour))
        for place, own in zip(places_of(view, self.pins, size), self._colours, strict=True):
            for inset, colour in ((0.0, _DARK), (1.3, _LIGHT), (3.0, own)):
                shapes.append((_ring(place, 0.0, PIN_RADIUS - inset), colour))
        self._actor.SetVisibility(len(shapes) > 0)
        if not shapes:
            return
        corners = np.concatenate([quads for quads, _ in shapes])
        corners[:, :, 1] = size[1] - corners[:, :, 1]
        flat = np.zeros((4 * len(corners), 3), dtype=np.float32)
        flat[:, :2] = corners.reshape(-1, 2) * device_pixel_ratio
        self._flat.points = flat
        self._flat.SetPolys(pv.CellArray.from_regular_cells(np.arange(len(flat)).reshape(-1, 4)))
        paint = np.repeat([rgb(c) for _, c in shapes], [len(q) for q, _ in shapes], axis=0)
        self._flat.cell_data.set_scalars(paint, "colours")

    def _target_shapes(
        self, line: FloatArray, view: View, size: Pixel
    ) -> list[tuple[FloatArray, str]]:
        start, end, below = places_of(view, line, size)
        shapes: list[tuple[FloatArray, str]] = []
        around = self._body_size * _TARGET_RADIUS
        radius = around / pixel_length(view, line[1], size)
        # The shadow lies flat on the ground.
        aside = np.eye(3)[[axis for axis in range(3) if not self._up[axis]]]
        rim = [
            places_of(view, line[2] + share * around * (_CIRCLE @ aside), size)
            for share in (0.8, 1.0)
        ]
        shadow = np.stack([rim[0][:-1], rim[1][:-1], rim[1][1:], rim[0][1:]], axis=1)
        for half, colour in ((1.2, _DARK), (0.5, _LIGHT)):
            shapes.append((_bar(end, below, half), colour))
        shapes.append((shadow, _DARK))
        for half, colour in ((2.0, _DARK), (0.9, _LIGHT)):
            shapes.append((_bar(start, end, half), colour))
            shapes.append((_ring(end, max(radius - half, 0.0), radius + half), colour))
        return shapes


_ANGLES = np.linspace(0.0, 2.0 * np.pi, _SIDES + 1)
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


def _arrow(start: FloatArray, tip: FloatArray, half: float) -> FloatArray:
    """Return an arrow with a head, as (2, 4, 2) quads."""
    neck = start + 0.8 * (tip - start)
    along = tip - start
    aside = 3.0 * half * np.array([-along[1], along[0]]) / max(float(np.linalg.norm(along)), 1e-9)
    head = np.stack([neck + aside, neck - aside, tip, tip])
    return np.concatenate([_bar(start, neck, half), head[None]])


def _ring(middle: FloatArray, inner: float, outer: float) -> FloatArray:
    """Return a ring, or a disc if its inner radius is 0, as (n, 4, 2) quads."""
    rim, on = _CIRCLE[:-1], _CIRCLE[1:]
    corners = np.stack([inner * rim, outer * rim, outer * on, inner * on])
    quads: FloatArray = middle + corners.transpose(1, 0, 2)
    return quads


def _bar(start: FloatArray, end: FloatArray, half: float) -> FloatArray:
    """Return a line of half width `half` as one quad, (1, 4, 2)."""
    along = end - start
    aside = half * np.array([-along[1], along[0]]) / max(float(np.linalg.norm(along)), 1e-9)
    return np.stack([start + aside, start - aside, end - aside, end + aside])[None]


def _dot_at(dots: FloatArray, place: Pixel, view: View, size: Pixel) -> int | None:
    """Return the index of the dot, of (n, 3) points, at an image position, or None."""
    if not len(dots):
        return None
    away = np.linalg.norm(places_of(view, dots, size) - np.array(place), axis=1)
    nearest = int(away.argmin())
    return nearest if away[nearest] <= PIN_RADIUS + 1.0 else None


def _thinned(places: FloatArray) -> list[FloatArray]:
    """Leave out positions that are near an earlier one."""
    points: list[FloatArray] = []
    for place in places:
        if all(np.linalg.norm(place - other) >= _APART for other in points):
            points.append(place)
    return points


_OPACITY = 0.32
"""Base opacity of the nearest onion skin; the others fade."""


class MotionMarks:
    """Onion skins and a motion path.

    Skins before the playhead have the theme's colour for free, those after it the accent colour:
    these differ in hue and in lightness.

    Parameters
    ----------
    renderer : to draw in
    model : of the frames
    theme : whose colours are used
    """

    def __init__(self, renderer: pv.Renderer, model: Body, theme: Theme) -> None:
        self._renderer, self._model, self._theme = renderer, model, theme
        self._skins: list[tuple[Surface, pv.Actor]] = []
        self._path: pv.Actor | None = None

    def set_theme(self, theme: Theme) -> None:
        """Apply the colours of a theme: to the path now, to the skins when next shown."""
        self._theme = theme
        if self._path is not None:
            self._path.prop.color = theme.accent

    def show_skins(self, frames: Sequence[tuple[int, PoseFrame]]) -> None:
        """Draw frames as onion skins.

        Parameters
        ----------
        frames : offset from the playhead, and the frame; the nearest first
        """
        while len(self._skins) < len(frames):
            self._skins.append(self._new_skin())
        farthest = max((abs(by) for by, _ in frames), default=1)
        for number, (surface, actor) in enumerate(self._skins):
            is_shown = number < len(frames)
            actor.SetVisibility(is_shown)
            if not is_shown:
                continue
            by, frame = frames[number]
            surface.vertices[:], surface.normals[:] = frame.vertices, frame.normals
            surface.polydata.Modified()
            actor.prop.color = self._theme.free if by < 0 else self._theme.accent
            actor.prop.opacity = _OPACITY * (1.2 - abs(by) / farthest)

    def show_path(self, points: npt.NDArray[np.floating] | None) -> None:
        """Draw the path through (N, 3) points, in the data's unit; None for none."""
        if self._path is not None:
            self._renderer.RemoveActor(self._path)
            self._path = None
        if points is not None and len(points) > 1:
            line = pv.lines_from_points(points.astype(np.float32))
            self._path = make_actor(line, lighting=False, line_width=2.5, color=self._theme.accent)
            self._renderer.AddActor(self._path)

    def _new_skin(self) -> tuple[Surface, pv.Actor]:
        surface = Surface(self._model.faces, self._model.n_vertices)
        actor = make_actor(surface.polydata, ambient=0.5, diffuse=0.6, culling="back")
        actor.ForceTranslucentOn()
        self._renderer.AddActor(actor)
        return surface, actor


_THROUGH_OPACITY = 0.22
_TO_THE_FRONT = -3.0e7  # in steps of a depth buffer of 24 bits: all of its range


class FaceHighlight:
    """Highlighted faces of a surface, drawn over it; they follow its vertices.

    Parameters
    ----------
    surface : whose vertices are drawn
    faces : (F, 3) array, all faces of the mesh
    colour : "#rrggbb"
    layer : from 1; of two highlights of one face, the higher layer is visible

    Attributes
    ----------
    visible_actor, occluded_actor : actors to be added to a renderer; the second shows occluded
        faces, on the far side or inside a limb, translucently through the body
    """

    def __init__(
        self, surface: Surface, faces: npt.NDArray[np.int32], colour: str, layer: int
    ) -> None:
        self._faces = faces
        self._hidden: npt.NDArray[np.bool_] | None = None
        self._shown: npt.NDArray[np.integer] | None = None
        self._polydata = pv.PolyData()
        self._polydata.SetPoints(surface.polydata.GetPoints())
        self.visible_actor = make_actor(self._polydata, color=colour, ambient=0.55, diffuse=0.5)
        self.occluded_actor = make_actor(
            self._polydata, color=colour, opacity=_THROUGH_OPACITY, lighting=False
        )
        # The body has the same triangles: without an offset, rounding decides which are visible.
        for actor, offset in (
            (self.visible_actor, (-1.0 * layer, -2.0 * layer)),
            (self.occluded_actor, (0.0, _TO_THE_FRONT)),
        ):
            actor.mapper.SetResolveCoincidentTopologyToPolygonOffset()
            actor.mapper.SetRelativeCoincidentTopologyPolygonOffsetParameters(*offset)
            actor.SetVisibility(False)

    def show(self, faces: npt.NDArray[np.integer] | None) -> None:
        """Draw the faces whose indices are in an array of any shape; None for none."""
        self._shown = faces
        face_numbers = np.unique(faces) if faces is not None else np.empty(0, dtype=np.int64)
        if self._hidden is not None:
            face_numbers = face_numbers[~self._hidden[face_numbers]]
        if len(face_numbers):
            self._polydata.SetPolys(pv.CellArray.from_regular_cells(self._faces[face_numbers]))
        self._set_visible(len(face_numbers) > 0)

    def hide(self, hidden: npt.NDArray[np.bool_] | None) -> None:
        """Hide faces, a (F,) bool array, even if they are highlighted; None for none."""
        self._hidden = hidden
        self.show(self._shown)

    def copy_from(self, other: FaceHighlight) -> None:
        """Show the faces of another highlight of the same mesh."""
        self.show(other._shown)

    @property
    def n_faces(self) -> int:
        """Number of faces drawn."""
        return int(self._polydata.GetNumberOfPolys()) if self.visible_actor.GetVisibility() else 0

    def _set_visible(self, visible: bool) -> None:
        for actor in (self.visible_actor, self.occluded_actor):
            actor.SetVisibility(visible)


Float32Array = npt.NDArray[np.float32]

_STROKES = ((1.4, "#ffffff", 9.0), (3.0, "#14171c", 6.0))
"""Width to each side, colour, and offset of the border towards the camera, of the inner and outer
stroke, visible on any colour; lengths in device-independent pixels."""

_SMOOTHINGS = 4

_BORDER_WIDTH = 1.5
"""Line width of the border over the width to one side; 2 would look heavier than the rim."""


@dataclass(frozen=True, eq=False)
class PartShape:
    """The region of a body part on the mesh, independent of the pose.

    Attributes
    ----------
    ends : (P, 2) integer array, the mesh edges that the border of the part crosses
    fractions : (P, 1) float32 array, where the border crosses: 0 at the first end, 1 at the second
    segments : (S, 2) integer array, pieces of the border between those P points
    vertices : (Q,) integer array, the vertices of faces that are wholly inside the part
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
        """Find the region where a domain has the largest weight, and its border.

        Parameters
        ----------
        attention_mask : (K, V) array, each column sums to 1
        faces : (F, 3) integer array
        domain : index from 0
        """
        part_weights = attention_mask[domain].astype(np.float64)
        others = np.delete(attention_mask, domain, axis=0).max(axis=0, initial=0.0)
        lead = _smooth(part_weights - others, faces)
        if not (lead > 0.0).any():
            # The domain dominates nowhere: take the region where its weight is large.
            lead = part_weights - 0.5 * part_weights.max()
        inside = (lead > 0.0)[faces]
        count = inside.sum(axis=1)
        crossed = np.flatnonzero((count == 1) | (count == 2))
        # Find the corner that is alone on its side: the border crosses its two edges.
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
    """Draw a part's border on the body and the rim of its silhouette, in a constant width.

    The rim is the part's surface, slightly enlarged, with only its back faces drawn: it stands out
    round the part unless the body hides it. The colours of the mesh do not change.

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
            line = make_actor(border, color=colour, lighting=False)
            # Cull front faces: only the far side shows, beside the part.
            rim = make_actor(shell, color=colour, lighting=False, culling="front")
            for actor in (line, rim):
                actor.SetVisibility(False)
                renderer.AddActor(actor)
            self._strokes.append((width, nearer, border, shell, line, rim))

    @property
    def is_shown(self) -> bool:
        """Whether a part is outlined."""
        return self._shape is not None

    def show(self, shape: PartShape | None) -> None:
        """Outline a part, from the next `fit` on, or none."""
        self._shape = shape
        for _, _, border, shell, *actors in self._strokes:
            if shape is not None:
                border.points = np.zeros((len(shape.ends), 3), dtype=np.float32)
                border.SetLines(pv.CellArray.from_regular_cells(shape.segments))
                shell.points = np.zeros((len(shape.vertices), 3), dtype=np.float32)
                shell.SetPolys(pv.CellArray.from_regular_cells(shape.faces))
            for actor in actors:
                actor.SetVisibility(shape is not None)

    def fit(self, vertices: Float32Array, normals: Float32Array, device_pixel_ratio: float) -> None:
        """Fit the outline to the pose and the camera.

        Parameters
        ----------
        vertices, normals : (V, 3) float32 arrays
        device_pixel_ratio : physical pixels per device-independent pixel
        """
        shape = self._shape
        if shape is None:
            return
        border = shape.border(vertices)
        skin, outward = vertices[shape.vertices], normals[shape.vertices]
        eye = np.array(self._renderer.GetActiveCamera().GetPosition(), dtype=np.float32)
        middle = np.concatenate([border, skin]).mean(axis=0)
        distance = float(np.linalg.norm(eye - middle))
        n_pixels = max(1, self._renderer.GetSize()[1]) / device_pixel_ratio
        pixel = 2.0 * distance * np.tan(np.radians(0.5 * VIEW_ANGLE)) / n_pixels
        for width, nearer, lines, shell, line, _ in self._strokes:
            lines.points = border + np.float32(nearer * pixel / distance) * (eye - border)
            shell.points = skin + np.float32(width * pixel) * outward
            line.prop.line_width = _BORDER_WIDTH * width * device_pixel_ratio


def _smooth(values: npt.NDArray[np.float64], faces: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Smooth (V,) values by averaging over the faces round each vertex."""
    corners = faces.ravel()
    n_faces = np.maximum(np.bincount(corners, minlength=len(values)), 1)
    for _ in range(_SMOOTHINGS):
        of_faces = np.repeat(values[faces].mean(axis=1), 3)
        values = np.bincount(corners, of_faces, minlength=len(values)) / n_faces
    return values
