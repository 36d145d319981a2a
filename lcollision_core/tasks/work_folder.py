"""The folder of a run of learning: what it works on, how far it is, and what goes on after a kill.

It stands beside the model that the run is to make, and any process can look into it: the one that
learns, the window that shows how far that is, and a later window.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from lcollision_core.bodies import LearnedBody, list_models, user_models_folder
from lcollision_core.bodies.learned_body import WORK_SUFFIX, work_path
from lcollision_core.errors import (
    HeldElsewhereError,
    LCollisionError,
    MeshFileError,
    ModelFileError,
)
from lcollision_core.files import atomic_write, file_stamp, locked
from lcollision_core.files.safe import read_regular
from lcollision_core.files.table import MODEL_SUFFIX
from lcollision_core.json_values import from_json, parse_json, to_json
from lcollision_core.learning_state import LearningStatus, RunState, Stage
from lcollision_core.model_file import digest_of
from lcollision_core.options import LearningRequest

_VERSION = 1
_MOST_BYTES = 1_000_000


class WorkFolder:
    """The folder of one run.

    Parameters
    ----------
    destination : the model file that the run is to make

    Attributes
    ----------
    destination : as given
    path : the folder, which may not exist
    """

    def __init__(self, destination: Path) -> None:
        self.destination = destination
        self.path = work_path(destination)

    @classmethod
    def at(cls, path: Path) -> WorkFolder:
        """Return the work folder of this path."""
        return cls(path.with_name(path.name.removesuffix(WORK_SUFFIX)))

    @property
    def name(self) -> str:
        """Of the model that it is to be."""
        return self.destination.stem

    @property
    def poses(self) -> Path:
        """The poses to learn from, once they are gathered."""
        return self.path / "poses.npz"

    @property
    def embedding(self) -> Path:
        """The model with its latent space, and no predictor yet."""
        return self.path / f"embedding{MODEL_SUFFIX}"

    @property
    def labels(self) -> Path:
        """The store of labelled samples."""
        return self.path / "labels"

    @property
    def log(self) -> Path:
        """What the process that learns in the background writes on its errors."""
        return self.path / "log.txt"

    def checkpoint(self, stage: Stage) -> Path:
        """Return the checkpoint of a stage's training."""
        return self.path / f"{stage.replace(' ', '-')}.checkpoint"

    def prepare(self, request: LearningRequest) -> None:
        """Make the folder for a request, or go on with the one that is there.

        Raises
        ------
        ModelFileError : there is a model of that name, or another is being learned.
        MeshFileError : it cannot be written.
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
            raise MeshFileError.because(
                self.path, "cannot be made", error, "choose another place for the model"
            ) from error
        with self.held():
            self.made(request)
            if (self.path / "request.json").exists() and self.request != request:
                # What failed before it had poses may be asked for anew, and what failed because
                # nearly all samples collide, as with parts left out.
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

    def made(self, request: LearningRequest) -> LearnedBody | None:
        """Return the model that came of a request, None if there is none of that name.

        Raises
        ------
        ModelFileError : there is a model of that name that did not come of it.
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
        """What the run is to do.

        Raises
        ------
        ModelFileError : it is damaged or missing.
        """
        path = self.path / "request.json"
        try:
            return from_json(LearningRequest, self._read(path), "request")
        except (OSError, ValueError, LCollisionError) as error:
            raise ModelFileError.unreadable(path, error, f"remove {self.path}") from error

    def go_on_regardless(self) -> None:
        """Let a run that stopped because nearly all samples collide go on when it is continued.

        Raises
        ------
        ModelFileError : the request is damaged or missing.
        MeshFileError : it cannot be written.
        """
        self._write("request.json", to_json(replace(self.request, regardless=True)))

    @property
    def status(self) -> LearningStatus:
        """How far the run is; a damaged or missing file says that it has not begun."""
        try:
            return from_json(LearningStatus, self._read(self.path / "status.json"), "status")
        except (OSError, ValueError, LCollisionError):
            return LearningStatus(RunState.STOPPED)

    def tell(self, status: LearningStatus) -> None:
        """Write how far the run is, whole or not at all.

        Raises
        ------
        MeshFileError : the disk is full, or the folder gone.
        """
        self._write("status.json", asdict(status))

    @contextmanager
    def held(self, wait: float = 5.0) -> Iterator[None]:
        """Keep other processes from running the same, for as long as this one lives.

        Raises
        ------
        ModelFileError : another process runs it.
        MeshFileError : it cannot be locked.
        """
        with ExitStack() as stack:
            try:
                stack.enter_context(locked(self.path / "run", wait))
            except HeldElsewhereError as error:
                raise ModelFileError(
                    f"a model {self.name!r} is being learned by another process",
                    "wait for it, or stop it first",
                ) from error
            yield

    @property
    def is_held(self) -> bool:
        """Whether a process is at it; asked without a write, also on a full disk."""
        if not (self.path / ".run.lock").exists():
            return False
        try:
            with self.held(wait=0.0):
                return False
        except ModelFileError:
            return True
        except MeshFileError:
            return False

    def remove(self) -> None:
        """Remove all of it; the model that came of it stays."""
        shutil.rmtree(self.path, ignore_errors=True)

    def keep_only_status(self) -> None:
        """Remove what the run worked on, and keep what it says of itself."""
        for entry in self.path.iterdir():
            if entry.is_dir():
                shutil.rmtree(entry, ignore_errors=True)
            elif entry.name not in ("request.json", "status.json") and entry.name[0] != ".":
                with suppress(OSError):  # on Windows the log is open as long as its process lives
                    entry.unlink(missing_ok=True)

    def _read(self, path: Path) -> Any:
        values = parse_json(read_regular(path, _MOST_BYTES))
        version = values.get("version", _VERSION) if isinstance(values, dict) else _VERSION
        if version != _VERSION:
            raise ModelFileError.too_new(path, version, _VERSION)
        return values

    def _write(self, name: str, values: Mapping[str, Any]) -> None:
        content = json.dumps({"version": _VERSION, **values}, indent=1)
        with atomic_write(self.path / name) as file:
            file.write(content.encode())


def stamped(request: LearningRequest) -> LearningRequest:
    """Return the same request with the sizes and times of its sources as they are now."""
    return replace(request, stamps=tuple(_stamp(Path(source)) for source in request.sources))


def _stamp(path: Path) -> str:
    """Return what changes with a file, or with the files of a folder; "" if there is none."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    stamps = [(file.name, *(file_stamp(file) or ())[2:]) for file in files]
    return digest_of(json.dumps(stamps), {})[:16] if path.exists() else ""


def list_work() -> tuple[WorkFolder, ...]:
    """Return the runs whose models are to be in the user's own folder, by name."""
    folders = user_models_folder().glob(f"*{MODEL_SUFFIX}{WORK_SUFFIX}")
    return tuple(WorkFolder.at(path) for path in sorted(folders) if path.is_dir())
