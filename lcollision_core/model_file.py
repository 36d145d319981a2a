"""The container of a model: one safetensors file of named sections, with a checksum.

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
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError, ModelFileError
from lcollision_core.files.safe import require_regular, write_bytes
from lcollision_core.json_values import parse_json, quoted

FORMAT_VERSION = 3
"""The version that `write_model_file` stores; older ones are read, later ones are refused.

Version 2 added the latent box to the embedding's section, version 3 the joint exclusion to the
card's rules.
"""

MAX_FILE_BYTES = 4 * 2**30

_METADATA_KEY = "lcollision"
_DTYPES = tuple(map(np.dtype, ("f2", "f4", "f8", "i4", "i8", "u1", "?")))


@dataclass(frozen=True)
class Section:
    """The data of one package in a model file.

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
    """Return an array of a section, checked for its dtype, shape and magnitude.

    Parameters
    ----------
    arrays : arrays of the section by name
    name : name of the array
    dtype, shape : required dtype and shape; None stands for any size but 0
    largest : largest magnitude allowed

    Raises
    ------
    ValueError : the array is missing, or fails one of the checks.
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
    """Write a model file atomically; equal sections give equal bytes.

    Parameters
    ----------
    path : the file to write; its folder must exist
    sections : sections by name; unknown ones are written like any other

    Raises
    ------
    ModelFileError : the file cannot be written, or the format cannot hold a section, for example
        because a number is not finite.
    """
    from safetensors.numpy import save

    tensors = {}
    for section_name, section in sections.items():
        for name, array in section.arrays.items():
            full_name = f"{section_name}/{name}"
            _require_storable(full_name, name, array)
            # ascontiguousarray alone would turn shape () into (1,).
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
            "sha256": digest_of(f"{FORMAT_VERSION}\n{described}\n", tensors),
        }
    )
    encoded = save(tensors, metadata={_METADATA_KEY: document})
    try:
        write_bytes(path, encoded)
    except MeshFileError as error:
        raise ModelFileError.from_error(error) from error


def read_model_file(path: str | os.PathLike[str]) -> dict[str, Section]:
    """Read a model file; no code in it is executed.

    Parameters
    ----------
    path : a file that `write_model_file` wrote

    Returns
    -------
    the sections by name, including unknown ones

    Raises
    ------
    ModelFileError : the file is missing, empty, truncated, damaged, not an LCollision model, of
        a later version, or larger than `MAX_FILE_BYTES`.
    """
    try:
        document, tensors = _read(path)
        described = _canonical_json(document["sections"])
    except (RecursionError, ValueError) as error:  # nested too deeply, or a number not in JSON
        _refuse_damaged(path, error)
    text = f"{document['format_version']}\n{described}\n"
    if digest_of(text, tensors) != document["sha256"]:
        _refuse_damaged(path)
    arrays: dict[str, dict[str, npt.NDArray[Any]]] = {name: {} for name in document["sections"]}
    for full_name, array in tensors.items():
        section_name, _, name = full_name.rpartition("/")
        if section_name not in arrays or array.dtype not in _DTYPES:
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


def read_section(path: str | os.PathLike[str], name: str) -> Section | None:
    """Read a single section of a model file, without verifying the checksum.

    Returns
    -------
    section : None if the file has none of this name

    Raises
    ------
    ModelFileError : the file cannot be read, is not an LCollision model, or is of a later version.
    """
    document, tensors = _read(path, f"{name}/")
    if name not in document["sections"]:
        return None
    arrays = {full_name.removeprefix(f"{name}/"): array for full_name, array in tensors.items()}
    return Section(arrays, document["sections"][name])


def _read(
    path: str | os.PathLike[str], prefix: str = ""
) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    """Read the JSON document, and the tensors whose names begin with `prefix`."""
    from safetensors import SafetensorError, safe_open

    try:
        size = require_regular(path)
        if size > MAX_FILE_BYTES:
            raise ModelFileError(
                f"has {size} bytes, more than the {MAX_FILE_BYTES} of any model",
                "check the name",
                where=path,
            )
        with safe_open(path, "numpy") as file:
            document = _checked_document(file.metadata() or {}, path)
            names = [name for name in file.keys() if name.startswith(prefix)]  # noqa: SIM118 - no mapping
            return document, {name: file.get_tensor(name) for name in names}
    except FileNotFoundError as error:
        raise ModelFileError("does not exist", "check the name", where=path) from error
    except (OSError, ValueError) as error:
        raise ModelFileError.unreadable(path, error, "check the file") from error
    except SafetensorError as error:
        raise ModelFileError(
            "is not an LCollision model, or was truncated or added to",
            "name a file that `lcollision train` wrote, or copy it again",
            where=path,
        ) from error
    except (TypeError, AttributeError) as error:  # a dtype that NumPy lacks
        _refuse_damaged(path, error)


def _checked_document(metadata: Mapping[str, str], path: str | os.PathLike[str]) -> dict[str, Any]:
    if _METADATA_KEY not in metadata:
        raise ModelFileError(
            "is not an LCollision model", "name a file that `lcollision train` wrote", where=path
        )
    try:
        document: dict[str, Any] = parse_json(metadata[_METADATA_KEY].encode())
        version, sections = document["format_version"], document["sections"].values()
        if type(version) is int and version > FORMAT_VERSION:
            raise ModelFileError.too_new(path, quoted(version), FORMAT_VERSION)
        is_sound = type(version) is int and version >= 1 and isinstance(document["sha256"], str)
        if not is_sound or not all(isinstance(section, dict) for section in sections):
            _refuse_damaged(path)
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        _refuse_damaged(path, error)
    return document


def _refuse_damaged(path: str | os.PathLike[str], cause: Exception | None = None) -> NoReturn:
    raise ModelFileError("is damaged", "copy or train the model again", where=path) from cause


def _canonical_json(value: Any) -> str:
    return json.dumps(value, sort_keys=True, allow_nan=False, separators=(",", ":"))


def _require_storable(full_name: str, name: str, array: npt.NDArray[Any]) -> None:
    if "/" in name:
        raise ModelFileError(f"a model cannot hold an array called {name!r}: it has a slash")
    if array.dtype not in _DTYPES:
        raise ModelFileError(
            f"a model cannot hold {full_name} of dtype {array.dtype}", "convert it"
        )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ModelFileError(
            f"a model cannot hold {full_name}: it has a number that is not finite", "train again"
        )


def digest_of(text: str, tensors: Mapping[str, npt.NDArray[Any]]) -> str:
    """Return the SHA-256 of a text and named arrays, independent of their order."""
    return _digest(text, tensors, "\n")


def run_key(arrays: Mapping[str, npt.NDArray[Any]], options: Mapping[str, Any]) -> str:
    """Return a digest that identifies a run, such as of training.

    Parameters
    ----------
    arrays : its data, by name
    options : JSON values
    """
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    return _digest(json.dumps(options, sort_keys=True), contiguous, "")


def _digest(text: str, arrays: Mapping[str, npt.NDArray[Any]], ending: str) -> str:
    digest = hashlib.sha256(text.encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype.str} {array.shape}{ending}".encode())
        digest.update(np.ascontiguousarray(array).data.cast("B") if array.size else b"")
    return digest.hexdigest()
