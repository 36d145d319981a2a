"""A body as it looks: its materials and textures, on points that seams split."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pyvista as pv
from vtkmodules.vtkRenderingCore import vtkTexture

from app.view.surface import Surface, body_actor
from lcollision_core.meshes.appearance import LEAST_SEEN, Appearance, Material, Texture, Wrap

if TYPE_CHECKING:
    from app.view.patch import Patch

_WRAPPED = {
    Wrap.REPEAT: "{at}",
    # Not beyond the middle of the last pixel, which would blend into the first.
    Wrap.MIRROR: "clamp(1.0 - abs(1.0 - mod({at}, 2.0)), {half}, 1.0 - {half})",
    Wrap.CLAMP: "clamp({at}, {half}, 1.0 - {half})",
}
"""In GLSL, as VTK wraps both directions of a texture in the same way."""


class TexturedBody:
    """Draws a mesh by its appearance: an actor for each material, all of them on the same points.

    Parameters
    ----------
    appearance : of the mesh
    patch : to be painted on it
    hidden : (F,) array, whether each of its faces is not drawn; None draws all

    Attributes
    ----------
    actors : to be added to a renderer, those that blend last
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
        """Take the pose of the mesh."""
        self._surface.vertices[:] = np.asarray(surface.vertices)[self._vertices]
        self._surface.normals[:] = np.asarray(surface.normals)[self._vertices]

    def set_visible(self, visible: bool) -> None:
        """Show or hide it."""
        for actor in self.actors:
            actor.SetVisibility(visible)


def _actor_of(polydata: pv.PolyData, material: Material) -> pv.Actor:
    actor = body_actor(polydata, culling=None if material.is_double_sided else "back")
    actor.prop.lighting = material.is_lit
    if not material.is_lit:
        actor.prop.ambient, actor.prop.diffuse = 0.0, 1.0
    # Blended with what is drawn already, and hiding what is behind: hair of many layers, and skin
    # that only says it blends, look right then without being sorted.
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
    # VTK takes an image of one column for one row.
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
