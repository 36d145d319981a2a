"""Pictures of poses, drawn off the screen: screenshots and turntable videos."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import pyvista as pv
    from PIL import Image

    from app.view.palettes import Theme
    from lcollision_core.bodies import PosableBody

UInt8Array = npt.NDArray[np.uint8]

_NOTHING = "#000000"
"""Behind a cut-out picture: adds nothing to the pixels that a rim covers in part."""

_CHART = (900, 620)

_FINEST = 512 * 512
"""Pixels: up to this size a picture is drawn 16 times as large and shrunk."""


def off_screen_plotter(width: int, height: int) -> pv.Plotter:
    """Return what draws into a picture, for the thread of the window."""
    import pyvista as pv
    from vtkmodules.vtkCommonCore import vtkLogger

    # Without a display VTK warns of that, then draws all the same.
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
    return pv.Plotter(off_screen=True, window_size=(width, height), lighting="light kit")


def save_chart(chart: pv.Chart2D, path: str | os.PathLike[str]) -> None:
    """Draw a chart on white as a PNG, whole or not at all.

    Raises
    ------
    MeshFileError : it cannot be written.
    """
    from PIL import Image

    plotter = off_screen_plotter(*_CHART)
    plotter.set_background("white")
    plotter.add_chart(chart)
    picture = Image.fromarray(plotter.screenshot(return_img=True))
    plotter.close()
    save_png(picture, path)


class PoseRenderer:
    """Draws poses of one model into pictures; for the thread of the window.

    Parameters
    ----------
    model : of all poses
    width, height : in pixels
    theme : whose colours are used
    transparent : nothing but the mesh, without a background
    """

    def __init__(
        self, model: PosableBody, width: int, height: int, theme: Theme, transparent: bool = False
    ) -> None:
        from app.view.scene import Scene

        self._transparent = transparent
        self._plotter = off_screen_plotter(width, height)
        if width * height <= _FINEST:
            self._plotter.enable_anti_aliasing("ssaa")
        else:
            self._plotter.enable_anti_aliasing("msaa", multi_samples=8)
        self.scene = Scene(self._plotter, model, theme)
        self.scene.show_floor(not transparent)
        if transparent:
            self.scene.set_plain_background(_NOTHING)

    def drawn(self) -> Image.Image:
        """Draw the scene as it is, in RGBA where it is `transparent` and else in RGB."""
        return picture_of(self.pixels())

    def pixels(self) -> UInt8Array:
        """Draw the scene as it is, (H, W, C), for `picture_of` in any thread."""
        # Otherwise pyvista returns the picture before.
        self._plotter.render()
        return np.array(
            self._plotter.screenshot(return_img=True, transparent_background=self._transparent)
        )

    def close(self) -> None:
        """Free the picture's memory on the graphics card."""
        self._plotter.close()


def picture_of(pixels: UInt8Array) -> Image.Image:
    """Return a picture of `PoseRenderer.pixels`, which may change."""
    from PIL import Image

    if pixels.shape[2] == 4:
        # Pixels of a rim get the colour of what covers them, without the black behind it.
        for row in pixels:
            alpha = np.maximum(row[:, 3:], 1).astype(np.float32)
            row[:, :3] = np.minimum(row[:, :3] * (255.0 / alpha), 255.0)
    return Image.fromarray(pixels)


def save_png(picture: Image.Image, path: str | os.PathLike[str]) -> None:
    """Write a picture as a .png file, whole or not at all.

    Raises
    ------
    MeshFileError : the file cannot be written.
    """
    from lcollision_core.meshes import atomic_write

    with atomic_write(path) as file:
        # Level 6, the default, takes seconds for a large picture and saves little.
        picture.save(file, format="PNG", compress_level=3)
