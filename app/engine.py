"""The threads behind the window: one follows the live pose, one does the long work.

Neither is ever given a second request while it works on a first, except to cancel it: the
document keeps what is wanted next, so that the newest request wins and nothing queues up.
"""

from __future__ import annotations

import logging
import sys
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Qt, QThread, QTimer, Signal, Slot

from app.frames import LiveFrame, PoseShower, keep_torch_to_one_thread
from lcollision_core.errors import CancelledError, LCollisionError
from lcollision_core.jobs import CancelToken, Progress, no_progress

if TYPE_CHECKING:
    from lcollision_core.model import PoseModel

_log = logging.getLogger(__name__)

Work = Callable[[Progress, CancelToken], Any]
"""Long work: called in another thread; its value is the result."""

_QUICK_SECONDS = 0.012
"""A frame that took less is waited for the next time,"""
_PATIENCE_SECONDS = 0.016
"""but at most this long, a picture of a screen that draws 60 in a second."""

_PROGRESS_SECONDS = 0.05
"""Between two reports of progress: more would only keep the window busy."""

_SWITCH_SECONDS = 0.001
"""A worker in plain Python holds the interpreter for so long before the window has its turn."""


@dataclass(frozen=True)
class Failure:
    """What went wrong, for people and for the log.

    Attributes
    ----------
    sentence : what happened and what to do, fit to be shown as it is
    details : the traceback
    """

    sentence: str
    details: str


@dataclass(frozen=True, eq=False)
class FrameRequest:
    """Ask for the frame of a pose.

    Attributes
    ----------
    latent : (D,) float64 array, read-only
    predicts : whether it is to have a prediction
    """

    request_id: int
    model: PoseModel
    latent: npt.NDArray[np.float64]
    predicts: bool


@dataclass(frozen=True, eq=False)
class VerdictRequest:
    """Ask for the exact check of a frame that is on the screen."""

    request_id: int
    model: PoseModel
    frame: LiveFrame


@dataclass(frozen=True, eq=False)
class Job:
    """Long work on a snapshot.

    Attributes
    ----------
    request_id : rises from job to job
    label : what is done, as in "Opening poses.json"
    work : called in the worker's thread
    cancel : set by the document to stop the work
    """

    request_id: int
    label: str
    work: Work
    cancel: CancelToken


@dataclass(frozen=True, eq=False)
class Answer:
    """What came of a request: a value, a failure, or neither where it was cancelled."""

    request_id: int
    value: Any = None
    failure: Failure | None = None
    cancelled: bool = False


class LiveWorker(QObject):
    """Computes frames and verdicts, in its own thread; `answered` tells what was asked too."""

    answered = Signal(object, object)

    def __init__(self) -> None:
        super().__init__()
        self._shower: PoseShower | None = None
        self._answer: Answer | None = None
        self._has_answered = threading.Event()

    @Slot(object)
    def answer(self, request: FrameRequest | VerdictRequest) -> None:
        """Answer one request, whatever happens."""
        self._answer = _guarded(request.request_id, "showing the pose", self._value, request)
        self._has_answered.set()
        self.answered.emit(request, self._answer)

    def forget(self) -> None:
        """Make `awaited` wait for the next answer; called before that is asked for."""
        self._has_answered.clear()

    def awaited(self, seconds: float) -> Answer | None:
        """Wait in another thread for the answer; None where it takes longer."""
        return self._answer if self._has_answered.wait(seconds) else None

    def _value(self, request: FrameRequest | VerdictRequest) -> object:
        if self._shower is None or self._shower.model is not request.model:
            self._shower = PoseShower(request.model)
            self._shower.predicts = False
        if isinstance(request, FrameRequest):
            if request.predicts and not self._shower.predicts:
                keep_torch_to_one_thread(request.model)
                self._shower.predicts = True
            return self._shower.frame(request.latent, request.request_id)
        return self._shower.verdict(request.frame)


class LongWorker(QObject):
    """Does one job after the other, in its own thread."""

    answered = Signal(object)
    progressed = Signal(int, object)

    @Slot(object)
    def answer(self, job: Job) -> None:
        """Do one job, whatever happens."""
        self.answered.emit(_guarded(job.request_id, job.label, self._value, job))

    def _value(self, job: Job) -> object:
        job.cancel.raise_if_cancelled()
        last = -_PROGRESS_SECONDS

        def report(*status: Any) -> None:
            nonlocal last
            now = time.monotonic()
            if now - last >= _PROGRESS_SECONDS:
                last = now
                self.progressed.emit(job.request_id, status[0] if len(status) == 1 else status)

        return job.work(report, job.cancel)


class LivePose(QObject):
    """Follows one pose: its frame as soon as can be, its verdict when it rests.

    Changes within one turn of the event loop are one request; while the worker is busy, only the
    newest pose waits. A quick frame is waited for, far shorter than a picture takes, so that the
    slider and the mesh are drawn together: drawing the window twice would cost more than all
    else. A failure that repeats itself from pose to pose is told once.

    Parameters
    ----------
    rest_milliseconds : how long a pose must have stayed before it is checked exactly
    """

    frame_computed = Signal(object)
    verdict_computed = Signal(object)
    failed = Signal(object)

    _wanted = Signal(object)
    _due = Signal()

    def __init__(self, rest_milliseconds: int, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._worker = LiveWorker()
        self._thread = started_thread("live pose", self._worker, self)
        self._wanted.connect(self._worker.answer)
        self._worker.answered.connect(self._on_answered)
        self._model: PoseModel | None = None
        self._next: FrameRequest | None = None
        self._asked: FrameRequest | VerdictRequest | None = None
        self._shown: tuple[FrameRequest, LiveFrame] | None = None
        self._last_id = 0
        self._told: dict[type, str] = {}
        self._is_quick = False
        self._is_due = False
        # Sooner than a timer of 0 ms, which Qt fires after it has drawn the slider alone.
        self._due.connect(self._on_due, Qt.ConnectionType.QueuedConnection)
        self._rested = single_shot(self, rest_milliseconds, self._ask)

    def follow(self, model: PoseModel, latent: npt.NDArray[np.float64], predicts: bool) -> None:
        """Want the frame, and later the verdict, of another pose.

        Parameters
        ----------
        latent : (D,) float64 array, read-only, as the worker reads it too
        predicts : whether predictions can be had without loading anything
        """
        self._last_id += 1
        self._model = model
        self._next = FrameRequest(self._last_id, model, latent, predicts)
        self._shown = None
        self._rested.stop()
        if not self._is_due:
            self._is_due = True
            self._due.emit()

    def stop(self) -> None:
        """Want nothing any more."""
        self._rested.stop()
        self._next = self._shown = self._model = None

    def close(self, deadline: float) -> bool:
        """End the thread; see `LongWork.close`."""
        self.stop()
        return end_thread(self._thread, deadline)

    @Slot()
    def _on_due(self) -> None:
        self._is_due = False
        if self._ask() and isinstance(self._asked, FrameRequest) and self._is_quick:
            answer = self._worker.awaited(_PATIENCE_SECONDS)
            self._is_quick = answer is not None
            if answer is not None:
                self._take(answer)

    @Slot()
    def _ask(self) -> bool:
        """Hand on what is wanted next, unless the worker is busy; tell whether it was."""
        if self._asked is not None:
            return False
        if self._next is not None:
            self._asked, self._next = self._next, None
        elif self._shown is not None and not self._rested.isActive():
            request, frame = self._shown
            self._asked = VerdictRequest(request.request_id, request.model, frame)
            self._shown = None
        if self._asked is None:
            return False
        self._worker.forget()
        self._wanted.emit(self._asked)
        return True

    @Slot(object, object)
    def _on_answered(self, request: FrameRequest | VerdictRequest, answer: Answer) -> None:
        # One that was waited for comes a second time this way, maybe amid a later request.
        if request is self._asked:
            self._take(answer)

    def _take(self, answer: Answer) -> None:
        request, self._asked = self._asked, None
        # What is next is handed on before the answer is drawn: the worker need not wait for that.
        # Nor is it waited for here: it would be told before this answer.
        self._ask()
        if request is None or request.model is not self._model:
            return
        if answer.failure is not None:
            if answer.failure.sentence != self._told.get(type(request)):
                self._told[type(request)] = answer.failure.sentence
                self.failed.emit(answer.failure)
        elif isinstance(request, FrameRequest) and answer.value is not None:
            if request.request_id == self._last_id:
                self._shown = (request, answer.value)
                self._rested.start()
            self._told.pop(FrameRequest, None)
            self._is_quick = answer.value.seconds < _QUICK_SECONDS
            self.frame_computed.emit(answer.value)
        elif answer.value is not None and answer.request_id == self._last_id:
            self._told.pop(VerdictRequest, None)
            self.verdict_computed.emit(answer.value)


class LongWork(QObject):
    """Does jobs one after the other in its own thread, and tells of them in the window's.

    `busy_changed` carries the label of the oldest job that is not done, "" where there is none;
    `failed` a `Failure`; `progressed` the job's number and what its work told.
    """

    busy_changed = Signal(str)
    progressed = Signal(int, object)
    failed = Signal(object)

    _wanted = Signal(object)

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._worker = LongWorker()
        self._thread = started_thread("long work", self._worker, self)
        self._wanted.connect(self._worker.answer)
        self._worker.answered.connect(self._on_answered)
        self._worker.progressed.connect(self._on_progressed)
        self._jobs: dict[int, tuple[Job, Callable[[Any], None], Callable[[], None]]] = {}
        self._last_id = 0

    @property
    def busy(self) -> str:
        """What is being done, or ""."""
        return next((job.label for job, _, _ in self._jobs.values()), "")

    def label_of(self, number: int) -> str:
        """Return what a job does, or "" where it is done."""
        return self._jobs[number][0].label if number in self._jobs else ""

    def start(
        self,
        label: str,
        work: Work,
        done: Callable[[Any], None],
        failed: Callable[[], None] = lambda: None,
    ) -> int:
        """Do some work when what was started before is done.

        Parameters
        ----------
        label : as in "Opening poses.json"
        work : called in the other thread with (progress, cancel)
        done : called in this thread with the work's value; not after `cancel`
        failed : called in this thread where the work fails, before `LongWork.failed` tells why

        Returns
        -------
        number : of the job
        """
        self._last_id += 1
        job = Job(self._last_id, label, work, CancelToken())
        self._jobs[job.request_id] = (job, done, failed)
        self._wanted.emit(job)
        self.busy_changed.emit(self.busy)
        return job.request_id

    def cancel(self, number: int) -> None:
        """Stop a job; nothing more is heard of it. Does nothing where it is done."""
        held = self._jobs.pop(number, None)
        if held is not None:
            held[0].cancel.cancel()
            self.busy_changed.emit(self.busy)

    def cancel_all(self) -> None:
        """Stop all jobs."""
        for number in list(self._jobs):
            self.cancel(number)

    def finish(self, number: int) -> None:
        """Do a job here and now, instead of in its turn; does nothing where it is done.

        Raises whatever its work raises.
        """
        held = self._jobs.get(number)
        if held is not None:
            job, done, _ = held
            self.cancel(number)
            done(job.work(no_progress, CancelToken()))

    def close(self, deadline: float) -> bool:
        """Cancel all jobs and end the thread.

        Parameters
        ----------
        deadline : until when to wait, on `time.monotonic`

        Returns
        -------
        ended : a thread that has not is left to end with the process
        """
        self.cancel_all()
        return end_thread(self._thread, deadline)

    @Slot(int, object)
    def _on_progressed(self, number: int, status: object) -> None:
        if number in self._jobs:
            self.progressed.emit(number, status)

    @Slot(object)
    def _on_answered(self, answer: Answer) -> None:
        held = self._jobs.pop(answer.request_id, None)
        if held is None:
            return
        _, done, failed = held
        if answer.failure is not None:
            failed()
            self.failed.emit(answer.failure)
        elif not answer.cancelled:
            done(answer.value)
        self.busy_changed.emit(self.busy)


def started_thread(name: str, worker: QObject, parent: QObject) -> QThread:
    """Move a worker, which has no parent, into a thread of its own."""
    sys.setswitchinterval(_SWITCH_SECONDS)
    thread = QThread(parent)
    thread.setObjectName(name)
    worker.moveToThread(thread)
    thread.start()
    return thread


def end_thread(thread: QThread, deadline: float) -> bool:
    """Let a thread end after what it does now, and tell whether it has by the deadline.

    One that has not, as in the first compiling, is kept from being destroyed, at which Qt aborts.
    """
    thread.quit()
    ended = thread.wait(max(1, int(1000 * (deadline - time.monotonic()))))
    if not ended:
        thread.setParent(None)
        _unfinished.append(thread)
    return ended


_unfinished: list[QThread] = []


def any_unfinished() -> bool:
    """Return whether a thread that was left behind by `end_thread` still runs."""
    return any(not thread.isFinished() for thread in _unfinished)


def single_shot(parent: QObject, milliseconds: int, slot: Callable[[], object]) -> QTimer:
    """Make a timer that calls a slot once each time it is started."""
    timer = QTimer(parent)
    timer.setSingleShot(True)
    timer.setInterval(milliseconds)
    timer.timeout.connect(slot)
    return timer


def _guarded(
    request_id: int, label: str, work: Callable[..., object], *arguments: object
) -> Answer:
    """Run some work and turn whatever it raises into an answer."""
    try:
        return Answer(request_id, work(*arguments))
    except CancelledError:
        return Answer(request_id, cancelled=True)
    except LCollisionError as error:
        _log.info("%s: %s", label, error, exc_info=True)
        return Answer(request_id, failure=Failure(str(error), traceback.format_exc()))
    except Exception as error:
        _log.exception("%s failed", label)
        sentence = (
            f"{label} failed ({type(error).__name__}: {error}); nothing was changed, try again or "
            f"look into the log"
        )
        return Answer(request_id, failure=Failure(sentence, traceback.format_exc()))
