"""A training run of an embedding: its configuration, steps and checkpoints."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy.typing as npt

from lcollision_core.errors import LCollisionError
from lcollision_core.jobs import Job
from lcollision_core.model_file import Section, read_model_file, write_model_file
from lcollision_core.options import Limits, require_limits

_SECONDS_BETWEEN_WRITES = 15.0
_RUN = "run"


class Checkpoint:
    """The state of a run, by part, in one file from which a killed run is resumed.

    Parameters
    ----------
    path : the file, which need not exist; None stores nothing
    key : of the run, see `run_key`

    Raises
    ------
    ModelFileError : the file is damaged.
    LCollisionError : the file belongs to another run.
    """

    def __init__(self, path: Path | None, key: str) -> None:
        self._path = path
        self._sections: dict[str, Section] = {_RUN: Section(metadata={"key": key})}
        self._written = time.monotonic()
        if path is not None and path.exists():
            stored = read_model_file(path)
            if _RUN not in stored or stored[_RUN].metadata.get("key") != key:
                raise LCollisionError(
                    "is the checkpoint of another training run (its poses, options or seed differ)",
                    "delete it to begin anew, or name another output",
                    where=path,
                )
            self._sections = stored

    def get(self, part: str) -> Section | None:
        """Return the stored state of a part of the run, None if it has not begun."""
        return self._sections.get(part)

    def put(
        self, part: str, arrays: Mapping[str, npt.NDArray[Any]], metadata: Mapping[str, Any]
    ) -> None:
        """Set the state of a part of the run and write the file atomically."""
        self._sections[part] = Section(arrays, metadata)
        if self._path is not None:
            write_model_file(self._path, self._sections)
        self._written = time.monotonic()

    @property
    def due(self) -> bool:
        """Whether the last write is so long ago that the state should be written again."""
        late = time.monotonic() - self._written > _SECONDS_BETWEEN_WRITES
        return self._path is not None and late


@dataclass(frozen=True)
class TrainingStatus:
    """Progress of a training run.

    Attributes
    ----------
    model : "all poses", or "held out" for the second model that measures the error of unseen poses
    stage : "level 1", "level 2" or "codes"
    done, total : epochs and fitted poses of the whole run
    level1_error : mean vertex error of a few training poses with level 1 alone, in normalised
        lengths
    both_error : mean vertex error of the training poses with both levels, in normalised lengths;
        None before level 2
    """

    model: str
    stage: str
    done: int
    total: int
    level1_error: float | None
    both_error: float | None


class Run:
    """The stages of one training run, each resumed from its checkpoint.

    Parameters
    ----------
    checkpoint : of the run
    job : reports a `TrainingStatus` after every step, and is polled then; the checkpoint is written
        before the work stops
    total : steps of all stages

    Attributes
    ----------
    level1_error, both_error : see `TrainingStatus`; set by the stages
    """

    def __init__(self, checkpoint: Checkpoint, job: Job, total: int) -> None:
        self._checkpoint, self._job = checkpoint, job
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
        """Yield the numbers of a stage's remaining steps, and checkpoint its state between them.

        Parameters
        ----------
        model, stage : see `TrainingStatus`
        n_steps : of the stage
        load : takes the arrays that an earlier process saved
        save : returns the stage's state as arrays
        part, unit : the checkpoint's names of the stage, by default `stage` without its space, and
            of its steps

        Raises
        ------
        CancelledError : the job was cancelled; the checkpoint holds the last step.
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
            self._job.report(TrainingStatus(model, stage, done, self._total, *errors))
            if number + 1 == n_steps or self._job.cancelled or self._checkpoint.due:
                self._checkpoint.put(name, save(), {unit: number + 1})
            self._job.check()
        self._before += n_steps


@dataclass(frozen=True)
class EmbeddingConfig:
    """Options for training a latent space.

    Attributes
    ----------
    n_domains : K = |Z_0|, the number of level 1's codes and of domains
    n_domain_codes : |Z_k|, the number of codes of each domain; fewer if the training poses span
        less
    level1_epochs, level2_epochs : passes over the poses; without any, level 2 consists of the
        principal components of level 1's residual, with a slightly larger error
    level1_rate, level2_rate : Adam's step sizes for the fully connected layers, whose weights
        start at a root mean square of 1; the second falls to 0 along a cosine
    convolution_rate : Adam's step size for the graph convolutions of both levels
    batch_poses : poses per step of level 2
    locality_weight : of the locality loss, divided by the root of V, relative to the squared
        feature error per vertex
    window_overlap : effective domains per vertex of the windows in which level 1's components
        start, at most (K + 1) / 2; the distances of the locality loss follow the windows
    vertex_weight : of the mean squared vertex distance, in squared normalised lengths, relative to
        the squared feature error per vertex, in level 2
    encoded_codes : whether the training poses keep the encoders' codes, as in Tan et al. 2021; if
        not, codes are fitted to the vertices, for a smaller error
    held_out_stride : every n-th pose is left out of a second model that measures the error of
        unseen poses; 0 trains no second model

    Raises
    ------
    LCollisionError : a value is out of range.
    """

    n_domains: Annotated[int, Limits(low=1)] = 10
    n_domain_codes: Annotated[int, Limits(low=1)] = 10
    level1_epochs: Annotated[int, Limits(low=0)] = 60
    level2_epochs: Annotated[int, Limits(low=0)] = 20
    level1_rate: Annotated[float, Limits(low=0)] = 0.1
    level2_rate: Annotated[float, Limits(low=0)] = 0.04
    convolution_rate: Annotated[float, Limits(low=0)] = 1e-3
    batch_poses: Annotated[int, Limits(low=1)] = 16
    locality_weight: Annotated[float, Limits(low=0)] = 0.03
    window_overlap: Annotated[float, Limits(above=1)] = 3.7
    vertex_weight: Annotated[float, Limits(low=0)] = 15.0
    encoded_codes: bool = False
    held_out_stride: Annotated[int, Limits(low=0)] = 10

    def __post_init__(self) -> None:
        require_limits(self)
        if self.held_out_stride == 1:
            raise LCollisionError(
                "held_out_stride 1 leaves no pose to train on", "use 0 or 2 and up"
            )
