"""The labelled samples on disk: a Zarr store that survives any interruption.

A Zarr v3 group of one array per column, row i being sample i, cut into chunks of `ROWS_A_CHUNK`
rows. Its attribute ``lcollision`` says what is labelled. The array ``chunks`` is the journal: its
row c is written after chunk c is on disk, and holds the number of rows, how many of them collide,
and the SHA-256 of all columns. What has no journal row does not exist: reading stops before it.
What has one that does not read, or other columns than it says, is damaged: reading refuses it,
labelling does it again.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lcollision_core.errors import LabelStoreError
from lcollision_core.jobs import CancelToken, Progress, no_progress
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
    crc32c,
    create_store,
    description_digest,
)
from lcollision_core.labels.lock import only_writer
from lcollision_core.regular_files import read_regular, require_regular

if TYPE_CHECKING:
    import zarr

_UNREADABLE = (ValueError, TypeError, KeyError, IndexError, RuntimeError, OSError, AttributeError)
"""What Zarr and its codecs raise for files that are missing, cut off or not theirs."""

_MAX_DESCRIPTION_BYTES = 2**20
_COMPRESSION_BYTES = 4096
"""More than this no codec adds to a chunk."""


@dataclass(frozen=True)
class _Chunk:
    """A row of the journal."""

    n_rows: int
    n_colliding: int
    digest: bytes

    def as_bytes(self) -> bytes:
        """Return what the journal's file holds: six words, and their CRC-32C."""
        words = np.array([self.n_rows, self.n_colliding], dtype="<u8").tobytes() + self.digest
        return words + crc32c(words).to_bytes(4, "little")

    @classmethod
    def from_bytes(cls, content: bytes) -> _Chunk | None:
        """Read what `as_bytes` returned; None of a chunk that is being written.

        Raises
        ------
        ValueError : it is damaged.
        """
        words = content[: 8 * JOURNAL_WIDTH]
        if content[len(words) :] != crc32c(words).to_bytes(4, "little"):
            raise ValueError("another checksum")
        if not any(words):
            return None
        n_rows, n_colliding = map(int, np.frombuffer(words, "<u8", count=2))
        if not 0 <= n_colliding <= n_rows <= ROWS_A_CHUNK:
            raise ValueError("no counts")
        return cls(n_rows, n_colliding, words[16:])


@dataclass(frozen=True)
class StoreCheck:
    """What reading all of a store found.

    Attributes
    ----------
    n_rows : rows that read back as they were labelled
    damaged : first and last row of each stretch that does not, or is missing before later ones
    has_checksum : whether the description of what is labelled has one; older stores' has none
    """

    n_rows: int
    damaged: tuple[tuple[int, int], ...]
    has_checksum: bool


class LabelStore:
    """Samples 0 to `n_rows` - 1 of a model's latent box, with their exact labels.

    Open one with `open` to read it; `label_poses` makes and extends them.

    Attributes
    ----------
    path, identity : where it is, and what it labels
    n_wanted : of one that is open to append, the rows that it is to have: those asked for, and all
        that it had where some of them are damaged or missing
    """

    def __init__(
        self,
        path: Path,
        identity: StoreIdentity,
        arrays: Mapping[str, Any],
        has_checksum: bool = True,
    ) -> None:
        self.path = path
        self.identity = identity
        self._arrays = arrays
        self._has_checksum = has_checksum
        self._journal: dict[int, _Chunk] = {}
        self._damaged_chunks: set[int] = set()
        self.n_wanted = 0

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
                n_finished = store.n_finished
                store._drop_unreadable(cancel)
                store.n_wanted = max(n_rows, n_finished if store.n_rows < n_finished else 0)
                store._make_room(store.n_wanted)
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
        """N, the rows up to the first that is missing or has no readable record."""
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
        LabelStoreError : a chunk is damaged, or missing before later ones.
        """
        for chunk in self._leading_chunks():
            yield self._read(chunk)
        self._require_no_more()

    def check(
        self, progress: Progress = no_progress, cancel: CancelToken | None = None
    ) -> StoreCheck:
        """Read everything, and tell what is damaged.

        Parameters
        ----------
        progress : called with (rows read, all rows)
        cancel : polled between chunks

        Raises
        ------
        CancelledError : `cancel` was set.
        """
        damaged, sound, total = [], 0, self.n_finished
        for chunk in range(-(-total // ROWS_A_CHUNK)):
            if cancel is not None:
                cancel.raise_if_cancelled()
            start = chunk * ROWS_A_CHUNK
            wanted = min(ROWS_A_CHUNK, total - start)
            n_rows = self.rows_in_chunk(chunk) if self._reads_back(chunk) else 0
            if n_rows < wanted:
                damaged.append((start + n_rows, start + wanted - 1))
            sound += n_rows
            progress(start + wanted, total)
        return StoreCheck(sound, _joined(damaged), self._has_checksum)

    @property
    def n_finished(self) -> int:
        """Rows up to the end of the last chunk that was ever finished, damaged or not."""
        last = max((*self._journal, *self._damaged_chunks), default=-1)
        if last < 0:
            return 0
        if last in self._journal:
            n_rows = self._journal[last].n_rows
        else:
            asked_for = int(self._arrays["energy"].shape[0]) - last * ROWS_A_CHUNK
            n_rows = min(asked_for, ROWS_A_CHUNK) if asked_for > 0 else ROWS_A_CHUNK
        return last * ROWS_A_CHUNK + n_rows

    def load(self, n_rows: int | None = None) -> LabelRows:
        """Read the first rows into memory, all by default: some 4 D + 8 K + 16 bytes a row.

        Parameters
        ----------
        n_rows : how many, at most those that there are

        Raises
        ------
        LabelStoreError : there are fewer, or a chunk is damaged or missing before later ones.
        """
        wanted = self.n_rows if n_rows is None else n_rows
        if n_rows is None or wanted > self.n_rows:
            self._require_no_more()
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
            journal[chunk] = np.frombuffer(entry.as_bytes(), "<u8", count=JOURNAL_WIDTH)
            _flush(self._chunk_file(JOURNAL, chunk, journal.ndim))
        except OSError as error:
            raise _unwritable(self.path, error) from error
        self._journal[chunk] = entry
        self._damaged_chunks.discard(chunk)

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
            _require_description(path)
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
            checksum = metadata.get("sha256")
            if checksum not in (None, description_digest(metadata["labels"])):
                raise ValueError("another checksum")
            for name in (*columns_of(identity), JOURNAL):
                _require_description(path / name)
            store = cls(path, identity, _open_arrays(group, identity), checksum is not None)
        except _UNREADABLE as error:
            raise LabelStoreError(
                f"{path} is damaged: its description does not fit its arrays; label again in "
                f"another place"
            ) from error
        store._read_journal()
        return store

    def _read_journal(self) -> None:
        """Read the journal's files, those that there are, however many rows it announces.

        Through Zarr each would take some hundred times as long.
        """
        folder = self.path / JOURNAL / "c"
        names = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
        for chunk in (int(name) for name in names if name.isascii() and name.isdecimal()):
            try:
                content = read_regular(self._chunk_file(JOURNAL, chunk, 2), 8 * JOURNAL_WIDTH + 4)
                entry = _Chunk.from_bytes(content)
            except FileNotFoundError:
                continue
            except (OSError, ValueError):
                self._damaged_chunks.add(chunk)
                continue
            if entry is not None:
                self._journal[chunk] = entry

    def _leading_chunks(self) -> Iterator[int]:
        """Give the chunks from 0 on, up to the first that is missing or not full."""
        chunk, full = 0, True
        while full and chunk in self._journal:
            full = self._journal[chunk].n_rows == ROWS_A_CHUNK
            yield chunk
            chunk += 1

    def _require_no_more(self) -> None:
        """Refuse a store with chunks behind one that is missing, not full or damaged."""
        first = self.n_rows
        later = [chunk * ROWS_A_CHUNK for chunk in (*self._journal, *self._damaged_chunks)]
        later = [start for start in later if start >= first]
        if first // ROWS_A_CHUNK in self._damaged_chunks:
            last = min(self.n_finished, (first // ROWS_A_CHUNK + 1) * ROWS_A_CHUNK) - 1
            raise self._damaged(f"rows {first} to {last} are damaged")
        if later:
            raise self._damaged(
                f"rows {first} to {min(later) - 1} are missing, though there are later ones"
            )

    def _read(self, chunk: int) -> LabelRows:
        entry, start = self._journal[chunk], chunk * ROWS_A_CHUNK
        what = f"rows {start} to {start + entry.n_rows - 1} are damaged"
        columns = columns_of(self.identity)
        try:
            for name, column in columns.items():
                most = ROWS_A_CHUNK * column.dtype.itemsize * int(np.prod(column.shape))
                size = require_regular(self._chunk_file(name, chunk, 1 + len(column.shape)))
                if size > most + _COMPRESSION_BYTES:
                    raise ValueError(f"{size} bytes")
            rows = LabelRows(
                **{
                    name: np.asarray(self._arrays[name][start : start + entry.n_rows])
                    for name in columns
                }
            )
            sound = len(rows) == entry.n_rows and chunk_digest(chunk, rows) == entry.digest
        except _UNREADABLE as error:
            raise self._damaged(what) from error
        if not sound:
            raise self._damaged(what)
        _require_finite(rows, f"{self.path} is unusable")
        return rows

    def _reads_back(self, chunk: int) -> bool:
        try:
            return chunk in self._journal and bool(len(self._read(chunk)))
        except LabelStoreError:
            return False

    def _damaged(self, what: str) -> LabelStoreError:
        return LabelStoreError(f"{self.path} is damaged: {what}; {self.repair_advice}")

    @property
    def repair_advice(self) -> str:
        """What to do when it is damaged."""
        seed = f" --seed {self.identity.seed}" if self.identity.seed else ""
        return (
            f"run `lcollision label M -n {self.n_finished} -o {self.path}{seed}` with its model M "
            f"to label them again"
        )

    def _drop_unreadable(self, cancel: CancelToken | None) -> None:
        for chunk in sorted(self._journal):
            if cancel is not None:
                cancel.raise_if_cancelled()
            if not self._reads_back(chunk):
                del self._journal[chunk]
                self._damaged_chunks.add(chunk)
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


def _joined(stretches: Iterable[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """Join stretches of rows that follow each other."""
    joined: list[tuple[int, int]] = []
    for first, last in stretches:
        if joined and joined[-1][1] + 1 == first:
            first = joined.pop()[0]
        joined.append((first, last))
    return tuple(joined)


def _require_description(folder: Path) -> None:
    """Refuse a description that Zarr could not read, or would wait for."""
    size = require_regular(folder / "zarr.json")
    if size > _MAX_DESCRIPTION_BYTES:
        raise ValueError(f"a description of {size} bytes")


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
