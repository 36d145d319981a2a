"""How a mesh looks: materials, and colours on points that its seams split."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

IntArray = npt.NDArray[np.int64]

LEAST_SEEN = 1.0 / 255.0
"""The opacity below which a blended material shows nothing."""


class Wrap(Enum):
    """What an image shows outside of coordinates from 0 to 1."""

    REPEAT = "repeat"
    MIRROR = "mirror"
    CLAMP = "clamp"


@dataclass(frozen=True, eq=False)
class Texture:
    """An image for the faces of a mesh.

    Attributes
    ----------
    pixels : (H, W, 4) uint8 array, red, green and blue in sRGB, and opacity; the first row is at
        v = 0
    wrap : along u, along v
    is_smooth : whether large pixels blend into each other
    has_mipmaps : whether small pixels are averaged
    file : the image's file, where only that holds it, and not the glTF file; else empty
    """

    pixels: npt.NDArray[np.uint8]
    wrap: tuple[Wrap, Wrap] = (Wrap.REPEAT, Wrap.REPEAT)
    is_smooth: bool = True
    has_mipmaps: bool = True
    file: bytes = b""


@dataclass(frozen=True, eq=False)
class Material:
    """What faces are made of; its colour multiplies into those of the points.

    Attributes
    ----------
    texture : None for the points' colours alone
    cutoff : opacity below which nothing is seen; what is seen is opaque, unless it blends
    is_blended : whether what is behind shines through by the opacity
    is_double_sided : whether faces are seen from behind
    is_lit : False for colours that no light changes
    """

    texture: Texture | None = None
    cutoff: float = 0.0
    is_blended: bool = False
    is_double_sided: bool = True
    is_lit: bool = True


@dataclass(frozen=True, eq=False)
class Appearance:
    """How the faces of a mesh look.

    A vertex at a seam has several points, with other colours or texture coordinates.

    Attributes
    ----------
    vertices : (P,) int64 array, the vertex of the mesh that each of the P points lies on
    faces : (F, 3) int64 array, indices of points
    uv : (P, 2) float32 array, texture coordinates
    colours : (P, 4) uint8 array, red, green and blue in sRGB, and opacity
    material_of : (F,) int64 array, indices into `materials`
    materials : no two are the same object
    notes : sentences on what could not be read
    normals : (P, 3) float32 array, in the coordinates of the mesh; None where they are not asked
        for, or its file has none
    """

    vertices: IntArray
    faces: IntArray
    uv: npt.NDArray[np.float32]
    colours: npt.NDArray[np.uint8]
    material_of: IntArray
    materials: tuple[Material, ...]
    notes: tuple[str, ...] = ()
    normals: npt.NDArray[np.float32] | None = None

    @property
    def is_plain(self) -> bool:
        """Whether it is white all over, as what has no material is."""
        has_texture = any(material.texture is not None for material in self.materials)
        return not has_texture and bool((self.colours == 255).all())


def join_appearances(
    parts: Sequence[Appearance], counts: Sequence[int], joined: IntArray
) -> Appearance:
    """Make one appearance of those of the parts of a mesh.

    Parameters
    ----------
    parts : of each part
    counts : how many vertices each part has, W in all
    joined : (W,) array, the vertex of the mesh that each vertex of the parts is
    """
    materials = list(dict.fromkeys(material for part in parts for material in part.materials))
    number = {material: index for index, material in enumerate(materials)}
    first_vertex = np.cumsum([0, *counts])
    first_point = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return Appearance(
        np.concatenate([joined[part.vertices + first_vertex[i]] for i, part in enumerate(parts)]),
        np.concatenate([part.faces + first_point[i] for i, part in enumerate(parts)]),
        np.concatenate([part.uv for part in parts]),
        np.concatenate([part.colours for part in parts]),
        np.concatenate(
            [np.array([number[one] for one in part.materials])[part.material_of] for part in parts]
        ),
        tuple(materials),
        tuple(dict.fromkeys(note for part in parts for note in part.notes)),
    )
