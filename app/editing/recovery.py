"""Recovery after a crash: unsaved edits are written every few seconds and found at the next start.

They are the pose and, if it is a frame of a motion, the changed frames of the motions: the rest
comes from the file that the motions were read from, as long as that file has not changed.

Each editor has a session, a folder below `sessions_folder`, locked for as long as its process
runs. However the process ends, the lock ends with it, and the next editor that starts can take
over the session. It never takes over a session that another running editor holds.
"""

from __future__ import annotations

import base64
import errno
import json
import logging
import shutil
import time
import uuid
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QLockFile, QObject, Signal, Slot

from app.editing.document import PoseDocument
from app.editing.history import Source
from app.editing.timeline import EditedMotions
from app.work.preparing import open_poses_to_show, open_to_show
from app.work.threads import Failure, LongWork, Task, guarded, single_shot
from lcollision_core.errors import LCollisionError
from lcollision_core.files.safe import FileStamp, read_regular, require_regular, write_bytes
from lcollision_core.jobs import Job
from lcollision_core.json_values import convert_checked, from_json, parse_json, to_json
from lcollision_core.tasks.opening import OpenedModel, ReadPoses, own_motions, read_motions

if TYPE_CHECKING:
    from lcollision_core.bodies import Body, NamedPose, OtherModelError
    from lcollision_core.motion import Motion


_log = logging.getLogger(__name__)

AUTOSAVE_SECONDS = 3.0
"""Maximum time of work that a crash loses, apart from the time to write."""

_LOCK = "lock"
_POSES = "poses.json"
_SESSION = "session.json"
_MAX_SESSION_BYTES = 2**20


def sessions_folder() -> Path:
    """Return the folder of all sessions, which may not exist yet."""
    from platformdirs import user_state_path

    return user_state_path("lcollision", appauthor=False) / "sessions"


class Session:
    """One editor's session folder, locked by this process.

    Attributes
    ----------
    folder : contains the lock, and the poses once there is something to keep
    """

    def __init__(self, folder: Path, lock: QLockFile) -> None:
        self.folder = folder
        self._lock = lock

    @classmethod
    def new(cls, parent: Path) -> Session:
        """Make a session; raises OSError if the folder cannot be made."""
        folder = parent / uuid.uuid4().hex
        folder.mkdir(parents=True)
        session = cls.try_lock(folder)
        if session is None:
            raise OSError(f"{folder} cannot be locked")
        return session

    @classmethod
    def try_lock(cls, folder: Path) -> Session | None:
        """Lock a session, or return None if a running process holds it.

        Also return None if its lock is not a regular file: Qt would wait for a pipe for ever.
        """
        try:
            require_regular(folder / _LOCK)
        except FileNotFoundError:
            pass
        except OSError as error:
            _log.warning("%s is not a session: %s", folder, error)
            return None
        lock = QLockFile(str(folder / _LOCK))
        # A lock never goes stale: it is released only when its process ends.
        lock.setStaleLockTime(0)
        return cls(folder, lock) if lock.tryLock(0) else None

    def release(self) -> None:
        """Leave the session to the next editor that starts."""
        self._lock.unlock()

    def discard(self) -> None:
        """Delete the session with its files."""
        self._lock.unlock()
        shutil.rmtree(self.folder, ignore_errors=True)


@dataclass(frozen=True)
class SessionNote:
    """What a session keeps beside its poses.

    Attributes
    ----------
    model : the file or the name of the model
    pose_name : of the edited pose
    file : the poses file that it was opened from or saved to
    file_stamp : of `file` at that time, None if unknown
    locked : the locked domains
    motion : the name of the edited motion that the pose is a frame of, "" for none
    motion_file, motion_stamp : the file that the motion was read from, and its stamp
    """

    model: str
    pose_name: str
    file: str | None
    file_stamp: FileStamp | None = None
    locked: tuple[int, ...] = ()
    motion: str = ""
    motion_file: str = ""
    motion_stamp: FileStamp | None = None


@dataclass(frozen=True, eq=False)
class RecoverablePose:
    """The unsaved pose of an editor that crashed.

    Attributes
    ----------
    session : locked by this process until it is discarded, released or recovered
    note : on the pose
    saved : when it was last written, in seconds since 1970
    """

    session: Session
    note: SessionNote
    saved: float

    @property
    def motion_loss_reason(self) -> str:
        """Why the edits of its motion cannot be restored; "" if they can."""
        file = self.note.motion_file
        return unreadable_reason(Path(file), self.note.motion_stamp) if file else ""

    @property
    def model_name(self) -> str:
        """The display name of the model."""
        return Path(self.note.model).stem

    @property
    def poses_file(self) -> Path:
        """An ordinary poses file that contains the edited pose."""
        return self.session.folder / _POSES


def find_recoverable_poses(parent: Path | None = None) -> list[RecoverablePose]:
    """Find and lock the sessions of editors that no longer run, newest first.

    Sessions without a pose are deleted.

    Parameters
    ----------
    parent : the folder of all sessions; the user's own by default
    """
    parent = parent or sessions_folder()
    lost_poses = []
    for folder in parent.iterdir() if parent.is_dir() else ():
        session = Session.try_lock(folder) if folder.is_dir() else None
        if session is None:
            continue
        try:
            values = parse_json(read_regular(folder / _SESSION, _MAX_SESSION_BYTES))
            # Not sanitised: a file may have any name.
            note = convert_checked(SessionNote, values, "the session")
            lost_poses.append(RecoverablePose(session, note, (folder / _POSES).stat().st_mtime))
        except (OSError, ValueError) as error:
            _log.info("nothing to recover in %s: %s", folder, error)
            # A disk error may be temporary: keep the session.
            is_useless = getattr(error, "errno", errno.ENOENT) in (errno.ENOENT, errno.EFBIG)
            (session.discard if is_useless else session.release)()
    return sorted(lost_poses, key=lambda lost: lost.saved, reverse=True)


class Autosave(QObject):
    """Keeps the unsaved edits of a document until they are saved or discarded.

    Parameters
    ----------
    document : read whenever it signals a change
    parent_folder : the folder of all sessions; the user's own by default
    seconds : from a change until it is written, however many changes follow

    Signals
    -------
    failed : Failure, emitted once until writing works again
    written : after each write
    recovered : `recover` has loaded a pose
    """

    failed = Signal(object)
    written = Signal()
    recovered = Signal()

    def __init__(
        self,
        document: PoseDocument,
        parent_folder: Path | None = None,
        seconds: float = AUTOSAVE_SECONDS,
    ) -> None:
        super().__init__(document)
        self._document = document
        self._has_reported = False
        self._session: Session | None = None
        try:
            self._session = Session.new(parent_folder or sessions_folder())
        except OSError as error:
            _log.warning("there is no autosave: %s", error)
        # A thread of its own: a disk may take longer than a frame, and must not wait for Resolve.
        self._work = LongWork(self, "autosave")
        self._work.failed.connect(self._on_failed)
        self._due = single_shot(self, int(1000 * seconds), self._write)
        for changed in (
            document.history.latent_changed,
            document.motion.locks_changed,
            document.history.pins_changed,
            document.library.changed,
            document.history.file_changed,
            document.history.moment_changed,
        ):
            changed.connect(self._on_changed)
        document.history.modified_changed.connect(self._on_modified_changed)

    def recover(self, lost: RecoverablePose) -> None:
        """Load a lost pose into the document, unsaved, and continue its session.

        If its model is gone, emit `PoseDocument.failed` and leave the session unchanged.
        """
        document = self._document
        file = lost.note.model
        model = document.model if file == document.history.model_file else None
        work = partial(read_lost, model, file, lost.poses_file)
        done = partial(self._on_read, lost)
        document.tasks.start_loading(f"Recovering {lost.note.pose_name}", work, done)

    def close(self, timeout: float = 5.0, keep: bool = False) -> bool:
        """Stop, and discard unsaved edits unless they are kept for the next start.

        Parameters
        ----------
        timeout : in seconds
        keep : keep unsaved edits, as the user was not asked

        Returns
        -------
        ended : whether the thread has ended in time
        """
        self._due.stop()
        ended = self._work.close(time.monotonic() + timeout)
        if self._session is None:
            return ended
        if keep and self._document.history.modified:
            if ended:
                guarded("Autosave", self._snapshot(), Job())
            self._session.release()
        else:
            self._session.discard()
        self._session = None
        return ended

    @Slot()
    def _on_changed(self) -> None:
        if self._document.history.modified and not self._due.isActive():
            self._due.start()

    @Slot(bool)
    def _on_modified_changed(self, modified: bool) -> None:
        if modified:
            self._on_changed()
        else:
            # Saved edits must not be offered again after a crash.
            self._write()

    @Slot()
    def _write(self) -> None:
        if self._session is not None and self._document.has_model:
            self._work.start("Autosave", self._snapshot(), self._on_written)

    def _snapshot(self) -> Task:
        """Return a task that writes the document, or deletes the session's files if it is saved."""
        assert self._session is not None
        document, folder = self._document, self._session.folder
        if not document.history.modified:
            return partial(_delete, folder)
        note = SessionNote(
            document.history.model_file,
            document.history.pose.name,
            str(document.history.file) if document.history.file else None,
            document.history.file_stamp,
            tuple(sorted(document.motion.locked_domains)),
        )
        return partial(
            _write,
            folder,
            note,
            document.model,
            document.history.file_poses,
            document.history.pose,
            document.timeline.edits(),
        )

    def _on_read(
        self,
        lost: RecoverablePose,
        contents: tuple[ReadPoses | OtherModelError, EditedMotions | Failure | None],
    ) -> None:
        (read, motions), document, history = contents, self._document, self._document.history
        if isinstance(read, LCollisionError):
            document.failed.emit(Failure.of(read))
            return
        if read.opened is not None:
            document.tasks.model_opened.emit(read.opened)
        poses = read.content.poses
        same_name = (pose for pose in poses if pose.name == lost.note.pose_name)
        edited = read.content.working or next(same_name, poses[0])
        file = Path(lost.note.file) if lost.note.file else None
        history.begin_with(edited, Source.FILE, file, poses)
        history.file_stamp = lost.note.file_stamp
        history.mark_unsaved()
        if self._session is not None:
            self._session.discard()
        self._session = lost.session
        for domain in range(len(document.model.domain_names)):
            document.motion.set_locked(domain, domain in lost.note.locked)
        if isinstance(motions, EditedMotions):
            document.timeline.restore(motions)
        self.recovered.emit()
        document.message.emit(f"Recovered {edited.name}")
        if isinstance(motions, Failure):
            document.failed.emit(motions)

    def _on_written(self, is_kept: bool) -> None:
        if is_kept:
            self._has_reported = False
            self.written.emit()

    @Slot(object)
    def _on_failed(self, failure: Failure) -> None:
        if not self._has_reported:
            self._has_reported = True
            headline = f"Autosave failed ({failure.headline})"
            is_motion = not self._document.timeline.are_saved()
            next_step = "export the motion" if is_motion else "save them to a file"
            self.failed.emit(Failure(headline, next_step, failure.details))


def _write(
    folder: Path,
    note: SessionNote,
    model: Body,
    file_poses: tuple[NamedPose, ...],
    working: NamedPose,
    motions: EditedMotions | None,
    _: Job,
) -> bool:
    from lcollision_core.bodies import write_poses

    extra: dict[str, Any] = {}
    too_large = None
    if motions is not None:
        try:
            extra = {KEY: to_json_values(motions)}
            file, stamp = str(motions.file.absolute()), motions.stamp
            note = replace(note, motion=motions.open, motion_file=file, motion_stamp=stamp)
        except LCollisionError as error:
            # The pose is still written.
            too_large = error
    write_poses(folder / _POSES, model, file_poses, working, extra)
    write_bytes(folder / _SESSION, json.dumps(to_json(note)).encode())
    if too_large is not None:
        raise too_large
    return True


def _delete(folder: Path, _: Job) -> bool:
    for name in (_POSES, _SESSION):
        (folder / name).unlink(missing_ok=True)
    return False


FloatArray = npt.NDArray[np.float64]

KEY = "motions"
"""Key of the edits in the poses file of a session."""

MOST_BYTES = 2**24
"""Size limit of the kept codes: about 20 000 frames of 100 codes."""


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
    stamp: FileStamp | None
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
    clip_names: list[str | None] = [None]
    if own_file is not None and own_file.absolute() == file.absolute():
        file, clip_names = own_file, [motion.name for motion in stored.motions]
    read_one = partial(read_motions, body, file, job=job)
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
