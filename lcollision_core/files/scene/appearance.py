"""How a mesh looks: materials, textures' images, and colours on points that its seams split."""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError

if TYPE_CHECKING:
    from PIL.Image import Image


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
            [
                np.array([number[material] for material in part.materials])[part.material_of]
                for part in parts
            ]
        ),
        tuple(materials),
        tuple(dict.fromkeys(note for part in parts for note in part.notes)),
    )


_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA")
_MOST_SIDE = 2048
"""Pixels of the longer side; larger images are shrunk to it."""

_MOST_PIXELS = 1 << 26
"""Of an image in a file; decoding needs up to 8 bytes for each."""

_MOST_BYTES = 1 << 29
"""Of all images of a file together, once they are shrunk."""


class ImageReader:
    """Decodes the images of one file, within a limit for all of them."""

    def __init__(self) -> None:
        self._left = _MOST_BYTES

    def read(self, data: bytes, what: str) -> npt.NDArray[np.uint8]:
        """Decode an image.

        Parameters
        ----------
        data : a file of a common format
        what : as in "image 3"

        Returns
        -------
        pixels : (H, W, 4) array, from top to bottom; at most `_MOST_SIDE` pixels a side

        Raises
        ------
        MeshFileError : it is damaged or too large, or of another format.
        """
        from PIL import Image

        try:
            with warnings.catch_warnings(action="ignore"):
                image = Image.open(io.BytesIO(data), formats=_FORMATS)
            if image.width * image.height > _MOST_PIXELS:
                raise Image.DecompressionBombError
            # Of a large JPEG no more is decoded than is needed.
            image.draft(None, (_MOST_SIDE, _MOST_SIDE))
            pixels = _shrunk(_in_8_bits(image))
        except Image.DecompressionBombError as error:
            most = f"more than {_MOST_PIXELS >> 20} million pixels"
            raise MeshFileError(f"has {most}", where=what) from error
        # On a damaged image Pillow raises whatever its line at hand raises; nothing of ours runs
        # here.
        except Exception as error:
            raise MeshFileError(
                f"is damaged or no {', '.join(_FORMATS[:-1])} or {_FORMATS[-1]} image", where=what
            ) from error
        self._left -= pixels.nbytes
        if self._left < 0:
            raise MeshFileError(
                f"is beyond the {_MOST_BYTES >> 20} MiB that all images may take", where=what
            )
        return pixels


def _in_8_bits(image: Image) -> Image:
    if image.mode.startswith("I"):
        # Pillow would clip 16 bits, not scale them.
        grey = np.asarray(image).astype(np.uint32) >> 8
        from PIL import Image as Images

        return Images.fromarray(grey.astype(np.uint8)).convert("RGBA")
    return image.convert("RGBA")


def _shrunk(image: Image) -> npt.NDArray[np.uint8]:
    scale = _MOST_SIDE / max(image.size)
    size = max(1, round(scale * image.width)), max(1, round(scale * image.height))
    # Band by band: where nothing is opaque, colours would be lost, which some materials show.
    bands = [band if scale >= 1.0 else band.resize(size) for band in image.split()]
    return np.stack([np.asarray(band) for band in bands], axis=-1)


def screen_colours(linear: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """Return (n, 4) linear colours from 0 to 1 in sRGB; the opacity stays linear."""
    light = linear[:, :3]
    colours = np.array(linear, dtype=np.float64)
    colours[:, :3] = np.where(
        light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055
    )
    return np.rint(255.0 * colours).astype(np.uint8)


def linear_colours(colours: npt.NDArray[np.uint8]) -> npt.NDArray[np.float64]:
    """Return the linear colours from 0 to 1 of (n, 4) colours in sRGB: see `screen_colours`."""
    linear = colours / 255.0
    light = linear[:, :3]
    linear[:, :3] = np.where(light <= 0.04045, light / 12.92, ((light + 0.055) / 1.055) ** 2.4)
    return linear
