"""What a model is to be learned from, and how."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated

from lcollision_core.errors import LCollisionError
from lcollision_core.options.contacts import RuleOptions
from lcollision_core.options.field import Option, require_limits


class Quality(StrEnum):
    """How much time is spent for how good a model."""

    QUICK = "quick"
    GOOD = "good"
    BEST = "best"


@dataclass(frozen=True)
class LearningRequest(RuleOptions):
    """What a model is to be learned from, and how; it is kept with the model.

    Attributes
    ----------
    sources : absolute paths of files of a character, folders of meshes, point caches or pose sets
        of one body
    quality : a `Quality`
    by_rig : poses drawn by the rig; None draws as many as the quality wants beside the clips
    clip, fps : of a character's animations, see `read_pose_set`
    up : 0, 1 or 2 where the files are wrong about the axis or say none; None takes theirs
    scale : brings the poses into the unit that the model is to have
    seed : equal seeds, equal models
    licence : under which the model may be used
    regardless : train a predictor even where nearly all samples collide; two requests that differ
        by this alone are equal
    stamps : of the sources, so that a file that has changed is not taken for the one that was read

    The rules that are None are proposed from the poses; an empty `ignored` proposes no groups.

    Raises
    ------
    LCollisionError : a value is out of its range.
    """

    sources: Annotated[
        tuple[str, ...],
        Option(
            "Files of one character (GLB, glTF, VRM, FBX), folders of meshes, point caches beside "
            "their mesh, .npz files.",
            metavar="FILE...",
        ),
    ]
    quality: Annotated[
        str,
        Option(
            "Time spent against accuracy: quick, 100 poses of a rig and 20 000 samples; good, 150 "
            "and 50 000, with errors of held-out poses; best, 300 and 340 000, with three times "
            "the epochs of level 2.",
            choices=tuple(Quality),
        ),
    ] = Quality.GOOD
    by_rig: Annotated[
        int | None,
        Option(
            "Number of random poses made by the rig. Default: as many as the clips lack.",
            metavar="N",
            low=0,
            high=10_000,
        ),
    ] = None
    clip: Annotated[str | None, Option("The animation to read. Default: all.", metavar="NAME")] = (
        None
    )
    fps: Annotated[
        float | None,
        Option("Frames per second. Default: the animation's keys.", metavar="X", above=0),
    ] = None
    up: Annotated[
        int | None,
        Option("The up axis. Default: what the files say, else a guess.", words=("x", "y", "z")),
    ] = None
    scale: Annotated[
        float, Option("Factor from the files' unit to the model's.", metavar="S", above=0)
    ] = 1.0
    seed: Annotated[int, Option("The same seed gives the same models.", metavar="S", low=0)] = 0
    licence: Annotated[str, Option("Licence of the model.")] = "unknown"
    regardless: Annotated[
        bool,
        Option(
            "Train the predictor even where nearly all samples collide.",
            ("--regardless",),
        ),
    ] = field(default=False, compare=False)
    stamps: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.sources:
            raise LCollisionError("no files are given to learn from", "name at least one")
        require_limits(self)
