"""Progress of learning a model, as its process reports it and windows and commands show it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any


class Stage(StrEnum):
    """One stage of learning a model."""

    POSES = "poses"
    LATENT_SPACE = "latent space"
    LABELS = "labels"
    PREDICTOR = "predictor"


STAGES = tuple(Stage)
"""In the order in which they run."""


class RunState(StrEnum):
    """State of a run.

    Its process reports RUNNING, STOPPED, FAILED or DONE; the others are derived elsewhere.
    """

    WAITING = "waiting"
    RUNNING = "running"
    STOPPING = "stopping"
    STOPPED = "stopped"
    FAILED = "failed"
    KILLED = "killed"
    DONE = "done"


@dataclass(frozen=True)
class LearningStatus:
    """Progress of a run.

    Attributes
    ----------
    state : a `RunState`; a "running" run without a process was killed
    stage : the current `Stage`
    stage_done : completed fraction of the stage, from 0 to 1
    done : completed fraction of all stages by estimated time, from 0 to 1
    seconds_left : until the end of all stages, at the pace of this run; None if it is not running
    facts : results of the stage so far, such as "error 0.31 %"
    sentence : why it failed or was killed
    seconds : time spent in each stage so far, by name
    model : path of the finished model; empty until then
    mostly_collides : whether it failed because nearly all samples collide; it can be continued
        regardless
    """

    state: str
    stage: str = Stage.POSES
    stage_done: float = 0.0
    done: float = 0.0
    seconds_left: float | None = None
    facts: tuple[str, ...] = ()
    sentence: str = ""
    seconds: Mapping[str, Any] = field(default_factory=dict)
    model: str = ""
    mostly_collides: bool = False
