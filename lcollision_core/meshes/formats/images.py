"""Images of textures, whoever made them."""

from __future__ import annotations

import io
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError

if TYPE_CHECKING:
    from PIL.Image import Image

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
