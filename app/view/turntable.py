"""A turntable video of a pose, made while the window stays alive."""

from __future__ import annotations

import logging
import traceback
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

import numpy as np
from PySide6.QtCore import QObject, QTimer, Signal, Slot

from app.view.camera import View, turned
from app.work.threads import Failure
from lcollision_core.errors import CancelledError, LCollisionError, MeshFileError
from lcollision_core.jobs import CancelToken

if TYPE_CHECKING:
    from PIL.Image import Image

    from app.view.rendering import PoseRenderer

_log = logging.getLogger(__name__)

FILMS = (".gif", ".webp", ".png")
"""What a film may be called; a GIF has 256 colours, a WebP all of them, and PNG is a folder of
numbered pictures."""

FASTEST_GIF = 50
"""Frames a second: a GIF counts in hundredths of a second, and players slow down one of 1."""

_MOST_BYTES = 2**31
"""Of all frames of a film, which are in memory until it is packed."""


@dataclass(frozen=True)
class TurntableStyle:
    """How a turntable looks.

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


class Turntable(QObject):
    """Draws a film frame by frame between the window's own events, then packs it in a thread.

    Parameters
    ----------
    renderer : whose scene is set up; belongs to the film from now on
    view : the first frame's camera
    path : the file to write, whole or not at all; "turn.png" stands for a new folder "turn"
    style : of the film; the renderer is of its size and background
    parent : of the object

    Signals
    -------
    progressed : int, int, the frames that are drawn and all frames
    finished : Path of the film, or None where it was cancelled
    failed : Failure; no film is written then

    Raises
    ------
    MeshFileError : `path` is none of `FILMS`, the folder of a PNG sequence is there already, or
        the format cannot hold what `style` asks for.
    """

    progressed = Signal(int, int)
    finished = Signal(object)
    failed = Signal(object)
    _packed = Signal(object)

    def __init__(
        self,
        renderer: PoseRenderer,
        view: View,
        path: Path,
        style: TurntableStyle,
        parent: QObject | None = None,
    ) -> None:
        super().__init__(parent)
        refusal = _refusal(path, style)
        if refusal is not None:
            renderer.close()
            raise refusal
        self._renderer: PoseRenderer | None = renderer
        self._view = view
        self._style = style
        self._format = path.suffix[1:].upper()
        self.path = path.with_suffix("") if self._format == "PNG" else path
        self._cancel = CancelToken()
        self._frames: list[Image] = []
        self._n_drawn = 0
        self.n_frames = style.n_frames
        # Of a PNG sequence, whose frames need not wait in memory.
        self._unfinished = ExitStack()
        self._folder: Path | None = None
        self._packer: Thread | None = None
        self._packed.connect(self._on_packed)
        # With 0 ms between two frames the window's own events still have their turn.
        self._next = QTimer(self, interval=0)
        self._next.timeout.connect(self._on_next)
        self._next.start()

    @property
    def is_running(self) -> bool:
        """Whether frames are still being drawn or packed."""
        return self._next.isActive() or self._packer is not None

    @Slot()
    def cancel(self) -> None:
        """Stop drawing; a film that is being packed already is thrown away once it is."""
        self._cancel.cancel()
        if self._next.isActive():
            self._stop_drawing()
            self._drop_files()
            self.finished.emit(None)

    def wait(self) -> None:
        """Stop drawing, or wait for a film that is being packed already."""
        if self._next.isActive():
            self.cancel()
        if self._packer is not None:
            self._packer.join()

    @Slot()
    def _on_next(self) -> None:
        try:
            self._draw_next()
        except Exception as error:
            self._stop_drawing()
            self._drop_files()
            self.failed.emit(self._failure(error))
            return
        self.progressed.emit(self._n_drawn, self.n_frames)
        if self._n_drawn == self.n_frames:
            frames = self._frames
            self._stop_drawing()
            self._packer = Thread(target=self._pack, args=(frames,), name="turntable")
            self._packer.start()

    def _draw_next(self) -> None:
        from PIL import Image

        assert self._renderer is not None
        angle = 2.0 * np.pi * self._n_drawn / self.n_frames
        self._renderer.scene.view = turned(self._view, angle)
        n_channels = 4 if self._style.background == "transparent" else 3
        picture = Image.fromarray(np.ascontiguousarray(self._renderer.drawn()[:, :, :n_channels]))
        self._n_drawn += 1
        if self._format == "PNG":
            self._keep(picture)
            return
        if self._format == "GIF":
            # One palette for all frames: colours of their own would flicker.
            palette = (
                self._frames[0] if self._frames else picture.quantize(dither=Image.Dither.NONE)
            )
            picture = picture.quantize(palette=palette, dither=Image.Dither.NONE)
        self._frames.append(picture)

    def _keep(self, picture: Image) -> None:
        """Write a frame of a PNG sequence, which comes into its folder with all others."""
        from lcollision_core.meshes import atomic_files

        if self._folder is None:
            self._folder = self._unfinished.enter_context(atomic_files(self.path))
        digits = max(4, len(str(self.n_frames)))
        name = f"{self.path.name}_{self._n_drawn:0{digits}d}.png"
        picture.save(self._folder / name, format="PNG", compress_level=3)

    def _drop_files(self) -> None:
        """Leave nothing of a PNG sequence that is not complete."""
        self._unfinished.__exit__(CancelledError, CancelledError("incomplete"), None)

    def _stop_drawing(self) -> None:
        self._next.stop()
        self._frames = []
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _pack(self, frames: list[Image]) -> None:
        from lcollision_core.meshes import atomic_write

        try:
            if self._format == "PNG":
                self._unfinished.close()
            else:
                with atomic_write(self.path) as file:
                    frames[0].save(
                        file,
                        format=self._format,
                        save_all=True,
                        append_images=frames[1:],
                        duration=self._style.durations(10 if self._format == "GIF" else 1),
                        loop=0,
                        optimize=False,
                    )
                    self._cancel.raise_if_cancelled()
        except CancelledError:
            self._packed.emit(None)
        except Exception as error:
            self._packed.emit(self._failure(error))
        else:
            self._packed.emit(self.path)

    def _failure(self, error: Exception) -> Failure:
        """Tell of what was raised, while it is handled."""
        if isinstance(error, LCollisionError):
            return Failure.of(error)
        _log.exception("no film")
        return Failure(
            f"the turntable {self.path.name} could not be made",
            f"try a shorter turn or another kind of file ({', '.join(FILMS)})",
            traceback.format_exc(),
        )

    @Slot(object)
    def _on_packed(self, outcome: Path | Failure | None) -> None:
        if self._packer is not None:
            self._packer.join()
            self._packer = None
        if isinstance(outcome, Failure):
            self.failed.emit(outcome)
        else:
            self.finished.emit(outcome)


def _refusal(path: Path, style: TurntableStyle) -> MeshFileError | None:
    """Say why a film cannot be written so, or return None where it can."""
    suffix = path.suffix.lower()
    where: str | Path = path.name
    n_bytes = style.n_frames * style.width * style.height * (1 if suffix == ".gif" else 4)
    if suffix not in FILMS:
        what, next_step = "can't be written as a turntable", f"name it {', '.join(FILMS)}"
    elif suffix == ".png" and path.with_suffix("").exists():
        where = path.with_suffix("")
        what, next_step = "is there already", "choose a new name for the PNG sequence"
    elif suffix == ".gif" and style.background == "transparent":
        what, next_step = "cannot have a transparent background", "choose WebP or PNG"
    elif suffix == ".gif" and style.rate > FASTEST_GIF:
        what = f"cannot have {style.rate} frames a second, a GIF has at most {FASTEST_GIF}"
        next_step = "choose fewer, WebP or PNG"
    elif suffix != ".png" and n_bytes > _MOST_BYTES:
        size = f"{style.n_frames} frames of {style.width} by {style.height} pixels"
        what = f"would have {size}, which is too much for one file"
        next_step = "choose less or a PNG sequence"
    else:
        return None
    return MeshFileError(what, next_step, where=where)
