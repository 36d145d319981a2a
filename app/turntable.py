"""A film of one turn round a pose, made while the window stays alive."""

from __future__ import annotations

import logging
import traceback
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

import numpy as np
from PySide6.QtCore import QObject, QTimer, Signal, Slot

from app.camera import View, turned
from app.engine import Failure
from lcollision_core.errors import CancelledError, LCollisionError, MeshFileError
from lcollision_core.jobs import CancelToken

if TYPE_CHECKING:
    from PIL.Image import Image

    from app.rendering import PoseRenderer

_log = logging.getLogger(__name__)

FILMS = (".gif", ".webp")
"""What a film may be called; a GIF has 256 colours, a WebP all of them."""

FRAME_SECONDS = 0.04
"""A GIF counts in hundredths of a second."""


class Turntable(QObject):
    """Draws a film frame by frame between the window's own events, then packs it in a thread.

    Parameters
    ----------
    renderer : whose scene is set up; belongs to the film from now on
    view : the first frame's camera
    path : the file to write, whole or not at all
    seconds : that one turn lasts
    parent : of the object

    Signals
    -------
    progressed : int, int, the frames that are drawn and all frames
    finished : Path of the film, or None where it was cancelled
    failed : Failure; no film is written then

    Raises
    ------
    MeshFileError : `path` is none of `FILMS`.
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
        seconds: float,
        parent: QObject | None = None,
    ) -> None:
        super().__init__(parent)
        if path.suffix.lower() not in FILMS:
            renderer.close()
            raise MeshFileError(
                f"{path.name} is no film that can be written; call it {' or '.join(FILMS)}"
            )
        self._renderer: PoseRenderer | None = renderer
        self._view = view
        self.path = path
        self._cancel = CancelToken()
        self._frames: list[Image] = []
        self.n_frames = max(2, round(seconds / FRAME_SECONDS))
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
            self.failed.emit(self._failure(error))
            return
        self.progressed.emit(len(self._frames), self.n_frames)
        if len(self._frames) == self.n_frames:
            frames = self._frames
            self._stop_drawing()
            self._packer = Thread(target=self._pack, args=(frames,), name="turntable")
            self._packer.start()

    def _draw_next(self) -> None:
        from PIL import Image

        assert self._renderer is not None
        angle = 2.0 * np.pi * len(self._frames) / self.n_frames
        self._renderer.scene.view = turned(self._view, angle)
        picture = Image.fromarray(np.ascontiguousarray(self._renderer.drawn()[:, :, :3]))
        if self.path.suffix.lower() == ".gif":
            # One palette for all frames: colours of their own would flicker.
            palette = (
                self._frames[0] if self._frames else picture.quantize(dither=Image.Dither.NONE)
            )
            picture = picture.quantize(palette=palette, dither=Image.Dither.NONE)
        self._frames.append(picture)

    def _stop_drawing(self) -> None:
        self._next.stop()
        self._frames = []
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _pack(self, frames: list[Image]) -> None:
        from lcollision_core.meshes import atomic_write

        try:
            with atomic_write(self.path) as file:
                frames[0].save(
                    file,
                    format=self.path.suffix[1:].upper(),
                    save_all=True,
                    append_images=frames[1:],
                    duration=round(1000 * FRAME_SECONDS),
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
            return Failure(str(error), traceback.format_exc())
        _log.exception("no film")
        return Failure(
            f"the turntable {self.path.name} could not be made; try a shorter turn or another "
            f"kind of file ({' or '.join(FILMS)})",
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
