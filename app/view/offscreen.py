"""Pictures and videos drawn without a window."""

from __future__ import annotations

import os
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from app.view.camera import followed
from lcollision_core.errors import CancelledError, MeshFileError
from lcollision_core.jobs import Job

if TYPE_CHECKING:
    import pyvista as pv
    from PIL.Image import Image

    from app.view.shading import Theme
    from lcollision_core.bodies import Body
    from lcollision_core.motion import Motion


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
        self, model: Body, width: int, height: int, theme: Theme, transparent: bool = False
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

    def drawn(self) -> Image:
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


def picture_of(pixels: UInt8Array) -> Image:
    """Return a picture of `PoseRenderer.pixels`, which may change."""
    from PIL import Image

    if pixels.shape[2] == 4:
        # Pixels of a rim get the colour of what covers them, without the black behind it.
        for row in pixels:
            alpha = np.maximum(row[:, 3:], 1).astype(np.float32)
            row[:, :3] = np.minimum(row[:, :3] * (255.0 / alpha), 255.0)
    return Image.fromarray(pixels)


def save_png(picture: Image, path: str | os.PathLike[str]) -> None:
    """Write a picture as a .png file, whole or not at all.

    Raises
    ------
    MeshFileError : the file cannot be written.
    """
    from lcollision_core.files import atomic_write

    with atomic_write(path) as file:
        # Level 6, the default, takes seconds for a large picture and saves little.
        picture.save(file, format="PNG", compress_level=3)


FORMATS = (".gif", ".webp", ".png")
"""A GIF has 256 colours, a WebP all of them, and PNG is a folder of numbered pictures."""

FASTEST_GIF = 50
"""Frames a second: a GIF counts in hundredths of a second, and players slow down one of 1."""

_MOST_BYTES = 2**31
"""Most bytes of all frames of a GIF or a WebP, which stay in memory until it is packed."""


@dataclass(frozen=True)
class TurntableStyle:
    """How a turntable video looks.

    Attributes
    ----------
    seconds : that one turn lasts
    width, height : in pixels
    rate : frames a second
    background : "shown" as in the window, "plain" for one colour, or "transparent", which a GIF
        cannot be; the last two leave the floor out
    colour : "#rrggbb", of a plain background
    """

    seconds: float = 4.0
    width: int = 640
    height: int = 640
    rate: int = 25
    background: str = "shown"
    colour: str = "#ffffff"

    @property
    def n_frames(self) -> int:
        """How many frames one turn has."""
        return max(2, round(self.seconds * self.rate))

    def durations(self, unit: int) -> list[int]:
        """Return each frame's milliseconds, in multiples of a unit that add up to the turn."""
        ends = np.arange(self.n_frames + 1) * (1000.0 / self.rate / unit)
        return [int(unit * step) for step in np.diff(np.round(ends))]

    def refusal(self, path: Path) -> MeshFileError | None:
        """Return why a video cannot be written in this style, or None if it can."""
        suffix = path.suffix.lower()
        where: str | Path = path.name
        n_bytes = self.n_frames * self.width * self.height * (1 if suffix == ".gif" else 4)
        if suffix not in FORMATS:
            what, next_step = "can't be written as a video", f"name it {', '.join(FORMATS)}"
        elif suffix == ".png" and path.with_suffix("").exists():
            where = path.with_suffix("")
            what, next_step = "already exists", "choose a new name for the PNG sequence"
        elif suffix == ".gif" and self.background == "transparent":
            what, next_step = "cannot have a transparent background", "choose WebP or PNG"
        elif suffix == ".gif" and self.rate > FASTEST_GIF:
            what = f"cannot have {self.rate} frames a second, a GIF has at most {FASTEST_GIF}"
            next_step = "choose fewer, WebP or PNG"
        elif suffix != ".png" and n_bytes > _MOST_BYTES:
            size = f"{self.n_frames} frames of {self.width} by {self.height} pixels"
            what = f"would take {size}, which is too much for one file"
            next_step = "choose a smaller size or a PNG sequence"
        else:
            return None
        return MeshFileError(what, next_step, where=where)


class TurntableVideo:
    """Draws a turntable video frame by frame; what is drawn is then packed, in any thread.

    Parameters
    ----------
    renderer : whose scene is set up for the first frame; closed with the video
    path : the file to write, whole or not at all; "turn.png" stands for a new folder "turn"
    style : of the video; the renderer is of its size and background
    """

    def __init__(self, renderer: PoseRenderer, path: Path, style: TurntableStyle) -> None:
        self._renderer = renderer
        self._style = style
        self._format = path.suffix[1:].upper()
        self.path = path.with_suffix("") if self._format == "PNG" else path
        self.n_drawn, self.n_frames = 0, style.n_frames
        self._frames: list[Image] = []
        # Of a PNG sequence, whose frames need not wait in memory.
        self._unfinished = ExitStack()
        self._folder: Path | None = None
        self._packing = Lock()

    def draw_next(self) -> None:
        """Draw one more frame; in the thread of the window."""
        from PIL.Image import Dither

        self._set_up(self.n_drawn)
        picture = self._renderer.drawn()
        self.n_drawn += 1
        if self._format == "PNG":
            self._keep(picture)
            if self.n_drawn == self.n_frames:
                self._unfinished.close()
            return
        if self._format == "GIF":
            # One palette for all frames: separate palettes would flicker.
            palette = self._frames[0] if self._frames else picture.quantize(dither=Dither.NONE)
            picture = picture.quantize(palette=palette, dither=Dither.NONE)
        self._frames.append(picture)

    def _set_up(self, number: int) -> None:
        """Bring the scene to one frame; the first is as the scene is."""
        if number:
            self._renderer.scene.turn_camera(360.0 / self.n_frames)

    def _keep(self, picture: Image) -> None:
        """Write a frame of a PNG sequence, which comes into its folder with all others."""
        from lcollision_core.files import atomic_files

        if self._folder is None:
            self._folder = self._unfinished.enter_context(atomic_files(self.path))
        digits = max(4, len(str(self.n_frames)))
        name = f"{self.path.name}_{self.n_drawn:0{digits}d}.png"
        picture.save(self._folder / name, format="PNG", compress_level=3)

    def close(self) -> None:
        """Stop drawing, and delete an incomplete PNG sequence."""
        self._renderer.close()
        incomplete = CancelledError("the video is incomplete")
        self._unfinished.__exit__(CancelledError, incomplete, None)

    def pack(self, job: Job) -> str:
        """Write the video once all of it is drawn, and return a message; a `Job`."""
        from lcollision_core.files import atomic_write

        if self._format != "PNG":
            # One thread at a time: saving changes a picture of Pillow's.
            with self._packing, atomic_write(self.path) as file:
                self._frames[0].save(
                    file,
                    format=self._format,
                    save_all=True,
                    append_images=self._frames[1:],
                    duration=self._style.durations(10 if self._format == "GIF" else 1),
                    loop=0,
                    optimize=False,
                )
                job.check()
        return f"Saved {self.path.name}"


class MotionVideo(TurntableVideo):
    """Draws a video of a motion, likewise, from where the camera is.

    Parameters
    ----------
    renderer, path, style : see `TurntableVideo`
    model : of the motion
    motion : as many frames as the video has
    follows : whether the camera moves along with the body
    """

    def __init__(
        self,
        renderer: PoseRenderer,
        path: Path,
        style: TurntableStyle,
        model: Body,
        motion: Motion,
        follows: bool = False,
    ) -> None:
        super().__init__(renderer, path, style)
        self._model, self._motion, self._check = model, motion, model.exact_check()
        self._follows, self._aspect = follows, style.width / style.height

    def _set_up(self, number: int) -> None:
        from lcollision_core.meshes.normals import vertex_normals

        scene, vertices = self._renderer.scene, self._motion.drawn(number, self._check)
        if self._follows:
            before, up = np.asarray(scene.surface.vertices), self._model.up_axis
            scene.view = followed(scene.view, before, vertices, up, self._aspect)
        scene.show(vertices, vertex_normals(vertices, self._model.faces))
