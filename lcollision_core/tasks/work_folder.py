"""The work folder of a learning run: its inputs, progress and checkpoints.

It lies beside the model that the run makes. Any process can read it: the one that learns, the
window that shows its progress, and a later window.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from lcollision_core.bodies.learned_body import (
    WORK_SUFFIX,
    LearnedBody,
    list_models,
    user_models_folder,
    work_path,
)
from lcollision_core.errors import FileLockedError, LCollisionError, MeshFileError, ModelFileError
from lcollision_core.files.formats import MODEL_SUFFIX
from lcollision_core.files.safe import file_stamp, locked, read_regular, write_bytes
from lcollision_core.json_values import from_json, parse_json, to_json
from lcollision_core.learning_state import LearningStatus, RunState, Stage
from lcollision_core.model_file import digest_of
from lcollision_core.options import LearningRequest

_VERSION = 1
_MOST_BYTES = 1_000_000


class WorkFolder:
    """The work folder of one run.

    Parameters
    ----------
    destination : the model file that the run makes

    Attributes
    ----------
    destination : as given
    path : the folder, which may not exist
    name : of the future model
    poses : the training poses, once gathered
    embedding : the model with its latent space, without a predictor
    labels : the store of labelled samples
    log : the error log of the background process
    """

    def __init__(self, destination: Path) -> None:
        self.destination, self.name = destination, destination.stem
        self.path = work_path(destination)
        self.poses, self.embedding = self.path / "poses.npz", self.path / f"embedding{MODEL_SUFFIX}"
        self.labels, self.log = self.path / "labels", self.path / "log.txt"

    @classmethod
    def at(cls, path: Path) -> WorkFolder:
        """Return the work folder at this path."""
        return cls(path.with_name(path.name.removesuffix(WORK_SUFFIX)))

    def checkpoint(self, stage: Stage) -> Path:
        """Return the checkpoint of a stage's training."""
        return self.path / f"{stage.replace(' ', '-')}.checkpoint"

    def prepare(self, request: LearningRequest) -> None:
        """Create the folder for a request, or continue with the existing one.

        Raises
        ------
        ModelFileError : a model of that name exists or is being learned from another request.
        MeshFileError : the folder cannot be written.
        """
        request = stamped(request)
        names = {model.name for model in list_models() if model.bundled}
        is_listed = self.destination.parent == user_models_folder()
        if not self.path.is_dir() and (
            self.destination.exists() or (is_listed and self.name in names)
        ):
            raise self._taken()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise MeshFileError.unwritable(
                self.destination, error, "choose another place for the model"
            ) from error
        with self.lock():
            self.finished_model(request)
            if (self.path / "request.json").exists() and self.request != request:
                # A failed run may change its request before it has poses, or if nearly all samples
                # collided, such as to ignore parts.
                if self.status.mostly_collides:
                    self.keep_only_status()
                elif self.poses.exists() or self.status.state != RunState.FAILED:
                    raise ModelFileError(
                        f"a model {self.name!r} is being learned from other files or options, or "
                        "its files have changed",
                        f"choose another name, or remove {self.path}",
                    )
                (self.path / "status.json").unlink(missing_ok=True)
            self._write("request.json", to_json(request))

    def finished_model(self, request: LearningRequest) -> LearnedBody | None:
        """Return the model made from a request, None if none of that name exists.

        Raises
        ------
        ModelFileError : a model of that name exists but was made from another request.
        """
        if not self.destination.exists():
            return None
        model = LearnedBody.load(self.destination)
        try:
            stored = from_json(LearningRequest, model.card.provenance.get("request"), "request")
        except (ValueError, LCollisionError) as error:
            raise self._taken() from error
        if stored != request:
            raise self._taken()
        return model

    def _taken(self) -> ModelFileError:
        what = f"a model {self.name!r} already exists"
        if not self.destination.exists():
            return ModelFileError(
                f"{what}, which is bundled with the program", "choose another name"
            )
        return ModelFileError(what, "choose another name, or remove it", where=self.destination)

    @property
    def request(self) -> LearningRequest:
        """The request of the run.

        Raises
        ------
        ModelFileError : its file is damaged or missing.
        """
        path = self.path / "request.json"
        try:
            return from_json(LearningRequest, self._read(path), "request")
        except (OSError, ValueError, LCollisionError) as error:
            raise ModelFileError.unreadable(path, error, f"remove {self.path}") from error

    def allow_mostly_colliding(self) -> None:
        """Let a run that stopped because nearly all samples collide continue when resumed.

        Raises
        ------
        ModelFileError : the request is damaged or missing.
        MeshFileError : the folder cannot be written.
        """
        self._write("request.json", to_json(replace(self.request, regardless=True)))

    @property
    def status(self) -> LearningStatus:
        """Progress of the run; stopped if the file is damaged or missing."""
        try:
            return from_json(LearningStatus, self._read(self.path / "status.json"), "status")
        except (OSError, ValueError, LCollisionError):
            return LearningStatus(RunState.STOPPED)

    def write_status(self, status: LearningStatus) -> None:
        """Write the progress of the run, atomically.

        Raises
        ------
        MeshFileError : the disk is full, or the folder is missing.
        """
        self._write("status.json", asdict(status))

    @contextmanager
    def lock(self, wait: float = 5.0) -> Iterator[None]:
        """Lock the run against other processes.

        Raises
        ------
        ModelFileError : another process holds the lock.
        MeshFileError : the lock file cannot be written.
        """
        with ExitStack() as stack:
            try:
                stack.enter_context(locked(self.path / "run", wait))
            except FileLockedError as error:
                raise ModelFileError(
                    f"a model {self.name!r} is being learned by another process",
                    "wait for it, or stop it first",
                ) from error
            yield

    @property
    def is_locked(self) -> bool:
        """Whether a process holds the lock; writes nothing, so it works on a full disk."""
        if not (self.path / ".run.lock").exists():
            return False
        try:
            with self.lock(wait=0.0):
                return False
        except ModelFileError:
            return True
        except MeshFileError:
            return False

    def remove(self) -> None:
        """Remove the folder; the finished model stays."""
        shutil.rmtree(self.path, ignore_errors=True)

    def keep_only_status(self) -> None:
        """Remove everything but the request and the status."""
        for entry in self.path.iterdir():
            if entry.is_dir():
                shutil.rmtree(entry, ignore_errors=True)
            elif entry.name not in ("request.json", "status.json") and entry.name[0] != ".":
                with suppress(OSError):  # On Windows, the log is open while its process lives.
                    entry.unlink(missing_ok=True)

    def _read(self, path: Path) -> Any:
        values = parse_json(read_regular(path, _MOST_BYTES))
        version = values.get("version", _VERSION) if isinstance(values, dict) else _VERSION
        if version != _VERSION:
            raise ModelFileError.too_new(path, version, _VERSION)
        return values

    def _write(self, name: str, values: Mapping[str, Any]) -> None:
        content = json.dumps({"version": _VERSION, **values}, indent=1)
        write_bytes(self.path / name, content.encode())


def stamped(request: LearningRequest) -> LearningRequest:
    """Return the request with the current sizes and times of its sources."""
    return replace(request, stamps=tuple(_stamp(Path(source)) for source in request.sources))


def _stamp(path: Path) -> str:
    """Return a digest that changes with a file or a folder's files; "" if it does not exist."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    stamps = [(file.name, *(file_stamp(file) or ())[2:]) for file in files]
    return digest_of(json.dumps(stamps), {})[:16] if path.exists() else ""


def list_work() -> tuple[WorkFolder, ...]:
    """Return the runs for models in the user's folder, by name."""
    folders = user_models_folder().glob(f"*{MODEL_SUFFIX}{WORK_SUFFIX}")
    return tuple(WorkFolder.at(path) for path in sorted(folders) if path.is_dir())
