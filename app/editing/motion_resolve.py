"""A Resolve of a motion while it runs: how far it is, and how it is ended early."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Signal, Slot

from app.editing.tasks import Work
from app.wording import counted
from app.work import jobs
from lcollision_core.jobs import CancelToken

if TYPE_CHECKING:
    from app.editing.tasks import Tasks
    from lcollision_core.bodies import PosableBody
    from lcollision_core.motion import Motion, ResolvedMotion
    from lcollision_core.options import MotionOptions


@dataclass(frozen=True)
class ResolveProgress:
    """How far a Resolve of a motion is.

    Attributes
    ----------
    began : when it became known which frames collide, else when it began, on `time.monotonic`
    done, total : frames of colliding spans; 0 of 0 until it is known which collide
    """

    began: float
    done: int = 0
    total: int = 0

    @property
    def seconds(self) -> float:
        """Since it began."""
        return time.monotonic() - self.began

    @property
    def seconds_left(self) -> float | None:
        """What the rest takes if it goes on so; None until something is done."""
        return self.seconds / self.done * (self.total - self.done) if self.done else None


class MotionResolve(QObject):
    """Resolves a motion in the long worker.

    Parameters
    ----------
    parent : of the object
    tasks : do it

    Attributes
    ----------
    progress : None while none runs

    Signals
    -------
    changed : `progress` is new
    """

    changed = Signal()

    def __init__(self, parent: QObject, tasks: Tasks) -> None:
        super().__init__(parent)
        self._tasks = tasks
        self.progress: ResolveProgress | None = None
        self._solved: npt.NDArray[np.bool_] = np.zeros(0, dtype=np.bool_)
        self._stop = CancelToken()
        tasks.motion_progressed.connect(self._on_progress)
        tasks.busy_changed.connect(self._on_busy)

    @property
    def runs(self) -> bool:
        """Whether one runs."""
        return self._tasks.solving_motion

    @property
    def spans(self) -> tuple[range, ...]:
        """While one runs: the spans of frames that it has freed so far."""
        from lcollision_core.motion.motion import runs

        return tuple(runs(self._solved)) if self.runs else ()

    def start(
        self,
        model: PosableBody,
        motion: Motion,
        options: MotionOptions,
        within: range | None,
        done: Callable[[ResolvedMotion], None],
    ) -> None:
        """Begin one; the parameters are those of `jobs.resolve_motion` and `LongWork.start`."""
        self._solved = np.zeros(len(motion), dtype=np.bool_)
        self._stop = CancelToken()
        job = partial(jobs.resolve_motion, model, motion, options, within, self._solved, self._stop)
        self._tasks.start(Work.RESOLVE_MOTION, f"Resolving {motion.name}", job, done)
        self.progress = ResolveProgress(time.monotonic())
        self.changed.emit()

    @Slot()
    def cancel(self) -> None:
        """End it; the motion stays as it was."""
        self.end("Resolve was cancelled: the motion is as it was")

    def end(self, why: str) -> None:
        """End it as of `cancel`, and say why."""
        if self.runs:
            self._tasks.cancel(Work.RESOLVE_MOTION)
            self._tasks.message.emit(why)

    @Slot()
    def keep_done(self) -> None:
        """End it soon, with the spans of frames that are resolved."""
        self._stop.cancel()
        self.changed.emit()

    @property
    def is_ending(self) -> bool:
        """Whether it was asked to end with what is done."""
        return self._stop.cancelled

    def told_of(self, found: ResolvedMotion, part_names: Sequence[str]) -> str:
        """Say what became of the motion."""
        if self.is_ending and not found.spans:
            return "Stopped before a span of frames was resolved: the motion is as it was"
        if not found.spans and not found.kept:
            return "No frame collides"
        n_left = int((~found.after).sum())
        told = f"{counted(int((~found.before).sum()), 'frame')} collided; "
        told += f"{n_left} still do" if n_left else "all are free now"
        kept = (one.sentence(part_names) for one in found.kept)
        return "; ".join(["Stopped: " * self.is_ending + told, *kept])

    @Slot(int, int)
    def _on_progress(self, done: int, total: int) -> None:
        progress = self.progress
        if progress is not None:
            began = progress.began if progress.total else time.monotonic()
            self.progress = ResolveProgress(began, done, total)
            self.changed.emit()

    @Slot()
    def _on_busy(self) -> None:
        if self.progress is not None and not self.runs:
            self.progress = None
            self.changed.emit()
