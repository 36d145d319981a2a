"""Progress of long tasks, stored beside their output so that the same command can continue."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy.typing as npt

from lcollision_core import __version__
from lcollision_core.bodies import Body, NamedPose, read_poses, write_poses
from lcollision_core.errors import CancelledError, LCollisionError
from lcollision_core.files import locked
from lcollision_core.files.safe import shortened, write_bytes
from lcollision_core.jobs import Job
from lcollision_core.meshes.face_groups import ignored_faces_digest
from lcollision_core.model_file import run_key
from lcollision_core.options import ResolveOptions
from lcollision_core.tasks.words import counted, say

Arrays = dict[str, npt.NDArray[Any]]
T = TypeVar("T")

_SECONDS_BETWEEN_WRITES = 5.0
_MAX_STEM_BYTES = 200
_LARGEST_FRACTION = 0.05
"""Largest share of a command's time that is spent writing progress."""


class Run(Generic[T]):
    """A command's progress, in a file that the same command continues from.

    Parameters
    ----------
    path : of the file
    key : of everything that the results depend on; a file with another key is refused
    total : number of items
    items : them in words, as in "3 poses"
    read : returns the finished items in the file, by name; None if its key differs
    write : writes a record and the finished items
    job : takes the notes
    pause : least seconds between two writes

    Attributes
    ----------
    done : finished items, by name
    """

    def __init__(
        self,
        path: Path,
        key: str,
        total: int,
        items: str,
        read: Callable[[Path, str], dict[str, T] | None],
        write: Callable[[Path, dict[str, Any], dict[str, T]], None],
        job: Job,
        pause: float,
    ) -> None:
        self.path, self.done = path, dict[str, T]()
        self._key, self._total, self._items, self._job = key, total, items, job
        self._read, self._write_all, self._pause = read, write, pause
        self._seconds, self._failure, self._written = 0.0, "", time.monotonic()

    def begin(self) -> None:
        """Load the progress of an earlier run.

        Raises
        ------
        LCollisionError : the file belongs to another run, or is damaged.
        """
        if not self.path.exists():
            return
        try:
            done = self._read(self.path, self._key)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise self.damaged() from error
        if done is None:
            raise LCollisionError(
                "is of another run (model, options, inputs or program differ)",
                "move or delete it, or name another output",
                where=self.path,
            )
        self.done.update(done)
        if done:
            going_on = say(
                "continuing from {path}, which has {done}", path=self.path, done=self._count
            )
            self._job.note(going_on)

    def keep(self, name: str, item: T) -> None:
        """Add a finished item; write the file if the last write was long ago."""
        self.done[name] = item
        pause = max(self._pause, self._seconds / _LARGEST_FRACTION)
        if time.monotonic() - self._written > pause:
            self._write()

    @property
    def is_complete(self) -> bool:
        """Whether all items are finished."""
        return len(self.done) == self._total

    def stop(self) -> None:
        """Write the progress, and note how to continue."""
        if not (self.done and self._write()):
            return
        stopped = say(
            "stopped; {path} has {done}, run the same command again to continue",
            path=self.path,
            done=self._count,
        )
        self._job.note(stopped)

    def finish(self) -> None:
        """Remove the file, as the output is complete."""
        self.path.unlink(missing_ok=True)

    def damaged(self) -> LCollisionError:
        """Return the error for a damaged file."""
        return LCollisionError("is damaged", "delete it to start again", where=self.path)

    def _write(self) -> bool:
        """Write, or report once why not: a full disk must not end the command or hide errors."""
        started, failure = time.monotonic(), ""
        try:
            self._write_all(self.path, {"key": self._key, "of": self._total}, self.done)
        except LCollisionError as error:
            failure = str(error)
            if failure != self._failure:
                self._job.note(failure)
        self._failure, self._written = failure, time.monotonic()
        self._seconds = self._written - started
        return not failure

    @property
    def _count(self) -> str:
        return say("{n} of {items}", n=len(self.done), items=self._items)


KeptPose = tuple["NamedPose", Mapping[str, Any]]
"""A finished pose, and JSON values that belong to it."""


@contextmanager
def run_of_poses(
    output: Path, body: Body, depends_on: tuple[Arrays, dict[str, Any]], total: int, job: Job
) -> Iterator[Run[KeptPose]]:
    """Keep finished poses beside an output until the block ends, in a pose file.

    Items are named by their index, from 0.

    Parameters
    ----------
    output : the final output of the task
    body : of the poses
    depends_on : everything else that the results depend on, except the program: arrays, and JSON
        values
    total : number of poses
    job : takes the notes

    Raises
    ------
    LCollisionError : another command writes to this output, or an earlier run left poses of other
        inputs there.
    """
    stem = output.stem if output.suffix.lower() == ".json" else output.name
    path = output.with_name(f"{shortened(stem, _MAX_STEM_BYTES)}.partial.json")

    def read(path: Path, key: str) -> dict[str, KeptPose] | None:
        poses = read_poses(path, body)
        record = json.loads(path.read_bytes()).get("unfinished")
        if not isinstance(record, dict) or record.get("key") != key:
            return None
        facts = zip(poses, record["done"], strict=True)
        return {str(int(values.pop("place"))): (pose, values) for pose, values in facts}

    def write(path: Path, record: dict[str, Any], done: dict[str, KeptPose]) -> None:
        names = sorted(done, key=int)
        record["done"] = [{"place": int(name), **done[name][1]} for name in names]
        extra = {"unfinished": record}
        write_poses(path, body, [done[name][0] for name in names], extra=extra)

    key = key_of(body, *depends_on)
    items = counted(total, "pose", "poses")
    run = Run(path, key, total, items, read, write, job, _SECONDS_BETWEEN_WRITES)
    with _kept(run, keeps_failures=False):
        yield run


@contextmanager
def run_of_rows(
    path: Path, key: str, total: int, is_current: Callable[[str, Any], bool], job: Job
) -> Iterator[Run[dict[str, Any]]]:
    """Keep the reports of finished files until the block ends, as JSON.

    Parameters
    ----------
    path, key, total, job : see `Run`; the file is written after each item
    is_current : whether a file's report, given by name and values, is still valid

    Raises
    ------
    LCollisionError : another command writes the file, or it has rows of another run.
    """

    def read(path: Path, key: str) -> dict[str, dict[str, Any]] | None:
        record = json.loads(path.read_bytes())
        if record["key"] != key:
            return None
        return {name: item for name, item in record["done"].items() if is_current(name, item)}

    def write(path: Path, record: dict[str, Any], done: dict[str, dict[str, Any]]) -> None:
        write_bytes(path, json.dumps({**record, "done": done}).encode())

    items = counted(total, "file", "files")
    run = Run(path, key, total, items, read, write, job, pause=-1.0)
    with _kept(run, keeps_failures=True):
        yield run


@contextmanager
def _kept(run: Run[Any], *, keeps_failures: bool) -> Iterator[None]:
    """Lock and load a run's progress; write it if the block fails, and remove it at the end.

    Without `keeps_failures`, an error of the command itself removes it, lest it recur on the next
    run; an interruption, or an error after the last item, does not.
    """
    with locked(run.path, wait=0.0):
        run.begin()
        try:
            yield
        except BaseException as error:
            is_own = isinstance(error, LCollisionError) and not isinstance(error, CancelledError)
            if is_own and not keeps_failures and not run.is_complete:
                run.finish()
            else:
                run.stop()
            raise
        run.finish()


def key_of(body: Body, arrays: Mapping[str, npt.NDArray[Any]], values: Any) -> str:
    """Return the key of a run: of its body, its inputs, and the program's version."""
    of_all = {"model": body.fingerprint, "version": __version__}
    return run_key(arrays, {**values, **of_all})


def depends_on(body: Body, options: ResolveOptions) -> tuple[Arrays, dict[str, Any]]:
    """Return inputs determined by a body and options: arrays, and JSON values."""
    arrays: Arrays = {"free": body.free_latent}
    for number, pair in enumerate(body.detector.may_touch):
        arrays |= {f"may touch {number} {side}": faces for side, faces in enumerate(pair)}
    metadata: dict[str, Any] = {}
    if body.has_predictor:
        predictor = body.require_predictor().to_section()
        arrays |= {f"predictor/{name}": array for name, array in predictor.arrays.items()}
        metadata = dict(predictor.metadata)
    return arrays, {
        **asdict(options),
        "locked_domains": sorted(options.locked_domains),
        "locked_codes": sorted(options.locked_codes),
        "still_domains": sorted(options.still_domains),
        "predictor": metadata,
        "height": body.body_size,
        "near_exclusion": body.rules.near_exclusion,
        "rules": body.rules.to_json(),
        "ignored_faces": ignored_faces_digest(body.rules, body.groups),
    }
