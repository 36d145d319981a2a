"""Undo commands of a document, and its history."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Signal
from PySide6.QtGui import QUndoCommand, QUndoStack

from lcollision_core.errors import LCollisionError, ModelFileError

if TYPE_CHECKING:
    from app.work.frames import SpaceFactory
    from lcollision_core.bodies import Body, NamedPose, PoseLibrary
    from lcollision_core.files import FileStamp
    from lcollision_core.motion import Motion
    from lcollision_core.resolve import ResolveResult


MERGE_SECONDS = 1.0
"""Time within which changes of one slider merge into one undo step."""

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
    """The pose that the working pose was loaded from.

    Attributes
    ----------
    source : where it is kept
    pose : as loaded; for a library pose, the library's present pose of that name takes precedence
    """

    source: Source
    pose: NamedPose


@dataclass(frozen=True, eq=False)
class Moment:
    """The frame of a motion that the working pose is.

    Attributes
    ----------
    motion : its current version
    frame : from 0
    """

    motion: Motion
    frame: int

    @property
    def space(self) -> SpaceFactory | None:
        """The body's space in this frame; None if it is the same in all frames."""
        frame_space = self.motion.space_at
        return None if frame_space is None else partial(frame_space, self.frame)


@dataclass(frozen=True, eq=False)
class DocumentState:
    """Everything that undo restores, except the library, which changes by `LibraryChange`.

    Attributes
    ----------
    pose : the working pose, its arrays read-only; it has no tags
    origin : the pose that the working pose came from, None for a new one
    ghost : (V, 3) float32 array, read-only: the mesh before the Resolve of `outcome`
    outcome : the result of the Resolve that ended in this pose
    outcome_seconds : from the request of that Resolve to its result, waiting included
    moment : the frame of the open motion; None if the pose is no frame
    """

    pose: NamedPose
    origin: Origin | None = None
    ghost: npt.NDArray[np.float32] | None = None
    outcome: ResolveResult | None = None
    outcome_seconds: float = 0.0
    moment: Moment | None = None

    @property
    def motion(self) -> Motion | None:
        """The motion of the working pose; None if the pose is no frame."""
        return None if self.moment is None else self.moment.motion

    @property
    def space(self) -> SpaceFactory | None:
        """The body's space in the moment; None if it is that of every pose."""
        return None if self.moment is None else self.moment.space

    def drawn(self, model: Body) -> npt.NDArray[np.float32]:
        """Return the (V, 3) vertices as drawn, in the data's unit: see `ExactCheck`."""
        check = model.exact_check(space=self.space and self.space())
        return check.drawn(check.decode(self.pose.latent)[0])

    def same_as(self, other: DocumentState) -> bool:
        """Whether there is nothing to undo between two states: the poses are bit-identical."""
        return (
            self.pose.name == other.pose.name
            and self.pose.same_as(other.pose)
            and _key(self.origin) == _key(other.origin)
            and self.motion is other.motion
        )


def _key(origin: Origin | None) -> tuple[Source, str] | None:
    return None if origin is None else (origin.source, origin.pose.name)


class ChangeState(QUndoCommand):
    """Switch from one state of the document to another, without recomputing anything.

    Parameters
    ----------
    label : the name of the action in the menu
    apply : puts a state into the document; a method of the history, as commands know no widget
    before, after : the two states, which `PoseHistory` may change
    run : steps of the same run that follow within `MERGE_SECONDS` merge; None never merges
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
        """Merge the next step of the same run; drop the step if it ends where it began."""
        if not isinstance(other, ChangeState) or other._run != self._run:
            return False
        if other._time - self._time > MERGE_SECONDS:
            return False
        self.after, self._time = other.after, other._time
        self.setObsolete(self.before.same_as(self.after))
        return True


FloatArray = npt.NDArray[np.float64]

UNNAMED = "pose"
"""Placeholder name of an unnamed pose."""

UNDO_STEPS = 1000
"""Maximum number of undo steps: a few kilobytes each, and two meshes for a Resolve."""


class MotionEdits(Protocol):
    """Turns edits of frames into edits of their motion."""

    def with_motion_edit(self, state: DocumentState) -> DocumentState:
        """Return the state to apply when an action ends in `state`."""

    def are_saved(self) -> bool:
        """Whether no motion has changed since it was read or exported."""

    def mark_saved(self) -> None:
        """Mark all motions as saved."""


@dataclass(eq=False)
class Gesture:
    """Changes that form one undo step together, such as a drag.

    Attributes
    ----------
    label : of its undo step
    before : the state that it began with
    run : see `ChangeState`
    has_asked : whether a pose was requested, which may still be pending
    """

    label: str
    before: DocumentState
    run: int | None = None
    has_asked: bool = False


class PoseHistory(QObject):
    """The working pose, its file, and the undo steps.

    Every change of the pose or of the library is one step of `undo_stack`. During a gesture,
    changes of the pose show at once but form one step, or none if they end where they began.
    The library has a file of its own. The poses of the opened file are separate from it and are
    never changed here.

    Attributes
    ----------
    undo_stack : all undo steps
    gesture : the gesture in progress; None if there is none
    model_file : the file that the model was read from, or the name of a model without a file
    file : the poses file that Save writes; if None, Save asks for one
    file_stamp : the stamp of `file` when it was last opened or saved here
    file_poses : the poses of the opened file, which Save writes unchanged
    document_token : a token of what was opened last, replaced with every file and new pose
    store : the user's library of the model; None before the first model
    ghost_shown : whether a ghost is drawn if there is one; see `show_ghost`
    motions : handles edits of a motion's frames; None without a timeline

    Signals
    -------
    latent_changed, pins_changed, ghost_changed : the pose's codes, its pins, `ghost`
    outcome_changed : the state's `outcome` is new, or None because the pose has changed since
    file_changed : the file, the pose's name or `changed` may be new
    modified_changed : bool
    file_poses_changed : another file, or none, is open
    pose_loaded : a whole pose was loaded, from the library or a file, not by sliders
    gesture_closed : the changes of a gesture have become a step
    moment_changed : another frame, another motion, or none
    moment_entered : the working pose has become a frame of a motion, or is no longer one
    """

    latent_changed = Signal()
    ghost_changed = Signal()
    outcome_changed = Signal()
    modified_changed = Signal(bool)
    file_changed = Signal()
    file_poses_changed = Signal()
    pose_loaded = Signal()
    pins_changed = Signal()
    gesture_closed = Signal()
    moment_changed = Signal()
    moment_entered = Signal()

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._model: Body | None = None
        self.model_file = ""
        self._held: DocumentState | None = None
        self.store: PoseLibrary | None = None
        self.gesture: Gesture | None = None
        self.file: Path | None = None
        self.file_stamp: FileStamp | None = None
        self.file_poses: tuple[NamedPose, ...] = ()
        self.document_token = object()
        self._saved: NamedPose | None = None
        self.ghost_shown = True
        self.motions: MotionEdits | None = None
        self._told_modified = self._told_changed = False
        self.undo_stack = QUndoStack(self)
        self.undo_stack.setUndoLimit(UNDO_STEPS)

    @property
    def has_model(self) -> bool:
        """Whether a model is loaded."""
        return self._model is not None

    @property
    def model(self) -> Body:
        """The model that the pose belongs to."""
        if self._model is None:
            raise LCollisionError("no model is open yet", "open one first")
        return self._model

    @property
    def pose(self) -> NamedPose:
        """The working pose, its arrays read-only."""
        return self.state.pose

    @property
    def latent(self) -> FloatArray:
        """(D,) float64 array, read-only."""
        return self.pose.latent

    @property
    def library_pose(self) -> NamedPose | None:
        """The present library pose that the working pose came from; None if there is none."""
        origin = self.state.origin
        if origin is None or origin.source is not Source.LIBRARY or self.store is None:
            return None
        return self.store.find(origin.pose.name)

    @property
    def changed(self) -> bool:
        """Whether the working pose differs from the one that it came from."""
        source = self._source_pose()
        return source is not None and not source.same_as(self.pose)

    @property
    def modified(self) -> bool:
        """Whether there is something to save.

        A pose untouched since it was loaded is still stored where it came from, and needs no
        file. For a frame of a motion, only changed motions count.
        """
        if self.state.moment is not None and self.motions is not None:
            return not self.motions.are_saved()
        if self._saved is not None and self._saved.same_as(self.pose):
            return False
        origin = self.state.origin
        if self.file is not None or self._saved is None or origin is None:
            return True
        if origin.source is Source.LIBRARY and self.store and not self.store.is_written:
            return True
        is_elsewhere = origin.source is not Source.MESH and self._source_pose() is not None
        return self.changed or not is_elsewhere

    @property
    def ghost(self) -> npt.NDArray[np.float32] | None:
        """(V, 3) float32 array, read-only: the mesh before the Resolve of `outcome`, if shown."""
        return self.state.ghost if self.ghost_shown else None

    def show_ghost(self, shown: bool) -> None:
        """Draw or hide the mesh before Resolve."""
        if shown != self.ghost_shown:
            self.ghost_shown = shown
            self.ghost_changed.emit()

    def open_gesture(self, label: str, run: int | None = None) -> Gesture:
        """Collect the following changes into one undo step, until `close_gesture`."""
        self.close_gesture()
        self.gesture = Gesture(label, self.state, run)
        return self.gesture

    def close_gesture(self) -> None:
        """End the gesture, if there is one, and push its changes as one undo step."""
        gesture, self.gesture = self.gesture, None
        if gesture is None:
            return
        before, after = gesture.before, self.state
        if after.pose is not before.pose:
            after = self._settled(after)
            self.apply(after)
        if not before.same_as(after):
            step = ChangeState(gesture.label, self.apply, before, after, gesture.run)
            self.undo_stack.push(step)
        self.gesture_closed.emit()
        self.update_modified()

    def cancel_gesture(self) -> None:
        """End the gesture and restore the state that it began with."""
        gesture, self.gesture = self.gesture, None
        if gesture is not None:
            self.apply(gesture.before)

    def undo(self) -> None:
        """Undo the last step; an unfinished gesture counts as that step."""
        gesture = self.gesture
        has_moved_nothing = gesture is not None and gesture.before.same_as(self.state)
        self.close_gesture()
        if gesture is None or not (gesture.has_asked and has_moved_nothing):
            self.undo_stack.undo()

    def redo(self) -> None:
        """Redo the last undone step."""
        self.close_gesture()
        self.undo_stack.redo()

    def load_pose(self, pose: NamedPose) -> None:
        """Load a pose of the library, of the file or of the training set, under its name."""
        library = () if self.store is None else self.store.poses
        source = Source.TRAINING
        for candidate, poses in ((Source.LIBRARY, library), (Source.FILE, self.file_poses)):
            if any(pose is stored_pose for stored_pose in poses):
                source = candidate
        self.load(f"Load {pose.name}", pose, source)

    @property
    def file_changed_elsewhere(self) -> bool:
        """Whether another program has written `file` since it was opened or saved here."""
        from lcollision_core.files import file_stamp

        return self.file is not None and file_stamp(self.file) not in (None, self.file_stamp)

    def mark_saved(self) -> None:
        """Mark everything as saved, for a window that closes without asking."""
        self._saved = self.pose
        if self.motions is not None:
            self.motions.mark_saved()
        self.update_modified()

    def _settled(self, state: DocumentState) -> DocumentState:
        return state if self.motions is None else self.motions.with_motion_edit(state)

    @property
    def state(self) -> DocumentState:
        """The working pose and everything else that undo restores."""
        if self._held is None:
            raise ModelFileError("no model is open yet", "open one first")
        return self._held

    def _source_pose(self) -> NamedPose | None:
        """Return the present pose that the working pose came from; None if it is gone."""
        origin = self.state.origin
        if origin is None or origin.source is Source.LIBRARY:
            return self.library_pose
        return origin.pose

    def load(self, label: str, pose: NamedPose, source: Source) -> None:
        """Load another pose as one undo step."""
        self.close_gesture()
        # On the timeline the pose replaces the frame's.
        moment = self.state.moment
        origin = Origin(source, pose) if moment is None else None
        self.push(label, DocumentState(_working(pose), origin, moment=moment))
        self.pose_loaded.emit()

    def with_latent(self, latent: FloatArray) -> DocumentState:
        """Return the state with other codes, (D,) and read-only."""
        # The fit error of a mesh does not apply to another pose.
        pose = replace(self.pose, latent=latent, fit_error_mean=None, fit_error_max=None)
        return replace(self.state, pose=pose, ghost=None, outcome=None)

    def set_model(self, model: Body, file: str, store: PoseLibrary) -> None:
        """Start with the first pose of another model, without signals: see `emit_all`."""
        self._model, self.model_file = model, file
        pose = self._blank()
        self.store, self.file, self.file_poses = store, None, ()
        self.gesture, self._held, self._saved = None, DocumentState(pose), pose
        self.document_token = object()

    def emit_all(self) -> None:
        """Emit every change signal, as after loading another model."""
        for changed in (
            self.latent_changed,
            self.ghost_changed,
            self.outcome_changed,
            self.pins_changed,
            self.file_poses_changed,
            self.file_changed,
            self.moment_changed,
        ):
            changed.emit()
        self.update_modified()

    def push(self, label: str, state: DocumentState, run: int | None = None) -> None:
        """Apply another state, as an undo step of its own or as part of the gesture."""
        if self.gesture is not None:
            self.apply(state)
            return
        state = self._settled(state)
        if not state.same_as(self.state):
            self.undo_stack.push(ChangeState(label, self.apply, self.state, state, run))

    def amend(self, state: DocumentState) -> None:
        """Replace the current state, also in the undo steps before and after it."""
        index = self.undo_stack.index()
        earlier = self.undo_stack.command(index - 1)
        later = self.undo_stack.command(index)
        if isinstance(earlier, ChangeState):
            earlier.after = state
        if isinstance(later, ChangeState):
            later.before = state
        self.apply(state)

    def mark_saved_as(self, asked: NamedPose, pose: NamedPose, file: Path) -> None:
        """Record that `file` now contains a pose; amend the undo steps if it is still current.

        Parameters
        ----------
        asked : the working pose when saving was requested; it may have changed since
        pose : the same pose as written
        """
        self.file, self._saved = file, pose
        if self.pose is asked:
            origin = self.state.origin
            if origin is None or origin.source is not Source.LIBRARY:
                origin = Origin(Source.FILE, pose)
            self.amend(replace(self.state, pose=pose, origin=origin))
        self.file_changed.emit()
        self.update_modified()

    def mark_unsaved(self) -> None:
        """Mark the pose as saved nowhere, as after recovery from a crash."""
        self._saved = None
        self.update_modified()

    def exchange_model(self, model: Body, file: str) -> None:
        """Replace the model by a changed version of itself; the pose stays."""
        self._model, self.model_file = model, file

    def begin_blank(self) -> None:
        """Set the unnamed reference pose, without history."""
        self.begin(DocumentState(self._blank()))

    def _blank(self) -> NamedPose:
        from lcollision_core.bodies import NamedPose

        return NamedPose(UNNAMED, read_only(self.model.known_poses[0]))

    def begin_with(
        self,
        pose: NamedPose,
        source: Source = Source.TRAINING,
        file: Path | None = None,
        file_poses: tuple[NamedPose, ...] = (),
    ) -> None:
        """Set a pose without history, marked as saved.

        Parameters
        ----------
        source : where the pose is kept
        file, file_poses : the file that Save writes, and the other poses in it
        """
        self.begin(DocumentState(_working(pose), Origin(source, pose)), file, file_poses)

    def begin(
        self,
        state: DocumentState,
        file: Path | None = None,
        file_poses: tuple[NamedPose, ...] = (),
    ) -> None:
        """Set a state, marked as saved, and clear the history."""
        self.gesture, self.document_token = None, object()
        self.file, self.file_poses, self._saved = file, file_poses, state.pose
        self.apply(state)
        self.undo_stack.clear()
        self.file_poses_changed.emit()
        self.file_changed.emit()
        self.pose_loaded.emit()

    def apply(self, state: DocumentState) -> None:
        """Set a state and signal the differences: the only place where the pose changes."""
        before, self._held = self.state, state
        if state.pose.latent is not before.pose.latent:
            self.latent_changed.emit()
        if state.pose.pins != before.pose.pins:
            self.pins_changed.emit()
        if state.ghost is not before.ghost:
            self.ghost_changed.emit()
        if state.outcome is not before.outcome:
            self.outcome_changed.emit()
        if state.pose.name != before.pose.name:
            self.file_changed.emit()
        if state.moment is not before.moment:
            self.moment_changed.emit()
            if (state.moment is None) != (before.moment is None):
                self.moment_entered.emit()
        self.update_modified()

    def update_modified(self) -> None:
        """Signal `changed` and `modified` if they have changed."""
        if self.changed != self._told_changed:
            self._told_changed = self.changed
            self.file_changed.emit()
        if self.modified != self._told_modified:
            self._told_modified = self.modified
            self.modified_changed.emit(self._told_modified)


def read_only(array: FloatArray) -> FloatArray:
    """Make an array read-only, because other threads read it, and return it."""
    array.flags.writeable = False
    return array


def _working(pose: NamedPose) -> NamedPose:
    """Return a copy of a pose for editing, without tags."""
    return replace(pose, latent=read_only(np.array(pose.latent, dtype=np.float64)), tags=())


def named_after(pose: NamedPose, file: Path) -> NamedPose:
    """Return a pose, named after its file if it is unnamed."""
    from lcollision_core.bodies import name_of_file

    return pose if pose.name != UNNAMED else replace(pose, name=name_of_file(file))
