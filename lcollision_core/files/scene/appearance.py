"""Appearance of a mesh: materials, textures, and colours on points that are split at seams."""

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
from lcollision_core.meshes.topology import Int64Array

if TYPE_CHECKING:
    from PIL.Image import Image


LEAST_SEEN = 1.0 / 255.0
"""Opacity below which a blended material is invisible."""


class Wrap(Enum):
    """Extension of an image beyond texture coordinates from 0 to 1."""

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
    is_smooth : whether magnified pixels are interpolated
    has_mipmaps : whether minified pixels are averaged
    file : bytes of the image file for an image of an FBX file; else empty
    """

    pixels: npt.NDArray[np.uint8]
    wrap: tuple[Wrap, Wrap] = (Wrap.REPEAT, Wrap.REPEAT)
    is_smooth: bool = True
    has_mipmaps: bool = True
    file: bytes = b""


@dataclass(frozen=True, eq=False)
class Material:
    """Material of faces; its texture is multiplied with the colours of the points.

    Attributes
    ----------
    texture : None for the colours of the points only
    cutoff : opacity below which a pixel is invisible; others are opaque unless blended
    is_blended : whether the opacity blends with the background
    is_double_sided : whether back faces are visible
    is_lit : whether light changes the colours
    """

    texture: Texture | None = None
    cutoff: float = 0.0
    is_blended: bool = False
    is_double_sided: bool = True
    is_lit: bool = True


@dataclass(frozen=True, eq=False)
class Appearance:
    """Appearance of the faces of a mesh.

    A vertex at a seam has several points with different colours or texture coordinates.

    Attributes
    ----------
    vertices : (P,) int64 array, the mesh vertex of each of the P points
    faces : (F, 3) int64 array, indices of points
    uv : (P, 2) float32 array, texture coordinates
    colours : (P, 4) uint8 array, red, green and blue in sRGB, and opacity
    material_of : (F,) int64 array, indices into `materials`
    materials : distinct materials
    notes : sentences on what could not be read
    normals : (P, 3) float32 array, in the coordinates of the mesh; None if not requested or not in
        the file
    """

    vertices: Int64Array
    faces: Int64Array
    uv: npt.NDArray[np.float32]
    colours: npt.NDArray[np.uint8]
    material_of: Int64Array
    materials: tuple[Material, ...]
    notes: tuple[str, ...] = ()
    normals: npt.NDArray[np.float32] | None = None

    @classmethod
    def plain(cls, n_vertices: int, faces: Int64Array) -> Appearance:
        """Return the appearance of a white mesh, with a point for each vertex."""
        return cls(
            np.arange(n_vertices),
            faces,
            np.zeros((n_vertices, 2), dtype=np.float32),
            np.full((n_vertices, 4), 255, dtype=np.uint8),
            np.zeros(len(faces), dtype=np.int64),
            (Material(),),
        )

    @property
    def is_plain(self) -> bool:
        """Whether the mesh is white all over, as without materials."""
        has_texture = any(material.texture is not None for material in self.materials)
        return not has_texture and bool((self.colours == 255).all())


def join_appearances(
    parts: Sequence[Appearance], counts: Sequence[int], joined: Int64Array
) -> Appearance:
    """Join the appearances of the parts of a mesh.

    Parameters
    ----------
    parts : appearance of each part
    counts : number of vertices of each part, W in all
    joined : (W,) array, the mesh vertex of each vertex of the parts
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
"""Most pixels of the longer side; larger images are downscaled."""

_MOST_PIXELS = 1 << 26
"""Most pixels of an image in a file; decoding takes up to 8 bytes per pixel."""

_MOST_BYTES = 1 << 29
"""Most bytes of all images of a file together, after downscaling."""


@dataclass(eq=False)
class ImageReader:
    """Decodes the images of one file, up to a limit for all together."""

    _left: int = _MOST_BYTES

    def read(self, data: bytes, what: str) -> npt.NDArray[np.uint8]:
        """Decode an image.

        Parameters
        ----------
        data : bytes of an image file in a common format
        what : name in error messages, such as "image 3"

        Returns
        -------
        pixels : (H, W, 4) array, from top to bottom; at most `_MOST_SIDE` pixels per side

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
            # Decode a large JPEG at a reduced size.
            image.draft(None, (_MOST_SIDE, _MOST_SIDE))
            pixels = _shrunk(_in_8_bits(image))
        except Image.DecompressionBombError as error:
            most = f"more than {_MOST_PIXELS >> 20} million pixels"
            raise MeshFileError(f"has {most}", where=what) from error
        # Pillow raises errors of any type for damaged images; none of our code runs here.
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
        # Pillow would clip 16-bit values instead of scaling them.
        grey = np.asarray(image).astype(np.uint32) >> 8
        from PIL import Image as Images

        return Images.fromarray(grey.astype(np.uint8)).convert("RGBA")
    return image.convert("RGBA")


def _shrunk(image: Image) -> npt.NDArray[np.uint8]:
    scale = _MOST_SIDE / max(image.size)
    size = max(1, round(scale * image.width)), max(1, round(scale * image.height))
    # Resize each band alone: otherwise transparent pixels lose their colours, which some materials
    # show.
    bands = [band if scale >= 1.0 else band.resize(size) for band in image.split()]
    return np.stack([np.asarray(band) for band in bands], axis=-1)


def screen_colours(linear: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """Convert (n, 4) linear colours from 0 to 1 to sRGB; the opacity stays linear."""
    light = linear[:, :3]
    colours = np.array(linear, dtype=np.float64)
    colours[:, :3] = np.where(
        light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055
    )
    return np.rint(255.0 * colours).astype(np.uint8)


def linear_colours(colours: npt.NDArray[np.uint8]) -> npt.NDArray[np.float64]:
    """Convert (n, 4) sRGB colours to linear ones from 0 to 1: see `screen_colours`."""
    linear = colours / 255.0
    light = linear[:, :3]
    linear[:, :3] = np.where(light <= 0.04045, light / 12.92, ((light + 0.055) / 1.055) ** 2.4)
    return linear
