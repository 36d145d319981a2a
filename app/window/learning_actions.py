"""Learn models from the window: the dialogs, and the indicator in the status bar."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from PySide6.QtCore import QObject, Qt, Slot
from PySide6.QtWidgets import QDialog, QStatusBar, QToolButton, QWidget

from app.window.dialogs.learning import STAGE_WORDS, LearningDialog
from app.window.dialogs.new_model import NewModelDialog
from app.window.file_actions import FileActions
from app.window.widgets import plain_tip, restyle
from app.work import learning_runs
from app.work.learning_runs import LearningRun, LearningRuns
from app.work.threads import LongWork
from lcollision_core.learning_state import RunState
from lcollision_core.tasks.words import duration_text, menu_text, one_line, say

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from lcollision_core.options import LearningRequest

Dialog = TypeVar("Dialog", bound=QDialog)

_SECONDS_TO_CLOSE = 5.0
_INDICATOR_SHARE = 0.45
"""Largest width of the indicator, as a fraction of the window's width."""

_MOST_URGENT = (
    *(RunState.RUNNING, RunState.STOPPING, RunState.FAILED, RunState.KILLED),
    *(RunState.DONE, RunState.WAITING, RunState.STOPPED),
)
"""States of a run, most urgent first; the indicator shows the most urgent run."""


class LearningActions(QObject):
    """Open the dialog of a new model, and show the progress of runs.

    Runs, those of earlier windows included, are looked for once the first model is open.

    Parameters
    ----------
    window : parent of the dialogs
    document : into which a finished model is opened
    files : opens the model, and signals files that a model is learned from
    bar : gets the indicator
    attempt : calls a function and shows an error that the user can fix

    Attributes
    ----------
    runs : all runs
    indicator : shows the progress, and opens the dialog
    """

    def __init__(
        self,
        window: QWidget,
        document: PoseDocument,
        files: FileActions,
        bar: QStatusBar,
        attempt: Callable[[Callable[[], object]], object],
    ) -> None:
        super().__init__(window)
        self._window, self._document, self._files = window, document, files
        self._attempt = attempt
        self._work = LongWork(self, "learning")
        self._work.failed.connect(document.failed)
        self.runs = LearningRuns(self)
        self._previous_states: dict[Path, RunState] = {}
        self._opening: tuple[Path, Path] | None = None
        self.indicator = QToolButton()
        self.indicator.setObjectName("indicator")
        self.indicator.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        self.indicator.clicked.connect(self.show_runs)
        self.indicator.hide()
        bar.insertPermanentWidget(0, self.indicator)
        self.runs.changed.connect(self._on_runs)
        files.learning_wanted.connect(self.new_model)
        document.tasks.opened.connect(self._on_opened)
        if document.has_model:
            self._look_for_runs()
        else:
            once = Qt.ConnectionType.SingleShotConnection
            document.model_changed.connect(self._look_for_runs, once)

    @Slot(object)
    def new_model(self, paths: Sequence[Path] = ()) -> None:
        """Open the dialog of a new model, or add files to it if it is open."""
        dialog = self._visible(NewModelDialog)
        if dialog is None:
            dialog = NewModelDialog(self._work, self._files.settings, self._window)
            dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
            dialog.started.connect(self._start)
            dialog.show()
        dialog.activateWindow()
        if paths:
            dialog.add(paths)

    @Slot()
    def show_runs(self) -> None:
        """Open the dialog on the most urgent run."""
        run = self._most_urgent()
        if run is not None:
            self._show(run.path)

    def close(self) -> None:
        """Stop watching the runs, which continue."""
        self.runs.close()
        self._work.close(time.monotonic() + _SECONDS_TO_CLOSE)

    def _show(self, path: Path, activates: bool = True) -> None:
        dialog = self._visible(LearningDialog)
        if dialog is None:
            dialog = LearningDialog(self.runs, self._work, self._window, self._attempt)
            dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
            dialog.setAttribute(Qt.WidgetAttribute.WA_ShowWithoutActivating, not activates)
            dialog.open_wanted.connect(self._open)
            dialog.closed.connect(self._on_closed)
        dialog.show_run(path)
        dialog.show()
        if activates:
            dialog.activateWindow()

    @Slot(object)
    def _on_closed(self, path: Path) -> None:
        """Remember, for other windows too, that the user closed the dialog of a run."""
        there = {str(run.path) for run in self.runs.runs} | {str(path)}
        settings = self._files.settings
        settings["closed_learning"] = tuple({*settings["closed_learning"], str(path)} & there)

    def _visible(self, kind: type[Dialog]) -> Dialog | None:
        shown = (dialog for dialog in self._window.findChildren(kind) if dialog.isVisible())
        return next(shown, None)

    @Slot(object, str)
    def _start(self, request: LearningRequest, name: str) -> None:
        path = self._attempt(lambda: self.runs.start(request, name))
        dialog = self._visible(NewModelDialog)
        if isinstance(path, Path) and dialog is not None:
            dialog.accept()
            self._show(path)

    @Slot(object)
    def _open(self, path: Path) -> None:
        """Open the model of a run, or its character, as any other file."""
        run = self.runs.run_of(path)
        if run is not None:
            model = Path(run.status.model)
            self._opening = model, path
            self._attempt(lambda: self._files.open_path(model))

    @Slot(object)
    def _on_opened(self, opened: Path) -> None:
        """Remove the working folder of a finished run once its model is open."""
        if self._opening is not None and self._opening[0] == opened:
            run = self.runs.run_of(self._opening[1])
            self._opening = None
            if run is not None and run.state == RunState.DONE:
                run.work.remove()
            self.runs.poll()

    @Slot()
    def _look_for_runs(self) -> None:
        # Load in a worker: the imports take longer than a frame.
        work = learning_runs.load_learning
        self._work.start("Looking for runs", work, lambda _: self.runs.start_polling())

    @Slot()
    def _on_runs(self) -> None:
        run = self._most_urgent()
        self.indicator.setVisible(run is not None)
        if run is not None:
            others = len(self.runs.runs) - 1
            text = indicator_text(run)
            if others:
                text = say("{run} (and {n} more)", run=text, n=others)
            # Elide the text: a status bar is never narrower than its widgets.
            most = round(_INDICATOR_SHARE * self._window.width())
            cut = self.indicator.fontMetrics().elidedText(text, Qt.TextElideMode.ElideRight, most)
            self.indicator.setText(menu_text(cut))
            self.indicator.setToolTip(plain_tip(run.status.sentence or text))
            self.indicator.setAccessibleName(text)
            failed = run.state in (RunState.FAILED, RunState.KILLED)
            state = "failed" if failed else "done" if run.state == RunState.DONE else ""
            if self.indicator.property("state") != state:
                self.indicator.setProperty("state", state)
                restyle(self.indicator)
        for learning_run in self.runs.runs:
            is_new = (
                learning_run.state == RunState.DONE
                and self._previous_states.get(learning_run.path) != RunState.DONE
            )
            if is_new and str(learning_run.path) not in self._files.settings["closed_learning"]:
                self._show(learning_run.path, activates=False)
        self._previous_states = {run.path: run.state for run in self.runs.runs}

    def _most_urgent(self) -> LearningRun | None:
        runs = sorted(self.runs.runs, key=lambda run: _MOST_URGENT.index(run.state))
        return runs[0] if runs else None


def indicator_text(run: LearningRun) -> str:
    """Describe the progress of a run in one line."""
    name, status = one_line(run.name), run.status
    if run.state == RunState.RUNNING:
        fields = {
            "name": name,
            "share": 100 * status.done,
            "stage": STAGE_WORDS.get(status.stage, status.stage),
        }
        if status.seconds_left is None or status.done == 0.0:
            return say("Learning {name}: {share:.0f} %, {stage}", **fields)
        left = duration_text(status.seconds_left)
        return say("Learning {name}: {share:.0f} %, {left} left, {stage}", left=left, **fields)
    return {
        RunState.WAITING: f"{name} is queued",
        RunState.STOPPING: f"Learning {name}: stopping",
        RunState.DONE: f"{name} is ready",
        RunState.STOPPED: f"Learning {name}: paused",
    }.get(run.state, f"Learning {name} failed: see why")
