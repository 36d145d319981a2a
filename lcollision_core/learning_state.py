"""How far the learning of a model is: what its process says, what windows and commands show."""

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
"""In their order."""


class RunState(StrEnum):
    """What a run is doing, or what has become of it.

    Its process says RUNNING, STOPPED, FAILED or DONE; the others follow from what else there is.
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
    """How far a run is.

    Attributes
    ----------
    state : a `RunState`; a run that is "running" and that no process holds was killed
    stage : a `Stage`
    stage_done : fraction of it, from 0 to 1
    done : fraction of all stages by their estimated time, from 0 to 1
    seconds_left : of all stages, at the pace of this run; None where it does not run
    facts : of the stage, as "error 0.31 %"
    sentence : why it failed or is gone
    seconds : spent in each stage so far, by name
    model : the file that came of it, once it is done
    mostly_collides : whether it failed because nearly all samples collide: it can go on regardless
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
