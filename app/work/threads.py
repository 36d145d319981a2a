"""The threads behind the window, and their responses to requests."""

from __future__ import annotations

import logging
import sys
import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from typing import Any

from PySide6.QtCore import QObject, QTimer, Signal, Slot

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


class WorkerThread(ThreadPoolExecutor):
    """One thread, which runs calls one after the other.

    Parameters
    ----------
    name : of the thread
    """

    def __init__(self, name: str) -> None:
        super().__init__(1, name)
        sys.setswitchinterval(_SWITCH_SECONDS)
        self._last: Future[float] | None = None

    def end(self, deadline: float) -> bool:
        """End the thread after the calls submitted so far; return whether it has ended in time.

        Parameters
        ----------
        deadline : until when to wait, on `time.monotonic`
        """
        if self._last is None:
            self._last = self.submit(time.monotonic)
            self.shutdown(wait=False)
        return bool(wait([self._last], max(0.001, deadline - time.monotonic())).done)


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
class _Started:
    """A job that has not ended; see `LongWork.start`."""

    label: str
    kind: object
    job: Job
    done: Callable[[Any], None]
    failed: Callable[[Failure], None]


class LongWork(QObject):
    """Runs jobs one after the other in its own thread, and reports on them in the window's.

    Signals
    -------
    busy_changed : str, the label of the oldest unfinished job, "" if there is none
    idle : the last job has ended
    progressed : a job's kind, its steps done and their total
    failed : Failure of a job that was started without `failed`
    """

    busy_changed = Signal(str)
    idle = Signal()
    progressed = Signal(object, int, int)
    failed = Signal(object)

    _reported = Signal(int, int, int)
    _answered = Signal(int, object)

    def __init__(self, parent: QObject | None = None, name: str = "long work") -> None:
        super().__init__(parent)
        self._thread = WorkerThread(name)
        # Emitted in that thread, and received in the window's.
        self._reported.connect(self._on_reported)
        self._answered.connect(self._on_answered)
        self._jobs: dict[int, _Started] = {}
        self._last_id = 0

    @property
    def busy(self) -> str:
        """The label of the running job, or ""."""
        return next((job.label for job in self._jobs.values()), "")

    def labels(self, *kinds: object) -> list[str]:
        """Return the labels of the unfinished jobs of these kinds, oldest first."""
        return [job.label for job in self._jobs.values() if job.kind in kinds]

    def start(
        self,
        label: str,
        work: Task,
        done: Callable[[Any], None],
        failed: Callable[[Failure], None] | None = None,
        kind: object = "",
    ) -> None:
        """Queue work behind the jobs started before.

        Parameters
        ----------
        label : as in "Opening poses.json"
        work : called in the other thread with its Job
        done : called in this thread with the work's value; not after `cancel`
        failed : called in this thread with the `Failure` of the work; by default the signal
            `failed` is emitted
        kind : by which the job is asked for and cancelled
        """
        self._last_id += 1
        number, job = self._last_id, Job()
        self._jobs[number] = _Started(label, kind, job, done, failed or self.failed.emit)
        self._thread.submit(self._run, number, label, work, job)
        self.busy_changed.emit(self.busy)

    def _run(self, number: int, label: str, work: Task, job: Job) -> None:
        """Run a job in the other thread; its errors become its response."""
        report = at_most_every(_PROGRESS_SECONDS, partial(self._reported.emit, number))

        def run() -> object:
            job.check()
            return work(job.part(report))

        self._answered.emit(number, guarded(label, run))

    def cancel(self, *kinds: object) -> None:
        """Stop the unfinished jobs of these kinds, which signal nothing more."""
        self._cancel([number for number, job in self._jobs.items() if job.kind in kinds])

    def cancel_all(self, but: object = None) -> None:
        """Stop all jobs, or all but those of a kind."""
        self._cancel([number for number, job in self._jobs.items() if job.kind != but])

    def _cancel(self, numbers: list[int]) -> None:
        for number in numbers:
            self._jobs.pop(number).job.cancel()
        if numbers:
            self.busy_changed.emit(self.busy)

    def close(self, deadline: float) -> bool:
        """Cancel all jobs and end the thread; see `WorkerThread.end`."""
        self.cancel_all()
        return self._thread.end(deadline)

    @Slot(int, int, int)
    def _on_reported(self, number: int, done: int, total: int) -> None:
        if number in self._jobs:
            self.progressed.emit(self._jobs[number].kind, done, total)

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
