"""The threads behind the window, and their responses to requests."""

from __future__ import annotations

import logging
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from PySide6.QtCore import QObject, QThread, QTimer

from lcollision_core.errors import CancelledError, LCollisionError

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
