"""Where a training run stands, on disk: written whole, and never code."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import LCollisionError
from lcollision_core.model_file import Section, read_model_file, write_model_file

_SECONDS_BETWEEN_WRITES = 15.0
_RUN = "run"


def run_key(arrays: Mapping[str, npt.NDArray[Any]], options: Mapping[str, Any]) -> str:
    """Return a digest that tells one training run from any other.

    Parameters
    ----------
    arrays : the data trained on, by name
    options : JSON values
    """
    digest = hashlib.sha256(json.dumps(options, sort_keys=True).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


class Checkpoint:
    """The state of a run, by part, kept in one file to resume a killed run from.

    Parameters
    ----------
    path : the file, which need not exist; None keeps nothing
    key : of the run, see `run_key`

    Raises
    ------
    ModelFileError : the file is damaged.
    LCollisionError : the file belongs to another run.
    """

    def __init__(self, path: Path | None, key: str) -> None:
        self._path = path
        self._sections: dict[str, Section] = {_RUN: Section(metadata={"key": key})}
        self._written = time.monotonic()
        if path is not None and path.exists():
            stored = read_model_file(path)
            if _RUN not in stored or stored[_RUN].metadata.get("key") != key:
                raise LCollisionError(
                    "is the checkpoint of another training run (its poses, options or seed differ)",
                    "delete it, or choose another checkpoint",
                    where=path,
                )
            self._sections = stored

    def get(self, part: str) -> Section | None:
        """Return the stored state of a part of the run, None if it has not begun."""
        return self._sections.get(part)

    def put(
        self, part: str, arrays: Mapping[str, npt.NDArray[Any]], metadata: Mapping[str, Any]
    ) -> None:
        """Write the file with the state of a part of the run, whole or not at all."""
        self._sections[part] = Section(arrays, metadata)
        if self._path is not None:
            write_model_file(self._path, self._sections)
        self._written = time.monotonic()

    @property
    def due(self) -> bool:
        """Whether the last write is long past; the state need not be gathered before."""
        late = time.monotonic() - self._written > _SECONDS_BETWEEN_WRITES
        return self._path is not None and late
