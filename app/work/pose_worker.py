"""The pose that is edited, computed in another thread: its frames and their exact checks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Qt, Signal, Slot

from app.work.frames import (
    FrameEvaluator,
    MeasuredFrame,
    OwnSpace,
    PoseFrame,
    keep_torch_to_one_thread,
)
from app.work.threads import Response, end_thread, guarded, started_thread

if TYPE_CHECKING:
    from lcollision_core.bodies import Body
    from lcollision_core.meshes import RigidTransform
    from lcollision_core.posing import DragOptions, Grip, Pin, PoseDragger, Twist

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CodeTarget:
    """Codes for the pose to reach, as of sliders.

    Attributes
    ----------
    aim : (D,) float64 array, read-only
    """

    aim: FloatArray


@dataclass(frozen=True, eq=False)
class GripTarget:
    """Where what is held by hand is to go.

    Attributes
    ----------
    aim : float64 array, read-only: (3,) point, or (1,) angle of a twist; see `PoseDragger.move`
    """

    aim: FloatArray


@dataclass(frozen=True, eq=False)
class MotionStart:
    """What stays the same while a pose is moved towards one target after the other.

    Attributes
    ----------
    latent : (D,) float64 array, read-only, where it begins
    grip : what is held by hand; None where the targets are codes
    pins : that stay in their places
    options : of the drag
    placement, space : of the pose, as of a `PoseRequest`
    """

    latent: FloatArray
    grip: Grip | Twist | None
    pins: tuple[Pin, ...]
    options: DragOptions
    placement: RigidTransform | None
    space: OwnSpace | None = None


@dataclass(frozen=True, eq=False)
class PoseRequest:
    """Ask for a `PoseFrame`.

    Attributes
    ----------
    model : of the pose
    target : the codes to show as they are, or where there is a `start`, what to move towards
    start : of the motion, which the worker begins where it is another than before
    predicts : whether the frame is to have a prediction
    unchecked : the frame to check exactly, instead of all that
    unmeasured : the frame to measure, instead of all that
    placement : where the pose is exported to
    space : of a frame of a motion, None for any other pose
    """

    model: Body
    target: CodeTarget | GripTarget | None
    start: MotionStart | None = None
    predicts: bool = False
    unchecked: PoseFrame | None = None
    placement: RigidTransform | None = None
    space: OwnSpace | None = None
    unmeasured: PoseFrame | None = None

    @property
    def is_of_rest(self) -> bool:
        """Whether it asks about a frame that is there, as its pose rests."""
        return self.unchecked is not None or self.unmeasured is not None

    @property
    def kind(self) -> str:
        """What it asks for; a failure that repeats in a kind is reported once."""
        if self.unchecked is not None:
            return "check"
        if self.unmeasured is not None:
            return "measure"
        return "frame" if self.start is None else "motion"


class PoseWorker(QObject):
    """Answers requests in its own thread, with a `PoseFrame` each, or a `MeasuredFrame`."""

    answered = Signal(object)

    def __init__(self) -> None:
        super().__init__()
        self._evaluator: FrameEvaluator | None = None
        self._start: MotionStart | None = None
        self._dragger: PoseDragger | None = None

    @Slot(object)
    def answer(self, request: PoseRequest) -> None:
        """Answer one request, whatever happens."""
        self.answered.emit(guarded("showing the pose", self._frame, request))

    def _frame(self, request: PoseRequest) -> PoseFrame | MeasuredFrame:
        evaluator = self._evaluator
        if evaluator is None or evaluator.model is not request.model:
            self._evaluator = evaluator = FrameEvaluator(request.model)
            evaluator.predicts = False
            # It holds the model before.
            self._start = self._dragger = None
        if request.unchecked is not None:
            return evaluator.checked(request.unchecked)
        if request.unmeasured is not None:
            return evaluator.measured(request.unmeasured)
        if request.predicts and not evaluator.predicts:
            keep_torch_to_one_thread(request.model)
            evaluator.predicts = True
        assert request.target is not None
        if request.start is None:
            if request.space is None:
                return evaluator.frame(request.target.aim)
            own = request.space()
            return evaluator.frame(request.target.aim, True, request.placement, own)
        return evaluator.moved(self._begun(request.model, request.start), request.target.aim)

    def _begun(self, model: Body, start: MotionStart) -> PoseDragger:
        """Return the dragger of a motion, which begins where it is new."""
        if self._dragger is None or start is not self._start:
            self._dragger = None
            dragger = model.dragger(start.placement, start.space and start.space())
            dragger.begin(start.latent, start.grip, start.pins, start.options)
            self._dragger, self._start = dragger, start
        return self._dragger


class PoseMailbox(QObject):
    """Between the window and the worker of the pose: of the requests that wait the newest wins.

    The worker gets no second request while it works on a first, so that nothing queues up, and
    requests within one turn of the event loop are one.

    Signals
    -------
    answered : PoseRequest and its Response, whose value is a PoseFrame or a MeasuredFrame
    """

    answered = Signal(object, object)

    _posted = Signal(object)
    _due = Signal()

    def __init__(self, parent: QObject) -> None:
        super().__init__(parent)
        self._worker = PoseWorker()
        self._thread = started_thread("pose", self._worker, self)
        self._posted.connect(self._worker.answer)
        self._worker.answered.connect(self._on_answered)
        self._waiting: PoseRequest | None = None
        self._asked: PoseRequest | None = None
        self._is_due = False
        # Sooner than a timer of 0 ms, which Qt fires after it has drawn the slider alone.
        self._due.connect(self.send, Qt.ConnectionType.QueuedConnection)

    @property
    def waiting(self) -> PoseRequest | None:
        """The request that the worker gets next."""
        return self._waiting

    @property
    def pending(self) -> list[PoseRequest]:
        """What is not answered yet: the request in hand, and the one that waits."""
        return [request for request in (self._asked, self._waiting) if request is not None]

    def put(self, request: PoseRequest) -> None:
        """Ask for another frame, soon, instead of what still waits."""
        self._waiting = request
        if not self._is_due:
            self._is_due = True
            self._due.emit()

    def withdraw(self) -> None:
        """Ask no more for what still waits."""
        self._waiting = None

    @Slot()
    def send(self) -> None:
        """Give the worker what waits, unless it is busy."""
        self._is_due = False
        if self._asked is None and self._waiting is not None:
            self._asked, self._waiting = self._waiting, None
            self._posted.emit(self._asked)

    def close(self, deadline: float) -> bool:
        """End the thread; see `LongWork.close`."""
        self._waiting = self._asked = None
        self.blockSignals(True)
        return end_thread(self._thread, deadline)

    @Slot(object)
    def _on_answered(self, answer: Response) -> None:
        request, self._asked = self._asked, None
        if request is not None:
            self.answered.emit(request, answer)
            self.send()
