"""Recovery after a crash: unsaved edits are written every few seconds and found at the next start.

They are the pose and, if it is a frame of a motion, the changed frames of the motions.

Each editor has a session, a folder below `sessions_folder`, locked for as long as its process
runs. However the process ends, the lock ends with it, and the next editor that starts can take
over the session. It never takes over a session that another running editor holds.
"""

from __future__ import annotations

import errno
import json
import logging
import shutil
import time
import uuid
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from PySide6.QtCore import QLockFile, QObject, Signal, Slot

from app.editing.document import PoseDocument
from app.work.kept_motions import KEY, EditedMotions, to_json_values, unreadable_reason
from app.work.threads import Failure, LongWork, Task, guarded, single_shot
from lcollision_core.errors import LCollisionError
from lcollision_core.files import atomic_write
from lcollision_core.files.safe import read_regular, require_regular
from lcollision_core.jobs import Job
from lcollision_core.json_values import parse_json

if TYPE_CHECKING:
    from lcollision_core.bodies import Body, NamedPose
    from lcollision_core.files import FileStamp

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


@dataclass(frozen=True, eq=False)
class RecoverablePose:
    """The unsaved pose of an editor that crashed.

    Attributes
    ----------
    session : locked by this process until it is discarded, released or recovered
    model : the file or the name of its model
    pose_name : of the edited pose
    file : the poses file that it was opened from or saved to
    locked : the locked domains
    saved : when it was last written, in seconds since 1970
    file_stamp : of `file` at that time, None if unknown
    motion : the name of the edited motion that the pose is a frame of, "" for none
    motion_file, motion_stamp : the file that the motion was read from, and its stamp
    """

    session: Session
    model: str
    pose_name: str
    file: Path | None
    locked: tuple[int, ...]
    saved: float
    file_stamp: FileStamp | None = None
    motion: str = ""
    motion_file: Path | None = None
    motion_stamp: FileStamp | None = None

    @property
    def motion_loss_reason(self) -> str:
        """Why the edits of its motion cannot be restored; "" if they can."""
        return unreadable_reason(self.motion_file, self.motion_stamp) if self.motion_file else ""

    @property
    def model_name(self) -> str:
        """The display name of the model."""
        return Path(self.model).stem

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
            description = parse_json(read_regular(folder / _SESSION, _MAX_SESSION_BYTES))
            lost = RecoverablePose(
                session=session,
                model=str(description["model"]),
                pose_name=str(description["pose_name"]),
                file=Path(description["file"]) if description["file"] else None,
                file_stamp=_stamp(description.get("file_stamp")),
                locked=tuple(map(int, description.get("locked", ()))),
                saved=(folder / _POSES).stat().st_mtime,
                motion=str(description.get("motion") or ""),
                motion_file=Path(description["motion_file"])
                if description.get("motion_file")
                else None,
                motion_stamp=_stamp(description.get("motion_stamp")),
            )
            lost_poses.append(lost)
        except (OSError, ValueError, LookupError, TypeError, OverflowError) as error:
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
    """

    failed = Signal(object)
    written = Signal()

    def __init__(
        self,
        document: PoseDocument,
        parent_folder: Path | None = None,
        seconds: float = AUTOSAVE_SECONDS,
    ) -> None:
        super().__init__(document)
        self._document = document
        self._told = False
        self._recovering: RecoverablePose | None = None
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
        document.tasks.recovered.connect(self._on_recovered)

    def recover(self, lost: RecoverablePose) -> None:
        """Load a lost pose into the document, unsaved, and continue its session.

        If its model is gone, emit `PoseDocument.failed` and leave the session unchanged.
        """
        self._recovering = lost
        self._document.tasks.recover(lost.poses_file, lost.model, lost.pose_name, lost.file)

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
        session = {
            "model": document.history.model_file,
            "pose_name": document.history.pose.name,
            "file": str(document.history.file) if document.history.file else None,
            "file_stamp": document.history.file_stamp,
            "locked": sorted(document.motion.locked_domains),
        }
        return partial(
            _write,
            folder,
            session,
            document.model,
            document.history.file_poses,
            document.history.pose,
            document.timeline.edits(),
        )

    @Slot(object, object)
    def _on_recovered(self, poses_file: Path, motions: EditedMotions | None) -> None:
        lost = self._recovering
        if lost is not None and lost.poses_file == poses_file:
            self._recovering = None
            if self._session is not None:
                self._session.discard()
            self._session = lost.session
            self._document.history.file_stamp = lost.file_stamp
            for domain in range(len(self._document.model.domain_names)):
                self._document.motion.set_locked(domain, domain in lost.locked)
            if motions is not None:
                self._document.timeline.restore(motions)

    def _on_written(self, is_kept: bool) -> None:
        if is_kept:
            self._told = False
            self.written.emit()

    @Slot(object)
    def _on_failed(self, failure: Failure) -> None:
        if not self._told:
            self._told = True
            headline = f"Autosave failed ({failure.headline})"
            is_motion = not self._document.timeline.are_saved()
            next_step = "export the motion" if is_motion else "save them to a file"
            self.failed.emit(Failure(headline, next_step, failure.details))


def _stamp(value: list[int] | None) -> FileStamp | None:
    if value is None:
        return None
    device, inode, size, modified = map(int, value)
    return device, inode, size, modified


def _write(
    folder: Path,
    session: dict[str, Any],
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
            file_of, stamp = str(motions.file.absolute()), motions.stamp
            session |= {"motion": motions.open, "motion_file": file_of, "motion_stamp": stamp}
        except LCollisionError as error:
            # The pose is still written.
            too_large = error
    write_poses(folder / _POSES, model, file_poses, working, extra)
    with atomic_write(folder / _SESSION) as file:
        file.write(json.dumps(session).encode())
    if too_large is not None:
        raise too_large
    return True


def _delete(folder: Path, _: Job) -> bool:
    for name in (_POSES, _SESSION):
        (folder / name).unlink(missing_ok=True)
    return False
