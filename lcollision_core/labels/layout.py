"""The label store's arrays: what is kept of a row, in which type, and how a store is made."""

from __future__ import annotations

import hashlib
import json
import secrets
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lcollision_core.errors import LabelStoreError
from lcollision_core.labels.identity import StoreIdentity
from lcollision_core.labels.labeller import LabelRows

FORMAT_VERSION = 1
"""The version that stores are written in; later ones are refused."""

ROWS_A_CHUNK = 1024
"""What an interruption may cost; a multiple of `ROWS_A_BLOCK`."""

KIND = "lcollision labels"
"""Tells a label store from other Zarr groups."""

JOURNAL = "chunks"
JOURNAL_WIDTH = 6
"""Numbers of a journal row: rows, colliding rows, and the four words of a SHA-256."""


@dataclass(frozen=True)
class Column:
    """An array of the store: the shape and type of one row, and what stands for no row."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    missing: float


JOURNAL_COLUMN = Column((JOURNAL_WIDTH,), np.dtype(np.uint64), 0)


def columns_of(identity: StoreIdentity) -> dict[str, Column]:
    """Return the store's columns by name, the fields of `LabelRows`."""
    real, whole = np.dtype(np.float64), np.dtype(np.int32)
    return {
        "latent": Column((identity.latent_size,), np.dtype(np.float32), np.nan),
        "domain_energy": Column((identity.n_domains,), real, np.nan),
        "energy": Column((), real, np.nan),
        "n_pairs": Column((), whole, -1),
        "n_near_pairs": Column((), whole, -1),
    }


def create_store(path: Path, identity: StoreIdentity) -> None:
    """Make an empty store under another name, which becomes its own when all of it is there.

    Parameters
    ----------
    path : does not exist, or is an empty folder
    identity : of the rows to come

    Raises
    ------
    LabelStoreError : its folder does not exist.
    OSError : it cannot be written.
    """
    import zarr
    from zarr.codecs import Crc32cCodec

    if not path.parent.is_dir():
        raise LabelStoreError(
            f"{path} cannot be made: there is no folder {path.parent}; create it first"
        )
    unfinished = path.with_name(f".{path.name[:100]}.{secrets.token_hex(6)}.part")
    try:
        group = zarr.open_group(str(unfinished), mode="w", zarr_format=3)
        group.attrs["lcollision"] = {
            "kind": KIND,
            "format_version": FORMAT_VERSION,
            "labels": asdict(identity),
            "sha256": description_digest(asdict(identity)),
        }
        for name, column in columns_of(identity).items():
            group.create_array(
                name,
                shape=(0, *column.shape),
                chunks=(ROWS_A_CHUNK, *column.shape),
                dtype=column.dtype,
                fill_value=column.missing,
                # Uniform numbers do not compress; the energies of free poses are zeros.
                compressors=None if name == "latent" else "auto",
            )
        group.create_array(
            JOURNAL,
            shape=(0, JOURNAL_WIDTH),
            chunks=(1, JOURNAL_WIDTH),
            dtype=JOURNAL_COLUMN.dtype,
            fill_value=0,
            compressors=Crc32cCodec(),
        )
        if path.exists():
            path.rmdir()
        unfinished.rename(path)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def chunk_digest(chunk: int, rows: LabelRows) -> bytes:
    """Return the SHA-256 of a chunk's place, length and columns."""
    digest = hashlib.sha256(f"{chunk} {len(rows)}\n".encode())
    columns = (rows.latent, rows.domain_energy, rows.energy, rows.n_pairs, rows.n_near_pairs)
    for array in columns:
        digest.update(np.ascontiguousarray(array).data.cast("B") if array.size else b"")
    return digest.digest()


def description_digest(labels: Mapping[str, Any]) -> str:
    """Return the SHA-256 of what a store says that it labels, JSON values, as hexadecimal."""
    return hashlib.sha256(json.dumps(labels, sort_keys=True).encode()).hexdigest()


def crc32c(data: bytes) -> int:
    """Return the CRC-32C (Castagnoli) of some bytes, as Zarr appends it."""
    remainder = 0xFFFFFFFF
    for byte in data:
        remainder = _CRC_TABLE[(remainder ^ byte) & 0xFF] ^ (remainder >> 8)
    return remainder ^ 0xFFFFFFFF


def _crc_table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value >> 1) ^ (0x82F63B78 if value & 1 else 0)
        table.append(value)
    return tuple(table)


_CRC_TABLE = _crc_table()
