"""Frames for the screen: mesh, normals, prediction and exact check of a pose.

Two threads compute them: one the edited pose, the other the frames of motions, ahead of time.
"""

from __future__ import annotations

import statistics
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Qt, Signal, Slot

from app.work.threads import Response, WorkerThread, guarded

if TYPE_CHECKING:
    from lcollision_core.bodies import Body
    from lcollision_core.contact import NearestPair, SelfCollisions
    from lcollision_core.meshes import RigidTransform
    from lcollision_core.motion import Motion
    from lcollision_core.posing import DragOptions, Grip, Pin, PoseDragger, PoseSpace, Twist


Float32Array = npt.NDArray[np.float32]
FloatArray = npt.NDArray[np.float64]

SpaceFactory = Callable[[], "PoseSpace"]
"""Returns the body's pose space in a motion's frame: see `Motion.space_at`."""

_QUICK_CHECK_SECONDS = 0.006
"""A faster exact check accompanies every frame; a slower one waits until the pose rests."""

_CHECKS = 5
"""Number of recent checks whose median time is used."""


def empty_points() -> FloatArray:
    """Return an empty (0, 3) array, read-only."""
    return _frozen(np.empty((0, 3)))


@dataclass(frozen=True, eq=False)
class PosePrediction:
    """The predictor's estimate for one pose.

    Attributes
    ----------
    domain_energy : (K,) float64 array, read-only, >= 0, in normalised lengths squared
    collision_probability : above 0.5 where the pose is estimated to collide
    """

    domain_energy: FloatArray
    collision_probability: float


@dataclass(frozen=True, eq=False)
class PoseFrame:
    """One pose as drawn; everything in it belongs to one latent.

    Attributes
    ----------
    latent : (D,) float64 array, read-only
    vertices : (V, 3) float32 array, read-only, in the data's unit, aligned to the reference
    normals : (V, 3) float32 array, read-only, of length 1, area-weighted
    prediction : None without a prediction
    collisions : the exact check of the vertices; None until they are checked
    seconds : thread time of the computation
    contacts : (C, 3) float64 array, points of the surface, in the data's unit, where contact keeps
        the pose from approaching its target
    standing : (S, 3) float64 array, points of the surface that a drag keeps on the ground
    target : that the pose was moved towards; None if it was requested unchanged
    miss : the remaining distance to the target: normalised length, or radians of a twist
    settled : whether the same target would move the pose no further
    """

    latent: FloatArray
    vertices: Float32Array
    normals: Float32Array
    prediction: PosePrediction | None
    collisions: SelfCollisions | None
    seconds: float
    contacts: FloatArray = field(default_factory=empty_points)
    standing: FloatArray = field(default_factory=empty_points)
    target: FloatArray | None = None
    miss: float = 0.0
    settled: bool = True

    @property
    def is_checked(self) -> bool:
        """Whether all colliding pairs are known, including those that contact rules leave out."""
        return self.collisions is not None and not self.collisions.counted_only


class FrameEvaluator:
    """Computes frames and exact checks of one model; for one thread at a time.

    Parameters
    ----------
    model : of all poses

    Attributes
    ----------
    predicts : whether frames get predictions, if the model has a predictor
    """

    def __init__(self, model: Body) -> None:
        self.model = model
        self.predicts = False
        self._checks: deque[float] = deque(maxlen=_CHECKS)

    def frame(
        self,
        latent: FloatArray,
        space: PoseSpace | None = None,
        checks: bool = True,
    ) -> PoseFrame:
        """Decode, shade and predict one pose, and check it if that is quick.

        Parameters
        ----------
        latent : (D,) finite array
        space : of a motion's frame; None for any other pose
        checks : False omits the exact check
        """
        start = time.thread_time()
        check = self.model.exact_check(space=space)
        vertices = check.drawn(check.decode(latent)[0])
        is_quick = (
            checks and self._checks and statistics.median(self._checks) < _QUICK_CHECK_SECONDS
        )
        collisions = self._detect(vertices) if is_quick else None
        return self._drawn(latent, vertices, collisions, start)

    def moved(self, dragger: PoseDragger, target: FloatArray) -> PoseFrame:
        """Move a pose towards a target, and shade and predict the result.

        Parameters
        ----------
        dragger : of this model, with a drag in progress
        target : see `PoseDragger.move`
        """
        start = time.thread_time()
        step = dragger.move(target)
        return self._drawn(
            step.latent,
            step.vertices,
            step.crossing,
            start,
            contacts=_frozen(step.contacts),
            standing=_frozen(step.standing),
            target=target,
            miss=step.miss,
            settled=step.settled,
        )

    def checked(self, frame: PoseFrame) -> PoseFrame:
        """Check the vertices of a frame exactly."""
        return replace(frame, collisions=self._detect(frame.vertices))

    def nearest(self, frame: PoseFrame) -> NearestPair | None:
        """Find the nearest pair of a frame's surface; None if none is nearer than the bound."""
        from lcollision_core.contact import DISTANCE_BOUND

        return self.model.detector.least_distance(frame.vertices, DISTANCE_BOUND)

    def _drawn(
        self,
        latent: FloatArray,
        vertices: Float32Array,
        collisions: SelfCollisions | None,
        start: float,
        **moved: Any,
    ) -> PoseFrame:
        predicts = self.predicts and self.model.has_predictor
        return PoseFrame(
            latent,
            _frozen(vertices),
            _frozen(self.normals(vertices)),
            self._predict(latent) if predicts else None,
            collisions,
            time.thread_time() - start,
            **moved,
        )

    def _predict(self, latent: FloatArray) -> PosePrediction:
        predicted = self.model.predict(latent[None])
        return PosePrediction(
            domain_energy=_frozen(predicted.domain_energy[0]),
            collision_probability=float(predicted.collision_probability[0]),
        )

    def _detect(self, vertices: Float32Array) -> SelfCollisions:
        start = time.thread_time()
        collisions = self.model.detector.detect(vertices)
        self._checks.append(time.thread_time() - start)
        return collisions

    def normals(self, vertices: Float32Array) -> Float32Array:
        """Return the (V, 3) float32 normals of (V, 3) float32 vertices."""
        from lcollision_core.meshes.normals import vertex_normals

        return vertex_normals(vertices, self.model.faces)


def keep_torch_to_one_thread(model: Body) -> None:
    """Let torch use one core in the calling thread: a single pose is too small to parallelise.

    On a busy machine torch's threads wait for each other: one prediction took 32 ms instead of
    0.4 ms. Does nothing if predicting a pose needs no torch.
    """
    if model.prediction_needs_torch:
        import torch

        torch.set_num_threads(1)


def _frozen(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    array.flags.writeable = False
    return array


@dataclass(frozen=True, eq=False)
class MotionStart:
    """The constant part of a motion towards changing targets.

    Attributes
    ----------
    latent : (D,) float64 array, read-only, the starting pose
    grip : the dragged patch or twist; None if the targets are codes
    pins : patches that stay in place
    options : of the drag
    placement : of the exported pose
    space : of a motion's frame; None for any other pose
    """

    latent: FloatArray
    grip: Grip | Twist | None
    pins: tuple[Pin, ...]
    options: DragOptions
    placement: RigidTransform | None
    space: SpaceFactory | None


@dataclass(frozen=True, eq=False)
class PoseRequest:
    """A request for a `PoseFrame`, or for more about one.

    Attributes
    ----------
    model : of the pose
    target : (D,) codes to show, or with a `start` to move towards; for the grip of a start a (3,)
        point, or the (1,) angle of a twist
    start : of the motion; the worker begins a new drag when it changes
    predicts : whether the frame gets a prediction
    space : of a motion's frame; None for any other pose
    resting : a frame to check exactly instead, or to measure if it is checked
    """

    model: Body
    target: FloatArray | None = None
    start: MotionStart | None = None
    predicts: bool = False
    space: SpaceFactory | None = None
    resting: PoseFrame | None = None

    @property
    def kind(self) -> str:
        """The kind of request; a failure that repeats within a kind is reported once."""
        if self.resting is not None:
            return "measure" if self.resting.is_checked else "check"
        return "frame" if self.start is None else "motion"


class PoseWorker:
    """Answers requests, most with a `PoseFrame`; for one thread."""

    def __init__(self) -> None:
        self._evaluator: FrameEvaluator | None = None
        self._start: MotionStart | None = None
        self._dragger: PoseDragger | None = None

    def answer(self, request: PoseRequest) -> PoseFrame | NearestPair | None:
        """Answer one request; measuring finds the nearest pair."""
        evaluator, resting = self._evaluator, request.resting
        if evaluator is None or evaluator.model is not request.model:
            self._evaluator = evaluator = FrameEvaluator(request.model)
            # The dragger belongs to the previous model.
            self._start = self._dragger = None
        if resting is not None:
            return evaluator.nearest(resting) if resting.is_checked else evaluator.checked(resting)
        if request.predicts and not evaluator.predicts:
            keep_torch_to_one_thread(request.model)
            evaluator.predicts = True
        assert request.target is not None
        if request.start is None:
            return evaluator.frame(request.target, request.space and request.space())
        return evaluator.moved(self._begun(request.model, request.start), request.target)

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
    answered : PoseRequest and its Response; see `PoseWorker.answer`

    Attributes
    ----------
    waiting : the request that the worker gets next; None withdraws it
    """

    answered = Signal(object, object)

    _due = Signal()
    _responded = Signal(object)

    def __init__(self, parent: QObject) -> None:
        super().__init__(parent)
        self._worker, self._thread = PoseWorker(), WorkerThread("pose")
        # Emitted in that thread, and received in the window's.
        self._responded.connect(self._on_answered)
        self.waiting: PoseRequest | None = None
        self._asked: PoseRequest | None = None
        self._is_due = False
        # Sooner than a timer of 0 ms, which Qt fires only after drawing the slider.
        self._due.connect(self.send, Qt.ConnectionType.QueuedConnection)

    @property
    def pending(self) -> list[PoseRequest]:
        """The unanswered requests: the one in progress, and the waiting one."""
        return [request for request in (self._asked, self.waiting) if request is not None]

    def put(self, request: PoseRequest) -> None:
        """Replace the waiting request, and send it soon."""
        self.waiting = request
        if not self._is_due:
            self._is_due = True
            self._due.emit()

    @Slot()
    def send(self) -> None:
        """Send the waiting request unless the worker is busy."""
        self._is_due = False
        if self._asked is None and self.waiting is not None:
            self._asked, self.waiting = self.waiting, None
            self._thread.submit(self._answer, self._asked)

    def _answer(self, request: PoseRequest) -> None:
        self._responded.emit(guarded("showing the pose", self._worker.answer, request))

    def close(self, deadline: float) -> bool:
        """End the thread; see `LongWork.close`."""
        self.waiting = self._asked = None
        self.blockSignals(True)
        return self._thread.end(deadline)

    @Slot(object)
    def _on_answered(self, answer: Response) -> None:
        request, self._asked = self._asked, None
        if request is not None:
            self.answered.emit(request, answer)


MOST_BYTES = 96 * 2**20
"""Size limit of the cache: about 250 frames of 15 000 vertices."""

_Key = tuple[bytes, object, int]


@dataclass(frozen=True)
class Onion:
    """The onion skin: frames around the playhead that are drawn transparent.

    Attributes
    ----------
    count : how many before and after the playhead; 0 for none
    step : distance between them, in frames
    """

    count: int = 0
    step: int = 4

    def frames(self, at: int, n_frames: int) -> list[int]:
        """Return the onion skin frames around a frame, nearest first."""
        away = [k * self.step for k in range(1, self.count + 1)]
        return [at + by for k in away for by in (-k, k) if 0 <= at + by < n_frames]


class FrameCache(QObject):
    """Frames of motions by their codes and bodies, so that an edit drops no unchanged frame.

    Parameters
    ----------
    parent : the Qt parent

    Attributes
    ----------
    predicts : whether frames get a prediction

    Signals
    -------
    ready : Motion and int, a wanted frame
    failed : Failure
    """

    ready = Signal(object, int)
    failed = Signal(object)

    def __init__(self, parent: QObject) -> None:
        super().__init__(parent)
        self.predicts = False
        self._guard = Lock()
        self._model: Body | None = None
        self._frames: dict[_Key, PoseFrame] = {}
        self._n_bytes = 0
        self._wanted: list[tuple[Motion, int]] = []
        self._evaluator: FrameEvaluator | None = None
        self._thread = WorkerThread("frames")

    def forget(self, model: Body | None) -> None:
        """Clear the cache and start with another model."""
        with self._guard:
            self._model, self._wanted = model, []
            self._frames.clear()
            self._n_bytes = 0

    def get(self, motion: Motion, number: int) -> PoseFrame | None:
        """Return a frame if it is cached."""
        with self._guard:
            return self._get(motion, number)

    def want(self, wanted: Sequence[tuple[Motion, int]]) -> None:
        """Request these frames, the most urgent first, replacing earlier requests."""
        with self._guard:
            self._wanted = [frame for frame in wanted if self._get(*frame) is None]
            is_due = bool(self._wanted)
        if is_due:
            self._thread.submit(self._work)

    # In the other thread.

    def _work(self) -> None:
        """Compute the wanted frames, always the most urgent, until none is left."""
        while (request := self._next_wanted()) is not None:
            model, motion, number, predicts = request
            answer = guarded("showing a frame", self._frame, model, motion, number, predicts)
            self._put(model, motion, number, answer)

    def _frame(self, model: Body, motion: Motion, number: int, predicts: bool) -> PoseFrame:
        evaluator = self._evaluator
        if evaluator is None or evaluator.model is not model:
            self._evaluator = evaluator = FrameEvaluator(model)
        if predicts:
            keep_torch_to_one_thread(model)
        evaluator.predicts = predicts
        frame_space = motion.space(number, model.space)
        return evaluator.frame(motion.codes[number], frame_space, checks=False)

    def _next_wanted(self) -> tuple[Body, Motion, int, bool] | None:
        """Return the next frame to compute; None if nothing is left."""
        with self._guard:
            while self._wanted:
                motion, number = self._wanted.pop(0)
                if self._model is not None and self._get(motion, number) is None:
                    return self._model, motion, number, self.predicts
        return None

    def _put(self, model: Body, motion: Motion, number: int, answer: Response) -> None:
        """Store a computed frame, and drop the least recently used ones beyond the limit."""
        frame: PoseFrame | None = answer.value
        with self._guard:
            if answer.failure is not None:
                self._wanted = []
            if model is not self._model:
                return
            if frame is not None:
                self._frames[_key(motion, number)] = frame
                self._n_bytes += _bytes_of(frame)
            while self._n_bytes > MOST_BYTES and len(self._frames) > 1:
                oldest = next(iter(self._frames))
                self._n_bytes -= _bytes_of(self._frames.pop(oldest))
        if answer.failure is not None:
            self.failed.emit(answer.failure)
        elif frame is not None:
            self.ready.emit(motion, number)

    def close(self, deadline: float) -> bool:
        """End the thread; see `LongWork.close`."""
        with self._guard:
            self._wanted = []
        self.blockSignals(True)
        return self._thread.end(deadline)

    def _get(self, motion: Motion, number: int) -> PoseFrame | None:
        frame = self._frames.pop(_key(motion, number), None)
        if frame is not None:
            # Move it to the most recently used end.
            self._frames[_key(motion, number)] = frame
        return frame


def _key(motion: Motion, number: int) -> _Key:
    # If all frames share one body, equal codes give equal frames.
    space_at = motion.space_at
    return motion.codes[number].tobytes(), space_at, 0 if space_at is None else number


def _bytes_of(frame: PoseFrame) -> int:
    return frame.vertices.nbytes + frame.normals.nbytes + frame.latent.nbytes
