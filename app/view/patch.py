"""The patch of the surface that would be taken hold of, painted by the graphics card."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.sparse.csgraph import dijkstra
from vtkmodules.vtkCommonDataModel import vtkDataObject

from app.view.shading import rgb

if TYPE_CHECKING:
    import pyvista as pv
    from vtkmodules.vtkRenderingCore import vtkUniforms

    from lcollision_core.posing import Grip, PoseSpace

_ALONG = 0.85
"""Factor on the length of a path along edges, which is longer than one across faces."""

_FAR, _BEYOND = 3.0, 1.5
"""Radii from the middle of what is not painted, and as far as distances are measured."""

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
"""A fill that falls off as the weights do, and a rim, white within dark, of constant width."""


class Patch:
    """Paints a grip on surfaces over whatever their colours say, smooth at any size of their faces.

    Distances are those of the reference, in which grips are made.

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
        """Give a surface the distances that `paint_on` needs.

        Parameters
        ----------
        polydata : the surface
        vertices : (P,) array, the vertex of the body at each of its points; None for all in order
        """
        self._surfaces.append((polydata, vertices))
        polydata.point_data["patch"] = self._along_of(vertices)

    def paint_on(self, actor: pv.Actor) -> None:
        """Paint on what draws a surface, or a part of one."""
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
        # What follows lights and textures.
        place = "//VTK::DepthPeeling::Impl"
        shading.AddFragmentShaderReplacement(place, True, _FRAGMENT, False)
        self._uniforms.append(shading.GetFragmentCustomUniforms())
        self._set_uniforms()

    def set_colour(self, colour: str) -> None:
        """Fill with a colour, "#rrggbb", where the surface has none of its own."""
        self._look[:3] = (rgb(colour) / 255.0).tolist()

    def show(self, grip: Grip | None) -> bool:
        """Paint a grip, or none; return whether that is another one than before."""
        if grip is self._grip:
            return False
        self._grip = grip
        middle = [0.0, 0.0, 0.0, 0.0]
        if grip is not None:
            middle = [*self._along[grip.vertex, :3].tolist(), grip.radius]
            # Somewhat beyond the rim, which lies between two vertices.
            beyond = _BEYOND * grip.radius
            graph = self._space.surface_graph
            along = dijkstra(graph, directed=False, indices=grip.vertex, limit=beyond)
            self._along[:, 3] = np.minimum(_ALONG * along / grip.radius, _FAR)
            for polydata, vertices in self._surfaces:
                polydata.point_data["patch"][:] = self._along_of(vertices)
        self._middle = middle
        self._set_uniforms()
        return True

    def fit(self, sharpness: float) -> None:
        """Draw the rim for a screen, given its device pixels per device-independent one."""
        self._look[3] = sharpness
        self._set_uniforms()

    def _along_of(self, vertices: npt.NDArray[np.intp] | None) -> npt.NDArray[np.float32]:
        along = self._along if vertices is None else self._along[vertices]
        return along.astype(np.float32)

    def _set_uniforms(self) -> None:
        for uniforms in self._uniforms:
            uniforms.SetUniform4f("patchMiddle", self._middle)
            uniforms.SetUniform4f("patchLook", self._look)
