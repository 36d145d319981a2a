"""Videos of one full turn round a pose, or of a motion: a GIF, a WebP or numbered pictures."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np

from app.view.camera import followed
from lcollision_core.errors import CancelledError, MeshFileError
from lcollision_core.jobs import CancelToken, Progress

if TYPE_CHECKING:
    from PIL.Image import Image

    from app.view.offscreen import PoseRenderer
    from lcollision_core.bodies import PosableBody
    from lcollision_core.motion import Motion

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
        from lcollision_core.meshes import atomic_files

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

    def pack(self, _: Progress, cancel: CancelToken) -> str:
        """Write the video once all of it is drawn, and return a message; a `Job`."""
        from lcollision_core.meshes import atomic_write

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
                cancel.raise_if_cancelled()
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
        model: PosableBody,
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
