"""The pose that is edited, computed in another thread: its frame, then the exact check.

The worker gets no second request while it works on a first: the newest request wins, and nothing
queues up.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Qt, Signal, Slot

from app.work.frames import FrameEvaluator, LiveFrame, keep_torch_to_one_thread
from app.work.threads import Response, end_thread, guarded, single_shot, started_thread

if TYPE_CHECKING:
    from lcollision_core.model import PoseModel

_QUICK_SECONDS = 0.012
"""A frame that took less is waited for the next time,"""
_PATIENCE_SECONDS = 0.016
"""but at most this long, a picture of a screen that draws 60 in a second."""


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


class LiveWorker(QObject):
    """Computes frames and exact checks in its own thread; `answered` carries the request too."""

    answered = Signal(object, object)

    def __init__(self) -> None:
        super().__init__()
        self._evaluator: FrameEvaluator | None = None
        self._answer: Response | None = None
        self._has_answered = threading.Event()

    @Slot(object)
    def answer(self, request: FrameRequest | VerdictRequest) -> None:
        """Answer one request, whatever happens."""
        self._answer = guarded(request.request_id, "showing the pose", self._value, request)
        self._has_answered.set()
        self.answered.emit(request, self._answer)

    def forget(self) -> None:
        """Make `awaited` wait for the next answer; called before that is asked for."""
        self._has_answered.clear()

    def awaited(self, seconds: float) -> Response | None:
        """Wait in another thread for the answer; None if it takes longer."""
        return self._answer if self._has_answered.wait(seconds) else None

    def _value(self, request: FrameRequest | VerdictRequest) -> object:
        if self._evaluator is None or self._evaluator.model is not request.model:
            self._evaluator = FrameEvaluator(request.model)
            self._evaluator.predicts = False
        if isinstance(request, FrameRequest):
            if request.predicts and not self._evaluator.predicts:
                keep_torch_to_one_thread(request.model)
                self._evaluator.predicts = True
            return self._evaluator.frame(request.latent, request.request_id)
        return self._evaluator.verdict(request.frame)


class LivePose(QObject):
    """Follows one pose: its frame at once, its exact check when it rests.

    Changes within one turn of the event loop are one request; while the worker is busy, only the
    newest pose waits. A quick frame is waited for, far shorter than a picture takes, so that the
    slider and the mesh are drawn together: drawing the window twice would cost the
    most. A failure that repeats from pose to pose is reported once.

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
        self._reported: dict[type, str] = {}
        self._is_quick = False
        self._is_due = False
        # Sooner than a timer of 0 ms, which Qt fires after it has drawn the slider alone.
        self._due.connect(self._on_due, Qt.ConnectionType.QueuedConnection)
        self._rested = single_shot(self, rest_milliseconds, self._ask)

    def follow(self, model: PoseModel, latent: npt.NDArray[np.float64], predicts: bool) -> None:
        """Request the frame, and later the exact check, of another pose.

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

    def close(self, deadline: float) -> bool:
        """End the thread; see `LongWork.close`."""
        self._rested.stop()
        self._next = self._shown = self._model = None
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
        """Send the next request unless the worker is busy; return whether it was sent."""
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
    def _on_answered(self, request: FrameRequest | VerdictRequest, answer: Response) -> None:
        # A response that was waited for arrives here again, maybe during a later request.
        if request is self._asked:
            self._take(answer)

    def _take(self, answer: Response) -> None:
        request, self._asked = self._asked, None
        # The next request is sent before the response is drawn: the worker need not wait.
        # It is not waited for here: its response would be signalled before this one.
        self._ask()
        if request is None or request.model is not self._model:
            return
        if answer.failure is not None:
            if answer.failure.headline != self._reported.get(type(request)):
                self._reported[type(request)] = answer.failure.headline
                self.failed.emit(answer.failure)
        elif isinstance(request, FrameRequest) and answer.value is not None:
            if request.request_id == self._last_id:
                self._shown = (request, answer.value)
                self._rested.start()
            self._reported.pop(FrameRequest, None)
            self._is_quick = answer.value.seconds < _QUICK_SECONDS
            self.frame_computed.emit(answer.value)
        elif answer.value is not None and answer.request_id == self._last_id:
            self._reported.pop(VerdictRequest, None)
            self.verdict_computed.emit(answer.value)
