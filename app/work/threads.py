"""The threads behind the window, and their responses to requests."""

from __future__ import annotations

import logging
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from PySide6.QtCore import QObject, QThread, QTimer, Signal, Slot

from lcollision_core.errors import CancelledError, LCollisionError
from lcollision_core.jobs import Job, at_most_every

_log = logging.getLogger(__name__)

_SWITCH_SECONDS = 0.001
"""Interpreter switch interval: how long a worker in plain Python may block the window."""


@dataclass(frozen=True)
class Failure:
    """An error, for the user and for the log.

    Attributes
    ----------
    headline : what happened, and where
    next_step : what to do; empty if there is nothing
    details : the traceback
    """

    headline: str
    next_step: str = ""
    details: str = ""

    @classmethod
    def of(cls, error: LCollisionError) -> Failure:
        """Report an error that the user can fix."""
        details = "".join(traceback.format_exception(error))
        return cls(error.headline, error.next_step, details)


@dataclass(frozen=True, eq=False)
class Response:
    """The result of a request: a value, a failure, or neither if it was cancelled."""

    value: Any = None
    failure: Failure | None = None
    cancelled: bool = False


def started_thread(name: str, worker: QObject, parent: QObject) -> QThread:
    """Move a worker, which has no parent, into a new thread."""
    sys.setswitchinterval(_SWITCH_SECONDS)
    thread = QThread(parent)
    thread.setObjectName(name)
    worker.moveToThread(thread)
    thread.start()
    return thread


def end_thread(thread: QThread, deadline: float) -> bool:
    """End a thread after its current work; return whether it has ended by the deadline.

    An unfinished thread, as during the first compiling, is kept alive: destroying it aborts Qt.
    """
    thread.quit()
    ended = thread.wait(max(1, int(1000 * (deadline - time.monotonic()))))
    if not ended:
        thread.setParent(None)
        _unfinished.append(thread)
    return ended


_unfinished: list[QThread] = []


def any_unfinished() -> bool:
    """Return whether a thread that missed its deadline in `end_thread` still runs."""
    return any(not thread.isFinished() for thread in _unfinished)


def single_shot(parent: QObject, milliseconds: int, slot: Callable[[], object]) -> QTimer:
    """Make a timer that calls a slot once each time it is started."""
    timer = QTimer(parent, singleShot=True, interval=milliseconds)
    timer.timeout.connect(slot)
    return timer


def guarded(label: str, work: Callable[..., object], *arguments: object) -> Response:
    """Run some work, and turn its value or its error into a response."""
    try:
        return Response(work(*arguments))
    except CancelledError:
        return Response(cancelled=True)
    except LCollisionError as error:
        _log.info("%s: %s", label, error, exc_info=True)
        return Response(failure=Failure.of(error))
    except Exception as error:
        _log.exception("%s failed", label)
        failure = Failure(
            f"{label} failed ({type(error).__name__}: {error})",
            "try again, or see the log",
            traceback.format_exc(),
        )
        return Response(failure=failure)


Task = Callable[[Job], Any]
"""Long work, called in another thread; it returns the result."""


def as_task(work: Callable[..., Any], *arguments: Any) -> Task:
    """Return a task of work that neither reports progress nor can be stopped."""
    return lambda _: work(*arguments)


_PROGRESS_SECONDS = 0.1
"""Least time between two progress reports: each recomposes the whole window."""


@dataclass(frozen=True, eq=False)
class JobRequest:
    """Long work on a snapshot.

    Attributes
    ----------
    request_id : rises from job to job
    label : as in "Opening poses.json"
    work : called in the worker's thread
    job : cancels the work
    done, failed : called in the window's thread with the work's value, or with its `Failure`
    """

    request_id: int
    label: str
    work: Task
    job: Job
    done: Callable[[Any], None]
    failed: Callable[[Failure], None]


class LongWorker(QObject):
    """Runs one job after the other, in its own thread."""

    answered = Signal(int, object)
    progressed = Signal(int, object)

    @Slot(object)
    def answer(self, job: JobRequest) -> None:
        """Run one job; its errors become its response."""
        self.answered.emit(job.request_id, guarded(job.label, self._value, job))

    def _value(self, job: JobRequest) -> object:
        job.job.check()

        def report(*status: Any) -> None:
            self.progressed.emit(job.request_id, status[0] if len(status) == 1 else status)

        return job.work(job.job.part(at_most_every(_PROGRESS_SECONDS, report)))


class LongWork(QObject):
    """Runs jobs one after the other in its own thread, and reports on them in the window's.

    Signals
    -------
    busy_changed : str, the label of the oldest unfinished job, "" if there is none
    idle : the last job has ended
    progressed : int and object, the job's number and its progress
    failed : Failure of a job that was started without `failed`
    """

    busy_changed = Signal(str)
    idle = Signal()
    progressed = Signal(int, object)
    failed = Signal(object)

    _wanted = Signal(object)

    def __init__(self, parent: QObject | None = None, name: str = "long work") -> None:
        super().__init__(parent)
        self._worker = LongWorker()
        self._thread = started_thread(name, self._worker, self)
        self._wanted.connect(self._worker.answer)
        self._worker.answered.connect(self._on_answered)
        self._worker.progressed.connect(self._on_progressed)
        self._jobs: dict[int, JobRequest] = {}
        self._last_id = 0

    @property
    def busy(self) -> str:
        """The label of the running job, or ""."""
        return next((job.label for job in self._jobs.values()), "")

    def label_of(self, number: int) -> str:
        """Return the label of a job, or "" if it is done."""
        return self._jobs[number].label if number in self._jobs else ""

    def start(
        self,
        label: str,
        work: Task,
        done: Callable[[Any], None],
        failed: Callable[[Failure], None] | None = None,
    ) -> int:
        """Queue work behind the jobs started before.

        Parameters
        ----------
        label : as in "Opening poses.json"
        work : called in the other thread with its Job
        done : called in this thread with the work's value; not after `cancel`
        failed : called in this thread with the `Failure` of the work; by default the signal
            `failed` is emitted

        Returns
        -------
        number : of the job
        """
        self._last_id += 1
        on_failure = self.failed.emit if failed is None else failed
        job = JobRequest(self._last_id, label, work, Job(), done, on_failure)
        self._jobs[job.request_id] = job
        self._wanted.emit(job)
        self.busy_changed.emit(self.busy)
        return job.request_id

    def cancel(self, number: int) -> None:
        """Stop a job, which signals nothing more. Does nothing if it is done."""
        job = self._jobs.pop(number, None)
        if job is not None:
            job.job.cancel()
            self.busy_changed.emit(self.busy)

    def cancel_all(self, but: int = 0) -> None:
        """Stop all jobs, or all but one."""
        for number in set(self._jobs) - {but}:
            self.cancel(number)

    def close(self, deadline: float) -> bool:
        """Cancel all jobs and end the thread.

        Parameters
        ----------
        deadline : until when to wait, on `time.monotonic`

        Returns
        -------
        ended : if False, the thread is left to end with the process
        """
        self.cancel_all()
        return end_thread(self._thread, deadline)

    @Slot(int, object)
    def _on_progressed(self, number: int, status: object) -> None:
        if number in self._jobs:
            self.progressed.emit(number, status)

    @Slot(int, object)
    def _on_answered(self, number: int, answer: Response) -> None:
        job = self._jobs.pop(number, None)
        if job is None:
            return
        try:
            if answer.failure is not None:
                job.failed(answer.failure)
            elif not answer.cancelled:
                job.done(answer.value)
        finally:
            self.busy_changed.emit(self.busy)
            if not self._jobs:
                self.idle.emit()
