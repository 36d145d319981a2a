"""A body's surface in the view: its mesh, a patch painted on it, its textures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pyvista as pv
from scipy.sparse.csgraph import dijkstra
from vtkmodules.vtkCommonDataModel import vtkDataObject
from vtkmodules.vtkRenderingCore import vtkPolyDataMapper, vtkTexture

from app.view.shading import rgb
from lcollision_core.files.scene.appearance import LEAST_SEEN, Appearance, Material, Texture, Wrap

if TYPE_CHECKING:
    import pyvista as pv
    from vtkmodules.vtkRenderingCore import vtkUniforms

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


def body_actor(polydata: pv.PolyData, coloured: bool = True, **properties: Any) -> pv.Actor:
    """Return an actor for a body: `make_actor` with a body's lighting."""
    shine = {"ambient": 0.22, "diffuse": 0.92, "specular": 0.1, "specular_power": 18}
    return make_actor(polydata, coloured, **shine, **properties)


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
