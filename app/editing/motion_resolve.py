"""The Resolve of a motion: its progress, how it is stopped, and what it says in the end."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Signal, Slot

from app.editing.tasks import Work
from lcollision_core.jobs import Job
from lcollision_core.tasks.editing import resolve_frames
from lcollision_core.tasks.words import counted, ground_text, joined, say, say_number

if TYPE_CHECKING:
    from app.editing.tasks import Tasks
    from lcollision_core.bodies import Body
    from lcollision_core.motion import Motion, ResolvedMotion
    from lcollision_core.options import MotionOptions


@dataclass(frozen=True)
class ResolveProgress:
    """The progress of a Resolve of a motion.

    Attributes
    ----------
    began : when the colliding frames became known, before that its start; `time.monotonic`
    done, total : frames of colliding spans; 0 of 0 until these are known
    """

    began: float
    done: int = 0
    total: int = 0

    @property
    def seconds(self) -> float:
        """Seconds since `began`."""
        return time.monotonic() - self.began

    @property
    def seconds_left(self) -> float | None:
        """Estimated time for the rest; None until a frame is done."""
        return self.seconds / self.done * (self.total - self.done) if self.done else None


class MotionResolve(QObject):
    """Resolves a motion in the long worker.

    Parameters
    ----------
    parent : the Qt parent
    tasks : run it

    Attributes
    ----------
    progress : None unless a Resolve runs

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
        self._stop = Job()
        tasks.progressed.connect(self._on_progress)
        tasks.busy_changed.connect(self._on_busy)

    @property
    def spans(self) -> tuple[range, ...]:
        """The spans of frames that the running Resolve has freed so far."""
        from lcollision_core.motion.motion import runs

        return tuple(runs(self._solved)) if self._tasks.solving_motion else ()

    def start(
        self,
        model: Body,
        motion: Motion,
        options: MotionOptions,
        within: range | None,
        done: Callable[[ResolvedMotion], None],
    ) -> None:
        """Start a Resolve; the parameters are those of `resolve_frames` and `LongWork.start`."""
        self._solved = np.zeros(len(motion), dtype=np.bool_)
        self._stop = Job()
        job = partial(resolve_frames, model, motion, options, within, self._solved, self._stop)
        self._tasks.start(Work.RESOLVE_MOTION, f"Resolving {motion.name}", job, done)
        self.progress = ResolveProgress(time.monotonic())
        self.changed.emit()

    @Slot()
    def cancel(self) -> None:
        """Cancel the Resolve; the motion stays as it was."""
        self.end("Resolve was cancelled: the motion is as it was")

    def end(self, why: str) -> None:
        """Cancel the Resolve, with `why` as the message."""
        if self._tasks.solving_motion:
            self._tasks.cancel(Work.RESOLVE_MOTION)
            self._tasks.message.emit(why)

    @Slot()
    def keep_done(self) -> None:
        """Stop soon, and keep the spans that are resolved by then."""
        self._stop.cancel()
        self.changed.emit()

    @property
    def is_ending(self) -> bool:
        """Whether the Resolve was asked to stop: see `keep_done`."""
        return self._stop.cancelled

    def summary(self, resolved: ResolvedMotion, part_names: Sequence[str]) -> str:
        """Summarise a result in one sentence."""
        if self.is_ending and not resolved.spans:
            return "Stopped before a span of frames was resolved: the motion is as it was"
        if not resolved.spans and not resolved.kept:
            return "No frame collides"
        n_left = int((~resolved.after).sum())
        before = counted(int((~resolved.before).sum()), "frame", "frames")
        text = say("{frames} collided", frames=before)
        if self.is_ending:
            text = say("Stopped: {frames} collided", frames=before)
        now = say_number(n_left, "{n} still does", "{n} still do") if n_left else "all are free now"
        kept_sentences = (span.sentence(part_names) for span in resolved.kept)
        ground = ground_text(None if resolved.ground is None else asdict(resolved.ground))
        return joined((text, now, *kept_sentences, ground))

    @Slot(object, int, int)
    def _on_progress(self, work: object, done: int, total: int) -> None:
        progress = self.progress
        if work is Work.RESOLVE_MOTION and progress is not None:
            began = progress.began if progress.total else time.monotonic()
            self.progress = ResolveProgress(began, done, total)
            self.changed.emit()

    @Slot()
    def _on_busy(self) -> None:
        if self.progress is not None and not self._tasks.solving_motion:
            self.progress = None
            self.changed.emit()
