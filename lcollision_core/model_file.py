"""The container of a model: one safetensors file of named sections, whole or refused.

A section belongs to one package: arrays and JSON metadata under one name. The file's tensors are
called ``section/array``; its one metadata entry, ``lcollision``, is a JSON document of the format
version, the sections' metadata and a SHA-256 of all of it.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, BinaryIO, NoReturn

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError, ModelFileError
from lcollision_core.json_values import parse_json, quoted
from lcollision_core.meshes.atomic import atomic_write
from lcollision_core.regular_files import open_regular

FORMAT_VERSION = 2
"""The version that `write_model_file` stores; older ones are read, later ones are refused.

Since version 2 the embedding's section has the latent box.
"""

MAX_HEADER_BYTES = 16 * 2**20
MAX_FILE_BYTES = 4 * 2**30

_METADATA_KEY = "lcollision"
_DTYPES = {
    "F16": np.dtype(np.float16),
    "F32": np.dtype(np.float32),
    "F64": np.dtype(np.float64),
    "I32": np.dtype(np.int32),
    "I64": np.dtype(np.int64),
    "U8": np.dtype(np.uint8),
    "BOOL": np.dtype(np.bool_),
}


@dataclass(frozen=True)
class Section:
    """What one package keeps in a model file.

    Attributes
    ----------
    arrays : read-only arrays by name, of float32, float64, int32, int64, uint8 or bool; floats
        are finite, and a name has no slash
    metadata : JSON values by name
    """

    arrays: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "arrays", MappingProxyType(dict(self.arrays)))
        object.__setattr__(self, "metadata", MappingProxyType(dict(self.metadata)))


def required_array(
    arrays: Mapping[str, npt.NDArray[Any]],
    name: str,
    dtype: npt.DTypeLike,
    shape: tuple[int | None, ...],
    largest: float = np.inf,
) -> npt.NDArray[Any]:
    """Return an array of a section that has the type and shape which its package relies on.

    Parameters
    ----------
    arrays : of the section
    name : of the array
    dtype, shape : what it must have; None stands for any size but 0
    largest : the largest magnitude that is allowed

    Raises
    ------
    ValueError : there is none, or it has another type or shape or a larger number.
    """
    array = arrays.get(name)
    if array is None:
        raise ValueError(f"its array {name} is missing")
    fits = array.ndim == len(shape) and all(
        size == wanted or (wanted is None and size > 0)
        for size, wanted in zip(array.shape, shape, strict=True)
    )
    if array.dtype != dtype or not fits:
        needed = " x ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(
            f"its array {name} must be {needed} numbers of {np.dtype(dtype)}, got {array.dtype} "
            f"of shape {quoted(array.shape)}"
        )
    if array.size and largest < np.inf:
        extreme = max(float(array.max()), -float(array.min()))
        if not extreme <= largest:
            raise ValueError(f"its array {name} holds {extreme:.3g}, at most {largest:g} can be")
    return array


def write_model_file(path: str | os.PathLike[str], sections: Mapping[str, Section]) -> None:
    """Write a model file, whole or not at all; equal sections give equal bytes.

    Parameters
    ----------
    path : the file to write; its folder must exist
    sections : by name; sections that this program does not know are written like any other

    Raises
    ------
    ModelFileError : the file cannot be written, or a section holds what the format cannot, such
        as a number that is not finite.
    """
    from safetensors.numpy import save

    tensors = {}
    for section_name, section in sections.items():
        for name, array in section.arrays.items():
            full_name = f"{section_name}/{name}"
            _require_storable(full_name, name, array)
            # ascontiguousarray alone would turn a single number into an array of one.
            tensors[full_name] = np.ascontiguousarray(array).reshape(array.shape)
    try:
        described = _canonical_json(
            {name: dict(section.metadata) for name, section in sections.items()}
        )
    except (TypeError, ValueError) as error:
        raise ModelFileError.unwritable(
            path, f"its metadata is not JSON ({error})", "keep plain values there"
        ) from error
    document = _canonical_json(
        {
            "format_version": FORMAT_VERSION,
            "sections": json.loads(described),
            "sha256": _digest(FORMAT_VERSION, described, tensors),
        }
    )
    encoded = save(tensors, metadata={_METADATA_KEY: document})
    try:
        with atomic_write(path) as file:
            file.write(encoded)
    except MeshFileError as error:
        raise ModelFileError.like(error) from error


def read_model_file(path: str | os.PathLike[str]) -> dict[str, Section]:
    """Read a model file; no code in it is executed.

    Parameters
    ----------
    path : a file that `write_model_file` wrote

    Returns
    -------
    the sections by name, those that this program does not know among them

    Raises
    ------
    ModelFileError : the file is missing, empty, truncated, damaged, not an LCollision model, of
        a later version, or larger than `MAX_FILE_BYTES`.
    """
    try:
        with open_regular(path) as file:
            return _read_open_file(file, path)
    except FileNotFoundError as error:
        raise ModelFileError("does not exist", "check the name", where=path) from error
    except RecursionError as error:
        _refuse_damaged(path, error)
    except (OSError, ValueError) as error:
        raise ModelFileError.unreadable(path, error, "check the file") from error


def read_section(path: str | os.PathLike[str], name: str) -> Section | None:
    """Read one section of a model file and nothing else, without the check of the whole file.

    Returns
    -------
    section : None if the file has none of this name

    Raises
    ------
    ModelFileError : the file cannot be read, is not an LCollision model, or of another version.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with open_regular(path) as file:
            header = _read_header(file, os.fstat(file.fileno()).st_size, path)
        metadata = header.document["sections"].get(name)
        if metadata is None:
            return None
        with safe_open(path, "numpy") as tensors:
            arrays = {
                full_name.removeprefix(f"{name}/"): tensors.get_tensor(full_name)
                for full_name in tensors.keys()  # noqa: SIM118 - no mapping
                if full_name.startswith(f"{name}/")
            }
    except SafetensorError as error:
        _refuse_damaged(path, error)
    except OSError as error:
        raise ModelFileError.unreadable(path, error) from error
    return Section(arrays, metadata)


def _read_open_file(file: BinaryIO, path: str | os.PathLike[str]) -> dict[str, Section]:
    from safetensors import SafetensorError
    from safetensors.numpy import load

    size = os.fstat(file.fileno()).st_size
    if size == 0:
        raise ModelFileError("is empty", "copy or train the model again", where=path)
    if size > MAX_FILE_BYTES:
        raise ModelFileError(
            f"has {size} bytes, more than the {MAX_FILE_BYTES} of any model",
            "check the name",
            where=path,
        )
    # The header first, so that a file of another format is refused before it fills the memory.
    header = _read_header(file, size, path)
    file.seek(0)
    content = file.read()
    if len(content) != size or header.end_of_data != size:
        raise ModelFileError(
            "was truncated or added to",
            "copy or train the model again",
            where=path,
            expected=f"{header.end_of_data} bytes",
            got=len(content),
        )
    try:
        tensors = load(content)
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        _refuse_damaged(path, error)
    del content
    document = header.document
    described = _canonical_json(document["sections"])
    if _digest(document["format_version"], described, tensors) != document["sha256"]:
        _refuse_damaged(path)
    arrays: dict[str, dict[str, npt.NDArray[Any]]] = {name: {} for name in document["sections"]}
    for full_name, array in tensors.items():
        section_name, _, name = full_name.rpartition("/")
        if section_name not in arrays:
            _refuse_damaged(path)
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ModelFileError(
                f"is unusable: its {full_name} holds a number that is not finite",
                "train the model again",
                where=path,
            )
        array.flags.writeable = False
        arrays[section_name][name] = array
    return {
        name: Section(arrays[name], metadata) for name, metadata in document["sections"].items()
    }


@dataclass(frozen=True)
class _Header:
    """The JSON document of a model file, and where its last tensor ends, in bytes."""

    document: dict[str, Any]
    end_of_data: int


def _read_header(file: BinaryIO, size: int, path: str | os.PathLike[str]) -> _Header:
    foreign = ModelFileError(
        "is not an LCollision model", "name a file that `lcollision train` wrote", where=path
    )
    length = int.from_bytes(file.read(8), "little")
    if size < 8 or length > MAX_HEADER_BYTES:
        raise foreign
    text = file.read(length)
    if not text.startswith(b"{"):
        raise foreign
    if len(text) < length:
        raise ModelFileError(
            f"was truncated at {size} bytes", "copy or train the model again", where=path
        )
    try:
        header = parse_json(text)
        metadata = header.pop("__metadata__", {})
        if _METADATA_KEY not in metadata:
            raise foreign
        document = parse_json(metadata[_METADATA_KEY].encode())
        version = document["format_version"]
        if isinstance(version, int) and version > FORMAT_VERSION:
            raise ModelFileError.too_new(path, quoted(version), FORMAT_VERSION)
        if type(version) is not int or version < 1:
            _refuse_damaged(path)
        if not all(isinstance(section, dict) for section in document["sections"].values()):
            _refuse_damaged(path)
        unknown = {tensor["dtype"] for tensor in header.values()} - _DTYPES.keys()
        if unknown or not isinstance(document["sha256"], str):
            _refuse_damaged(path)
        ends = [int(tensor["data_offsets"][1]) for tensor in header.values()]
        if not all(0 <= end <= MAX_FILE_BYTES for end in ends):
            _refuse_damaged(path)
    except (ValueError, TypeError, LookupError, AttributeError, OverflowError) as error:
        _refuse_damaged(path, error)
    return _Header(document, 8 + length + max(ends, default=0))


def _refuse_damaged(path: str | os.PathLike[str], cause: Exception | None = None) -> NoReturn:
    raise ModelFileError("is damaged", "copy or train the model again", where=path) from cause


def _canonical_json(value: Any) -> str:
    return json.dumps(value, sort_keys=True, allow_nan=False, separators=(",", ":"))


def _require_storable(full_name: str, name: str, array: npt.NDArray[Any]) -> None:
    if "/" in name:
        raise ModelFileError(f"a model cannot hold an array called {name!r}: it has a slash")
    if array.dtype not in _DTYPES.values():
        raise ModelFileError(
            f"a model cannot hold {full_name} of dtype {array.dtype}", "convert it"
        )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ModelFileError(
            f"a model cannot hold {full_name}: it has a number that is not finite", "train again"
        )


def _digest(version: int, described: str, tensors: Mapping[str, npt.NDArray[Any]]) -> str:
    """Return the SHA-256 of the file's content, independent of the order of its parts."""
    digest = hashlib.sha256(f"{version}\n{described}\n".encode())
    for name in sorted(tensors):
        array = tensors[name]
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).data.cast("B") if array.size else b"")
    return digest.hexdigest()
