"""The pose that is edited, computed in another thread: its frame, then the exact check.

The worker gets no second request while it works on a first: the newest request wins, and nothing
queues up.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Qt, Signal, Slot

from app.work.frames import FrameEvaluator, LiveFrame, keep_torch_to_one_thread
from app.work.threads import Response, end_thread, guarded, single_shot, started_thread

if TYPE_CHECKING:
    from lcollision_core.meshes import RigidTransform
    from lcollision_core.model import PosableBody
    from lcollision_core.posing import DragOptions, Grip, Pin, PoseDragger, Twist

_QUICK_SECONDS = 0.012
"""Seconds of a frame below which the window waits for the next one before it draws."""
_PATIENCE_SECONDS = 0.016
"""The longest such wait: one picture of a screen that draws 60 a second."""

_MOST_IDLE = 5
"""Events towards one target, none of which came nearer, after which a drag counts as settled."""

_NEARER = 0.999
"""A miss that is less than this fraction of the least one before is nearer."""


@dataclass(frozen=True, eq=False)
class FrameRequest:
    """Ask for the frame of a pose.

    Attributes
    ----------
    latent : (D,) float64 array, read-only
    predicts : whether it is to have a prediction
    """

    request_id: int
    model: PosableBody
    latent: npt.NDArray[np.float64]
    predicts: bool


@dataclass(frozen=True, eq=False)
class DragSession:
    """What stays the same while a pose is dragged.

    Attributes
    ----------
    latent : (D,) float64 array, read-only, where it begins
    grip : what is dragged; None for the codes themselves
    pins : that stay in their places
    options : of the drag
    placement : where the pose is exported to
    """

    model: PosableBody
    latent: npt.NDArray[np.float64]
    grip: Grip | Twist | None
    pins: tuple[Pin, ...]
    options: DragOptions
    placement: RigidTransform | None


@dataclass(frozen=True, eq=False)
class DragRequest:
    """Ask for the frame of a drag's next event.

    Attributes
    ----------
    session : that the worker begins where it is another than before
    target : float64 array, read-only, see `PoseDragger.move`
    predicts : whether it is to have a prediction
    """

    request_id: int
    session: DragSession
    target: npt.NDArray[np.float64]
    predicts: bool

    @property
    def model(self) -> PosableBody:
        """The model of the drag."""
        return self.session.model


@dataclass(frozen=True, eq=False)
class VerdictRequest:
    """Ask for the exact check of a frame that is on the screen."""

    request_id: int
    model: PosableBody
    frame: LiveFrame


Request = FrameRequest | DragRequest | VerdictRequest


class LiveWorker(QObject):
    """Computes frames and exact checks in its own thread; `answered` carries the request too."""

    answered = Signal(object, object)

    def __init__(self) -> None:
        super().__init__()
        self._evaluator: FrameEvaluator | None = None
        self._answer: Response | None = None
        self._has_answered = threading.Event()
        self._session: DragSession | None = None
        self._dragger: PoseDragger | None = None

    @Slot(object)
    def answer(self, request: Request) -> None:
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

    def _value(self, request: Request) -> object:
        evaluator = self._evaluator
        if evaluator is None or evaluator.model is not request.model:
            self._evaluator = evaluator = FrameEvaluator(request.model)
            evaluator.predicts = False
            # It holds the model before.
            self._session = self._dragger = None
        if isinstance(request, VerdictRequest):
            return evaluator.verdict(request.frame)
        if request.predicts and not evaluator.predicts:
            keep_torch_to_one_thread(request.model)
            evaluator.predicts = True
        if isinstance(request, FrameRequest):
            return evaluator.frame(request.latent, request.request_id)
        return evaluator.dragged(self._begun(request.session), request.target, request.request_id)

    def _begun(self, session: DragSession) -> PoseDragger:
        """Return the dragger of a session, which begins where it is new."""
        if self._dragger is None or session is not self._session:
            self._dragger = None
            dragger = session.model.dragger(session.placement)
            dragger.begin(session.latent, session.grip, session.pins, session.options)
            self._dragger, self._session = dragger, session
        return self._dragger


class LivePose(QObject):
    """Follows one pose: its frame at once, its exact check with it or when it rests.

    Changes within one turn of the event loop are one request; while the worker is busy, only the
    newest pose waits. A quick frame is waited for, far shorter than a picture takes, so that the
    slider and the mesh are drawn together: drawing the window twice would cost the
    most. A failure that repeats from pose to pose is reported once.

    A drag is a session and the newest target: until the pose has settled on that, it goes on by
    itself. Its frames say where the pose is; nothing else asks for their poses.

    Parameters
    ----------
    rest_milliseconds : how long a pose must have stayed before it is checked exactly, where its
        frame came without

    Signals
    -------
    frame_computed : LiveFrame of the pose that is followed, or of an earlier one
    dragged : LiveFrame of the session that is dragged
    verdict_computed : ExactVerdict of the newest frame
    settled : the drag would lead no further, or has failed
    failed : Failure
    """

    frame_computed = Signal(object)
    dragged = Signal(object)
    verdict_computed = Signal(object)
    settled = Signal()
    failed = Signal(object)

    _wanted = Signal(object)
    _due = Signal()

    def __init__(self, rest_milliseconds: int, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._worker = LiveWorker()
        self._thread = started_thread("live pose", self._worker, self)
        self._wanted.connect(self._worker.answer)
        self._worker.answered.connect(self._on_answered)
        self._model: PosableBody | None = None
        self._session: DragSession | None = None
        self._least_miss, self._n_idle = np.inf, 0
        self._next: FrameRequest | DragRequest | None = None
        self._asked: Request | None = None
        self._unanswered: FrameRequest | None = None
        self._unchecked: VerdictRequest | None = None
        self._last_id = self._shown_id = 0
        self._reported: dict[type, str] = {}
        self._is_quick = False
        self._is_due = False
        # Sooner than a timer of 0 ms, which Qt fires after it has drawn the slider alone.
        self._due.connect(self._on_due, Qt.ConnectionType.QueuedConnection)
        self._rested = single_shot(self, rest_milliseconds, self._ask)

    def follow(self, model: PosableBody, latent: npt.NDArray[np.float64], predicts: bool) -> None:
        """Request the frame, and later the exact check, of another pose; a drag ends.

        Parameters
        ----------
        latent : (D,) float64 array, read-only, as the worker reads it too
        predicts : whether predictions can be had without loading anything
        """
        self._model, self._session = model, None
        self._unanswered = FrameRequest(self._next_id(), model, latent, predicts)
        self._unchecked, self._shown_id = None, 0
        self._want(self._unanswered)

    def drag(self, session: DragSession, target: npt.NDArray[np.float64], predicts: bool) -> None:
        """Go towards another target; a session that is new begins.

        Parameters
        ----------
        target : float64 array, read-only, see `PoseDragger.move`
        predicts : as for `follow`
        """
        self._model, self._session = session.model, session
        self._least_miss, self._n_idle = np.inf, 0
        self._want(DragRequest(self._next_id(), session, target, predicts))

    @property
    def is_dragging(self) -> bool:
        """Whether the drag has not settled on its newest target yet."""
        return self._session is not None and any(
            isinstance(request, DragRequest) and request.session is self._session
            for request in (self._next, self._asked)
        )

    def end_drag(self) -> None:
        """End the drag at its newest frame; what still comes of it is dropped."""
        self._session = None
        if isinstance(self._next, DragRequest):
            self._next = None
        if self._unanswered is not None and self._asked is not self._unanswered:
            held = self._unanswered
            self.follow(held.model, held.latent, held.predicts)
        elif self._unchecked is not None:
            self._rested.start()

    def close(self, deadline: float) -> bool:
        """End the thread; see `LongWork.close`."""
        self._rested.stop()
        self._next = self._unanswered = self._unchecked = self._model = self._session = None
        return end_thread(self._thread, deadline)

    def _next_id(self) -> int:
        self._last_id += 1
        return self._last_id

    def _want(self, request: FrameRequest | DragRequest) -> None:
        self._next = request
        self._rested.stop()
        if not self._is_due:
            self._is_due = True
            self._due.emit()

    @Slot()
    def _on_due(self) -> None:
        self._is_due = False
        is_new = self._ask() and isinstance(self._asked, FrameRequest)
        answer = self._awaited() if is_new or isinstance(self._asked, DragRequest) else None
        if answer is not None:
            self._take(answer)

    def _awaited(self) -> Response | None:
        """Wait for an answer that is expected to be quick; None if it is not there."""
        answer = self._worker.awaited(_PATIENCE_SECONDS) if self._is_quick else None
        self._is_quick = answer is not None
        return answer

    @Slot()
    def _ask(self) -> bool:
        """Send the next request unless the worker is busy; return whether it was sent."""
        if self._asked is not None:
            return False
        if self._next is not None:
            self._asked, self._next = self._next, None
        elif not self._rested.isActive():
            self._asked, self._unchecked = self._unchecked, None
        if self._asked is None:
            return False
        self._worker.forget()
        self._wanted.emit(self._asked)
        return True

    @Slot(object, object)
    def _on_answered(self, request: Request, answer: Response) -> None:
        # A response that was waited for arrives here again, maybe during a later request.
        if request is self._asked:
            self._take(answer)

    def _take(self, answer: Response) -> None:
        request, self._asked = self._asked, None
        is_of_drag = isinstance(request, DragRequest) and request.session is self._session
        frame = answer.value if isinstance(answer.value, LiveFrame) else None
        if frame is not None and (is_of_drag or request is self._unanswered):
            self._unanswered, self._unchecked, self._shown_id = None, None, frame.request_id
            if request is not None and (frame.verdict is None or frame.verdict.excluded is None):
                self._unchecked = VerdictRequest(frame.request_id, request.model, frame)
                self._rested.start()
        is_late = is_of_drag and self._next is not None
        if isinstance(request, DragRequest) and is_of_drag and frame is not None:
            self._go_on(request, frame)
        if frame is not None:
            self._is_quick = frame.seconds < _QUICK_SECONDS
        # The next request is sent before the response is drawn: the worker need not wait.
        # It is not waited for here: its response would be signalled before this one.
        self._ask()
        if is_late and frame is not None:
            # But drawing where the pointer was takes longer than going to where it is.
            later = self._awaited()
            if later is not None and later.failure is None:
                self._take(later)
                return
        if request is None or request.model is not self._model:
            return
        if answer.failure is not None:
            if answer.failure.headline != self._reported.get(type(request)):
                self._reported[type(request)] = answer.failure.headline
                self.failed.emit(answer.failure)
        elif frame is not None:
            self._reported.pop(type(request), None)
            if is_of_drag:
                self.dragged.emit(frame)
            elif isinstance(request, FrameRequest):
                self.frame_computed.emit(frame)
        elif answer.value is not None and answer.request_id == self._shown_id:
            self._reported.pop(VerdictRequest, None)
            self.verdict_computed.emit(answer.value)
        if is_of_drag and not self.is_dragging:
            self.settled.emit()

    def _go_on(self, request: DragRequest, frame: LiveFrame) -> None:
        """Want the same target again, unless that leads no further or a newer one waits."""
        self._n_idle += 1
        if frame.miss < _NEARER * self._least_miss:
            self._least_miss, self._n_idle = frame.miss, 0
        if self._next is None and not frame.settled and self._n_idle < _MOST_IDLE:
            self._next = replace(request, request_id=self._next_id())
