"""The undo command of the editor: the document's state before and after one act."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtGui import QUndoCommand

if TYPE_CHECKING:
    from lcollision_core.meshes import RigidTransform
    from lcollision_core.model import MirrorSource, NamedPose
    from lcollision_core.resolve import ResolveResult

MERGE_SECONDS = 1.0
"""Steps on one slider that follow each other this fast are one step of undo."""

_MERGE_ID = 1


@dataclass(frozen=True, eq=False)
class DocumentState:
    """All that undo brings back.

    Attributes
    ----------
    latent : (D,) float64 array, read-only
    pose_name : under which Save stores the pose
    placement : where the decoded pose belongs, for one that came in as a mesh
    poses : the user's library
    ghost : (V, 3) float32 array, read-only: the mesh before the Resolve of `outcome`
    outcome : of the Resolve that ended in this pose
    mirror_of : what the pose was mirrored from; once it is changed, of no meaning
    outcome_seconds : from asking for that Resolve to its result, with all that it waited for
    """

    latent: npt.NDArray[np.float64]
    pose_name: str
    placement: RigidTransform | None = None
    poses: tuple[NamedPose, ...] = ()
    ghost: npt.NDArray[np.float32] | None = None
    outcome: ResolveResult | None = None
    mirror_of: MirrorSource | None = None
    outcome_seconds: float = 0.0

    def same_as(self, other: DocumentState) -> bool:
        """Whether there is nothing to undo between two states: equal poses, to the bit."""
        return (
            self.latent.tobytes() == other.latent.tobytes()
            and self.pose_name == other.pose_name
            and self.placement is other.placement
            and self.poses is other.poses
        )


class ChangeState(QUndoCommand):
    """Goes from one state of the document to another, without computing anything again.

    Parameters
    ----------
    label : what the menu calls the act
    apply : puts a state into the document; a method of the document, as commands know no widget
    before, after : the two states, which `PoseHistory` may amend
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
