"""What an interrupted command has done, kept beside its output to resume it."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from app.cli.console import note
from app.wording import counted
from lcollision_core.errors import CancelledError, LCollisionError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from lcollision_core.bodies import Body, NamedPose
    from lcollision_core.options import ResolveOptions

_SECONDS_BETWEEN_WRITES = 5.0
_MAX_STEM_BYTES = 200
_LARGEST_FRACTION = 0.05
"""Fraction of a command's time for writing when there are many poses."""


class UnfinishedPoses:
    """The poses that a command has finished, in an ordinary file of poses beside its output.

    Make one with `unfinished_poses`.

    Attributes
    ----------
    path : the file, "free.partial.json" beside "free.json" or the folder "free"
    finished : what is done, by index: a pose, and JSON values that come with it
    """

    def __init__(self, path: Path, model: Body, key: str, total: int) -> None:
        self.path = path
        self.finished: dict[int, tuple[NamedPose, Mapping[str, Any]]] = {}
        self._model, self._key, self._total = model, key, total
        self._seconds = 0.0
        self._failure = ""
        self._written = time.monotonic()
        if path.exists():
            self._go_on()

    def keep(self, index: int, pose: NamedPose, facts: Mapping[str, Any]) -> None:
        """Remember a pose that is done; write the file when the last time is long past."""
        self.finished[index] = (pose, facts)
        pause = max(_SECONDS_BETWEEN_WRITES, self._seconds / _LARGEST_FRACTION)
        if time.monotonic() - self._written > pause:
            self._write()

    def stop(self) -> None:
        """Write what is done, and say how to go on."""
        if self.finished and self._write():
            again = "run the same command again to continue"
            if len(self.finished) == self._total:
                again = "run the command again when they can be written"
            note(f"stopped; {self.path} has {self._told}, {again}")

    def _write(self) -> bool:
        """Write, or report once why not: a full disk neither ends the command nor hides errors."""
        from lcollision_core.bodies import write_poses

        started = time.monotonic()
        indices = sorted(self.finished)
        record = {
            "key": self._key,
            "of": self._total,
            "done": [{"place": index, **self.finished[index][1]} for index in indices],
        }
        poses = [self.finished[index][0] for index in indices]
        failure = ""
        try:
            write_poses(self.path, self._model, poses, extra={"unfinished": record})
        except LCollisionError as error:
            failure = str(error)
            if failure != self._failure:
                note(failure)
        self._failure, self._written = failure, time.monotonic()
        self._seconds = self._written - started
        return not failure

    def damaged(self) -> LCollisionError:
        """Return the error for a file whose facts are not those that were kept."""
        return LCollisionError("is damaged", "delete it to start again", where=self.path)

    def _go_on(self) -> None:
        from lcollision_core.bodies import read_poses

        poses = read_poses(self.path, self._model)
        record = json.loads(self.path.read_bytes()).get("unfinished")
        if not isinstance(record, dict) or record.get("key") != self._key:
            raise LCollisionError(
                "has poses of another run (model, options, inputs or program differ)",
                "move or delete it, or name another output",
                where=self.path,
            )
        try:
            for pose, facts in zip(poses, record["done"], strict=True):
                self.finished[int(facts.pop("place"))] = (pose, facts)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise self.damaged() from error
        note(f"continuing from {self.path}, which has {self._told}")

    @property
    def _told(self) -> str:
        return f"{len(self.finished)} of {counted(self._total, 'pose')}"


@contextmanager
def unfinished_poses(
    output: Path,
    model: Body,
    arrays: Mapping[str, npt.NDArray[np.generic]],
    options: Mapping[str, Any],
    total: int,
) -> Iterator[UnfinishedPoses]:
    """Keep what is finished beside an output until the block ends, and go on from an earlier run.

    Parameters
    ----------
    output : what the command is to write in the end
    model : of the poses
    arrays, options : all that the results depend on but the program; options are JSON values
    total : how many poses there are to be

    Raises
    ------
    LCollisionError : another command writes to this output, or an earlier one left poses there
        that are not of the same run.
    """
    from importlib.metadata import version

    from lcollision_core.embedding.training_run import run_key
    from lcollision_core.files import locked
    from lcollision_core.files.safe import shortened

    stem = output.stem if output.suffix.lower() == ".json" else output.name
    path = output.with_name(f"{shortened(stem, _MAX_STEM_BYTES)}.partial.json")
    key = run_key(arrays, {**options, "model": model.fingerprint, "version": version("lcollision")})
    with locked(path, wait=0.0):
        held = UnfinishedPoses(path, model, key, total)
        try:
            yield held
        except LCollisionError as error:
            # An error of the command itself would recur next time.
            if isinstance(error, CancelledError) or len(held.finished) == total:
                held.stop()
            else:
                path.unlink(missing_ok=True)
            raise
        except BaseException:
            held.stop()
            raise
        path.unlink(missing_ok=True)


def depends_on(
    model: Body, options: ResolveOptions
) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """Return what a model and options determine of results: arrays, and JSON values."""
    from lcollision_core.bodies import LearnedBody
    from lcollision_core.meshes.face_groups import ignored_faces_digest

    arrays: dict[str, npt.NDArray[Any]] = {"free": model.free_latent}
    for number, pair in enumerate(model.detector.may_touch):
        arrays |= {f"may touch {number} {side}": faces for side, faces in enumerate(pair)}
    metadata: dict[str, Any] = {}
    if isinstance(model, LearnedBody):
        predictor = model.require_predictor().to_section()
        arrays |= {f"predictor/{name}": array for name, array in predictor.arrays.items()}
        metadata = dict(predictor.metadata)
    return arrays, {
        **asdict(options),
        "locked_domains": sorted(options.locked_domains),
        "locked_codes": sorted(options.locked_codes),
        "still_domains": sorted(options.still_domains),
        "predictor": metadata,
        "height": model.body_size,
        "near_exclusion": model.rules.near_exclusion,
        "rules": model.rules.to_json(),
        "ignored_faces": ignored_faces_digest(model.rules, model.groups),
    }
