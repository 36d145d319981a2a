"""Frames of motions for the screen: computed ahead in another thread, in a bounded cache."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, Signal, Slot

from app.work.frames import FrameEvaluator, PoseFrame, keep_torch_to_one_thread
from app.work.threads import Response, end_thread, guarded, started_thread

if TYPE_CHECKING:
    from lcollision_core.bodies import Body
    from lcollision_core.motion import Motion

MOST_BYTES = 96 * 2**20
"""Size limit of the cache: about 250 frames of 15 000 vertices."""

_Key = tuple[bytes, object, int]


@dataclass(frozen=True)
class Onion:
    """The onion skin: frames around the playhead that are drawn transparent.

    Attributes
    ----------
    before, after : how many; 0 for none
    step : distance between them, in frames
    """

    before: int = 0
    after: int = 0
    step: int = 4

    def frames(self, at: int, n_frames: int) -> list[int]:
        """Return the onion skin frames around a frame, nearest first."""
        offsets = [-k * self.step for k in range(1, self.before + 1)]
        offsets += [k * self.step for k in range(1, self.after + 1)]
        return [at + by for by in sorted(offsets, key=abs) if 0 <= at + by < n_frames]


class _Worker(QObject):
    """Computes the wanted frames until none is left."""

    def __init__(self, cache: FrameCache) -> None:
        super().__init__()
        self._cache = cache
        self._evaluator: FrameEvaluator | None = None

    @Slot()
    def work(self) -> None:
        """Compute one frame after the other, always the most urgent."""
        while (request := self._cache.next_wanted()) is not None:
            model, motion, number, predicts = request
            answer = guarded("showing a frame", self._frame, model, motion, number, predicts)
            self._cache.put(model, motion, number, answer)

    def _frame(self, model: Body, motion: Motion, number: int, predicts: bool) -> PoseFrame:
        evaluator = self._evaluator
        if evaluator is None or evaluator.model is not model:
            self._evaluator = evaluator = FrameEvaluator(model)
        if predicts:
            keep_torch_to_one_thread(model)
        evaluator.predicts = predicts
        frame_space = motion.space(number, model.space)
        return evaluator.frame(motion.codes[number], False, motion.placement(number), frame_space)


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

    _due = Signal()

    def __init__(self, parent: QObject) -> None:
        super().__init__(parent)
        self.predicts = False
        self._guard = Lock()
        self._model: Body | None = None
        self._frames: dict[_Key, PoseFrame] = {}
        self._n_bytes = 0
        self._wanted: list[tuple[Motion, int]] = []
        self._worker = _Worker(self)
        self._thread = started_thread("frames", self._worker, self)
        self._due.connect(self._worker.work)

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
            self._due.emit()

    def next_wanted(self) -> tuple[Body, Motion, int, bool] | None:
        """Return the next frame for the worker to compute; None if nothing is left."""
        with self._guard:
            while self._wanted:
                motion, number = self._wanted.pop(0)
                if self._model is not None and self._get(motion, number) is None:
                    return self._model, motion, number, self.predicts
        return None

    def put(self, model: Body, motion: Motion, number: int, answer: Response) -> None:
        """Store a computed frame, and drop the least recently used ones beyond the limit."""
        frame: PoseFrame | None = answer.value
        with self._guard:
            if answer.failure is not None:
                self._wanted = []
            if model is not self._model:
                return
        if answer.failure is not None:
            self.failed.emit(answer.failure)
        if frame is None:
            return
        with self._guard:
            self._frames[_key(motion, number)] = frame
            self._n_bytes += _bytes_of(frame)
            while self._n_bytes > MOST_BYTES and len(self._frames) > 1:
                oldest = next(iter(self._frames))
                self._n_bytes -= _bytes_of(self._frames.pop(oldest))
        self.ready.emit(motion, number)

    def close(self, deadline: float) -> bool:
        """End the thread; see `LongWork.close`."""
        with self._guard:
            self._wanted = []
        self.blockSignals(True)
        return end_thread(self._thread, deadline)

    def _get(self, motion: Motion, number: int) -> PoseFrame | None:
        frame = self._frames.pop(_key(motion, number), None)
        if frame is not None:
            # Move it to the most recently used end.
            self._frames[_key(motion, number)] = frame
        return frame


def _key(motion: Motion, number: int) -> _Key:
    # If all frames share one body, equal codes give equal frames.
    frame_space = motion.space_at
    return motion.codes[number].tobytes(), frame_space, 0 if frame_space is None else number


def _bytes_of(frame: PoseFrame) -> int:
    return frame.vertices.nbytes + frame.normals.nbytes + frame.latent.nbytes
