"""Load the model and the first pose once the window is on the screen."""

from __future__ import annotations

import logging
import signal
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, Qt, QTimer, Slot

from app.editing.live_pose import training_pose
from app.window.dialogs.questions import Choice, ask_about_recovery
from lcollision_core.bundled import bundled_folder
from lcollision_core.errors import LCollisionError
from lcollision_core.files.formats import MODEL_SUFFIX, POSES_SUFFIX
from lcollision_core.tasks.opening import Unposable

if TYPE_CHECKING:
    from types import FrameType

    from app.window.main_window import MainWindow
    from app.work.threads import Failure
    from lcollision_core.bodies import Body, NamedPose
    from lcollision_core.files import Character
    from lcollision_core.files.scene_files import SceneDocument
    from lcollision_core.tasks.opening import FileContent

_log = logging.getLogger(__name__)

DEFAULT_MODEL = "body"

_LIVELY = ("dancer", "thinking")
"""Training poses of the built-in body suited as opening poses."""

_LATER_MILLISECONDS = 300
_ONCE = Qt.ConnectionType.SingleShotConnection


class StartUp(QObject):
    """Fill a window that is on the screen.

    The document opens the model in its worker for long work, which also does the slow imports.
    Then the pose of the given file is loaded, or an opening pose, and poses lost in a crash are
    offered.

    Parameters
    ----------
    window : already shown
    path : a poses file, a character, a mesh or a model; None for the editor's opening pose
    model_name : a model's file or name; None for the model used last
    """

    def __init__(self, window: MainWindow, path: Path | None, model_name: str | None) -> None:
        super().__init__(window)
        self._window = window
        self._document = window.document
        self._path = path
        self._body_is_chosen = model_name is not None
        self._model: str | Path = model_name or last_model(window.settings["model"])

    def begin(self) -> None:
        """Start loading; return at once."""
        signal.signal(signal.SIGINT, self._on_signal)
        signal.signal(signal.SIGTERM, self._on_signal)
        self._document.model_changed.connect(self._on_model, _ONCE)
        path = self._path
        if path is None or path.suffix.lower() in (MODEL_SUFFIX, POSES_SUFFIX):
            self._open_model(path is not None and path.suffix.lower() == MODEL_SUFFIX)
        else:
            self._document.tasks.examine(path, self._open_rigged, self._open_without_path)

    def _open_rigged(self, read: FileContent) -> None:
        body = None if isinstance(read, Unposable) else read
        self._open_model(body is not None, body)

    def _open_model(self, is_in_path: bool, read: SceneDocument | Character | None = None) -> None:
        """Open the body of the path, or the given or last used model."""
        if is_in_path and self._path is not None:
            self._model, self._path = self._path, None
        self._document.tasks.open_model(self._model, read)

    def _open_without_path(self, failure: Failure) -> None:
        """Report that the file cannot be read, and start without it."""
        self._document.failed.emit(failure)
        self._path = None
        self._open_model(False)

    @Slot()
    def _on_model(self) -> None:
        from app.editing.recovery import Autosave

        autosave = self._window.autosave = Autosave(self._document)
        autosave.failed.connect(self._window.show_failure)
        # Wait until the document has loaded its own pose.
        QTimer.singleShot(0, self, self._on_first_pose)
        # Frame the first pose only: later ones keep the user's camera.
        self._document.history.pose_loaded.connect(self._window.viewport.frame_pose, _ONCE)
        autosave.recovered.connect(self._window.viewport.frame_pose)
        self._window.ready.connect(self._on_ready)

    @Slot()
    def _on_first_pose(self) -> None:
        if self._path is not None:
            path = self._path
            is_chosen = self._body_is_chosen
            self._window.attempt(lambda: self._window.files.open_path(path, is_chosen))
            return
        # The opening pose is not a change to save or undo.
        self._document.history.begin_with(opening_pose(self._document.model))

    @Slot()
    def _on_ready(self) -> None:
        _log.info("the first pose is on the screen")
        # Wait until the pose is drawn: a question over an empty window would be confusing.
        QTimer.singleShot(_LATER_MILLISECONDS, self, self._offer_recovery)

    @Slot()
    def _offer_recovery(self) -> None:
        from app.editing.recovery import find_recoverable_poses

        lost = find_recoverable_poses()
        for pose in lost:
            answer = ask_about_recovery(self._window, pose)
            if answer is Choice.SAVE:
                assert self._window.autosave is not None
                self._window.autosave.recover(pose)
                break
            if answer is Choice.DISCARD:
                pose.session.discard()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002
        _log.info("signal %d: closing", number)
        # Python handles signals between any two bytecodes, even in the middle of a render.
        QTimer.singleShot(0, self._window, self._window.close_unasked)


def last_model(remembered: str) -> str:
    """Return the remembered model, a file or a bundled name, or the default if it is gone."""
    bundled = bundled_folder("models") / f"{remembered}{MODEL_SUFFIX}"
    return remembered if bundled.is_file() or Path(remembered).is_file() else DEFAULT_MODEL


def opening_pose(model: Body) -> NamedPose:
    """Return the pose to open a model with.

    This is the first pose of the bundled poses file with the model's name. Without one, it is the
    first training pose named in `_LIVELY`, or else the last; for a character, the rest pose.
    """
    from lcollision_core.bodies import read_poses

    bundled = bundled_folder("poses") / f"{model.name}.json"
    if bundled.is_file():
        try:
            return read_poses(bundled, model)[0]
        except LCollisionError as error:
            # A user's model may share its name with a bundled one.
            _log.info("no opening pose: %s", error)
    names = model.card.pose_names
    if not model.is_trained:
        return training_pose(model, 0)
    number = next((names.index(name) for name in _LIVELY if name in names), len(names) - 1)
    return training_pose(model, number)
