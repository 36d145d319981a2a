"""The user's pose library: every change is an undo step, and is written in the background."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, Signal

from app.editing.history import UNNAMED, ChangeState, DocumentState, Origin, PoseHistory, Source
from app.work.threads import Failure, LongWork
from lcollision_core.errors import LCollisionError, ModelFileError
from lcollision_core.tasks.words import counted

if TYPE_CHECKING:
    from pathlib import Path

    from lcollision_core.bodies import Body, LibraryChange, LibraryWrite, NamedPose, PoseLibrary
    from lcollision_core.jobs import Job


class Library(QObject):
    """Edits the user's pose library of one model.

    Changes show at once; `saving` writes them one after the other, in its thread. Changes that
    could not be written are kept and written with the next one.

    Parameters
    ----------
    history : receives the undo steps
    saving : writes files
    folder : the folder of all libraries; the user's own by default

    Signals
    -------
    changed : `poses` may have changed
    failed : Failure
    """

    changed = Signal()
    failed = Signal(object)

    def __init__(self, history: PoseHistory, saving: LongWork, folder: Path | None = None) -> None:
        super().__init__(history)
        self._history, self._saving, self._folder = history, saving, folder

    def opened(self, model: Body) -> PoseLibrary:
        """Read the library of a model."""
        from lcollision_core.bodies import PoseLibrary, user_poses_folder

        return PoseLibrary(model, self._folder or user_poses_folder(), self._report)

    @property
    def poses(self) -> tuple[NamedPose, ...]:
        """The user's library of this model."""
        store = self._history.store
        return () if store is None else store.poses

    def of_members(self) -> list[NamedPose]:
        """Return the library poses of each body of an open scene, which leave the others alone."""
        from lcollision_core.bodies import NamedPose, as_scene
        from lcollision_core.bodies.rig_poses import StarterPose
        from lcollision_core.tasks.scenes import placed_pose

        def own(body: Body) -> list[StarterPose]:
            poses = [placed_pose(body, pose) for pose in self.opened(body).poses]
            return [StarterPose(pose.name, pose.latent, pose.moves) for pose in poses]

        scene = as_scene(self._history.model)
        poses = () if scene is None else scene.poses_of_members(own)
        return [NamedPose(pose.name, pose.codes, moves=pose.moves) for pose in poses]

    @property
    def is_written(self) -> bool:
        """Whether the file contains all changes."""
        store = self._history.store
        return store is None or store.is_written

    @property
    def can_update(self) -> bool:
        """Whether `update_pose` has something to do."""
        return self._history.library_pose is not None and self._history.changed

    def add_pose(self, name: str) -> None:
        """Add the working pose to the library and rename it; a taken name gets a number."""
        added = replace(self._history.pose, name=self.free_name(name or UNNAMED))
        self._step(f"Add {added.name}", [(None, added)], self._as_in_library(added))

    def replace_pose(self, name: str) -> None:
        """Replace a library pose by the working pose, keeping its name and tags.

        Raises
        ------
        ModelFileError : there is no such pose.
        """
        old = self._required(name)
        new = replace(self._history.pose, name=name, tags=old.tags)
        self._step(f"Replace {name}", [(old, new)], self._as_in_library(new))

    def update_pose(self) -> None:
        """Update the library pose that the working pose came from.

        Raises
        ------
        ModelFileError : it came from none, or that one is gone.
        """
        old = self._history.library_pose
        if old is None:
            raise ModelFileError(
                "this pose is not in your library", "add it with Library > Add to library"
            )
        if self._history.changed:
            new = replace(self._history.pose, name=old.name, tags=old.tags)
            self._step(f"Update {old.name}", [(old, new)], self._as_in_library(new))

    def add_poses(self, poses: Sequence[NamedPose]) -> int:
        """Add poses from elsewhere to the library; taken names get numbers.

        Poses that are already there, identical and under the same name, are left out.

        Returns
        -------
        added : how many were new
        """
        pose_by_name = {pose.name: pose for pose in self.poses}
        added = [
            p for p in poses if p.name not in pose_by_name or not pose_by_name[p.name].same_as(p)
        ]
        names = self._free_names([pose.name for pose in added])
        what = added[0].name if len(added) == 1 else counted(len(added), "pose", "poses")
        new = [replace(p, name=name, moves=None) for p, name in zip(added, names, strict=True)]
        self._step(f"Add {what}", [(None, pose) for pose in new])
        return len(new)

    def duplicate_poses(self, poses: Sequence[NamedPose]) -> None:
        """Add copies of poses of the library."""
        names = self._free_names([pose.name for pose in poses])
        copies = [replace(p, name=name) for p, name in zip(poses, names, strict=True)]
        self._step(f"Duplicate {_called(poses)}", [(None, copy) for copy in copies])

    def remove_poses(self, names: Sequence[str]) -> None:
        """Remove poses from the library.

        Raises
        ------
        ModelFileError : there is no such pose.
        """
        poses = [self._required(name) for name in names]
        self._step(f"Remove {_called(poses)}", [(pose, None) for pose in poses])

    def tag_poses(
        self, names: Sequence[str], tags: Sequence[str], replaced: Sequence[str] = ()
    ) -> None:
        """Add tags to poses of the library and remove others; each pose keeps the rest of its tags.

        Raises
        ------
        ModelFileError : there is no such pose.
        """
        poses = [self._required(name) for name in names]
        tagged = [replace(pose, tags=retagged(pose, tags, replaced)) for pose in poses]
        pairs = zip(poses, tagged, strict=True)
        self._step(f"Tag {_called(poses)}", [(p, new) for p, new in pairs if p.tags != new.tags])

    def rename_pose(self, old: str, new: str) -> None:
        """Rename a pose of the library, and the working pose if it came from that one.

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
        state = self._history.state
        if state.origin is not None and self._history.library_pose is pose:
            name = new if state.pose.name == old else state.pose.name
            origin = replace(state.origin, pose=renamed)
            state = replace(state, pose=replace(state.pose, name=name), origin=origin)
        self._step(f"Rename {old}", [(pose, renamed)], state)

    def why_not_called(self, name: str, old: str = "") -> ModelFileError | None:
        """Return the error that a name for a library pose would raise, or None if it is allowed.

        Parameters
        ----------
        old : the present name of the pose, "" for a new one
        """
        from lcollision_core.bodies import MAX_POSE_NAME_LENGTH, name_error

        if not name:
            return ModelFileError("a pose needs a name", "type one")
        if name_error(name):
            what = f"a name has at most {MAX_POSE_NAME_LENGTH} characters"
            return ModelFileError(what, "choose a shorter one")
        holder = self.name_taken_by(name)
        if holder and holder != old:
            what = f"your library already has a pose “{holder}”"
            return ModelFileError(what, "choose another name")
        return None

    def name_taken_by(self, name: str) -> str:
        """Return the library name that equals this one apart from case, or ""."""
        names = (pose.name for pose in self.poses)
        return next((other for other in names if other.casefold() == name.casefold()), "")

    def free_name(self, name: str) -> str:
        """Return this name, with a number if a pose of the library has it."""
        return self._free_names([name])[0]

    def refresh(self) -> None:
        """Load changes that another program has made to the library's file."""
        store = self._history.store
        # Writing reads the file first.
        if store is not None and not self._is_writing and store.refresh():
            self._tell_changed()

    def write(self) -> None:
        """Write changes that are not in the file yet, including those that failed before."""
        if self._history.store is not None and not self._is_writing:
            self._write(self._history.store)

    def discard_changes(self) -> None:
        """Discard changes that could not be written."""
        if self._history.store is not None:
            self._history.store.discard_unwritten()
            self._tell_changed()

    def apply(self, state: DocumentState, changes: Sequence[LibraryChange]) -> None:
        """Change the library and set the history's state; for `LibraryStep`."""
        if self._history.store is not None:
            self._history.store.change(changes)
        self._history.apply(state)
        self.changed.emit()
        self.write()

    @property
    def _is_writing(self) -> bool:
        return bool(self._saving.labels(self))

    def _write(self, store: PoseLibrary) -> None:
        if store.is_written:
            return
        write = store.writing()

        def work(_: Job) -> LibraryWrite:
            return write()

        def done(written: LibraryWrite) -> None:
            before = store.poses
            store.take(written)
            if store is not self._history.store or store.poses == before:
                self._history.update_modified()
            else:
                # Another program has changed it too.
                self._tell_changed()
            # Write what has changed meanwhile.
            self._write(store)
            # The open library may be another model's, or another one of the same file.
            self.refresh()

        self._saving.start("Saving the pose library", work, done, kind=self)

    def _tell_changed(self) -> None:
        self.changed.emit()
        self._history.update_modified()

    def _report(self, error: LCollisionError) -> None:
        self.failed.emit(Failure.of(error))

    def _required(self, name: str) -> NamedPose:
        store = self._history.store
        pose = None if store is None else store.find(name)
        if pose is None:
            raise ModelFileError(f"your library has no pose {name!r}", "choose one of your own")
        return pose

    def _free_names(self, names: Sequence[str]) -> list[str]:
        """Return these names, with numbers where poses of the library have them."""
        from lcollision_core.bodies import unique_names

        return unique_names([*(pose.name for pose in self.poses), *names])[len(self.poses) :]

    def _as_in_library(self, pose: NamedPose) -> DocumentState:
        """Return the state with the library pose `pose` as the origin of the working pose."""
        working = replace(self._history.pose, name=pose.name)
        return replace(self._history.state, pose=working, origin=Origin(Source.LIBRARY, pose))

    def _step(
        self,
        label: str,
        changes: Sequence[tuple[NamedPose | None, NamedPose | None]],
        state: DocumentState | None = None,
    ) -> None:
        """Change the library, and perhaps the state, in one undo step.

        Parameters
        ----------
        changes : pairs of a library pose and its replacement; (None, pose) appends,
            (pose, None) removes
        """
        from lcollision_core.bodies import LibraryChange

        self._history.close_gesture()
        if not changes:
            return
        poses = list(self.poses)
        applied = []
        for old, new in changes:
            index = next((at for at, pose in enumerate(poses) if pose is old), len(poses))
            applied.append(LibraryChange(old, new, index))
            poses[index : index + 1] = [] if new is None else [new]
        history = self._history
        step = LibraryStep(label, self, history, state or history.state, applied)
        history.undo_stack.push(step)


class LibraryStep(ChangeState):
    """An undo step that changes the library too.

    Parameters
    ----------
    library : owns the poses
    history : owns the states
    changes : of the library, in order
    """

    def __init__(
        self,
        label: str,
        library: Library,
        history: PoseHistory,
        after: DocumentState,
        changes: Sequence[LibraryChange],
    ) -> None:
        super().__init__(label, history.apply, history.state, after)
        self._library, self._changes = library, tuple(changes)

    def redo(self) -> None:
        """Apply the changes."""
        self._library.apply(self.after, self._changes)

    def undo(self) -> None:
        """Revert the changes."""
        inverse = [change.inverse for change in reversed(self._changes)]
        self._library.apply(self.before, inverse)


def retagged(pose: NamedPose, tags: Sequence[str], replaced: Sequence[str]) -> tuple[str, ...]:
    """Return the pose's tags with `tags` first and without `replaced`."""
    return (*tags, *(tag for tag in pose.tags if tag not in (*tags, *replaced)))


def _called(poses: Sequence[NamedPose]) -> str:
    return poses[0].name if len(poses) == 1 else counted(len(poses), "pose", "poses")
