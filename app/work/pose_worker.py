"""The edited pose, computed in another thread: its frames and their exact checks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Qt, Signal, Slot

from app.work.frames import (
    FrameEvaluator,
    MeasuredFrame,
    PoseFrame,
    SpaceFactory,
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
    """Codes for the pose to reach, as set by sliders.

    Attributes
    ----------
    aim : (D,) float64 array, read-only
    """

    aim: FloatArray


@dataclass(frozen=True, eq=False)
class GripTarget:
    """Target of a dragged patch or twist.

    Attributes
    ----------
    aim : float64 array, read-only: (3,) point, or (1,) angle of a twist; see `PoseDragger.move`
    """

    aim: FloatArray


@dataclass(frozen=True, eq=False)
class MotionStart:
    """The constant part of a motion towards changing targets.

    Attributes
    ----------
    latent : (D,) float64 array, read-only, the starting pose
    grip : the dragged patch or twist; None if the targets are codes
    pins : patches that stay in place
    options : of the drag
    placement, space : of the pose, as in `PoseRequest`
    """

    latent: FloatArray
    grip: Grip | Twist | None
    pins: tuple[Pin, ...]
    options: DragOptions
    placement: RigidTransform | None
    space: SpaceFactory | None = None


@dataclass(frozen=True, eq=False)
class PoseRequest:
    """A request for a `PoseFrame`.

    Attributes
    ----------
    model : of the pose
    target : the codes to show, or with a `start` the target to move towards
    start : of the motion; the worker begins a new drag when it changes
    predicts : whether the frame gets a prediction
    unchecked : a frame to check exactly instead
    unmeasured : a frame to measure instead
    placement : of the exported pose
    space : of a motion's frame; None for any other pose
    """

    model: Body
    target: CodeTarget | GripTarget | None
    start: MotionStart | None = None
    predicts: bool = False
    unchecked: PoseFrame | None = None
    placement: RigidTransform | None = None
    space: SpaceFactory | None = None
    unmeasured: PoseFrame | None = None

    @property
    def is_of_rest(self) -> bool:
        """Whether it checks or measures an existing frame, because its pose rests."""
        return self.unchecked is not None or self.unmeasured is not None

    @property
    def kind(self) -> str:
        """The kind of request; a failure that repeats within a kind is reported once."""
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
            # The dragger belongs to the previous model.
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
            frame_space = request.space()
            return evaluator.frame(request.target.aim, True, request.placement, frame_space)
        return evaluator.moved(self._begun(request.model, request.start), request.target.aim)

    def _begun(self, model: Body, start: MotionStart) -> PoseDragger:
        """Return the dragger of a motion, and begin its drag if it is new."""
        if self._dragger is None or start is not self._start:
            self._dragger = None
            dragger = model.dragger(start.placement, start.space and start.space())
            dragger.begin(start.latent, start.grip, start.pins, start.options)
            self._dragger, self._start = dragger, start
        return self._dragger


class PoseMailbox(QObject):
    """Passes the newest waiting request to the pose worker.

    The worker has one request at a time, so nothing queues up. Requests within one turn of the
    event loop count as one.

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
        # Sooner than a timer of 0 ms, which Qt fires only after drawing the slider.
        self._due.connect(self.send, Qt.ConnectionType.QueuedConnection)

    @property
    def waiting(self) -> PoseRequest | None:
        """The request that the worker gets next."""
        return self._waiting

    @property
    def pending(self) -> list[PoseRequest]:
        """The unanswered requests: the one in progress, and the waiting one."""
        return [request for request in (self._asked, self._waiting) if request is not None]

    def put(self, request: PoseRequest) -> None:
        """Replace the waiting request, and send it soon."""
        self._waiting = request
        if not self._is_due:
            self._is_due = True
            self._due.emit()

    def withdraw(self) -> None:
        """Drop the waiting request."""
        self._waiting = None

    @Slot()
    def send(self) -> None:
        """Send the waiting request unless the worker is busy."""
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
