"""Pose files and the user's pose library.

Several programs may have one library open. Changes are therefore stored as differences and applied
to the current file under a lock: no program loses poses, and undoing a change keeps the others'.
"""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
import numpy.typing as npt
from msgspec import UNSET, Meta, Struct, UnsetType, to_builtins
from msgspec.structs import astuple

from lcollision_core.bodies.body import Body
from lcollision_core.bodies.learned_body import ListedModel, find_latent_space, user_models_folder
from lcollision_core.bodies.mirror import MirroredPose, MirrorSource, Symmetry, pose_bytes
from lcollision_core.bodies.names import BETWEEN_BODIES, MAX_POSE_NAME_LENGTH, unique_names
from lcollision_core.bodies.remembered import find_character
from lcollision_core.bundled import user_folder
from lcollision_core.errors import LCollisionError, MeshFileError, ModelFileError
from lcollision_core.files import (
    FileStamp,
    Mesh,
    file_stamp,
    locked,
    read_mesh,
    unused_name,
)
from lcollision_core.files.safe import read_regular, write_bytes
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.json_values import convert_checked, parse_json, quoted
from lcollision_core.meshes import RigidTransform

if TYPE_CHECKING:
    from lcollision_core.posing import Pin
    from lcollision_core.resolve import ResolveResult


POSES_FORMAT = "lcollision-poses"
POSES_VERSION = 2
"""Latest supported version; version 1 has neither a working pose nor tags."""

MAX_FILE_BYTES = 2**28
"""About 80 000 poses of 110 numbers; reading takes about four times that in memory."""

MAX_TAGS = 50

MAX_PINS = 50
_MOST_OF_FRAME = 2
"""Vertices that keep a pin's orientation, besides its own."""

_NOT_ROTATED = 1e-6
_LARGEST_CODE, _LARGEST_PLACE = 1e6, 1e30
"""Far beyond any pose or unit; larger numbers would overflow."""
_LEAST_SCALE = 1e-9


@dataclass(frozen=True)
class NamedPose:
    """One latent pose of a file.

    Attributes
    ----------
    name : unique in the file
    latent : (D,) float64 array
    placement : of the decoded pose, if it was encoded from a mesh; None leaves it in the model's
        coordinates
    fit_error_mean, fit_error_max : of a pose fitted to a mesh or a mirror image, normalised
    tags : search terms in a library
    mirror_of : the pose that a mirror image was made from; mirroring the unchanged image again
        returns it exactly
    pins : patches that stay in place while others are dragged
    moves : (D,) mask of the codes that it sets, such as those of hands; None for all. It is not
        stored in files.
    """

    name: str
    latent: npt.NDArray[np.float64]
    placement: RigidTransform | None = None
    fit_error_mean: float | None = None
    fit_error_max: float | None = None
    tags: tuple[str, ...] = ()
    mirror_of: MirrorSource | None = None
    pins: tuple[Pin, ...] = ()
    moves: npt.NDArray[np.bool_] | None = None

    def applied_to(self, latent: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return this pose's codes, filled up with those of `latent` if it sets only some."""
        return self.latent if self.moves is None else np.where(self.moves, self.latent, latent)

    def same_as(self, other: NamedPose) -> bool:
        """Whether latents, placements and pins are exactly equal; names may differ."""
        mine, others = (pose_bytes(pose.latent, pose.placement) for pose in (self, other))
        return mine == others and self.pins == other.pins

    def mirrored(self, image: MirroredPose, symmetry: Symmetry) -> NamedPose:
        """Return the mirror image as a pose with this one's name and tags.

        Parameters
        ----------
        image : of the latent
        symmetry : of the model, which also mirrors the pins
        """
        return replace(
            self,
            latent=image.latent,
            placement=image.placement,
            fit_error_mean=None if image.restored else image.fit_error_mean,
            fit_error_max=None if image.restored else image.fit_error_max,
            mirror_of=image.source,
            pins=tuple(map(symmetry.mirror_pin, self.pins)),
            moves=None,
        )


@dataclass(frozen=True, eq=False)
class PoseFile:
    """The contents of a pose file.

    Attributes
    ----------
    poses : in the file's order, with unique names
    working : the pose being edited, whose name may equal one of `poses`
    """

    poses: tuple[NamedPose, ...]
    working: NamedPose | None = None

    @property
    def all_poses(self) -> tuple[NamedPose, ...]:
        """The poses, followed by the working one, renamed if its name is taken.

        A working pose that is exactly equal to one of `poses` is not repeated.
        """
        working = self.working
        if working is None or any(pose.same_as(working) for pose in self.poses):
            return self.poses
        *_, name = unique_names([*(pose.name for pose in self.poses), working.name])
        return (*self.poses, replace(working, name=name))


class DamagedPosesError(ModelFileError):
    """A file is not a valid pose file of any version."""


class OtherModelError(ModelFileError):
    """A file holds the poses of another model.

    Attributes
    ----------
    model : the model that the poses belong to, None if unknown
    """

    def __init__(
        self, what: str, next_step: str = "", *, model: ListedModel | None = None, **fields: object
    ) -> None:
        super().__init__(what, next_step, **fields)
        self.model: Final = model


def write_poses(
    path: str | os.PathLike[str],
    model: Body,
    poses: Sequence[NamedPose],
    working: NamedPose | None = None,
    extra: Mapping[str, Any] | None = None,
) -> None:
    """Write latent poses, atomically.

    Without a working pose, tags and scales, the file has version 1, which older programs read.

    Parameters
    ----------
    path : a .json file in an existing folder
    model : of the poses
    poses : with unique names
    working : the pose being edited, stored apart from `poses`
    extra : further JSON values by name, which `read_poses` ignores

    Raises
    ------
    ModelFileError : the extension is not .json, two poses share a name, a pose is invalid, or the
        file cannot be written.
    """
    if Path(path).suffix.lower() != ".json":
        raise ModelFileError.unwritable(path, "poses are a .json file", "rename it")
    name, times = Counter(pose.name for pose in poses).most_common(1)[0] if poses else ("", 0)
    if times > 1:
        raise ModelFileError.unwritable(path, f"{times} poses are called {name!r}")
    all_poses = [*poses, *([] if working is None else [working])]
    entries = [to_json(pose, model) for pose in all_poses]
    for pose, entry in zip(all_poses, entries, strict=True):
        try:
            _from_json(entry, model)
        except ValueError as error:
            raise ModelFileError.unwritable(
                path, f"of the pose {pose.name[:80]!r}, {error}", "repair that pose"
            ) from error
    needs_latest = working is not None or any(
        pose.tags or (pose.placement is not None and pose.placement.scale != 1.0) for pose in poses
    )
    document = {
        "format": POSES_FORMAT,
        "format_version": POSES_VERSION if needs_latest else 1,
        "model": {"name": model.name, "fingerprint": model.fingerprint, **_measures(model)},
        **({} if working is None else {"working": entries[-1]}),
        "poses": entries[: len(poses)],
        **(extra or {}),
    }
    content = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False).encode()
    if len(content) >= MAX_FILE_BYTES:
        raise ModelFileError.unwritable(
            path,
            f"{len(poses)} poses take more than the {MAX_FILE_BYTES} bytes that can be read again",
            "write several files",
        )
    try:
        write_bytes(path, content + b"\n")
    except MeshFileError as error:
        raise ModelFileError.from_error(error) from error


def read_poses(path: str | os.PathLike[str], model: Body) -> tuple[NamedPose, ...]:
    """Read all latent poses of a file, including the working one: `PoseFile.all_poses`.

    Raises
    ------
    ModelFileError : as in `read_pose_file`.
    """
    return read_pose_file(path, model).all_poses


def read_pose_file(path: str | os.PathLike[str], model: Body) -> PoseFile:
    """Read a file of a model's latent poses.

    Raises
    ------
    DamagedPosesError : the file is empty, damaged, or not a pose file.
    OtherModelError : the poses belong to another model.
    ModelFileError : the file is missing, cannot be read, or is of a later version.
    """
    try:
        content = read_regular(path, MAX_FILE_BYTES)
    except FileNotFoundError as error:
        raise ModelFileError.unreadable(
            path, "there is no such file", "name a .json file of poses"
        ) from error
    except (OSError, ValueError) as error:
        raise ModelFileError.unreadable(path, error, "check the file") from error
    try:
        document = parse_json(content)
    except ValueError as error:
        raise DamagedPosesError(
            f"is not JSON ({error})", "name a file of poses that lcollision wrote", where=path
        ) from error
    return _parse(document, path, model)


def name_error(name: str) -> str:
    """Return why a name is invalid for a pose, or "" if it is valid."""
    if not 0 < len(name) <= MAX_POSE_NAME_LENGTH:
        return f"its name must have 1 to {MAX_POSE_NAME_LENGTH} characters"
    if any("\ud800" <= character <= "\udfff" for character in name):
        return "its name contains invalid Unicode"
    return ""


def name_of_file(path: Path) -> str:
    """Return a valid pose name from a file's name."""
    stem = path.stem.encode(errors="replace").decode()
    return stem[:MAX_POSE_NAME_LENGTH]


def _parse(document: Any, path: str | os.PathLike[str], model: Body) -> PoseFile:
    if not isinstance(document, dict) or document.get("format") != POSES_FORMAT:
        raise DamagedPosesError(
            "is not an LCollision pose file", "name a file that lcollision wrote", where=path
        )
    version = document.get("format_version")
    if isinstance(version, int) and version > POSES_VERSION:
        raise ModelFileError.too_new(path, quoted(version), POSES_VERSION)
    owner, entries = document.get("model"), document.get("poses")
    if version not in range(1, POSES_VERSION + 1) or isinstance(version, bool | float):
        version = None
    if version is None or not isinstance(owner, dict) or not isinstance(entries, list):
        raise DamagedPosesError(
            "is damaged: it lacks its version, model or poses", "save the poses again", where=path
        )
    if owner.get("fingerprint") != model.fingerprint:
        raise _other_model(path, owner, model)

    def pose(entry: Any, location: str) -> NamedPose:
        try:
            return _from_json(entry, model)
        except ValueError as error:
            raise DamagedPosesError.because(
                path, f"is damaged at {location}", error, "repair or remove that pose"
            ) from error

    poses = tuple(pose(entry, f"pose {index} (from 0)") for index, entry in enumerate(entries))
    if len({pose.name for pose in poses}) < len(poses):
        raise DamagedPosesError(
            "is damaged: two of its poses share a name", "rename one", where=path
        )
    working = document.get("working") if version > 1 else None
    return PoseFile(poses, None if working is None else pose(working, "its working pose"))


def _other_model(
    path: str | os.PathLike[str], owner: dict[str, Any], model: Body
) -> OtherModelError:
    """Return the error for poses of another model, naming it."""
    fingerprint, name = (
        str(owner.get(key))[:MAX_POSE_NAME_LENGTH] for key in ("fingerprint", "name")
    )
    listed, character = find_latent_space(fingerprint, name), find_character(fingerprint)
    other = listed or character
    if other is not None and other.name == model.name:
        what = f"contains poses of another {name!r}, {other.path}: {_difference(owner, model)}"
        next_step = f"use them with {other.path}"
    elif listed is not None:
        what = f"contains poses of the model {listed.name!r}, not of {model.name!r}"
        next_step = f"use them with {listed.name!r}"
    elif character is not None:
        what = f"contains poses of the character {character.name!r}, not of {model.name!r}"
        next_step = f"use them with {character.path}"
    elif name == model.name:
        what = (
            f"contains poses of another model {name!r}, which is not among your models: "
            f"{_difference(owner, model)}"
        )
        next_step = "use them with the model that they were made with"
    elif BETWEEN_BODIES in name:
        what = f"contains poses of the scene {name!r}, not of {model.name!r}"
        next_step = "name the scene's file, or its other bodies by --with"
    elif "joints" in owner:
        what = f"contains poses of the character {name!r}, not of {model.name!r}"
        next_step = "use them with that character's file"
    else:
        what = (
            f"contains poses of the model {name!r}, not of {model.name!r}, and {name!r} is not "
            "among your models"
        )
        next_step = f"copy its file to {user_models_folder()}, or name it"
    return OtherModelError(what, next_step, where=path, model=other)


def _measures(model: Body) -> dict[str, int]:
    """Return counts by which people can distinguish models of equal names."""
    joints = {} if model.joints is None else {"joints": model.joints.n_joints}
    return joints | {"vertices": model.n_vertices, "codes": model.shape_codes.start}


def _difference(owner: dict[str, Any], model: Body) -> str:
    """Describe how a file's model differs from another model of the same name."""
    differences = [
        f"{owner[what]} {what} instead of {number}"
        for what, number in _measures(model).items()
        if type(owner.get(what)) is int and owner[what] != number
    ]
    if differences:
        return f"it has {', '.join(differences)}"
    alike = "has as many vertices, but" if "vertices" in owner else "is another export:"
    if model.joints is not None:
        return f"it {alike} its joints differ in rest position, axes or skin weights"
    return f"it {alike} its codes come from another training"


_Code = Annotated[float, Meta(ge=-_LARGEST_CODE, le=_LARGEST_CODE)]
_Place = Annotated[float, Meta(ge=-_LARGEST_PLACE, le=_LARGEST_PLACE)]
_Cosine = Annotated[float, Meta(ge=-2.0, le=2.0)]
_Point = tuple[_Place, _Place, _Place]
_Row = tuple[_Cosine, _Cosine, _Cosine]


class _StoredPlacement(Struct, omit_defaults=True):
    rotation: tuple[_Row, _Row, _Row]
    translation: _Point
    scale: Annotated[float, Meta(ge=_LEAST_SCALE, le=1.0 / _LEAST_SCALE)] = 1.0


class _StoredErrors(Struct):
    mean: _Place
    max: _Place


class _StoredSource(Struct, omit_defaults=True):
    latent: list[_Code]
    image: str
    placement: _StoredPlacement | UnsetType = UNSET
    shapes: dict[str, _Code] = {}


class _StoredPin(Struct, omit_defaults=True):
    """A pin; older programs only know pins without a frame."""

    vertex: int
    radius: float
    position: _Point
    frame: Annotated[tuple[tuple[int, _Point], ...], Meta(max_length=_MOST_OF_FRAME)] = ()


class _StoredPose(Struct, omit_defaults=True):
    """A pose as stored in files.

    `latent` excludes the codes of shapes; nonzero ones are stored by name in `shapes`.
    """

    name: str
    latent: list[_Code]
    placement: _StoredPlacement | UnsetType = UNSET
    fit_error: _StoredErrors | UnsetType = UNSET
    tags: Annotated[tuple[str, ...], Meta(max_length=MAX_TAGS)] = ()
    pins: Annotated[tuple[_StoredPin, ...], Meta(max_length=MAX_PINS)] = ()
    mirror_of: _StoredSource | UnsetType = UNSET
    shapes: dict[str, _Code] = {}


def to_json(pose: NamedPose, model: Body) -> dict[str, Any]:
    """Return the JSON record of a pose; exactly equal poses have equal records."""
    latent, shapes = _stored_latent(pose.latent, model)
    stored = _StoredPose(
        pose.name,
        latent,
        _stored_placement(pose.placement),
        tags=pose.tags,
        pins=tuple(_StoredPin(**vars(pin)) for pin in pose.pins),
        shapes=shapes,
    )
    if pose.fit_error_mean is not None and pose.fit_error_max is not None:
        stored.fit_error = _StoredErrors(pose.fit_error_mean, pose.fit_error_max)
    source = pose.mirror_of
    if source is not None and source.is_of(pose.latent, pose.placement):
        latent, shapes = _stored_latent(source.latent, model)
        placement = _stored_placement(source.placement)
        stored.mirror_of = _StoredSource(latent, source.image, placement, shapes)
    record: dict[str, Any] = to_builtins(stored)
    return record


def _stored_placement(placement: RigidTransform | None) -> _StoredPlacement | UnsetType:
    if placement is None:
        return UNSET
    return _StoredPlacement(
        placement.rotation.tolist(), placement.translation.tolist(), placement.scale
    )


def _from_json(entry: Any, model: Body) -> NamedPose:
    pose = convert_checked(_StoredPose, entry, "pose")
    for name in (pose.name, *pose.tags):
        if reason := name_error(name):
            raise ValueError(reason if name is pose.name else f"of its tag {name!r}, {reason}")
    latent, placement = _latent(pose, model), _placement(pose.placement)
    mean = largest = source = None
    if pose.fit_error:
        mean, largest = pose.fit_error.mean, pose.fit_error.max
    if stored := pose.mirror_of:
        mirror_source = MirrorSource(
            _latent(stored, model), _placement(stored.placement), stored.image
        )
        # After manual changes, a pose is no longer that image.
        source = mirror_source if mirror_source.is_of(latent, placement) else None
    tags, pins = tuple(dict.fromkeys(pose.tags)), _pins(pose.pins, model.n_vertices)
    return NamedPose(pose.name, latent, placement, mean, largest, tags, source, pins)


def _pins(stored: tuple[_StoredPin, ...], n_vertices: int) -> tuple[Pin, ...]:
    if not stored:
        return ()
    from lcollision_core.posing import LARGEST_RADIUS, LEAST_RADIUS, Pin

    for pin in stored:
        for vertex in (pin.vertex, *(vertex for vertex, _ in pin.frame)):
            if not 0 <= vertex < n_vertices:
                raise ValueError(f"a vertex of its pins must be 0 to {n_vertices - 1}")
        if not LEAST_RADIUS <= pin.radius <= LARGEST_RADIUS:
            raise ValueError(
                f"the radius of its pins must be {LEAST_RADIUS:g} to {LARGEST_RADIUS:g}"
            )
    return tuple(Pin(*astuple(pin)) for pin in stored)


def _stored_latent(
    latent: npt.NDArray[np.float64], model: Body
) -> tuple[list[float], dict[str, float]]:
    """Return the codes without shapes, and the nonzero shapes by name."""
    shape_codes = model.shape_codes
    named = zip(model.shape_names, latent[shape_codes].tolist(), strict=True)
    return latent[: shape_codes.start].tolist(), {name: number for name, number in named if number}


def _latent(stored: _StoredPose | _StoredSource, model: Body) -> npt.NDArray[np.float64]:
    """Return the (D,) codes; shapes unknown to the model are ignored."""
    codes, n = stored.latent, model.shape_codes.start
    if len(codes) != n:
        raise ValueError(f"its latent must be {n} numbers, got {len(codes)}")
    return np.array([*codes, *(stored.shapes.get(name, 0.0) for name in model.shape_names)])


def _placement(stored: _StoredPlacement | UnsetType) -> RigidTransform | None:
    if not stored:
        return None
    rotation = np.array(stored.rotation)
    turned = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not turned < _NOT_ROTATED or np.linalg.det(rotation) < 0.0:
        raise ValueError("its rotation is not a rotation matrix")
    return RigidTransform(rotation, np.array(stored.translation), stored.scale)


_LOCK_SECONDS = 5.0
_MAX_NAME = 60


def user_poses_folder() -> Path:
    """Return the folder of the user's pose libraries, which may not exist yet."""
    return user_folder("poses")


@dataclass(frozen=True, eq=False)
class LibraryChange:
    """The addition, removal or replacement of a pose; the new pose may have another name.

    Attributes
    ----------
    old : None for an addition
    new : None for a removal
    index : position of an addition in the library, from 0
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
    """The known state of a library's file.

    Attributes
    ----------
    path : of the file, which may not exist yet
    poses : in order, with unique names
    stamp : of the file with these poses, None if there is none
    damage : the error in a previous file, which has been set aside
    """

    path: Path
    poses: tuple[NamedPose, ...] = ()
    stamp: FileStamp | None = None
    damage: ModelFileError | None = None


@dataclass(frozen=True, eq=False)
class LibraryWrite:
    """A library's file after a write, and the number of changes written."""

    file: LibraryFile
    n_changes: int


class PoseLibrary:
    """The user's poses of one latent space: those in the file and unwritten changes.

    Parameters
    ----------
    model : of the poses; a library does not depend on the model's name
    folder : of all libraries, created on the first write
    tell : called with the error if the file cannot be read
    """

    def __init__(self, model: Body, folder: Path, tell: Callable[[LCollisionError], None]) -> None:
        self._model = model
        self._tell = tell
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
        """The poses in order, with unique names."""
        return self._poses

    @property
    def is_written(self) -> bool:
        """Whether all changes are in the file."""
        return not self._unwritten

    def find(self, name: str) -> NamedPose | None:
        """Return the pose with this name, None if there is none."""
        return next((pose for pose in self._poses if pose.name == name), None)

    def change(self, changes: Sequence[LibraryChange]) -> None:
        """Make changes; the next `writing` stores them."""
        self._unwritten = (*self._unwritten, *changes)
        self._poses = _changed(self._file.poses, self._unwritten, self._model)

    def writing(self) -> Callable[[], LibraryWrite]:
        """Return a function that writes all changes, in any thread; pass its result to `take`.

        It raises ModelFileError if the file cannot be written. Only one may run at a time.
        """
        return partial(_write, self._model, self._file, self._unwritten)

    def take(self, written: LibraryWrite) -> None:
        """Take over the result of a write, including changes by other programs."""
        self._note(written.file)
        self._unwritten = self._unwritten[written.n_changes :]
        self._poses = _changed(self._file.poses, self._unwritten, self._model)

    def discard_unwritten(self) -> None:
        """Return to the state of the file."""
        self._unwritten = ()
        self._poses = self._file.poses

    def refresh(self) -> bool:
        """Load changes by other programs; return whether there were any."""
        file = _at_current_path(self._model, self._file)
        stamp = file_stamp(file.path)
        if stamp is None or stamp in (file.stamp, self._refused):
            return False
        try:
            self._note(_read(self._model, file))
        except (ModelFileError, OSError) as error:
            self._refused = stamp
            self._tell(ModelFileError.because("your pose library", "could not be read", error))
            return False
        self._poses = _changed(self._file.poses, self._unwritten, self._model)
        return True

    def _note(self, file: LibraryFile) -> None:
        self._file = replace(file, damage=None)
        if file.damage is not None:
            self._tell(file.damage)


def _at_current_path(model: Body, file: LibraryFile) -> LibraryFile:
    """Adopt a library file made under another name of the same model."""
    return file if file.path.exists() else replace(file, path=_path(model, file.path.parent))


def _read(model: Body, file: LibraryFile) -> LibraryFile:
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


def _write(model: Body, file: LibraryFile, changes: Sequence[LibraryChange]) -> LibraryWrite:
    """Apply changes to the current file, under its lock."""
    file = _at_current_path(model, file)
    try:
        file.path.parent.mkdir(parents=True, exist_ok=True)
        with locked(file.path, _LOCK_SECONDS):
            file = _read(model, file)
            poses = _changed(file.poses, changes, model)
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


def _changed(
    poses: Sequence[NamedPose], changes: Sequence[LibraryChange], model: Body
) -> tuple[NamedPose, ...]:
    """Apply changes; a pose that another program has changed since is kept."""
    poses_kept = list(poses)
    for change in changes:
        index = next(
            (at for at, pose in enumerate(poses_kept) if _alike(pose, change.old, model)), None
        )
        if index is not None:
            del poses_kept[index]
        if change.new is not None:
            *_, name = unique_names([*(pose.name for pose in poses_kept), change.new.name])
            new = change.new if name == change.new.name else replace(change.new, name=name)
            poses_kept.insert(change.index if index is None else index, new)
    return tuple(poses_kept)


def _alike(pose: NamedPose, other: NamedPose | None, model: Body) -> bool:
    if other is None or pose.name != other.name:
        return False
    return to_json(pose, model) == to_json(other, model)


def _path(model: Body, folder: Path) -> Path:
    ending = f"{model.fingerprint}.json"
    readable = re.sub(r"[^\w-]+", "_", model.name)[:_MAX_NAME]
    return next(iter(sorted(folder.glob(f"* {ending}"))), folder / f"{readable} {ending}")


def read_model_mesh(path: str | os.PathLike[str], model: Body) -> Mesh:
    """Read a mesh file and require the model's topology.

    Raises
    ------
    MeshFileError : the file cannot be read.
    PoseSetError : the topology differs.
    """
    mesh = read_mesh(path, topology=model.topology)
    model.require_topology(mesh.topology, str(path))
    return mesh


def encode_mesh(mesh: Mesh, model: Body, scale: float = 1.0, job: Job = UNWATCHED) -> NamedPose:
    """Find the latent pose nearest to a mesh, named after the mesh's file.

    Parameters
    ----------
    mesh : of the model's topology, by `read_model_mesh`
    model, scale, job : see `Body.encode`, which raises the same errors
    """
    encoded = model.encode(mesh.vertices, job, scale)
    return NamedPose(
        name_of_file(mesh.source),
        encoded.latent,
        encoded.placement,
        encoded.fit_error_mean,
        encoded.fit_error_max,
    )


def with_detail(
    model: Body,
    mesh: npt.NDArray[np.float64],
    pose: NamedPose,
    result: ResolveResult,
    clearance: float = 0.0,
) -> npt.NDArray[np.float64] | None:
    """Move a mesh by its encoded pose's displacement in Resolve, so that its detail is kept.

    Parameters
    ----------
    model : of the pose
    mesh : (V, 3) float64 array, the encoded vertices
    pose : their encoded pose
    result : of its Resolve
    clearance : of the Resolve, normalised

    Returns
    -------
    vertices : (V, 3) float64 array, free by the exact check; None if the moved mesh would
        collide
    """
    # If the pose did not move, the mesh is exactly unchanged.
    moved: npt.NDArray[np.float64] = mesh + (
        result.vertices - model.exported_vertices(pose.latent, pose.placement)
    )
    check = model.exact_check(pose.placement, clearance=clearance)
    return moved if check.is_free_mesh(moved) else None
