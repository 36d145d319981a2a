"""The learning runs: each is a folder that a separate process works on."""

from __future__ import annotations

import os
import shutil
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from PySide6.QtCore import QObject, QProcess, QProcessEnvironment, QTimer, Signal, Slot

import app
from app.work.learner import DISCARD, STOP, WANTED
from lcollision_core.errors import LCollisionError
from lcollision_core.jobs import Job
from lcollision_core.learning_state import RunState

if TYPE_CHECKING:
    from lcollision_core.bodies import LearnedBody
    from lcollision_core.learning_state import LearningStatus
    from lcollision_core.options import LearningRequest
    from lcollision_core.tasks.learning import LearnedCard
    from lcollision_core.tasks.sources import SourcesSummary
    from lcollision_core.tasks.work_folder import WorkFolder


LEARNER = (sys.executable, "-P", "-m", "app.work.learner")
"""The learning program and its arguments before the work folder; -P skips the current folder."""

POLL_MILLISECONDS = 1000

_SECONDS_TO_BEGIN = 120.0
"""Time after which a process without any sign of life counts as failed."""

_LEAST_FREE_BYTES = 100_000_000
"""Free disk space below which a full disk is given as the reason for a killed process."""

_GONE = "it stopped unexpectedly (was the computer switched off?); Continue resumes it"
_NOT_BEGUN = "its process didn't start; choose Continue to retry, or see {0}"
_FULL = "the disk is full: {0:.0f} MB are left at {1}; free some space, then continue"


@dataclass(frozen=True)
class LearningRun:
    """One run, as it was when its folder was last read.

    Attributes
    ----------
    path : its work folder
    status : the last status of its process, with the `RunState` that the lock and the request
        files imply; a waiting run starts when no other runs
    """

    path: Path
    status: LearningStatus

    @property
    def name(self) -> str:
        """The name of the model."""
        return self.work.name

    @property
    def state(self) -> RunState:
        """The state of the run."""
        return RunState(self.status.state)

    @property
    def is_active(self) -> bool:
        """Whether a process works on it or soon will."""
        return self.state in (RunState.WAITING, RunState.RUNNING, RunState.STOPPING)

    @property
    def work(self) -> WorkFolder:
        """Its work folder."""
        from lcollision_core.tasks.work_folder import WorkFolder

        return WorkFolder.at(self.path)


class LearningRuns(QObject):
    """Polls the user's runs, and starts, stops and continues them.

    One runs at a time, in a process that outlives the window; the others wait.

    Signals
    -------
    changed : `runs` has changed

    Attributes
    ----------
    runs : by name
    """

    changed = Signal()

    def __init__(self, parent: QObject) -> None:
        super().__init__(parent)
        self.runs: tuple[LearningRun, ...] = ()
        self._starting: tuple[Path, float] | None = None
        self._timer = QTimer(self, interval=POLL_MILLISECONDS)
        self._timer.timeout.connect(self.poll)

    def start_polling(self) -> None:
        """Look now and start polling."""
        self._timer.start()
        self.poll()

    def close(self) -> None:
        """Stop polling; a running process continues."""
        self._timer.stop()

    def run_of(self, path: Path | None) -> LearningRun | None:
        """Return the run of a work folder; None if it is gone."""
        return next((run for run in self.runs if run.path == path), None)

    def start(self, request: LearningRequest, name: str) -> Path:
        """Request a new run, which starts as soon as no other runs.

        Parameters
        ----------
        request : the sources and options
        name : of the model

        Returns
        -------
        path : of the work folder

        Raises
        ------
        LCollisionError : there is a model or a run of that name, or the folder cannot be made.
        """
        from lcollision_core.bodies import model_destination
        from lcollision_core.tasks.work_folder import WorkFolder

        destination = model_destination(name)
        if destination.exists():
            raise LCollisionError(f"a model {name!r} already exists", "choose another name")
        work = WorkFolder(destination)
        work.prepare(request)
        self.resume(work.path)
        return work.path

    def resume(self, path: Path) -> None:
        """Continue a run, including one that stopped because nearly all samples collide.

        Raises
        ------
        LCollisionError : its folder cannot be written to.
        """
        run = self.run_of(path)
        if run is not None and run.status.mostly_collides:
            run.work.allow_mostly_colliding()
        try:
            (path / STOP).unlink(missing_ok=True)
            (path / WANTED).touch()
        except OSError as error:
            raise LCollisionError.unwritable(path, error, "free some space there") from error
        self.poll()

    def stop(self, path: Path, discard: bool = False) -> None:
        """Stop a run, whichever window started it; it can be continued unless discarded.

        Raises
        ------
        LCollisionError : its folder cannot be written to.
        """
        run = self.run_of(path)
        try:
            (path / WANTED).unlink(missing_ok=True)
            if self._is_starting(path) or (run is not None and run.work.is_locked):
                (path / STOP).write_text(DISCARD if discard else "", encoding="utf-8")
            elif discard and run is not None:
                run.work.remove()
        except OSError as error:
            raise LCollisionError.unwritable(path, error, "free some space there") from error
        self.poll()

    @Slot()
    def poll(self) -> None:
        """Update all runs, and start a waiting one if none is running."""
        from lcollision_core.tasks.work_folder import list_work

        runs = tuple(self._looked_at(work) for work in list_work() if not self._is_gone(work))
        self._forget_what_has_begun(runs)
        idle = not any(run.state in (RunState.RUNNING, RunState.STOPPING) for run in runs)
        waiting = [run for run in runs if run.state == RunState.WAITING]
        if idle and waiting and self._starting is None:
            self._launch(waiting[0].work)
        if runs != self.runs:
            self.runs = runs
            self.changed.emit()

    def _looked_at(self, work: WorkFolder) -> LearningRun:
        # In this order, a run that starts or ends meanwhile is seen in its earlier state.
        is_wanted, stops, is_held = (work.path / WANTED).exists(), _is_to_stop(work), work.is_locked
        status = work.status
        state, sentence = status.state, ""
        if is_held or (stops and self._is_starting(work.path)):
            state = RunState.STOPPING if stops else RunState.RUNNING
        elif is_wanted:
            state = RunState.WAITING
        elif state == RunState.RUNNING:
            state = RunState.KILLED
            free = shutil.disk_usage(work.path.parent).free
            is_full = free < _LEAST_FREE_BYTES
            sentence = _FULL.format(free / 1e6, work.path.parent) if is_full else _GONE
        elif state == RunState.FAILED:
            sentence = status.sentence
        elif state != RunState.DONE:
            state = RunState.STOPPED
        return LearningRun(work.path, replace(status, state=state, sentence=sentence))

    def _is_gone(self, work: WorkFolder) -> bool:
        """Remove a discarded run that no process holds; return whether it was removed."""
        if not _is_to_stop(work, DISCARD) or work.is_locked or self._is_starting(work.path):
            return False
        work.remove()
        return True

    def _is_starting(self, path: Path) -> bool:
        return self._starting is not None and self._starting[0] == path

    def _forget_what_has_begun(self, runs: tuple[LearningRun, ...]) -> None:
        """Clear `_starting` once its process is at work, or has shown nothing for too long."""
        from lcollision_core.tasks.work_folder import WorkFolder

        if self._starting is None:
            return
        path, give_up = self._starting
        run = next((run for run in runs if run.path == path), None)
        has_begun = run is None or run.work.is_locked or not (path / WANTED).exists()
        if has_begun and not (path / STOP).exists():
            self._starting = None
        elif time.monotonic() > give_up:
            self._starting = None
            _tell_not_begun(WorkFolder.at(path))

    def _launch(self, work: WorkFolder) -> None:
        """Start the learning process, detached from this window."""
        process = QProcess()
        program, *arguments = LEARNER
        process.setProgram(program)
        process.setArguments([*arguments, str(work.path)])
        # Windows cannot remove a process's working folder, so use the parent folder.
        process.setWorkingDirectory(str(work.path.parent))
        process.setStandardInputFile(QProcess.nullDevice())
        for redirect in (process.setStandardOutputFile, process.setStandardErrorFile):
            redirect(str(work.log), QProcess.OpenModeFlag.Append)
        process.setProcessEnvironment(_environment())
        self._starting = work.path, time.monotonic() + _SECONDS_TO_BEGIN
        # Typed as a pair, but a single value at run time.
        started: Any = process.startDetached()
        if started is False or (isinstance(started, tuple) and not started[0]):
            self._starting = None
            _tell_not_begun(work)


def _tell_not_begun(work: WorkFolder) -> None:
    """Mark a run as failed because its process did not start."""
    with suppress(OSError, LCollisionError):
        sentence = _NOT_BEGUN.format(work.log)
        work.write_status(replace(work.status, state=RunState.FAILED, sentence=sentence))
        for name in (WANTED, STOP):
            (work.path / name).unlink(missing_ok=True)


def _is_to_stop(work: WorkFolder, how: str = "") -> bool:
    """Whether a window has requested a run to stop, with the text `how`."""
    try:
        return how in (work.path / STOP).read_text(encoding="utf-8")
    except OSError:
        return False


def _environment() -> QProcessEnvironment:
    """Return this process's environment, with a checkout of the program on the module path."""
    environment = QProcessEnvironment.systemEnvironment()
    root = Path(app.__file__).parents[1]
    if root.name != "site-packages":
        python_path = environment.value("PYTHONPATH")
        environment.insert("PYTHONPATH", os.pathsep.join(filter(None, (str(root), python_path))))
    return environment


def load_learning(_: Job) -> None:
    """Import the modules for looking at runs, which takes longer than a frame."""
    import lcollision_core.tasks.learning  # noqa: F401


def look_into_sources(paths: tuple[Path, ...], job: Job) -> SourcesSummary:
    """Summarise the files that a model is to be learned from.

    Raises
    ------
    LCollisionError : nothing can be learned from them.
    """
    from lcollision_core.tasks.sources import summarise_sources

    return summarise_sources(paths, job)


def read_card(model_file: str, _: Job) -> tuple[LearnedBody, LearnedCard]:
    """Read a learned model and its figures."""
    from lcollision_core.bodies import LearnedBody
    from lcollision_core.tasks.learning import card_of

    model = LearnedBody.load(model_file)
    return model, card_of(model, model_file)
