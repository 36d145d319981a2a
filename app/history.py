"""The state of a document and its undo: gestures, merged steps, the modified mark."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Signal, Slot
from PySide6.QtGui import QUndoStack

from app.commands import ChangeState, DocumentState
from lcollision_core.errors import ModelFileError

if TYPE_CHECKING:
    from lcollision_core.meshes import RigidTransform
    from lcollision_core.model import NamedPose
    from lcollision_core.resolve import ResolveResult

FloatArray = npt.NDArray[np.float64]

UNNAMED = "pose"
"""What a pose without a name is called."""

UNDO_STEPS = 1000
"""Kept at most: a step is a few kilobytes, so that memory stays small however long one edits."""


class PoseHistory(QObject):
    """One pose and the user's library, and how both came to be.

    Every change is one step of `undo_stack`. Between `begin_gesture` and `end_gesture` changes
    show at once but make one step together, and none where they end as they began.
    `PoseDocument`, which is what the window holds, tells what the signals mean.
    """

    latent_changed = Signal()
    ghost_changed = Signal()
    outcome_changed = Signal()
    modified_changed = Signal(bool)
    file_changed = Signal()
    library_changed = Signal()
    pose_loaded = Signal()

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._state = DocumentState(read_only(np.zeros(0)), UNNAMED)
        self._gesture: tuple[str, DocumentState] | None = None
        self._file: Path | None = None
        self._ghost_shown = True
        self._told_modified = False
        self.undo_stack = QUndoStack(self)
        self.undo_stack.setUndoLimit(UNDO_STEPS)
        self.undo_stack.cleanChanged.connect(self._on_clean_changed)

    @property
    def latent(self) -> FloatArray:
        """(D,) float64 array, read-only."""
        return self._state.latent

    @property
    def pose_name(self) -> str:
        """The name under which Save stores the pose."""
        return self._state.pose_name

    @property
    def placement(self) -> RigidTransform | None:
        """Where the decoded pose belongs, for one that came in as a mesh."""
        return self._state.placement

    @property
    def poses(self) -> tuple[NamedPose, ...]:
        """The user's library, which Save stores beside the pose."""
        return self._state.poses

    @property
    def file(self) -> Path | None:
        """The poses file that Save writes; None asks for one."""
        return self._file

    @property
    def modified(self) -> bool:
        """Whether there is something to save."""
        return not self.undo_stack.isClean() or self._changed_in_gesture()

    @property
    def ghost(self) -> npt.NDArray[np.float32] | None:
        """(V, 3) float32 array, read-only: the mesh before the Resolve of `outcome`, if shown."""
        return self._state.ghost if self._ghost_shown else None

    @property
    def vertices_before(self) -> npt.NDArray[np.float32] | None:
        """(V, 3) float32 array, read-only: the mesh before the Resolve of `outcome`."""
        return self._state.ghost

    @property
    def ghost_shown(self) -> bool:
        """Whether a ghost is drawn where there is one."""
        return self._ghost_shown

    @property
    def outcome(self) -> ResolveResult | None:
        """What the Resolve that ended in this pose reported."""
        return self._state.outcome

    @property
    def outcome_seconds(self) -> float:
        """From asking for the Resolve of `outcome` to its result, with all that it waited for."""
        return self._state.outcome_seconds

    def show_ghost(self, shown: bool) -> None:
        """Draw or hide the mesh before Resolve."""
        if shown != self._ghost_shown:
            self._ghost_shown = shown
            self.ghost_changed.emit()

    def begin_gesture(self, label: str) -> None:
        """Start a drag: what follows until `end_gesture` is one step of undo."""
        self.end_gesture()
        self._gesture = (label, self._state)

    def end_gesture(self) -> None:
        """End a drag; does nothing where none has begun."""
        if self._gesture is None:
            return
        label, before = self._gesture
        self._gesture = None
        if not before.same_as(self._state):
            self.undo_stack.push(ChangeState(label, self._apply, before, self._state))
        self._tell_modified()

    def cancel_gesture(self) -> None:
        """End a drag and go back to where it began, as for Escape."""
        if self._gesture is not None:
            _, before = self._gesture
            self._gesture = None
            self._apply(before)

    def set_latent(self, latent: npt.ArrayLike, label: str) -> None:
        """Set the whole pose, a (D,) finite array, in one step with this name in the menu."""
        self._edit(label, np.array(latent, dtype=np.float64))

    def blend_towards(self, latent: npt.ArrayLike, share: float) -> None:
        """Blend from the pose at the gesture's begin, share 0, to a (D,) other one, share 1.

        Locked domains stay as they are.
        """
        start = self._gesture[1].latent if self._gesture else self.latent
        target = np.asarray(latent, dtype=np.float64)
        blended = target.copy() if share == 1.0 else start + share * (target - start)
        self._edit("Blend", self._with_locked(blended))

    def undo(self) -> None:
        """Take back the last step; a drag that has not ended is that step."""
        self.end_gesture()
        self.undo_stack.undo()

    def redo(self) -> None:
        """Do again the step that was taken back last."""
        self.end_gesture()
        self.undo_stack.redo()

    def load_pose(self, pose: NamedPose) -> None:
        """Edit a pose of the library under its name, or a training pose under a free one."""
        self._load(f"Load {pose.name}", pose)

    def add_pose_to_library(self, name: str) -> None:
        """Keep the pose in the library; a taken name gets a number.

        Parameters
        ----------
        name : of the pose, which is called so from then on
        """
        from lcollision_core.model import NamedPose

        free = self._free_name(name or UNNAMED)
        added = NamedPose(free, self.latent, self.placement)
        state = replace(self._state, pose_name=free, poses=(*self.poses, added))
        self._push(f"Keep {free}", state)

    def remove_pose_from_library(self, name: str) -> None:
        """Drop a pose of the library.

        Raises
        ------
        ModelFileError : there is no such pose.
        """
        self._require_kept(name)
        kept = tuple(pose for pose in self.poses if pose.name != name)
        self._push(f"Remove {name}", replace(self._state, poses=kept))

    def rename_pose(self, old: str, new: str) -> None:
        """Rename a pose of the library, and the edited pose where it is that one.

        Raises
        ------
        ModelFileError : there is no such pose, or the new name is empty or another pose's.
        """
        self._require_kept(old)
        if not new or any(pose.name == new != old for pose in self.poses):
            raise ModelFileError(f"a pose cannot be called {new!r}; choose another name")
        poses = tuple(replace(p, name=new) if p.name == old else p for p in self.poses)
        name = new if self.pose_name == old else self.pose_name
        self._push(f"Rename {old}", replace(self._state, poses=poses, pose_name=name))

    def all_poses(self) -> tuple[NamedPose, ...]:
        """Return what Save writes: the library, with the edited pose in its place or at the end."""
        from lcollision_core.model import NamedPose

        edited = NamedPose(self.pose_name, self.latent, self.placement)
        if all(pose.name != edited.name for pose in self.poses):
            return (*self.poses, edited)
        return tuple(edited if pose.name == edited.name else pose for pose in self.poses)

    def _require_kept(self, name: str) -> None:
        if all(pose.name != name for pose in self.poses):
            raise ModelFileError(f"your library has no pose {name!r}; choose one of your own")

    def _free_name(self, name: str) -> str:
        """Return a name that no pose of the library has: this one, or with a number."""
        from lcollision_core.model import unique_names

        return unique_names([*(pose.name for pose in self.poses), name])[-1]

    def _load(self, label: str, pose: NamedPose) -> None:
        # Under the name of another pose of the library, Save would put it in that one's place.
        is_own = any(pose is own for own in self.poses)
        name = pose.name if is_own else self._free_name(pose.name)
        latent = read_only(np.array(pose.latent, dtype=np.float64))
        self._push(label, DocumentState(latent, name, pose.placement, self.poses))
        self.pose_loaded.emit()

    def _edit(self, label: str, latent: FloatArray, run: int | None = None) -> None:
        state = replace(self._state, latent=read_only(latent), ghost=None, outcome=None)
        self._push(label, state, run)

    def _push(self, label: str, state: DocumentState, run: int | None = None) -> None:
        """Go to another state, as a step of its own or as part of the gesture."""
        if self._gesture is not None:
            self._apply(state)
        elif not state.same_as(self._state):
            self.undo_stack.push(ChangeState(label, self._apply, self._state, state, run))

    def _amend(self, state: DocumentState) -> None:
        """Put in a state that the undo steps on both sides of it lead to, in the place of this."""
        place = self.undo_stack.index()
        earlier = self.undo_stack.command(place - 1)
        later = self.undo_stack.command(place)
        if isinstance(earlier, ChangeState):
            earlier.after = state
        if isinstance(later, ChangeState):
            later.before = state
        self._apply(state)

    def _keep_saved(self, poses: tuple[NamedPose, ...], file: Path) -> None:
        """Remember what a file holds now as the library, whichever way undo comes back to it."""
        self._file = file
        self._amend(replace(self._state, poses=poses))
        self.undo_stack.setClean()
        self.file_changed.emit()

    def _begin_with(
        self, edited: NamedPose, poses: tuple[NamedPose, ...], file: Path | None
    ) -> None:
        """Put in a pose of a library, without a past."""
        latent = read_only(edited.latent)
        self._begin(DocumentState(latent, edited.name, edited.placement, poses), file)

    def _begin(self, state: DocumentState, file: Path | None) -> None:
        """Put in a state without a past."""
        self._gesture = None
        self._file = file
        self._apply(state)
        self.undo_stack.clear()
        self.file_changed.emit()
        self.pose_loaded.emit()

    def _apply(self, state: DocumentState) -> None:
        """Put in a state and tell what has changed: the one place where the pose changes."""
        before, self._state = self._state, state
        if state.latent is not before.latent:
            self._follow_latent()
            self.latent_changed.emit()
        if state.ghost is not before.ghost:
            self.ghost_changed.emit()
        if state.outcome is not before.outcome:
            self.outcome_changed.emit()
        if state.poses is not before.poses:
            self.library_changed.emit()
        if state.pose_name != before.pose_name:
            self.file_changed.emit()
        self._tell_modified()

    def _follow_latent(self) -> None:
        """Tell the workers, before the widgets, that the pose is another."""

    def _with_locked(self, latent: FloatArray) -> FloatArray:
        """Return the latent with the present codes of locked domains."""
        return latent

    def _tell_modified(self) -> None:
        if self.modified != self._told_modified:
            self._told_modified = self.modified
            self.modified_changed.emit(self._told_modified)

    @Slot(bool)
    def _on_clean_changed(self, _: bool) -> None:
        self._tell_modified()

    def _changed_in_gesture(self) -> bool:
        return self._gesture is not None and not self._gesture[1].same_as(self._state)


def read_only(array: FloatArray) -> FloatArray:
    """Return the array itself, from now on read-only, as other threads read it."""
    array.flags.writeable = False
    return array
