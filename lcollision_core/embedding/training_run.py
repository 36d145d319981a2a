"""A training run: its progress, and resuming a killed one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy.typing as npt

from lcollision_core.embedding.checkpoint import Checkpoint
from lcollision_core.jobs import CancelToken


@dataclass(frozen=True)
class TrainingStatus:
    """Progress of a training run.

    Attributes
    ----------
    model : "all poses", or "held out" for the second model that measures the error of unseen poses
    stage : "level 1", "level 2" or "codes"
    done, total : epochs and fitted poses of the whole run
    level1_error : mean vertex error with level 1 alone, of a few training poses, in normalised
        lengths
    both_error : mean vertex error with both levels, of the training poses, in normalised lengths;
        None before level 2
    """

    model: str
    stage: str
    done: int
    total: int
    level1_error: float | None
    both_error: float | None


StatusCallback = Callable[[TrainingStatus], None]


class Run:
    """The stages of one training run, each resumed from its checkpoint.

    Parameters
    ----------
    checkpoint : of the run
    progress : called after every step
    cancel : polled after every step; the checkpoint is written before the work stops
    total : steps of all stages

    Attributes
    ----------
    level1_error, both_error : see `TrainingStatus`; set by the stages
    """

    def __init__(
        self, checkpoint: Checkpoint, progress: StatusCallback, cancel: CancelToken, total: int
    ) -> None:
        self._checkpoint, self._progress, self._cancel = checkpoint, progress, cancel
        self._before, self._total = 0, total
        self.level1_error: float | None = None
        self.both_error: float | None = None

    def steps(
        self,
        model: str,
        stage: str,
        n_steps: int,
        load: Callable[[Mapping[str, npt.NDArray[Any]]], None],
        save: Callable[[], dict[str, npt.NDArray[Any]]],
        *,
        part: str = "",
        unit: str = "epochs",
    ) -> Iterator[int]:
        """Yield the numbers of the steps that are left of a stage, and keep its state after each.

        Parameters
        ----------
        model, stage : see `TrainingStatus`
        n_steps : of the stage
        load : takes the arrays that an earlier process saved
        save : returns the stage's state as arrays
        part, unit : what the checkpoint calls the stage, where that is not without its space, and
            its steps

        Raises
        ------
        CancelledError : the cancel token was set; the checkpoint holds the last step.
        """
        name = f"{model}/{part or stage.replace(' ', '')}"
        stored = self._checkpoint.get(name)
        done = 0
        if stored is not None:
            done = int(stored.metadata[unit])
            load(stored.arrays)
        for number in range(done, n_steps):
            yield number
            done = self._before + number + 1
            errors = self.level1_error, self.both_error
            self._progress(TrainingStatus(model, stage, done, self._total, *errors))
            if number + 1 == n_steps or self._cancel.cancelled or self._checkpoint.due:
                self._checkpoint.put(name, save(), {unit: number + 1})
            self._cancel.raise_if_cancelled()
        self._before += n_steps
