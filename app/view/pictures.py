"""Screenshots and turntable videos of what a viewport shows, in other sizes."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, QTimer, Signal, Slot

from app.view.offscreen import (
    MotionVideo,
    PoseRenderer,
    TurntableStyle,
    TurntableVideo,
    UInt8Array,
    picture_of,
    save_png,
)
from app.view.theme import current_theme
from app.work.threads import guarded
from lcollision_core.errors import MeshFileError
from lcollision_core.jobs import Job

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.view.scene import Scene
    from lcollision_core.motion import Motion

_MOST_PIXELS = 2**25
"""Of a screenshot: drawing takes about 80 bytes of memory for each."""


class Pictures(QObject):
    """Copies a viewport's scene off the screen, and writes what is seen of it.

    Frames of a video are drawn one by one between the window's own events; the document's long
    worker packs them.

    Parameters
    ----------
    document : whose mesh the scene shows; tells the user what has been saved
    scene_now : returns the scene as it is to be seen, or raises if there is none yet
    parent : of the object

    Signals
    -------
    busy_changed : `busy` may be another
    """

    busy_changed = Signal()

    def __init__(
        self, document: PoseDocument, scene_now: Callable[[], Scene], parent: QObject
    ) -> None:
        super().__init__(parent)
        self._document = document
        self._scene_now = scene_now
        self._video: TurntableVideo | None = None
        # With 0 ms between two frames the window's own events are still processed.
        self._next = QTimer(self, interval=0)
        self._next.timeout.connect(self._on_next)

    @property
    def busy(self) -> str:
        """Which video is being drawn, or "" if none is."""
        return f"Making {self._video.path.name}" if self._video is not None else ""

    def screenshot(
        self, path: str | os.PathLike[str], width: int, height: int, transparent: bool
    ) -> None:
        """Draw what is seen, without legend, in another size; the document's long worker saves it.

        Parameters
        ----------
        path : a .png file
        width, height : in pixels; as much is seen from bottom to top as in the window
        transparent : without background, floor and shadow

        Raises
        ------
        MeshFileError : so many pixels would not fit into the memory.
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

    def turntable(self, path: str | os.PathLike[str], style: TurntableStyle) -> None:
        """Begin a video of one turn round what is seen, in place of one that is being drawn.

        The document tells when it is saved.

        Parameters
        ----------
        path : a .gif or .webp file, or a .png one, whose name without that a new folder of
            numbered pictures gets
        style : its size, rate and background

        Raises
        ------
        MeshFileError : the format is unknown or cannot hold what `style` asks for, or the folder
            of a PNG sequence is there already.
        """
        self._film(Path(path), style, None)

    def motion(
        self,
        path: str | os.PathLike[str],
        style: TurntableStyle,
        motion: Motion,
        follows: bool = False,
    ) -> None:
        """Begin a video of a motion's frames, seen as the body is now; see `turntable`.

        Parameters
        ----------
        motion : as many frames as the video has
        follows : whether the camera moves along with the body
        """
        self._film(Path(path), style, motion, follows)

    def _film(
        self, path: Path, style: TurntableStyle, motion: Motion | None, follows: bool = False
    ) -> None:
        refusal = style.refusal(path)
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
            # What crosses in the frame that is seen now crosses in no other.
            renderer.scene.crossing.show(None)
            renderer.scene.uncounted.show(None)
            renderer.scene.show_ghost(None)
            model = self._document.model
            self._video = MotionVideo(renderer, path, style, model, motion, follows)
        self._next.start()
        self.busy_changed.emit()

    @Slot()
    def cancel(self) -> None:
        """Cancel the video that is being drawn."""
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
        scene = self._scene_now()
        renderer = PoseRenderer(self._document.model, width, height, current_theme(), transparent)
        renderer.scene.look_like(scene)
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
            # Before it ends, as a window that closes waits for one or the other.
            self._document.tasks.write(label, video.pack)
            self._end().close()


def _save(pixels: UInt8Array, path: Path, _: Job) -> str:
    save_png(picture_of(pixels), path)
    return f"Saved {path.name}"
