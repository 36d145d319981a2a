"""Pictures of poses, drawn off the screen: screenshots and turntables."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from lcollision_core.model import PoseModel

ImageArray = npt.NDArray[np.uint8]

_NOTHING = "#000000"
"""Behind a cut-out picture: adds nothing to the pixels that a rim covers in part."""

_FINEST = 512 * 512
"""Pixels up to which a picture is drawn 16 times as large and shrunk."""


class PoseRenderer:
    """Draws poses of one model into arrays; for the thread of the window.

    Parameters
    ----------
    model : of all poses
    width, height : in pixels
    dark : for a dark theme
    transparent : nothing but the mesh, without a background
    """

    def __init__(
        self,
        model: PoseModel,
        width: int,
        height: int,
        dark: bool = False,
        transparent: bool = False,
    ) -> None:
        import pyvista as pv
        from vtkmodules.vtkCommonCore import vtkLogger

        from app.view.scene import Scene

        # Without a display VTK warns of that, then draws all the same.
        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
        self._transparent = transparent
        self._plotter = pv.Plotter(
            off_screen=True, window_size=(width, height), lighting="light kit"
        )
        if width * height <= _FINEST:
            self._plotter.enable_anti_aliasing("ssaa")
        else:
            self._plotter.enable_anti_aliasing("msaa", multi_samples=8)
        self.scene = Scene(
            self._plotter, model.faces, model.n_vertices, model.up_axis, model.height, dark
        )
        self.scene.show_floor(not transparent)
        if transparent:
            self.scene.set_plain_background(_NOTHING)

    def drawn(self) -> ImageArray:
        """Draw the scene as it is.

        Returns
        -------
        pixels : (height, width, 4) uint8 array, red, green, blue and alpha, which is 255
            throughout unless `transparent`
        """
        # Or else pyvista hands out the last picture again.
        self._plotter.render()
        pixels = np.asarray(
            self._plotter.screenshot(return_img=True, transparent_background=self._transparent)
        )
        if self._transparent:
            return _uncovered(pixels)
        opaque = np.full((*pixels.shape[:2], 1), 255, dtype=np.uint8)
        return np.concatenate([pixels, opaque], axis=2)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Draw the scene as it is into a file.

        Parameters
        ----------
        path : a .png file, written whole or not at all

        Raises
        ------
        MeshFileError : the file cannot be written.
        """
        from PIL import Image

        from lcollision_core.meshes import atomic_write

        pixels = self.drawn()
        picture = Image.fromarray(pixels if self._transparent else pixels[:, :, :3].copy())
        with atomic_write(path) as file:
            # Level 6, the default, takes seconds for a large picture and saves little.
            picture.save(file, format="PNG", compress_level=3)

    def close(self) -> None:
        """Free the picture's memory on the graphics card."""
        self._plotter.close()


def _uncovered(pixels: ImageArray) -> ImageArray:
    """Give pixels of a rim, darkened by the black behind, the colour of what covers them.

    Parameters
    ----------
    pixels : (height, width, 4) uint8 array, drawn on black; alpha is the share that is covered
    """
    alpha = np.maximum(pixels[:, :, 3:], 1).astype(np.float32)
    straight = pixels.copy()
    straight[:, :, :3] = np.minimum(pixels[:, :, :3] * (255.0 / alpha), 255.0).astype(np.uint8)
    return straight
