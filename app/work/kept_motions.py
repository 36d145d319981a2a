"""Edits of motions as autosave keeps them beside the pose, and their recovery.

Only the changed frames are kept: the rest comes from the file that the motions were read from, as
long as that file has not changed.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from app.work.preparing import open_poses_to_show, open_to_show
from app.work.threads import Failure
from lcollision_core.errors import LCollisionError
from lcollision_core.files.safe import read_regular
from lcollision_core.json_values import from_json, parse_json, to_json
from lcollision_core.tasks.opening import OpenedModel, ReadPoses, own_motions, read_motions

if TYPE_CHECKING:
    from lcollision_core.bodies import Body, OtherModelError
    from lcollision_core.files import FileStamp
    from lcollision_core.jobs import Job
    from lcollision_core.motion import Motion

FloatArray = npt.NDArray[np.float64]

KEY = "motions"
"""Key of the edits in the poses file of a session."""

MOST_BYTES = 2**24
"""Size limit of the kept codes: about 20 000 frames of 100 codes."""


@dataclass(frozen=True, eq=False)
class EditedMotions:
    """Motions of one file with changed frames.

    Attributes
    ----------
    file : that they were read from
    stamp : of the file at that time, None if it did not exist
    open : the name of the motion on the timeline
    frame : the playhead
    read, edited : as read, and as edited; by the same names
    saved : names of the motions exported since their last edit
    """

    file: Path
    stamp: FileStamp | None
    open: str
    frame: int
    read: Mapping[str, Motion]
    edited: Mapping[str, Motion]
    saved: frozenset[str]


@dataclass(frozen=True)
class _KeptMotion:
    """The changes of one motion: `codes` are the rows of `frames`, float64 as base64."""

    name: str
    shape: tuple[int, int]
    frames: tuple[int, ...]
    codes: str
    is_saved: bool


@dataclass(frozen=True)
class _StoredMotions:
    """`EditedMotions` as stored in a file."""

    file: str
    stamp: tuple[int, int, int, int] | None
    open: str
    frame: int
    motions: tuple[_KeptMotion, ...]


def to_json_values(motions: EditedMotions) -> dict[str, Any]:
    """Return edited motions as JSON values for a file.

    Raises
    ------
    LCollisionError : the codes exceed `MOST_BYTES`.
    """
    kept_frames, n_bytes = [], 0
    for name, now in motions.edited.items():
        changed = np.flatnonzero((now.codes != motions.read[name].codes).any(axis=1))
        codes = now.codes[changed].astype("<f8").tobytes()
        n_bytes += len(codes)
        if n_bytes > MOST_BYTES:
            what = f"has edits of more than {MOST_BYTES >> 20} MiB, which autosave doesn't keep"
            raise LCollisionError(what, "export the motion", where=f"the motion “{motions.open}”")
        shape = len(now), now.codes.shape[1]
        text = base64.b64encode(codes).decode()
        kept_frames.append(
            _KeptMotion(name, shape, tuple(changed.tolist()), text, name in motions.saved)
        )
    file, stamp = str(motions.file.absolute()), motions.stamp
    return to_json(_StoredMotions(file, stamp, motions.open, motions.frame, tuple(kept_frames)))


def read_lost(
    model: Body | None,
    model_file: str,
    path: Path,
    job: Job,
) -> tuple[ReadPoses | OtherModelError, EditedMotions | Failure | None]:
    """Read the poses and motions that a crash left.

    Parameters
    ----------
    model, model_file, path : see `open_poses`

    Returns
    -------
    read, motions : the motions are None if there are none, or the Failure that lost them
    """
    stored = _stored_motions(path)
    opened = _opened_in_shape(model, model_file, stored, job)
    if opened is not None:
        model = opened.model
    read = open_poses_to_show(model, model_file, path, job)
    if opened is not None and isinstance(read, ReadPoses):
        read = replace(read, opened=opened)
    body = read.opened.model if isinstance(read, ReadPoses) and read.opened else model
    if body is None or isinstance(read, LCollisionError):
        return read, None
    try:
        return read, _motions(body, stored, job)
    except LCollisionError as error:
        return read, Failure.of(error)


def _stored_motions(path: Path) -> Any:
    """Return what a file of poses stores of the motions; None if it stores none or is damaged."""
    from lcollision_core.bodies.poses import MAX_FILE_BYTES

    try:
        document = parse_json(read_regular(path, MAX_FILE_BYTES))
    except (OSError, ValueError):
        # Reading the poses reports it.
        return None
    return document.get(KEY) if isinstance(document, dict) else None


def _opened_in_shape(
    model: Body | None,
    model_file: str,
    stored: Any,
    job: Job,
) -> OpenedModel | None:
    """Return the body in the shape that the kept motion's file gives; None if it gives none."""
    from lcollision_core.bodies.motions import body_of_motion
    from lcollision_core.files.motion.smpl import is_smpl_motion

    file = stored.get("file") if isinstance(stored, dict) else None
    if not isinstance(file, str) or not is_smpl_motion(file):
        return None
    body = model or open_to_show(model_file, job).model
    return OpenedModel(body_of_motion(body, Path(file))[0], model_file)


def _motions(body: Body, document: Any, job: Job) -> EditedMotions | None:
    if document is None:
        return None
    try:
        stored = from_json(_StoredMotions, document, "the motion")
    except ValueError as error:
        raise _lost("the motion", str(error)) from error
    file, name = Path(stored.file), f"“{stored.open}”"
    why = unreadable_reason(file, stored.stamp)
    if why:
        raise _lost(name, why)
    own_file = own_motions(body)[0]
    is_own = own_file is not None and own_file.absolute() == file.absolute()
    clip_names = [motion.name for motion in stored.motions] if is_own else [None]
    read_one = partial(read_motions, body, own_file if is_own and own_file else file, job=job)
    try:
        read = {motion.name: motion for clip in clip_names for motion in read_one(clip)}
    except LCollisionError as error:
        raise _lost(name, error.headline) from error
    edited = {}
    for kept_motion in stored.motions:
        was = read.get(kept_motion.name)
        if was is None or was.codes.shape != kept_motion.shape or not 0 <= stored.frame < len(was):
            raise _lost(name, f"{file.name} has other frames than before")
        edited[kept_motion.name] = (
            replace(was, codes=_codes(was, kept_motion)) if kept_motion.frames else was
        )
    if stored.open not in edited:
        raise _lost(name, "its edits are not among those that were kept")
    saved = frozenset(kept_motion.name for kept_motion in stored.motions if kept_motion.is_saved)
    return EditedMotions(file, stored.stamp, stored.open, stored.frame, read, edited, saved)


def _codes(was: Motion, kept: _KeptMotion) -> FloatArray:
    codes, frames = np.array(was.codes), np.array(kept.frames, dtype=np.intp)
    try:
        rows = np.frombuffer(base64.b64decode(kept.codes, validate=True), "<f8")
        if len(frames) and not (frames.min() >= 0 and frames.max() < len(was)):
            raise ValueError("a frame is beyond its end")
        codes[frames] = rows.reshape(len(frames), codes.shape[1])
    except ValueError as error:
        raise _lost(f"“{kept.name}”", f"what was kept is damaged ({error})") from error
    return codes


def unreadable_reason(file: Path, stamp: FileStamp | None) -> str:
    """Return why motions cannot be read from a file again, or "" if it is unchanged."""
    from lcollision_core.files import file_stamp

    now = file_stamp(file)
    if now is None:
        return f"{file.name} is gone"
    return "" if now == stamp else f"{file.name} was changed since"


def _lost(motion: str, why: str) -> LCollisionError:
    what = f"can't be recovered, as {why}; its frame is recovered as a pose"
    return LCollisionError(what, where=f"The edits of {motion}")
