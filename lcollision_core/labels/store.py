"""The folder of labelled rows: a manifest, and a shard, a NumPy archive, for each chunk of rows.

``labels.json`` identifies the labelled data. ``FIRST-LAST.npz`` holds the columns of `LabelRows`
of the samples FIRST to LAST; FIRST is a multiple of `ROWS_PER_CHUNK`, and of shards with the same
FIRST the longest is used. Rows depend only on the manifest and their indices, and shards are
written atomically: a shard that exists is complete, whoever wrote it. A damaged shard is detected
by the CRC-32 of its arrays, or by samples that do not match its name.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.embedding.bilevel import ROWS_PER_BLOCK
from lcollision_core.errors import LabelStoreError, LCollisionError
from lcollision_core.files.safe import atomic_files, atomic_write, read_npz, read_regular
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.json_values import from_json, parse_json
from lcollision_core.labels.labeller import LabelRows, StoreIdentity
from lcollision_core.model_file import required_array
from lcollision_core.options import SampleDistribution

FORMAT_VERSION = 3
"""The version that stores are written in, and the only one that is read."""

ROWS_PER_CHUNK = 1024
"""Most rows lost by an interruption; a multiple of `ROWS_PER_BLOCK`."""

MANIFEST = "labels.json"
KIND = "lcollision labels"
_CHUNK_NAME = re.compile(r"([0-9]{10})-([0-9]{10})\.npz")
_MAX_MANIFEST_BYTES = 2**20


def chunks_of(n_rows: int) -> Iterator[range]:
    """Yield the rows of each chunk that holds some of the first `n_rows` rows."""
    for first in range(0, n_rows, ROWS_PER_CHUNK):
        yield range(first, min(first + ROWS_PER_CHUNK, n_rows))


class LabelStore:
    """The first samples of a model's latent box, with their exact labels.

    Use `open` to read a store; `label_poses` creates and extends stores.

    Attributes
    ----------
    path, identity : its folder, and the identity of its labels
    """

    def __init__(self, path: Path, identity: StoreIdentity) -> None:
        self.path = path
        self.identity = identity
        self._ends: dict[int, int] = {}
        for file in path.iterdir():
            if name := _CHUNK_NAME.fullmatch(file.name):
                first, last = int(name[1]), int(name[2])
                if first % ROWS_PER_CHUNK == 0 and first <= last < first + ROWS_PER_CHUNK:
                    self._ends[first] = max(self._ends.get(first, 0), last + 1)

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> LabelStore:
        """Open a store.

        Raises
        ------
        LabelStoreError : there is none, it belongs to another program, has another version, or is
            damaged.
        """
        target = Path(path)
        if not target.exists():
            raise LabelStoreError(
                f"there is no label store {path}", "make one with `lcollision label`"
            )
        try:
            manifest = parse_json(read_regular(target / MANIFEST, _MAX_MANIFEST_BYTES))
            is_ours = manifest.get("kind") == KIND
        except (OSError, ValueError, AttributeError):
            is_ours = False
        if not is_ours:
            raise LabelStoreError(
                "is not a label store", "give a folder made by `lcollision label`", where=path
            )
        version = manifest.get("format_version")
        if isinstance(version, int) and version > FORMAT_VERSION:
            raise LabelStoreError.too_new(path, version, FORMAT_VERSION)
        try:
            checksum = manifest.pop("sha256", None)
            if checksum != _digest(manifest) or version != FORMAT_VERSION:
                raise ValueError(f"its {MANIFEST} was changed")
            return cls(target, from_json(StoreIdentity, manifest.get("labels"), "labels"))
        except (OSError, ValueError) as error:
            raise LabelStoreError.because(
                path, "is damaged", error, "label again, into another folder"
            ) from error

    @classmethod
    def draws_of(
        cls, path: str | os.PathLike[str], otherwise: SampleDistribution
    ) -> SampleDistribution:
        """Return how a store's samples are drawn, or `otherwise` if no store can be read.

        `open_or_make` then refuses a store that cannot be read.
        """
        try:
            return cls.open(path).identity.draws
        except LabelStoreError:
            return otherwise

    @classmethod
    def open_or_make(cls, path: str | os.PathLike[str], identity: StoreIdentity) -> LabelStore:
        """Open the store of an identity, or create it if there is none.

        Parameters
        ----------
        path : a store, an empty folder, or a folder to create in one that exists
        identity : that the store must have

        Raises
        ------
        LabelStoreError : as for `open`, or the store has another identity.
        MeshFileError : it cannot be created.
        """
        target = Path(path)
        # A hidden file is the unfinished manifest of another run, alive or killed.
        if not target.exists() or (target.is_dir() and not any(target.glob("[!.]*"))):
            manifest: dict[str, Any] = {
                "kind": KIND,
                "format_version": FORMAT_VERSION,
                "rows_per_chunk": ROWS_PER_CHUNK,
                "labels": asdict(identity),
            }
            manifest["sha256"] = _digest(manifest)
            with atomic_files(target) as folder, atomic_write(folder / MANIFEST) as file:
                file.write(json.dumps(manifest, indent=1).encode())
        store = cls.open(target)
        store.require(identity)
        return store

    def require(self, identity: StoreIdentity) -> None:
        """Check that the store has a model, seed, body size, box and contact rules.

        Raises
        ------
        LabelStoreError : the store has another identity; the message names the first difference.
        """
        for name, what in (
            ("model", "the model of fingerprint {}"),
            ("seed", "samples of seed {}"),
            ("near_exclusion", "with a near exclusion of {}"),
            ("rules", "with the contact rules {}"),
            ("ignored_faces", "with ignored groups of the faces {}"),
            ("height", "with a body size of {}"),
            ("draws", "{} samples"),
        ):
            ours, theirs = getattr(self.identity, name), getattr(identity, name)
            if ours != theirs:
                raise LabelStoreError(
                    f"labels {what.format(ours)}, not {what.format(theirs)}",
                    "name another store, or the model and seed that this one was made with "
                    "(retraining the embedding makes a new model)",
                    where=self.path,
                )
        if self.identity != identity:
            raise LabelStoreError(
                "has labels for a different latent box than the model's",
                "name another store",
                where=self.path,
            )

    @property
    def n_rows(self) -> int:
        """N, the number of rows before the first missing one."""
        n_rows = 0
        while n_rows in self._ends:
            n_rows = self._ends[n_rows]
        return n_rows

    @property
    def end(self) -> int:
        """The index after the last row, even if earlier rows are missing."""
        return max(self._ends.values(), default=0)

    def load(self, n_rows: int | None = None) -> LabelRows:
        """Read the first rows into memory, all by default: about 4 D + 8 K + 16 bytes a row.

        Parameters
        ----------
        n_rows : number of rows, at most `end`

        Raises
        ------
        LabelStoreError : there are fewer, or some of them are damaged or missing.
        """
        return self.read(range(self.end if n_rows is None else n_rows))

    def read(self, rows: range) -> LabelRows:
        """Read consecutive rows from one or more shards.

        Parameters
        ----------
        rows : of step 1, within 0 to `end`

        Raises
        ------
        LabelStoreError : there are no such rows, or some of them are damaged or missing.
        """
        if rows.start < 0 or rows.step != 1:
            raise LabelStoreError.must_be("rows", "a range of step 1 from 0 on", rows)
        if rows.stop > self.end:
            raise LabelStoreError(
                f"has {self.end} rows, not {rows.stop}",
                "run `lcollision label` on it for more",
                where=self.path,
            )
        columns = {
            name: np.empty((len(rows), *shape), dtype)
            for name, (dtype, shape) in self._columns().items()
        }
        for shard in chunks_of(rows.stop):
            first = max(shard.start, rows.start)
            if first < shard.stop:
                labelled = self._read_shard(shard)
                for name, column in columns.items():
                    part = getattr(labelled, name)[first - shard.start : len(shard)]
                    column[first - rows.start : shard.stop - rows.start] = part
        return LabelRows(**columns)

    def _read_shard(self, rows: range) -> LabelRows:
        """Read the longest shard of a chunk, which may have more than the given rows."""
        end = self._ends.get(rows.start, 0)
        if end < rows.stop:
            raise self._unreadable(rows, "missing")
        columns = self._columns()
        try:
            arrays, _ = read_npz(self._file(range(rows.start, end)), [(name,) for name in columns])
            labelled = LabelRows(
                **{
                    name: required_array(arrays, name, dtype, (end - rows.start, *shape))
                    for name, (dtype, shape) in columns.items()
                }
            )
            expected = self.identity.box.draw(self.identity.seed, rows.start // ROWS_PER_BLOCK)
            if not np.array_equal(labelled.latent[0], expected[0]):
                raise ValueError("the rows do not match the file name")
            _require_finite(labelled)
        except (LCollisionError, ValueError) as error:
            raise self._unreadable(rows, "damaged") from error
        return labelled

    def write(self, rows: range, labelled: LabelRows) -> None:
        """Write a chunk atomically.

        Parameters
        ----------
        rows : their indices, starting with the chunk's first
        labelled : these rows

        Raises
        ------
        LabelStoreError : a label is not finite.
        MeshFileError : the file cannot be written.
        """
        _require_finite(labelled)
        with atomic_write(self._file(rows)) as file:
            np.savez(file, **vars(labelled))
        self._ends[rows.start] = max(self._ends.get(rows.start, 0), rows.stop)

    def check(self, job: Job = UNWATCHED) -> tuple[range, ...]:
        """Read all rows and return those that are damaged, or missing before later ones.

        Parameters
        ----------
        job : reports (rows read, all rows); polled between chunks

        Returns
        -------
        damaged : maximal ranges of rows

        Raises
        ------
        CancelledError : the job was cancelled.
        """
        damaged: list[range] = []
        for rows in chunks_of(self.end):
            job.check()
            try:
                self._read_shard(rows)
            except LabelStoreError:
                if damaged and damaged[-1].stop == rows.start:
                    rows = range(damaged.pop().start, rows.stop)
                damaged.append(rows)
            job.report(rows.stop, self.end)
        return tuple(damaged)

    @property
    def repair_advice(self) -> str:
        """Advice for a damaged store."""
        seed = f" --seed {self.identity.seed}" if self.identity.seed else ""
        return (
            f"run `lcollision label M -n {self.end} -o {self.path}{seed}` with its model M to "
            f"label them again"
        )

    def _unreadable(self, rows: range, how: str) -> LabelStoreError:
        return LabelStoreError(
            f"is damaged: rows {rows[0]} to {rows[-1]} are {how}",
            self.repair_advice,
            where=self.path,
        )

    def _file(self, rows: range) -> Path:
        return self.path / f"{rows[0]:010}-{rows[-1]:010}.npz"

    def _columns(self) -> dict[str, tuple[npt.DTypeLike, tuple[int, ...]]]:
        """Return the type of each column of `LabelRows`, and the shape of its rows."""
        return {
            "latent": (np.float32, (len(self.identity.box_low),)),
            "domain_energy": (np.float64, (self.identity.n_domains,)),
            "energy": (np.float64, ()),
            "n_pairs": (np.int32, ()),
        }


def _digest(manifest: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()


def _require_finite(labelled: LabelRows) -> None:
    for name in ("latent", "domain_energy", "energy"):
        if not np.isfinite(getattr(labelled, name)).all():
            raise LabelStoreError(
                f"the {name} of a labelled pose is not finite", "train the model again"
            )
