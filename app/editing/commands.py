"""The undo command of the editor: the document's state before and after one action."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtGui import QUndoCommand

if TYPE_CHECKING:
    from app.work.frames import Displacement
    from lcollision_core.bodies import NamedPose, PosableBody
    from lcollision_core.motion import Motion
    from lcollision_core.resolve import ResolveResult

MERGE_SECONDS = 1.0
"""Seconds within which steps on one slider merge into one step of undo."""

_MERGE_ID = 1


class Source(Enum):
    """Where a pose comes from."""

    TRAINING = "training"
    STARTER = "starter"
    LIBRARY = "library"
    FILE = "file"
    MESH = "mesh"


@dataclass(frozen=True, eq=False)
class Origin:
    """The pose that the working pose was before it was changed.

    Attributes
    ----------
    source : where it is
    pose : as it was; for one of the library, the pose of its name there counts
    """

    source: Source
    pose: NamedPose


@dataclass(frozen=True, eq=False)
class Moment:
    """A frame of a motion, which the working pose is.

    Attributes
    ----------
    motion : as it is now
    frame : from 0
    """

    motion: Motion
    frame: int

    @property
    def displacement(self) -> Displacement | None:
        """What the codes do not hold of the frame; None where they hold all of the motion."""
        moved = self.motion.displacement
        return None if moved is None else partial(moved, self.frame)


@dataclass(frozen=True, eq=False)
class DocumentState:
    """All that undo restores, except the library, which changes by `LibraryChange`.

    Attributes
    ----------
    pose : the working pose, its arrays read-only; it has no tags
    origin : what the working pose came from, None for a new one
    ghost : (V, 3) float32 array, read-only: the mesh before the Resolve of `outcome`
    outcome : of the Resolve that ended in this pose
    outcome_seconds : from asking for that Resolve to its result, with all that it waited for
    moment : of the motion that is on the timeline; None without one
    """

    pose: NamedPose
    origin: Origin | None = None
    ghost: npt.NDArray[np.float32] | None = None
    outcome: ResolveResult | None = None
    outcome_seconds: float = 0.0
    moment: Moment | None = None

    @property
    def motion(self) -> Motion | None:
        """The motion that is on the timeline."""
        return None if self.moment is None else self.moment.motion

    def drawn(self, model: PosableBody) -> npt.NDArray[np.float32]:
        """Return the (V, 3) vertices that are drawn of it, in the data's unit: see `ExactCheck`."""
        moved = None if self.moment is None else self.moment.displacement
        check = model.exact_check(self.pose.placement, None if moved is None else moved())
        return check.drawn(check.decode(self.pose.latent)[0])

    def same_as(self, other: DocumentState) -> bool:
        """Whether there is nothing to undo between two states: equal poses, to the bit."""
        return (
            self.pose.name == other.pose.name
            and self.pose.same_as(other.pose)
            and _key(self.origin) == _key(other.origin)
            and self.motion is other.motion
        )


def _key(origin: Origin | None) -> tuple[Source, str] | None:
    return None if origin is None else (origin.source, origin.pose.name)


class ChangeState(QUndoCommand):
    """Goes from one state of the document to another, without computing anything again.

    Parameters
    ----------
    label : the name of the action in the menu
    apply : puts a state into the document; a method of the history, as commands know no widget
    before, after : the two states, which `PoseHistory` may change
    run : steps of one run on one slider merge when they follow fast; None never merges
    """

    def __init__(
        self,
        label: str,
        apply: Callable[[DocumentState], None],
        before: DocumentState,
        after: DocumentState,
        run: int | None = None,
    ) -> None:
        super().__init__(label)
        self._apply = apply
        self.before = before
        self.after = after
        self._run = run
        self._time = time.monotonic()

    def redo(self) -> None:
        """Go to the later state."""
        self._apply(self.after)

    def undo(self) -> None:
        """Go back to the earlier state."""
        self._apply(self.before)

    def id(self) -> int:
        """Tell Qt whether to ask `mergeWith`."""
        return -1 if self._run is None else _MERGE_ID

    def mergeWith(self, other: QUndoCommand) -> bool:  # noqa: N802
        """Take in the next step of the same run; one that ends where it began vanishes."""
        if not isinstance(other, ChangeState) or other._run != self._run:
            return False
        if other._time - self._time > MERGE_SECONDS:
            return False
        self.after, self._time = other.after, other._time
        self.setObsolete(self.before.same_as(self.after))
        return True
