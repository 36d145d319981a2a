"""The state of a document and its undo: gestures, merged steps, the library, the modified mark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Signal
from PySide6.QtGui import QUndoStack

from app.editing.commands import ChangeState, DocumentState, Origin, Source
from app.wording import counted
from lcollision_core.errors import ModelFileError

if TYPE_CHECKING:
    from lcollision_core.meshes import RigidTransform
    from lcollision_core.model import LibraryChange, NamedPose, PoseLibrary
    from lcollision_core.resolve import ResolveResult

FloatArray = npt.NDArray[np.float64]

UNNAMED = "pose"
"""Name of a pose without a name."""

UNDO_STEPS = 1000
"""Most steps kept: a few kilobytes each, and two meshes for a Resolve."""


@dataclass(frozen=True, eq=False)
class Gesture:
    """A drag that has begun.

    Attributes
    ----------
    label : of its step of undo
    before : the state that it began with
    run : see `ChangeState`
    """

    label: str
    before: DocumentState
    run: int | None = None


class PoseHistory(QObject):
    """The working pose and the user's library, and their history.

    Every change of either is one step of `undo_stack`. Between `begin_gesture` and `end_gesture`
    changes of the pose show at once but make one step together, and none where they end as they
    began. The library is a file of its own, written at every change; the poses of the file that
    was opened are a third thing, which nothing here changes. `PoseDocument`, which is what the
    window holds, documents the signals.

    Attributes
    ----------
    undo_stack : of all steps
    file : the poses file that Save writes; None asks for one
    file_poses : the poses of the file that was opened, which Save writes as they are
    ghost_shown : whether a ghost is drawn where there is one; see `show_ghost`
    """

    latent_changed = Signal()
    ghost_changed = Signal()
    outcome_changed = Signal()
    modified_changed = Signal(bool)
    file_changed = Signal()
    library_changed = Signal()
    pose_loaded = Signal()
    pins_changed = Signal()

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._held: DocumentState | None = None
        self._library: PoseLibrary | None = None
        self._gesture: Gesture | None = None
        self.file: Path | None = None
        self.file_poses: tuple[NamedPose, ...] = ()
        self._saved: NamedPose | None = None
        self.ghost_shown = True
        self._told_modified = self._told_changed = False
        self.undo_stack = QUndoStack(self)
        self.undo_stack.setUndoLimit(UNDO_STEPS)

    @property
    def pose(self) -> NamedPose:
        """The working pose, its arrays read-only."""
        return self._state.pose

    @property
    def latent(self) -> FloatArray:
        """(D,) float64 array, read-only."""
        return self.pose.latent

    @property
    def pose_name(self) -> str:
        """The name under which Save stores the pose."""
        return self.pose.name

    @property
    def placement(self) -> RigidTransform | None:
        """Where the decoded pose belongs, for one that came in as a mesh."""
        return self.pose.placement

    @property
    def poses(self) -> tuple[NamedPose, ...]:
        """The user's library of this model."""
        return () if self._library is None else self._library.poses

    @property
    def library_is_written(self) -> bool:
        """Whether the library's file has all of it."""
        return self._library is None or self._library.is_written

    @property
    def library_pose(self) -> NamedPose | None:
        """The pose of the library that the working pose came from, as it is there now."""
        origin = self._state.origin
        if origin is None or origin.source is not Source.LIBRARY or self._library is None:
            return None
        return self._library.find(origin.pose.name)

    @property
    def changed(self) -> bool:
        """Whether the working pose differs from the one that it came from."""
        source = self._source_pose()
        return source is not None and not source.same_as(self.pose)

    @property
    def can_update(self) -> bool:
        """Whether `update_library_pose` has something to do."""
        return self.library_pose is not None and self.changed

    @property
    def modified(self) -> bool:
        """Whether there is something to save.

        A pose that was not touched since it was loaded is where it came from, and needs no file.
        """
        if self._saved is not None and self._saved.same_as(self.pose):
            return False
        origin = self._state.origin
        if self.file is not None or self._saved is None or origin is None:
            return True
        if origin.source is Source.LIBRARY and not self.library_is_written:
            return True
        is_elsewhere = origin.source is not Source.MESH and self._source_pose() is not None
        return self.changed or not is_elsewhere

    @property
    def ghost(self) -> npt.NDArray[np.float32] | None:
        """(V, 3) float32 array, read-only: the mesh before the Resolve of `outcome`, if shown."""
        return self._state.ghost if self.ghost_shown else None

    @property
    def vertices_before(self) -> npt.NDArray[np.float32] | None:
        """(V, 3) float32 array, read-only: the mesh before the Resolve of `outcome`."""
        return self._state.ghost

    @property
    def outcome(self) -> ResolveResult | None:
        """Result of the Resolve that ended in this pose."""
        return self._state.outcome

    @property
    def outcome_seconds(self) -> float:
        """From asking for the Resolve of `outcome` to its result, with all that it waited for."""
        return self._state.outcome_seconds

    def show_ghost(self, shown: bool) -> None:
        """Draw or hide the mesh before Resolve."""
        if shown != self.ghost_shown:
            self.ghost_shown = shown
            self.ghost_changed.emit()

    def begin_gesture(self, label: str) -> None:
        """Start a drag: what follows until `end_gesture` is one step of undo."""
        self._close_gesture()
        self._gesture = Gesture(label, self._state)

    def end_gesture(self) -> None:
        """End a drag; does nothing if none has begun."""
        self._close_gesture()

    def _close_gesture(self) -> None:
        """Make one step of what the gesture has done so far, as before another action."""
        gesture, self._gesture = self._gesture, None
        if gesture is None:
            return
        before, after = gesture.before, self._state
        if not before.same_as(after):
            step = ChangeState(gesture.label, self._apply, before, after, gesture.run)
            self.undo_stack.push(step)
        self._tell_modified()

    def cancel_gesture(self) -> None:
        """Cancel a drag and restore its start, as for Escape."""
        gesture, self._gesture = self._gesture, None
        if gesture is not None:
            self._apply(gesture.before)

    def undo(self) -> None:
        """Undo the last step; a drag that has not ended is that step."""
        self._close_gesture()
        self.undo_stack.undo()

    def redo(self) -> None:
        """Redo the last undone step."""
        self._close_gesture()
        self.undo_stack.redo()

    def load_pose(self, pose: NamedPose) -> None:
        """Edit a pose of the library, of the file or of the training set, under its name."""
        source = Source.TRAINING
        for held, poses in ((Source.LIBRARY, self.poses), (Source.FILE, self.file_poses)):
            if any(pose is own for own in poses):
                source = held
        self._load(f"Load {pose.name}", pose, source)

    def add_pose_to_library(self, name: str) -> None:
        """Keep the working pose in the library; a taken name gets a number.

        Parameters
        ----------
        name : of the pose, which is called so from then on
        """
        added = replace(self.pose, name=self.free_name(name or UNNAMED))
        self._step(f"Add {added.name}", [(None, added)], self._as_in_library(added))

    def replace_pose_of_library(self, name: str) -> None:
        """Put the working pose in the place of one of the library, under its name and tags.

        Raises
        ------
        ModelFileError : there is no such pose.
        """
        old = self._required(name)
        new = replace(self.pose, name=name, tags=old.tags)
        self._step(f"Replace {name}", [(old, new)], self._as_in_library(new))

    def update_library_pose(self) -> None:
        """Update the pose of the library that the working pose came from.

        Raises
        ------
        ModelFileError : it came from none, or that is no longer there.
        """
        old = self.library_pose
        if old is None:
            raise ModelFileError(
                "this pose is not in your library", "add it with Library > Add to library"
            )
        if self.changed:
            new = replace(self.pose, name=old.name, tags=old.tags)
            self._step(f"Update {old.name}", [(old, new)], self._as_in_library(new))

    def add_to_library(self, poses: Sequence[NamedPose]) -> int:
        """Add poses from elsewhere to the library; those whose names are taken get numbers.

        Poses that are there already, under the same name and to the bit, are left out.

        Returns
        -------
        added : how many were not there
        """
        known = {pose.name: pose for pose in self.poses}
        added = [p for p in poses if p.name not in known or not known[p.name].same_as(p)]
        names = self._free_names([pose.name for pose in added])
        what = added[0].name if len(added) == 1 else counted(len(added), "pose")
        new = [replace(p, name=name, moves=None) for p, name in zip(added, names, strict=True)]
        self._step(f"Add {what}", [(None, pose) for pose in new])
        return len(new)

    def duplicate_poses(self, poses: Sequence[NamedPose]) -> None:
        """Add a copy of each of some poses of the library."""
        names = self._free_names([pose.name for pose in poses])
        copies = [replace(p, name=name) for p, name in zip(poses, names, strict=True)]
        self._step(f"Duplicate {_called(poses)}", [(None, copy) for copy in copies])

    def remove_poses_from_library(self, names: Sequence[str]) -> None:
        """Drop poses of the library.

        Raises
        ------
        ModelFileError : there is no such pose.
        """
        poses = [self._required(name) for name in names]
        self._step(f"Remove {_called(poses)}", [(pose, None) for pose in poses])

    def tag_poses(
        self, names: Sequence[str], tags: Sequence[str], replaced: Sequence[str] = ()
    ) -> None:
        """Put tags in the place of others in poses of the library; each keeps the rest of its own.

        Raises
        ------
        ModelFileError : there is no such pose.
        """
        poses = [self._required(name) for name in names]
        tagged = [replace(pose, tags=retagged(pose, tags, replaced)) for pose in poses]
        pairs = zip(poses, tagged, strict=True)
        self._step(f"Tag {_called(poses)}", [(p, new) for p, new in pairs if p.tags != new.tags])

    def rename_pose(self, old: str, new: str) -> None:
        """Rename a pose of the library, and the working pose where it came from that one.

        Raises
        ------
        ModelFileError : there is no such pose, or the new name is refused.
        """
        pose = self._required(old)
        if (refusal := self.why_not_called(new, old)) is not None:
            raise refusal
        if new == old:
            return
        renamed = replace(pose, name=new)
        state = self._state
        if state.origin is not None and self.library_pose is pose:
            name = new if state.pose.name == old else state.pose.name
            origin = replace(state.origin, pose=renamed)
            state = replace(state, pose=replace(state.pose, name=name), origin=origin)
        self._step(f"Rename {old}", [(pose, renamed)], state)

    def why_not_called(self, name: str, old: str = "") -> ModelFileError | None:
        """Say why no pose of the library can get a name, or return None if one can.

        Parameters
        ----------
        old : the present name of the pose, "" for a new one
        """
        from lcollision_core.model import MAX_POSE_NAME_LENGTH, why_no_name

        if not name:
            return ModelFileError("a pose needs a name", "type one")
        if why_no_name(name):
            what = f"a name has at most {MAX_POSE_NAME_LENGTH} characters"
            return ModelFileError(what, "choose a shorter one")
        taken = self.name_taken_by(name)
        if taken and taken != old:
            what = f"your library already has a pose “{taken}”"
            return ModelFileError(what, "choose another name")
        return None

    def name_taken_by(self, name: str) -> str:
        """Return the name in the library that differs from this one by case at most, or ""."""
        names = (pose.name for pose in self.poses)
        return next((other for other in names if other.casefold() == name.casefold()), "")

    def free_name(self, name: str) -> str:
        """Return a name that no pose of the library has: this one, or with a number."""
        return self._free_names([name])[0]

    def refresh_library(self) -> None:
        """Load what another program has changed in the library's file."""
        if self._library is not None and self._library.refresh():
            self.library_changed.emit()
            self._tell_modified()

    def retry_library(self) -> None:
        """Write what could not be written before, as when the disk was full."""
        if self._library is not None and not self._library.is_written:
            self._library.change(())
            self._tell_modified()

    def discard_library_changes(self) -> None:
        """Give up what could not be written."""
        if self._library is not None:
            self._library.discard_unwritten()
            self.library_changed.emit()
            self._tell_modified()

    def mark_saved(self) -> None:
        """Count the pose as saved, as when the user discards the changes."""
        self._saved = self.pose
        self._tell_modified()

    @property
    def _state(self) -> DocumentState:
        if self._held is None:
            raise ModelFileError("no model is open yet", "open one first")
        return self._held

    def _source_pose(self) -> NamedPose | None:
        """Return what the working pose came from, as it is there now; None if it is gone."""
        origin = self._state.origin
        if origin is None or origin.source is Source.LIBRARY:
            return self.library_pose
        return origin.pose

    def _required(self, name: str) -> NamedPose:
        pose = None if self._library is None else self._library.find(name)
        if pose is None:
            raise ModelFileError(f"your library has no pose {name!r}", "choose one of your own")
        return pose

    def _free_names(self, names: Sequence[str]) -> list[str]:
        """Return names that no pose of the library has: these, or with a number."""
        from lcollision_core.model import unique_names

        return unique_names([*(pose.name for pose in self.poses), *names])[len(self.poses) :]

    def _as_in_library(self, pose: NamedPose) -> DocumentState:
        """Return the state whose pose came from one of the library that is equal to it."""
        working = replace(self.pose, name=pose.name)
        return replace(self._state, pose=working, origin=Origin(Source.LIBRARY, pose))

    def _step(
        self,
        label: str,
        changes: Sequence[tuple[NamedPose | None, NamedPose | None]],
        state: DocumentState | None = None,
    ) -> None:
        """Change the library, and perhaps the state, by one step.

        Parameters
        ----------
        changes : pairs of a pose of the library and what comes in its place; None if one is
            added at the end, or removed
        """
        from lcollision_core.model import LibraryChange

        self._close_gesture()
        if not changes:
            return
        held = list(self.poses)
        made = []
        for old, new in changes:
            index = next((at for at, pose in enumerate(held) if pose is old), len(held))
            made.append(LibraryChange(old, new, index))
            held[index : index + 1] = [] if new is None else [new]
        before = self._state
        self.undo_stack.push(ChangeState(label, self._apply, before, state or before, changes=made))

    def _load(self, label: str, pose: NamedPose, source: Source) -> None:
        self._close_gesture()
        self._push(label, DocumentState(_working(pose), Origin(source, pose)))
        self.pose_loaded.emit()

    def _edit(self, label: str, latent: FloatArray, run: int | None = None) -> None:
        self._push(label, self._with_latent(read_only(latent)), run)

    def _with_latent(self, latent: FloatArray) -> DocumentState:
        # The fit error of a mesh does not apply to another pose.
        pose = replace(self.pose, latent=latent, fit_error_mean=None, fit_error_max=None)
        return replace(self._state, pose=pose, ghost=None, outcome=None)

    def _push(self, label: str, state: DocumentState, run: int | None = None) -> None:
        """Go to another state, as a step of its own or as part of the gesture."""
        if self._gesture is not None:
            self._apply(state)
        elif not state.same_as(self._state):
            self.undo_stack.push(ChangeState(label, self._apply, self._state, state, run))

    def _amend(self, state: DocumentState) -> None:
        """Replace the current state, also in the undo steps on both sides of it."""
        index = self.undo_stack.index()
        earlier = self.undo_stack.command(index - 1)
        later = self.undo_stack.command(index)
        if isinstance(earlier, ChangeState):
            earlier.after = state
        if isinstance(later, ChangeState):
            later.before = state
        self._apply(state)

    def _keep_saved(self, pose: NamedPose, file: Path) -> None:
        """Record what a file holds now, in every state that undo can restore."""
        self.file, self._saved = file, pose
        origin = self._state.origin
        if origin is None or origin.source is not Source.LIBRARY:
            origin = Origin(Source.FILE, pose)
        self._amend(replace(self._state, pose=pose, origin=origin))
        self.file_changed.emit()

    def begin_with(
        self,
        pose: NamedPose,
        source: Source = Source.TRAINING,
        file: Path | None = None,
        file_poses: tuple[NamedPose, ...] = (),
    ) -> None:
        """Set a pose without history, which counts as saved.

        Parameters
        ----------
        source : where the pose is
        file, file_poses : that Save writes to, and the poses that it has beside this one
        """
        self._begin(DocumentState(_working(pose), Origin(source, pose)), file, file_poses)

    def _begin(
        self, state: DocumentState, file: Path | None, file_poses: tuple[NamedPose, ...] = ()
    ) -> None:
        """Set a state without history."""
        self._gesture = None
        self.file, self.file_poses, self._saved = file, file_poses, state.pose
        self._apply(state)
        self.undo_stack.clear()
        self.library_changed.emit()
        self.file_changed.emit()
        self.pose_loaded.emit()

    def _apply(self, state: DocumentState, changes: Sequence[LibraryChange] = ()) -> None:
        """Set a state and signal what has changed: only this changes pose or library."""
        before, self._held = self._state, state
        if changes and self._library is not None:
            self._library.change(changes)
        if state.pose.latent is not before.pose.latent:
            self._follow_latent()
            self.latent_changed.emit()
        if state.pose.pins != before.pose.pins:
            self.pins_changed.emit()
        if state.ghost is not before.ghost:
            self.ghost_changed.emit()
        if state.outcome is not before.outcome:
            self.outcome_changed.emit()
        if changes:
            self.library_changed.emit()
        if state.pose.name != before.pose.name:
            self.file_changed.emit()
        self._tell_modified()

    def _follow_latent(self) -> None:
        """Notify the workers, then the widgets, of another pose."""

    def _tell_modified(self) -> None:
        if self.changed != self._told_changed:
            self._told_changed = self.changed
            self.file_changed.emit()
        if self.modified != self._told_modified:
            self._told_modified = self.modified
            self.modified_changed.emit(self._told_modified)


def read_only(array: FloatArray) -> FloatArray:
    """Make an array read-only, as other threads read it, and return it."""
    array.flags.writeable = False
    return array


def retagged(pose: NamedPose, tags: Sequence[str], replaced: Sequence[str]) -> tuple[str, ...]:
    """Return the tags of a pose with some in the place of others."""
    return (*tags, *(tag for tag in pose.tags if tag not in (*tags, *replaced)))


def _working(pose: NamedPose) -> NamedPose:
    """Return a copy of a pose, for editing."""
    return replace(pose, latent=read_only(np.array(pose.latent, dtype=np.float64)), tags=())


def _called(poses: Sequence[NamedPose]) -> str:
    return poses[0].name if len(poses) == 1 else counted(len(poses), "pose")


def named_after(pose: NamedPose, file: Path) -> NamedPose:
    """Return a pose under its own name, or where it has none under that of its file."""
    from lcollision_core.model import name_of_file

    return pose if pose.name != UNNAMED else replace(pose, name=name_of_file(file))
