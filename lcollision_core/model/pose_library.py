"""The user's own poses of a model: a file in their data folder, written at every change.

Several programs may have one library open. A change is therefore no new content but a difference,
which is applied to what the file holds by then, under a lock: nobody's poses are lost, nor does
taking one's own change back take another's.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lcollision_core.errors import MeshFileError, ModelFileError
from lcollision_core.meshes.locks import locked
from lcollision_core.model.pose_file import (
    DamagedPosesError,
    NamedPose,
    OtherModelError,
    read_pose_file,
    to_json,
    unique_names,
    write_poses,
)
from lcollision_core.model.pose_model import PoseModel

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
    old : None where a pose is added
    new : None where a pose is removed
    place : in the library, from 0, where a pose is added
    """

    old: NamedPose | None
    new: NamedPose | None
    place: int

    @property
    def inverse(self) -> LibraryChange:
        """The change that takes this one back."""
        return LibraryChange(self.new, self.old, self.place)


class PoseLibrary:
    """The user's poses of one latent space, as the file has them.

    Parameters
    ----------
    model : that the poses belong to; a library is found again whatever the model is called
    folder : of all libraries; it is made when there is something to write
    tell : called with one sentence where the file cannot be read or written; a change that cannot
        be written stays here, and is written with the next one that can
    """

    def __init__(self, model: PoseModel, folder: Path, tell: Callable[[str], None]) -> None:
        self._model = model
        self._tell = tell
        self.path = _path(model, folder)
        self._in_file: tuple[NamedPose, ...] = ()
        self._unwritten: list[LibraryChange] = []
        self._poses: tuple[NamedPose, ...] = ()
        self._seen: tuple[int, ...] | None = None
        self._refused: tuple[int, ...] | None = None
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
        """Return the pose of this name, None where there is none."""
        return next((pose for pose in self._poses if pose.name == name), None)

    def change(self, changes: Sequence[LibraryChange]) -> None:
        """Make changes, in the file too."""
        self._unwritten += changes
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with locked(self.path, _LOCK_SECONDS):
                self._read()
                poses = _changed(self._in_file, self._unwritten)
                write_poses(self.path, self._model, poses)
                self._seen = _signature(self.path)
            self._in_file = poses
            self._unwritten.clear()
        except (ModelFileError, MeshFileError, OSError) as error:
            self._tell(
                f"your pose library could not be saved ({error}); export it to another place "
                f"before you close the editor"
            )
        self._poses = _changed(self._in_file, self._unwritten)

    def refresh(self) -> bool:
        """Take in what another program has changed; return whether there was anything."""
        signature = _signature(self.path)
        if signature is None or signature in (self._seen, self._refused):
            return False
        try:
            self._read()
        except (ModelFileError, OSError) as error:
            self._refused = signature
            self._tell(f"your pose library could not be read: {error}")
            return False
        self._poses = _changed(self._in_file, self._unwritten)
        return True

    def _read(self) -> None:
        """Learn what the file holds; what it held before counts where it is gone or damaged."""
        signature = _signature(self.path)
        if signature is None or signature == self._seen:
            return
        try:
            self._in_file = read_pose_file(self.path, self._model).poses
            self._seen = signature
        except (DamagedPosesError, OtherModelError) as error:
            aside = _unused(self.path.with_name(f"{self.path.stem} damaged.json"))
            self.path.rename(aside)
            self._tell(
                f"your pose library was damaged and has been set aside as {aside} ({error}); "
                f"poses that you keep from now on go to a new one"
            )


def _changed(poses: Sequence[NamedPose], changes: Sequence[LibraryChange]) -> tuple[NamedPose, ...]:
    """Apply changes; a pose that another program has changed meanwhile is left as it is."""
    held = list(poses)
    for change in changes:
        place = next((at for at, pose in enumerate(held) if _alike(pose, change.old)), None)
        if place is not None:
            del held[place]
        if change.new is not None:
            *_, name = unique_names([*(pose.name for pose in held), change.new.name])
            new = change.new if name == change.new.name else replace(change.new, name=name)
            held.insert(change.place if place is None else place, new)
    return tuple(held)


def _alike(pose: NamedPose, other: NamedPose | None) -> bool:
    return other is not None and pose.name == other.name and to_json(pose) == to_json(other)


def _signature(path: Path) -> tuple[int, ...] | None:
    """Return what differs whenever a file has been written anew; None where it is not there."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size


def _unused(path: Path) -> Path:
    number, result = 1, path
    while result.exists():
        number += 1
        result = path.with_name(f"{path.stem} {number}{path.suffix}")
    return result


def _path(model: PoseModel, folder: Path) -> Path:
    ending = f"{model.fingerprint}.json"
    readable = re.sub(r"[^\w-]+", "_", model.name)[:_MAX_NAME]
    return next(iter(sorted(folder.glob(f"* {ending}"))), folder / f"{readable} {ending}")
