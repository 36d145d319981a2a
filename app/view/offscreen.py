"""Pictures and videos drawn off screen, without a window or as copies of its view."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, QTimer, Signal, Slot

from app.view.camera import followed
from app.work.threads import guarded
from lcollision_core.errors import CancelledError, MeshFileError
from lcollision_core.jobs import Job

if TYPE_CHECKING:
    import pyvista as pv
    from PIL.Image import Image

    from app.editing.document import PoseDocument
    from app.view.scene import Scene
    from app.view.shading import Theme
    from lcollision_core.bodies import Body
    from lcollision_core.motion import Motion


UInt8Array = npt.NDArray[np.uint8]

_NOTHING = "#000000"
"""Background of a transparent picture: black adds nothing to partly covered pixels at the rim."""

_CHART = (900, 620)

_FINEST = 512 * 512
"""Largest picture, in pixels, that is supersampled, at 16 times its size."""


def off_screen_plotter(width: int, height: int) -> pv.Plotter:
    """Return an off-screen plotter, for use in the GUI thread."""
    import pyvista as pv
    from vtkmodules.vtkCommonCore import vtkLogger

    # Without a display, VTK warns, but draws all the same.
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
    return pv.Plotter(off_screen=True, window_size=(width, height), lighting="light kit")


def save_chart(chart: pv.Chart2D, path: str | os.PathLike[str]) -> None:
    """Draw a chart on white and write it as a PNG file atomically.

    Raises
    ------
    MeshFileError : the file cannot be written.
    """
    from PIL import Image

    plotter = off_screen_plotter(*_CHART)
    plotter.set_background("white")
    plotter.add_chart(chart)
    picture = Image.fromarray(plotter.screenshot(return_img=True))
    plotter.close()
    save_png(picture, path)


class PoseRenderer:
    """Render poses of one model into pictures, in the GUI thread.

    Parameters
    ----------
    model : of all poses
    width, height : in pixels
    theme : whose colours are used
    transparent : whether to draw only the mesh, without a background
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
        """Render the current scene, in RGBA if `transparent`, else in RGB."""
        return to_image(self.pixels())

    def pixels(self) -> UInt8Array:
        """Render the current scene, (H, W, C), for `to_image` in any thread."""
        # Otherwise pyvista returns the previous picture.
        self._plotter.render()
        return np.array(
            self._plotter.screenshot(return_img=True, transparent_background=self._transparent)
        )

    def close(self) -> None:
        """Free the graphics memory."""
        self._plotter.close()


def to_image(pixels: UInt8Array) -> Image:
    """Return a picture of `PoseRenderer.pixels`, which may be changed in place."""
    from PIL import Image

    if pixels.shape[2] == 4:
        # Remove the black background from the colour of partly covered pixels.
        for row in pixels:
            alpha = np.maximum(row[:, 3:], 1).astype(np.float32)
            row[:, :3] = np.minimum(row[:, :3] * (255.0 / alpha), 255.0)
    return Image.fromarray(pixels)


def save_png(picture: Image, path: str | os.PathLike[str]) -> None:
    """Write a picture as a .png file atomically.

    Raises
    ------
    MeshFileError : the file cannot be written.
    """
    from lcollision_core.files import atomic_write

    with atomic_write(path) as file:
        # The default, level 6, takes seconds for a large picture and saves little.
        picture.save(file, format="PNG", compress_level=3)


FORMATS = (".gif", ".webp", ".png")
"""Video formats: GIF with 256 colours, WebP with all, PNG as a folder of numbered pictures."""

FASTEST_GIF = 50
"""Highest frame rate of a GIF: durations are in 1/100 s, and players slow down those of 1/100 s."""

_MOST_BYTES = 2**31
"""Most bytes of all frames of a GIF or a WebP, which stay in memory until encoded."""


@dataclass(frozen=True)
class VideoStyle:
    """The style of a video.

    Attributes
    ----------
    seconds : duration of one turn
    width, height : in pixels
    rate : frames per second
    background : "shown" as in the window, "plain" for one colour, or "transparent", which a GIF
        cannot be; the last two leave out the floor
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
        """Number of frames."""
        return max(2, round(self.seconds * self.rate))

    def durations(self, unit: int) -> list[int]:
        """Return each frame's duration in milliseconds, a multiple of `unit`.

        Rounding errors do not add up over the video.
        """
        ends = np.arange(self.n_frames + 1) * (1000.0 / self.rate / unit)
        return [int(unit * step) for step in np.diff(np.round(ends))]

    def why_not_writable(self, path: Path) -> MeshFileError | None:
        """Return an error that says why a video of this style cannot be written, or None."""
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
    """Draw a turntable video frame by frame; the frames are then encoded in any thread.

    Parameters
    ----------
    renderer : its scene is set up for the first frame; closed with the video
    path : the file to write, atomically; "turn.png" stands for a new folder "turn"
    style : of the video; the renderer has its size and background
    """

    def __init__(self, renderer: PoseRenderer, path: Path, style: VideoStyle) -> None:
        self._renderer = renderer
        self._style = style
        self._format = path.suffix[1:].upper()
        self.path = path.with_suffix("") if self._format == "PNG" else path
        self.n_drawn, self.n_frames = 0, style.n_frames
        self._frames: list[Image] = []
        # For a PNG sequence, whose frames are written as they are drawn.
        self._unfinished = ExitStack()
        self._folder: Path | None = None
        self._packing = Lock()

    def draw_next(self) -> None:
        """Draw the next frame, in the GUI thread."""
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
            # Use one palette for all frames: separate palettes would flicker.
            palette = self._frames[0] if self._frames else picture.quantize(dither=Dither.NONE)
            picture = picture.quantize(palette=palette, dither=Dither.NONE)
        self._frames.append(picture)

    def _set_up(self, number: int) -> None:
        """Set up the scene for a frame; the first is the current scene."""
        if number:
            self._renderer.scene.turn_camera(360.0 / self.n_frames)

    def _keep(self, picture: Image) -> None:
        """Write a frame of a PNG sequence; all frames appear in the folder at once."""
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

    def encode(self, job: Job) -> str:
        """Write the video once all frames are drawn, and return a message; runs as a job."""
        from lcollision_core.files import atomic_write

        if self._format != "PNG":
            # One thread at a time: Pillow's `save` changes the picture.
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
    """Draw a video of a motion from the current camera; see `TurntableVideo`.

    Parameters
    ----------
    renderer, path, style : see `TurntableVideo`
    model : of the motion
    motion : with as many frames as the video
    follows : whether the camera moves along with the body
    """

    def __init__(
        self,
        renderer: PoseRenderer,
        path: Path,
        style: VideoStyle,
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


_MOST_PIXELS = 2**25
"""Largest screenshot, in pixels: rendering takes about 80 bytes of memory per pixel."""


class Pictures(QObject):
    """Render copies of a viewport's scene off screen, and write them to files.

    The frames of a video are drawn one by one between the window's events; the document's worker
    for long work encodes them.

    Parameters
    ----------
    document : whose mesh the scene shows; emits messages on saved files
    scene_now : returns the updated scene, or raises if there is none yet
    parent : of the object

    Signals
    -------
    busy_changed : `busy` may have changed
    """

    busy_changed = Signal()

    def __init__(
        self, document: PoseDocument, scene_now: Callable[[], Scene], parent: QObject
    ) -> None:
        super().__init__(parent)
        self._document = document
        self._scene_now = scene_now
        self._video: TurntableVideo | None = None
        # Even with 0 ms between two frames, the window's events are processed.
        self._next = QTimer(self, interval=0)
        self._next.timeout.connect(self._on_next)

    @property
    def busy(self) -> str:
        """Description of the video being drawn, or "" if there is none."""
        return f"Making {self._video.path.name}" if self._video is not None else ""

    def screenshot(
        self, path: str | os.PathLike[str], width: int, height: int, transparent: bool
    ) -> None:
        """Render the scene in a given size; the document's worker for long work saves it.

        Parameters
        ----------
        path : a .png file
        width, height : in pixels; the vertical field of view is that of the window
        transparent : whether to leave out background, floor and shadow

        Raises
        ------
        MeshFileError : the picture has too many pixels for the memory.
        """
        path = Path(path)
        if width * height > _MOST_PIXELS:
            raise MeshFileError(
                f"would have {width} by {height} pixels, which takes too much memory",
                f"choose at most {_MOST_PIXELS // 10**6} million, such as 7680 by 4320",
                where=path.name,
            )
        renderer = self._copy(width, height, transparent)
        try:
            pixels = renderer.pixels()
        finally:
            renderer.close()
        self._document.tasks.write(f"Saving {path.name}", partial(_save, pixels, path))

    def film(
        self,
        path: str | os.PathLike[str],
        style: VideoStyle,
        motion: Motion | None = None,
        follows: bool = False,
    ) -> None:
        """Start a video, replacing one that is being drawn; emit a message once it is saved.

        It shows one full turn round the body, or a motion from the current camera.

        Parameters
        ----------
        path : a .gif or .webp file; a .png file stands for a new folder of numbered pictures with
            its stem as name
        style : size, rate and background
        motion : with as many frames as the video; None for a full turn
        follows : whether the camera moves along with the body of a motion

        Raises
        ------
        MeshFileError : the format is unknown or does not support `style`, or the folder of a PNG
            sequence exists already.
        """
        path = Path(path)
        refusal = style.why_not_writable(path)
        if refusal is not None:
            raise refusal
        self.cancel()
        renderer = self._copy(style.width, style.height, style.background == "transparent")
        if style.background == "plain":
            renderer.scene.show_floor(False)
            renderer.scene.set_plain_background(style.colour)
        if motion is None:
            self._video = TurntableVideo(renderer, path, style)
        else:
            # The crossing faces are those of the current frame only.
            renderer.scene.crossing.show(None)
            renderer.scene.uncounted.show(None)
            renderer.scene.show_ghost(None)
            model = self._document.model
            self._video = MotionVideo(renderer, path, style, model, motion, follows)
        self._next.start()
        self.busy_changed.emit()

    @Slot()
    def cancel(self) -> None:
        """Cancel the video being drawn."""
        if self._video is not None:
            self._end().close()
            self._document.message.emit("The video was cancelled")

    def _end(self) -> TurntableVideo:
        assert self._video is not None
        video, self._video = self._video, None
        self._next.stop()
        self.busy_changed.emit()
        return video

    def _copy(self, width: int, height: int, transparent: bool) -> PoseRenderer:
        from app.view.theme import current_theme

        scene = self._scene_now()
        renderer = PoseRenderer(self._document.model, width, height, current_theme(), transparent)
        renderer.scene.copy_from(scene)
        return renderer

    @Slot()
    def _on_next(self) -> None:
        video, label = self._video, self.busy
        assert video is not None
        drawn = guarded(label, video.draw_next)
        if drawn.failure is not None:
            self._end().close()
            self._document.failed.emit(drawn.failure)
            return
        self._document.message.emit(f"Video: frame {video.n_drawn} of {video.n_frames}")
        if video.n_drawn == video.n_frames:
            # Start writing before drawing ends: a closing window waits while either is busy.
            self._document.tasks.write(label, video.encode)
            self._end().close()


def _save(pixels: UInt8Array, path: Path, _: Job) -> str:
    save_png(to_image(pixels), path)
    return f"Saved {path.name}"
