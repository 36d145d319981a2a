"""Options of motions: which ones, and how they are resolved."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from lcollision_core.options.field import Option, require_limits
from lcollision_core.options.resolve import ResolveOptions


@dataclass(frozen=True)
class MotionChoice:
    """Which motions of a file are meant, and which of their poses are looked at.

    Attributes
    ----------
    clip : one of the file's clips; None for all
    fps : frames a second; None for the rate of its keys, else 30
    substeps : >= 0, poses between two frames that count too
    continuous : whether all of the linear path of the vertices between two frames counts

    Raises
    ------
    LCollisionError : a number is out of its range.
    """

    clip: Annotated[
        str | None, Option("Of motions: one of a file's clips. Default: all.", metavar="NAME")
    ] = None
    fps: Annotated[
        float | None,
        Option(
            "Frames a second of a motion. Default: the rate of its keys, else 30.",
            metavar="N",
            low=0.01,
            high=1000.0,
        ),
    ] = None
    substeps: Annotated[
        int,
        Option("For motions: poses to check between two frames.", metavar="N", low=0, high=99),
    ] = 1
    continuous: Annotated[
        bool,
        Option(
            "For motions: prove that nothing touches between frames either, if every vertex moves "
            "in a straight line from frame to frame, as cloth solvers assume. "
            "Needs the extra 'ccd'.",
            ("--continuous",),
        ),
    ] = False

    def __post_init__(self) -> None:
        require_limits(self)


@dataclass(frozen=True)
class MotionOptions:
    """How to resolve a motion; the defaults are what measured best.

    Attributes
    ----------
    easing : >= 0, frames at 30 a second on either side of a collision over which the correction
        fades in and out
    keep_feet : what stands on the ground stays there
    frame : how single frames are resolved: locked domains, weights, what a distance is, and the
        largest change; still domains stay where the motion has them, as feet do
    substeps : >= 0, poses between two frames that are to be free too
    continuous : whether all of the linear path of the vertices between them is to be free
    feet : domains that count as standing in all frames; where empty, those that rest near the
        ground are found

    Raises
    ------
    LCollisionError : a number is out of its range.
    """

    easing: Annotated[
        int,
        Option(
            "Frames, at 30 a second, over which a motion's correction fades in and out.",
            metavar="N",
            low=0,
            high=1000,
        ),
    ] = 12
    keep_feet: Annotated[
        bool,
        Option(
            "Keep standing feet in place: of motions, and of a character's poses.",
            ("--keep-feet/--no-keep-feet",),
        ),
    ] = True
    frame: ResolveOptions = field(default_factory=ResolveOptions)
    substeps: int = 1
    continuous: bool = False
    feet: frozenset[int] = field(default_factory=frozenset)

    def __post_init__(self) -> None:
        require_limits(self)
