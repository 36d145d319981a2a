"""Screenshots and videos of a viewport's scene, in any size."""

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
    TurntableVideo,
    UInt8Array,
    VideoStyle,
    save_png,
    to_image,
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
