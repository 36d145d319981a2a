"""The labelled samples on disk: a Zarr store that survives any interruption.

A Zarr v3 group of one array per column, row i being sample i, cut into chunks of `ROWS_A_CHUNK`
rows. Its attribute ``lcollision`` says what is labelled. The array ``chunks`` is the journal: its
row c is written after chunk c is on disk, and holds the number of rows, how many of them collide,
and the SHA-256 of all columns. What has no valid journal row does not exist: reading stops before
it, labelling does it again.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lcollision_core.errors import LabelStoreError
from lcollision_core.jobs import CancelToken
from lcollision_core.labels.identity import StoreIdentity
from lcollision_core.labels.labeller import LabelRows
from lcollision_core.labels.layout import (
    FORMAT_VERSION,
    JOURNAL,
    JOURNAL_COLUMN,
    JOURNAL_WIDTH,
    KIND,
    ROWS_A_CHUNK,
    chunk_digest,
    columns_of,
    create_store,
)
from lcollision_core.labels.lock import only_writer

if TYPE_CHECKING:
    import zarr

_UNREADABLE = (ValueError, TypeError, KeyError, IndexError, RuntimeError, OSError, AttributeError)
"""What Zarr and its codecs raise for files that are missing, cut off or not theirs."""


@dataclass(frozen=True)
class _Chunk:
    """A row of the journal."""

    n_rows: int
    n_colliding: int
    digest: bytes


class LabelStore:
    """Samples 0 to `n_rows` - 1 of a model's latent box, with their exact labels.

    Open one with `open` to read it; `label_poses` makes and extends them.
    """

    def __init__(self, path: Path, identity: StoreIdentity, arrays: Mapping[str, Any]) -> None:
        self.path = path
        self.identity = identity
        self._arrays = arrays
        self._journal: dict[int, _Chunk] = {}

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> LabelStore:
        """Open a store to read it.

        Raises
        ------
        LabelStoreError : there is none, or it is of another program, of a later version, or
            damaged.
        """
        return cls._open(Path(path), "r")

    @classmethod
    @contextmanager
    def open_to_append(
        cls,
        path: str | os.PathLike[str],
        identity: StoreIdentity,
        n_rows: int,
        cancel: CancelToken | None = None,
    ) -> Iterator[LabelStore]:
        """Open a store, made if there is none, and forget chunks that do not read back.

        Until the context ends nobody else can append to it; the store can still be read then.

        Parameters
        ----------
        path : a folder that is a store, or empty, or that does not exist in one that does
        identity : what the store must label
        n_rows : how many rows it is to have room for; never fewer than it has
        cancel : polled while the chunks are read back

        Raises
        ------
        LabelStoreError : as for `open`, or the store labels something else, or cannot be written,
            or another run appends to it.
        CancelledError : `cancel` was set.
        """
        target = Path(path)
        with ExitStack() as held:
            try:
                if not target.exists() or (target.is_dir() and not any(target.iterdir())):
                    create_store(target, identity)
                cls.open(target).require(identity)
                held.enter_context(only_writer(target))
                # Once more: until now another run may have appended.
                store = cls._open(target, "r+")
                store._drop_unreadable(cancel)
                store._make_room(n_rows)
            except OSError as error:
                raise _unwritable(target, error) from error
            yield store

    def require(self, identity: StoreIdentity) -> None:
        """Refuse a store of another model, seed, unit, near exclusion or box.

        Raises
        ------
        LabelStoreError : naming the first difference.
        """
        for name, what in (
            ("model", "the model of fingerprint {}"),
            ("seed", "samples of seed {}"),
            ("near_exclusion", "with a near exclusion of {}"),
            ("height", "with a height of {}"),
        ):
            ours, theirs = getattr(self.identity, name), getattr(identity, name)
            if ours != theirs:
                raise LabelStoreError(
                    f"{self.path} labels {what.format(ours)}, not {what.format(theirs)}; name "
                    "another store, or the model and seed that this one was made with (a model "
                    "whose embedding is trained anew is another)"
                )
        if self.identity != identity:
            raise LabelStoreError(
                f"{self.path} labels another latent box than this program samples; name another "
                f"store"
            )

    @property
    def n_rows(self) -> int:
        """N, the rows up to the first that is missing."""
        return sum(self._journal[chunk].n_rows for chunk in self._leading_chunks())

    def __len__(self) -> int:
        return self.n_rows

    @property
    def n_colliding(self) -> int:
        """How many of the `n_rows` poses intersect themselves."""
        return sum(self._journal[chunk].n_colliding for chunk in self._leading_chunks())

    def rows_in_chunk(self, chunk: int) -> int:
        """Return how many rows a chunk holds: 0 if it was never finished."""
        return self._journal[chunk].n_rows if chunk in self._journal else 0

    def colliding_in_chunk(self, chunk: int) -> int:
        """Return how many rows of a chunk collide."""
        return self._journal[chunk].n_colliding if chunk in self._journal else 0

    def chunks(self) -> Iterator[LabelRows]:
        """Read the rows in order, `ROWS_A_CHUNK` at a time, each checked against its SHA-256.

        Raises
        ------
        LabelStoreError : a chunk is damaged.
        """
        for chunk in self._leading_chunks():
            yield self._read(chunk)

    def load(self, n_rows: int | None = None) -> LabelRows:
        """Read the first rows into memory, all by default: some 4 D + 8 K + 16 bytes a row.

        Parameters
        ----------
        n_rows : how many, at most those that there are

        Raises
        ------
        LabelStoreError : there are fewer, or a chunk is damaged.
        """
        wanted = self.n_rows if n_rows is None else n_rows
        if wanted > self.n_rows:
            raise LabelStoreError(
                f"{self.path} has {self.n_rows} rows, not {wanted}; run `lcollision label` on it "
                f"for more"
            )
        columns = {
            name: np.empty((wanted, *column.shape), column.dtype)
            for name, column in columns_of(self.identity).items()
        }
        start = 0
        for rows in self.chunks() if wanted else ():
            taken = min(len(rows), wanted - start)
            for name, column in columns.items():
                column[start : start + taken] = getattr(rows, name)[:taken]
            start += taken
            if start == wanted:
                break
        return LabelRows(**columns)

    def write_chunk(self, chunk: int, rows: LabelRows) -> None:
        """Put a chunk on disk, then into the journal; until then it counts as not done.

        Parameters
        ----------
        chunk : which; its first row is sample chunk * `ROWS_A_CHUNK`
        rows : at most `ROWS_A_CHUNK`

        Raises
        ------
        LabelStoreError : a label is not finite, or the disk is full.
        """
        _require_finite(rows, f"chunk {chunk} cannot be stored")
        entry = _Chunk(len(rows), int(np.count_nonzero(rows.colliding)), chunk_digest(chunk, rows))
        try:
            journal = self._arrays[JOURNAL]
            journal[chunk] = 0
            start = chunk * ROWS_A_CHUNK
            for name, column in columns_of(self.identity).items():
                array = self._arrays[name]
                # The whole chunk: Zarr would read the rest of it back, and that may be cut off.
                whole = min(ROWS_A_CHUNK, array.shape[0] - start)
                values = np.full((whole, *column.shape), column.missing, column.dtype)
                values[: len(rows)] = getattr(rows, name)
                array[start : start + whole] = values
                _flush(self._chunk_file(name, chunk, array.ndim))
            line = np.array([entry.n_rows, entry.n_colliding], dtype=np.uint64)
            journal[chunk] = np.concatenate([line, np.frombuffer(entry.digest, dtype="<u8")])
            _flush(self._chunk_file(JOURNAL, chunk, journal.ndim))
        except OSError as error:
            raise _unwritable(self.path, error) from error
        self._journal[chunk] = entry

    @classmethod
    def _open(cls, path: Path, mode: str) -> LabelStore:
        import zarr

        foreign = LabelStoreError(
            f"{path} is no label store; name one that `lcollision label` made"
        )
        if not path.exists():
            raise LabelStoreError(
                f"there is no label store {path}; make one with `lcollision label`"
            )
        if not path.is_dir():
            raise foreign
        try:
            group = zarr.open_group(str(path), mode="r+" if mode == "r+" else "r", zarr_format=3)
            metadata: Any = group.attrs.asdict().get("lcollision")
        except _UNREADABLE as error:
            raise foreign from error
        if not isinstance(metadata, dict) or metadata.get("kind") != KIND:
            raise foreign
        version = metadata.get("format_version")
        if isinstance(version, int) and version > FORMAT_VERSION:
            raise LabelStoreError(
                f"{path} has format version {version}, this program reads up to "
                f"{FORMAT_VERSION}; update the program"
            )
        try:
            identity = StoreIdentity.from_metadata(metadata["labels"])
            if version != FORMAT_VERSION:
                raise ValueError(f"version {version}")
            store = cls(path, identity, _open_arrays(group, identity))
        except _UNREADABLE as error:
            raise LabelStoreError(
                f"{path} is damaged: its description does not fit its arrays; label again in "
                f"another place"
            ) from error
        store._journal = store._read_journal()
        return store

    def _read_journal(self) -> dict[int, _Chunk]:
        journal, array = {}, self._arrays[JOURNAL]
        for chunk in range(array.shape[0]):
            try:
                entry = np.asarray(array[chunk], dtype=np.uint64)
            except _UNREADABLE:
                continue  # cut off while it was written
            n_rows = int(entry[0])
            if 0 < n_rows <= ROWS_A_CHUNK:
                journal[chunk] = _Chunk(n_rows, int(entry[1]), entry[2:].astype("<u8").tobytes())
        return journal

    def _leading_chunks(self) -> Iterator[int]:
        """Give the chunks from 0 on, up to the first that is missing or not full."""
        chunk, full = 0, True
        while full and chunk in self._journal:
            full = self._journal[chunk].n_rows == ROWS_A_CHUNK
            yield chunk
            chunk += 1

    def _read(self, chunk: int) -> LabelRows:
        entry, start = self._journal[chunk], chunk * ROWS_A_CHUNK
        what = f"rows {start} to {start + entry.n_rows - 1} are damaged"
        try:
            rows = LabelRows(
                **{
                    name: np.asarray(self._arrays[name][start : start + entry.n_rows])
                    for name in columns_of(self.identity)
                }
            )
            sound = len(rows) == entry.n_rows and chunk_digest(chunk, rows) == entry.digest
        except _UNREADABLE as error:
            raise self._damaged(what) from error
        if not sound:
            raise self._damaged(what)
        _require_finite(rows, f"{self.path} is unusable")
        return rows

    def _damaged(self, what: str) -> LabelStoreError:
        return LabelStoreError(
            f"{self.path}: {what}; run `lcollision label` on it again to mend them"
        )

    def _drop_unreadable(self, cancel: CancelToken | None) -> None:
        for chunk in sorted(self._journal):
            if cancel is not None:
                cancel.raise_if_cancelled()
            try:
                self._read(chunk)
            except LabelStoreError:
                del self._journal[chunk]
        for leftover in self.path.rglob("*.partial"):
            leftover.unlink(missing_ok=True)

    def _make_room(self, n_rows: int) -> None:
        for name in columns_of(self.identity):
            array = self._arrays[name]
            array.resize((max(n_rows, array.shape[0]), *array.shape[1:]))
        journal = self._arrays[JOURNAL]
        journal.resize((max(-(-n_rows // ROWS_A_CHUNK), journal.shape[0]), JOURNAL_WIDTH))

    def _chunk_file(self, name: str, chunk: int, n_axes: int) -> Path:
        return self.path.joinpath(name, "c", str(chunk), *["0"] * (n_axes - 1))


def _open_arrays(group: zarr.Group, identity: StoreIdentity) -> dict[str, Any]:
    arrays: dict[str, Any] = {}
    for name, column in {**columns_of(identity), JOURNAL: JOURNAL_COLUMN}.items():
        array: Any = group[name]
        rows_a_file = 1 if name == JOURNAL else ROWS_A_CHUNK
        found = (array.dtype, array.shape[1:], array.chunks)
        if found != (column.dtype, column.shape, (rows_a_file, *column.shape)):
            raise ValueError(f"{name} is {found}")
        arrays[name] = array
    return arrays


def _require_finite(rows: LabelRows, refusal: str) -> None:
    for name in ("latent", "domain_energy", "energy"):
        if not np.isfinite(getattr(rows, name)).all():
            raise LabelStoreError(
                f"{refusal}: its {name} has a number that is not finite; label again in another "
                f"place"
            )


def _flush(path: Path) -> None:
    """Wait until a file is on disk, so that the journal never runs ahead of the rows."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def _unwritable(path: Path, error: OSError) -> LabelStoreError:
    return LabelStoreError(
        f"{path} cannot be written: {error.strerror or error}; choose another place"
    )
