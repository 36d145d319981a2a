"""The document, free of widgets: one model, one working pose of it, the user's library."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, Signal, Slot

from app.editing.history import PoseHistory
from app.editing.library import Library
from app.editing.live_pose import Pins, PoseMotion
from app.editing.tasks import Tasks, Work
from app.editing.timeline import Timeline
from app.work.threads import LongWork
from lcollision_core.tasks.opening import OpenedModel

if TYPE_CHECKING:
    from lcollision_core.bodies import Body, SceneBody


class PoseDocument(QObject):
    """The open model and everything that is done with it.

    Lives in the GUI thread and computes nothing there. Until the first model is loaded,
    `has_model` is False; then only opening or setting a model is allowed.

    Parameters
    ----------
    model : the first model; it may be set later
    library_folder : the folder of the pose libraries; the user's own by default

    Attributes
    ----------
    history : the model, the working pose, its file, and undo
    motion : sliders and drags, and the frame of the pose
    pins : the pins of the pose
    library : the user's poses
    tasks : all long-running work
    timeline : the open motion

    Signals
    -------
    model_changed : another model is loaded; pose, library, locks and history are new too
    message : str, one sentence for the status bar
    failed : Failure, one sentence and its details, for a dialog
    """

    model_changed = Signal()
    message = Signal(str)
    failed = Signal(object)

    def __init__(
        self,
        model: Body | None = None,
        library_folder: Path | None = None,
    ) -> None:
        super().__init__()
        self._saving = LongWork(self, "saving")
        self.history = PoseHistory(self)
        self.motion = PoseMotion(self.history)
        self.pins = Pins(self.history, self.motion)
        self.library = Library(self.history, self._saving, library_folder)
        self.tasks = Tasks(self.history, self.motion, self.library, self._saving)
        self.timeline = Timeline(self.history, self.motion, self.tasks)
        for said in (self.motion, self.pins, self.tasks, self.timeline):
            said.message.connect(self.message)
        for failing in (self.motion, self.library, self.tasks, self.timeline):
            failing.failed.connect(self.failed)
        self._saving.failed.connect(self.failed)
        self.tasks.model_opened.connect(self._on_opened)
        self.tasks.model_exchanged.connect(self._on_exchanged)
        self._closed = False
        if model is not None:
            self.set_model(model)

    @property
    def has_model(self) -> bool:
        """Whether a model is loaded."""
        return self.history.has_model

    @property
    def model(self) -> Body:
        """The model that the pose belongs to."""
        return self.history.model

    @property
    def scene(self) -> SceneBody | None:
        """The model if it is a scene of several bodies; None for one body, or without a model."""
        from lcollision_core.bodies import as_scene

        return as_scene(self.model) if self.has_model else None

    def set_model(self, model: Body) -> None:
        """Load another model, with a new pose and the user's library of it.

        Prefer `Tasks.open_model`, which compiles and loads in the long worker what the first
        frames need.

        Parameters
        ----------
        model : may lack a predictor
        """
        self._on_opened(OpenedModel(model, model.name))

    @Slot(object)
    def _on_opened(self, opened: OpenedModel) -> None:
        self.library.write()
        self.tasks.forget_model()
        store = self.library.opened(opened.model)
        self.history.set_model(opened.model, opened.file, store)
        self.motion.set_model()
        self.history.undo_stack.clear()
        self._prepare()
        self.timeline.set_model()

    @Slot(object)
    def _on_exchanged(self, changed: OpenedModel) -> None:
        self.history.exchange_model(changed.model, changed.file)
        self.motion.follow()
        self._prepare()
        self.timeline.check_again()

    def replay(self, scene: Body, file: str) -> None:
        """Replace the scene by the same one with other clips, and reset the pose."""
        self.history.exchange_model(scene, file)
        self.history.begin_blank()
        self.motion.follow()
        self._prepare()
        self.timeline.set_model()

    def _prepare(self) -> None:
        self.tasks.prepare()
        # Everything is in place before any signal: a slot sees only poses of this model, and may
        # edit at once.
        self.model_changed.emit()
        self.history.emit_all()
        self.motion.emit_all()
        self.library.changed.emit()

    def new_pose(self) -> None:
        """Reset to the reference pose: unnamed, no file, no history; the library stays."""
        self.tasks.cancel(Work.INCOMING)
        self.history.begin_blank()

    def close(self, timeout: float = 5.0) -> bool:
        """Write pending files, stop all work and end the threads, before any window closes.

        Returns
        -------
        ended : whether all threads have ended within `timeout` seconds
        """
        if self._closed:
            return True
        self._closed = True
        self.library.write()
        self.tasks.wait_for_saves(timeout)
        self.tasks.cancel_all()
        # Deleting the stack would signal widgets that refer to deleted objects.
        self.history.undo_stack.blockSignals(True)
        deadline = time.monotonic() + timeout
        ended = [
            part.close(deadline) for part in (self.motion, self.timeline, self.tasks, self._saving)
        ]
        return all(ended)
