"""Screenshots and turntables of what a viewport shows, in other sizes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, Signal, Slot

from app.view.rendering import PoseRenderer
from app.view.theme import current_theme
from app.view.turntable import Turntable, TurntableStyle
from app.work.threads import Failure

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.view.scene import Scene


class Pictures(QObject):
    """Copies a viewport's scene off the screen, and writes what is seen of it.

    Parameters
    ----------
    document : whose mesh the scene shows; tells the user what has been saved
    parent : of the object

    Signals
    -------
    busy_changed : `busy` may be another
    """

    busy_changed = Signal()

    def __init__(self, document: PoseDocument, parent: QObject) -> None:
        super().__init__(parent)
        self._document = document
        self._film: Turntable | None = None

    @property
    def busy(self) -> str:
        """Which film is being made, or "" where none is."""
        film = self._film
        return f"Making {film.path.name}" if film is not None and film.is_running else ""

    def screenshot(
        self,
        scene: Scene,
        path: str | os.PathLike[str],
        width: int,
        height: int,
        transparent: bool,
    ) -> None:
        """Save a scene as a .png file; see `Viewport.screenshot`."""
        renderer = self._copy(scene, width, height, transparent)
        try:
            renderer.save(path)
        finally:
            renderer.close()

    def turntable(
        self, scene: Scene, path: str | os.PathLike[str], style: TurntableStyle
    ) -> Turntable:
        """Begin a film of a scene, in place of one that is being drawn."""
        self.stop()
        transparent = style.background == "transparent"
        renderer = self._copy(scene, style.width, style.height, transparent)
        if style.background == "plain":
            renderer.scene.show_floor(False)
            renderer.scene.set_plain_background(style.colour)
        self._film = Turntable(renderer, scene.view, Path(path), style, self)
        self._film.progressed.connect(self._on_progressed)
        self._film.finished.connect(self._on_finished)
        self._film.failed.connect(self._on_failed)
        self.busy_changed.emit()
        return self._film

    def cancel(self) -> None:
        """Give up the film that is being made."""
        if self._film is not None:
            self._film.cancel()

    def stop(self) -> None:
        """Cancel a film that is being drawn, and wait for one that is being packed."""
        if self._film is not None:
            self._film.wait()
            self._film.deleteLater()
            self._film = None
            self.busy_changed.emit()

    def _copy(self, scene: Scene, width: int, height: int, transparent: bool) -> PoseRenderer:
        renderer = PoseRenderer(
            self._document.model, width, height, current_theme().is_dark, transparent
        )
        renderer.scene.look_like(scene)
        return renderer

    @Slot(int, int)
    def _on_progressed(self, n_drawn: int, n_frames: int) -> None:
        self._document.message.emit(f"Turntable: frame {n_drawn} of {n_frames}")

    @Slot(object)
    def _on_finished(self, path: Path | None) -> None:
        words = f"Saved {path.name}" if path is not None else "The turntable was cancelled"
        self._document.message.emit(words)
        self.busy_changed.emit()

    @Slot(object)
    def _on_failed(self, failure: Failure) -> None:
        self._document.failed.emit(failure)
        self.busy_changed.emit()
