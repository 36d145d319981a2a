"""The user's own poses of a model: a file in their data folder, written after every change.

Several programs may have one library open. A change is therefore stored as a difference,
which is applied to the current file under a lock: no program's poses are lost, and undoing a change
keeps those of others.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from lcollision_core.bodies.naming import unique_names
from lcollision_core.bodies.posable_body import PosableBody
from lcollision_core.bodies.pose_file import (
    DamagedPosesError,
    NamedPose,
    OtherModelError,
    read_pose_file,
    to_json,
    write_poses,
)
from lcollision_core.errors import LCollisionError, MeshFileError, ModelFileError
from lcollision_core.files import FileStamp, file_stamp, locked, unused_name

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


@dataclass(frozen=True, eq=False)
class LibraryFile:
    """What is known of a library's file.

    Attributes
    ----------
    path : where it is, or will be
    poses : in their order, names all different
    stamp : of the file with these poses, None if there is none
    damage : what was wrong with the one before, which has been set aside
    """

    path: Path
    poses: tuple[NamedPose, ...] = ()
    stamp: FileStamp | None = None
    damage: ModelFileError | None = None


@dataclass(frozen=True, eq=False)
class LibraryWrite:
    """The file after some changes, and how many of those that waited it has."""

    file: LibraryFile
    n_changes: int


class PoseLibrary:
    """The user's poses of one latent space, as the file has them, with what is not written yet.

    Parameters
    ----------
    model : that the poses belong to; a library does not depend on the model's name
    folder : of all libraries; it is made when there is something to write
    tell : called with the error where the file cannot be read
    """

    def __init__(
        self, model: PosableBody, folder: Path, tell: Callable[[LCollisionError], None]
    ) -> None:
        self._model = model
        self._tell = tell
        self._folder = folder
        self._file = LibraryFile(_path(model, folder))
        self._unwritten: tuple[LibraryChange, ...] = ()
        self._poses: tuple[NamedPose, ...] = ()
        self._refused: FileStamp | None = None
        self.refresh()

    @property
    def path(self) -> Path:
        """The library's file."""
        return self._file.path

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
        """Make changes, which the next `writing` brings into the file."""
        self._unwritten = (*self._unwritten, *changes)
        self._poses = _changed(self._file.poses, self._unwritten)

    def writing(self) -> Callable[[], LibraryWrite]:
        """Return what writes all changes, in any thread; its value is for `take`.

        It raises ModelFileError where the file cannot be written. No other may begin before that.
        """
        return partial(_write, self._model, self._folder, self._file, self._unwritten)

    def take(self, written: LibraryWrite) -> None:
        """Note that changes are in the file, among what other programs have changed in it."""
        self._note(written.file)
        self._unwritten = self._unwritten[written.n_changes :]
        self._poses = _changed(self._file.poses, self._unwritten)

    def discard_unwritten(self) -> None:
        """Go back to what the file has."""
        self._unwritten = ()
        self._poses = self._file.poses

    def refresh(self) -> bool:
        """Load what another program has changed; return whether there was anything."""
        file = _found(self._model, self._folder, self._file)
        stamp = file_stamp(file.path)
        if stamp is None or stamp in (file.stamp, self._refused):
            return False
        try:
            self._note(_read(self._model, file))
        except (ModelFileError, OSError) as error:
            self._refused = stamp
            self._tell(ModelFileError.because("your pose library", "could not be read", error))
            return False
        self._poses = _changed(self._file.poses, self._unwritten)
        return True

    def _note(self, file: LibraryFile) -> None:
        self._file = replace(file, damage=None)
        if file.damage is not None:
            self._tell(file.damage)


def _found(model: PosableBody, folder: Path, file: LibraryFile) -> LibraryFile:
    """Adopt a library file made under another name of the same model."""
    return file if file.path.exists() else replace(file, path=_path(model, folder))


def _read(model: PosableBody, file: LibraryFile) -> LibraryFile:
    """Read the file; if it is gone or damaged, keep its previous content."""
    stamp = file_stamp(file.path)
    if stamp is None or stamp == file.stamp:
        return file
    try:
        return LibraryFile(file.path, read_pose_file(file.path, model).poses, stamp)
    except (DamagedPosesError, OtherModelError) as error:
        aside = file.path.with_name(f"{file.path.stem} damaged.json")
        if aside.exists():
            aside = unused_name(aside)
        file.path.rename(aside)
        what = f"was damaged and has been set aside as {aside}: {error.headline}"
        next_step = "poses that you keep from now on go to a new one"
        return replace(file, damage=ModelFileError(what, next_step, where="your pose library"))


def _write(
    model: PosableBody, folder: Path, file: LibraryFile, changes: Sequence[LibraryChange]
) -> LibraryWrite:
    """Make changes in the file as it is now, under its lock."""
    file = _found(model, folder, file)
    try:
        file.path.parent.mkdir(parents=True, exist_ok=True)
        with locked(file.path, _LOCK_SECONDS):
            file = _read(model, file)
            poses = _changed(file.poses, changes)
            write_poses(file.path, model, poses)
            written = replace(file, poses=poses, stamp=file_stamp(file.path))
    except (ModelFileError, MeshFileError, OSError) as error:
        reason = error.headline if isinstance(error, LCollisionError) else error.strerror
        next_step = "export it to another place before you close the editor"
        if isinstance(error, ModelFileError) and error.next_step:
            next_step = f"{error.next_step}, or {next_step}"
        raise ModelFileError(
            f"your pose library could not be saved ({reason})", next_step
        ) from error
    return LibraryWrite(written, len(changes))


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
