"""The progress of a run of learning, from that of its stages."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

from lcollision_core.learning_state import STAGES, LearningStatus, RunState, Stage

_TRUSTED_SECONDS = 30.0
"""Of estimated work, as much as which the estimate counts beside the pace of the run."""

_TELLING = 0.05
"""Fraction of a stage from which its own pace is known."""

_FIRST = 2
"""Reports of a stage that tell where it begins, not how fast it is."""


class Pace:
    """Turns the progress of single stages into that of the run, and measures its pace.

    Parameters
    ----------
    report : called with each status
    expected : estimated seconds of each stage
    """

    def __init__(
        self, report: Callable[[LearningStatus], None], expected: Mapping[Stage, float]
    ) -> None:
        self._report, self._expected = report, expected
        self._began = time.monotonic()
        self._stage, self._n_told = Stage.POSES, 0
        self._behind = self._skipped = self._shown = 0.0
        self._entered, self._entered_at = self._began, 0.0

    def expect(self, seconds: Mapping[Stage, float]) -> None:
        """Take better estimates once the poses are known; the pace begins anew."""
        self._expected = seconds
        self._began = time.monotonic()
        self._behind = self._skipped = self._seconds_behind(self._stage, 1.0)

    def tell(self, stage: Stage, stage_done: float, facts: Sequence[str] = ()) -> None:
        """Report a fraction of a stage.

        What is done at once when a stage begins was done by an earlier process.
        """
        if stage is not self._stage:
            self._stage, self._n_told = stage, 0
        behind, total = self._seconds_behind(stage, stage_done), sum(self._expected.values())
        now = time.monotonic()
        if self._n_told < _FIRST:
            self._skipped += behind - self._behind
            self._entered, self._entered_at = now, stage_done
        self._n_told += 1
        self._behind = behind
        seconds, worked = now - self._began, behind - self._skipped
        pace = (_TRUSTED_SECONDS + seconds) / (_TRUSTED_SECONDS + max(worked, 0.0))
        done_here = stage_done - self._entered_at
        if done_here > _TELLING:
            # How fast the stage is says more of it than how fast those before were.
            here = (now - self._entered) * (1.0 - stage_done) / done_here
        else:
            here = (1.0 - stage_done) * self._expected[stage] * pace
        left = here + (total - self._seconds_behind(stage, 1.0)) * pace
        # Better estimates never take back what was shown.
        self._shown = max(self._shown, behind / total)
        status = LearningStatus(
            RunState.RUNNING, stage, stage_done, self._shown, left, tuple(facts)
        )
        self._report(status)

    def _seconds_behind(self, stage: Stage, stage_done: float) -> float:
        """Return the estimated seconds of what is done."""
        before = sum(self._expected[one] for one in STAGES[: STAGES.index(stage)])
        return before + stage_done * self._expected[stage]
