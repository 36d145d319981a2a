"""The user's own poses of a model: a file in their data folder, written at every change.

Several programs may have one library open. A change is therefore stored as a difference,
which is applied to the current file under a lock: no program's poses are lost, and undoing a change
keeps those of others.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lcollision_core.errors import LCollisionError, MeshFileError, ModelFileError
from lcollision_core.meshes import FileStamp, file_stamp, locked, unused_name
from lcollision_core.model.naming import unique_names
from lcollision_core.model.posable_body import PosableBody
from lcollision_core.model.pose_file import (
    DamagedPosesError,
    NamedPose,
    OtherModelError,
    read_pose_file,
    to_json,
    write_poses,
)

_LOCK_SECONDS = 5.0
_MAX_NAME = 60


def user_poses_folder() -> Path:
    """Return the folder of the user's pose libraries, which may not exist yet."""
    from platformdirs import user_data_path

    return user_data_path("lcollision", appauthor=False) / "poses"


@dataclass(frozen=True, eq=False)
class LibraryChange:
    """One pose that is added, removed or replaced by another, which may have another name.

    Attributes
    ----------
    old : None if a pose is added
    new : None if a pose is removed
    index : from 0 in the library, where a pose is added
    """

    old: NamedPose | None
    new: NamedPose | None
    index: int

    @property
    def inverse(self) -> LibraryChange:
        """The inverse change."""
        return LibraryChange(self.new, self.old, self.index)


class PoseLibrary:
    """The user's poses of one latent space, as the file has them.

    Parameters
    ----------
    model : that the poses belong to; a library does not depend on the model's name
    folder : of all libraries; it is made when there is something to write
    tell : called with the error where the file cannot be read or written; a change that cannot
        be written stays here, and is written with the next one that can
    """

    def __init__(
        self, model: PosableBody, folder: Path, tell: Callable[[LCollisionError], None]
    ) -> None:
        self._model = model
        self._tell = tell
        self._folder = folder
        self.path = _path(model, folder)
        self._in_file: tuple[NamedPose, ...] = ()
        self._unwritten: list[LibraryChange] = []
        self._poses: tuple[NamedPose, ...] = ()
        self._seen: FileStamp | None = None
        self._refused: FileStamp | None = None
        self.refresh()

    @property
    def poses(self) -> tuple[NamedPose, ...]:
        """The poses in their order, names all different."""
        return self._poses

    @property
    def is_written(self) -> bool:
        """Whether the file has all of it."""
        return not self._unwritten

    def find(self, name: str) -> NamedPose | None:
        """Return the pose of this name, None if there is none."""
        return next((pose for pose in self._poses if pose.name == name), None)

    def change(self, changes: Sequence[LibraryChange]) -> None:
        """Make changes, in the file too."""
        self._unwritten += changes
        self._find_file()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with locked(self.path, _LOCK_SECONDS):
                self._read()
                poses = _changed(self._in_file, self._unwritten)
                write_poses(self.path, self._model, poses)
                self._seen = file_stamp(self.path)
            self._in_file = poses
            self._unwritten.clear()
        except (ModelFileError, MeshFileError, OSError) as error:
            reason = error.headline if isinstance(error, LCollisionError) else error.strerror
            next_step = "export it to another place before you close the editor"
            if isinstance(error, ModelFileError) and error.next_step:
                next_step = f"{error.next_step}, or {next_step}"
            self._tell(
                ModelFileError(f"your pose library could not be saved ({reason})", next_step)
            )
        self._poses = _changed(self._in_file, self._unwritten)

    def discard_unwritten(self) -> None:
        """Go back to what the file has."""
        self._unwritten.clear()
        self._poses = self._in_file

    def refresh(self) -> bool:
        """Load what another program has changed; return whether there was anything."""
        self._find_file()
        stamp = file_stamp(self.path)
        if stamp is None or stamp in (self._seen, self._refused):
            return False
        try:
            self._read()
        except (ModelFileError, OSError) as error:
            self._refused = stamp
            self._tell(ModelFileError.because("your pose library", "could not be read", error))
            return False
        self._poses = _changed(self._in_file, self._unwritten)
        return True

    def _find_file(self) -> None:
        """Adopt a library file made under another name of the same model."""
        if not self.path.exists():
            self.path = _path(self._model, self._folder)

    def _read(self) -> None:
        """Read the file; if it is gone or damaged, keep its previous content."""
        stamp = file_stamp(self.path)
        if stamp is None or stamp == self._seen:
            return
        try:
            self._in_file = read_pose_file(self.path, self._model).poses
            self._seen = stamp
        except (DamagedPosesError, OtherModelError) as error:
            aside = self.path.with_name(f"{self.path.stem} damaged.json")
            if aside.exists():
                aside = unused_name(aside)
            self.path.rename(aside)
            what = f"was damaged and has been set aside as {aside}: {error.headline}"
            next_step = "poses that you keep from now on go to a new one"
            self._tell(ModelFileError(what, next_step, where="your pose library"))


def _changed(poses: Sequence[NamedPose], changes: Sequence[LibraryChange]) -> tuple[NamedPose, ...]:
    """Apply changes; a pose that another program has changed meanwhile is kept."""
    held = list(poses)
    for change in changes:
        index = next((at for at, pose in enumerate(held) if _alike(pose, change.old)), None)
        if index is not None:
            del held[index]
        if change.new is not None:
            *_, name = unique_names([*(pose.name for pose in held), change.new.name])
            new = change.new if name == change.new.name else replace(change.new, name=name)
            held.insert(change.index if index is None else index, new)
    return tuple(held)


def _alike(pose: NamedPose, other: NamedPose | None) -> bool:
    return other is not None and pose.name == other.name and to_json(pose) == to_json(other)


def _path(model: PosableBody, folder: Path) -> Path:
    ending = f"{model.fingerprint}.json"
    readable = re.sub(r"[^\w-]+", "_", model.name)[:_MAX_NAME]
    return next(iter(sorted(folder.glob(f"* {ending}"))), folder / f"{readable} {ending}")
