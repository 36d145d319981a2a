"""The description of a glTF 2.0 file, as .glb, .gltf or .vrm, and the arrays that it points to."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.json_values import parse_json, quoted
from lcollision_core.meshes.formats.polygons import MAX_FACES, MAX_FILE_BYTES
from lcollision_core.regular_files import read_regular

MAX_NUMBERS = 1 << 27
"""The most numbers that are read of all arrays of a file together: 1 GiB as float64."""

_GLB_MAGIC = b"glTF"
_JSON, _BINARY = b"JSON", b"BIN\0"
_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_N_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
DRACO = "KHR_draco_mesh_compression"
COMPRESSIONS = {
    DRACO: "Draco",
    "EXT_meshopt_compression": "meshopt",
    "KHR_meshopt_compression": "meshopt",
}
"""What compresses meshes, by the name of the extension."""

_STRUCTURE: dict[str, Any] = {
    "extensions": {},
    "extensionsUsed": [str],
    "extensionsRequired": [str],
    "accessors": [{"sparse": {"indices": {}, "values": {}}}],
    "animations": [{"channels": [{"target": {}}], "samplers": [{}]}],
    "buffers": [{"extensions": {}}],
    "bufferViews": [{}],
    "images": [{}],
    "materials": [{}],
    "meshes": [
        {"primitives": [{"attributes": {}, "extensions": {}, "targets": [{}]}], "weights": [float]}
    ],
    "samplers": [{}],
    "textures": [{}],
    "nodes": [{"children": [int], "weights": [float], "extensions": {}}],
    "scenes": [{"nodes": [int]}],
    "skins": [{"joints": [int]}],
}
"""What is read of a description: objects by their keys, and lists of one kind."""

_KINDS = {dict: "object", str: "text", int: "whole number", float: "number"}

_FREE = ("extras", "extensions")
"""Keys whose values may be anything."""

_LARGEST = 1e100
"""Largest number of the description; products of a few are finite."""

T = TypeVar("T")


class GltfDocument:
    """A parsed glTF file whose arrays are read when they are asked for.

    Parameters
    ----------
    data : the file's bytes
    path : where it is; buffers may lie beside it

    Attributes
    ----------
    description : the file's JSON, whose objects and lists are where glTF has them; single values
        are unchecked, and a null is none

    Raises
    ------
    MeshFileError : it is truncated, or no glTF.
    """

    def __init__(self, data: bytes, path: Path) -> None:
        # Before a mark the text would not begin with its brace.
        text, self._blob = _chunks(data.removeprefix(b"\xef\xbb\xbf"))
        self._path = path
        self._buffers: dict[int, bytes] = {}
        self._left = MAX_NUMBERS
        self.description = _parsed(text)

    def objects(self, kind: str) -> list[dict[str, Any]]:
        """Return a list of the description, such as "nodes"; empty where the file has none."""
        found: list[dict[str, Any]] = self.description.get(kind, [])
        return found

    def array(
        self, index: object, what: str, types: Sequence[str], count: int | None = None
    ) -> npt.NDArray[Any]:
        """Read an accessor.

        Parameters
        ----------
        index : its number in the file
        what : as in "the positions of mesh 3"
        types : which of "SCALAR", "VEC3" ... it may have
        count : how many elements it must have

        Returns
        -------
        (n, k) array in the type of the file; normalised integers are float64 numbers up to 1

        Raises
        ------
        MeshFileError : a number of the description is wrong, or points outside the data.
        """
        accessor = element(self.objects("accessors"), index, f"accessor of {what}")
        kind: Any = accessor.get("type")
        if kind not in types:
            raise MeshFileError.must_be(what, " or ".join(types), quoted(kind))
        n = whole(accessor.get("count"), f"the count of {what}", 0, MAX_FACES * 3)
        if count is not None and n != count:
            raise MeshFileError(f"have {n} values, {count} are needed", where=what)
        dtype = _dtype(accessor.get("componentType"), what)
        width = _N_COMPONENTS[kind]
        self._left -= n * width
        if self._left < 0:
            raise MeshFileError(
                f"its arrays hold more than {MAX_NUMBERS} numbers", "decimate the meshes"
            )
        if "bufferView" in accessor:
            values = self._view(accessor, what, n, width, dtype)
        else:
            values = np.zeros((n, width), dtype)
        if "sparse" in accessor:
            values = self._with_sparse(values.copy(), accessor["sparse"], what)
        if accessor.get("normalized") and dtype.kind in "iu":
            return np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values

    def _with_sparse(
        self, values: npt.NDArray[Any], sparse: dict[str, Any], what: str
    ) -> npt.NDArray[Any]:
        """Put the values that an accessor stores apart into their places."""
        n = whole(sparse.get("count"), f"the sparse count of {what}", 0, len(values))
        if not sparse.keys() >= {"indices", "values"}:
            raise MeshFileError("lack their sparse indices or values", where=what)
        dtype = _dtype(sparse["indices"].get("componentType"), what)
        places = self._view(sparse["indices"], what, n, 1, dtype)[:, 0]
        if n and not (dtype.kind == "u" and places.max() < len(values)):
            raise MeshFileError("are sparse at places that they do not have", where=what)
        values[places] = self._view(sparse["values"], what, n, values.shape[1], values.dtype)
        return values

    def _view(
        self, stored: dict[str, Any], what: str, n: int, width: int, dtype: np.dtype[Any]
    ) -> npt.NDArray[Any]:
        """Return (n, width) numbers of the buffer view that an object names, nothing copied."""
        view = element(
            self.objects("bufferViews"), stored.get("bufferView"), f"buffer view of {what}"
        )
        buffer = self.buffer(view.get("buffer"), what)
        start = whole(view.get("byteOffset", 0), f"the offset of {what}", 0, len(buffer))
        most = len(buffer) - start
        length = whole(view.get("byteLength"), f"the length of {what}", 0, most)
        inside = whole(stored.get("byteOffset", 0), f"the offset of {what}", 0, length)
        size = width * dtype.itemsize
        stride = whole(view.get("byteStride", size), f"the stride of {what}", size, 1 << 16)
        needed = (n - 1) * stride + size if n else 0
        if inside + needed > length:
            raise MeshFileError(
                f"it is truncated: {what} need {needed} bytes, there are {length - inside}"
            )
        at = start + inside if n else 0
        strides = (stride, dtype.itemsize)
        return np.ndarray((n, width), dtype, buffer if n else b"", at, strides)

    def buffer(self, index: object, what: str) -> bytes:
        """Return the bytes of a buffer, which may be a file beside this one.

        Parameters
        ----------
        index : its number in the file
        what : what is in it, as in "the positions of mesh 3"

        Raises
        ------
        MeshFileError : it is missing, too large, or not beside this file.
        """
        buffers = self.objects("buffers")
        number = whole(index, f"the buffer of {what}", 0, len(buffers) - 1)
        if number not in self._buffers:
            buffer = buffers[number]
            if "uri" in buffer:
                held = sum(map(len, self._buffers.values()))
                self._buffers[number] = resource(buffer["uri"], self._path, MAX_FILE_BYTES - held)
            elif number == 0 and self._blob is not None:
                self._buffers[number] = self._blob
            else:
                for name in COMPRESSIONS.keys() & buffer.get("extensions", {}).keys():
                    raise compressed(name)
                raise MeshFileError(f"it has no data for {what}")
        return self._buffers[number]

    def image(self, described: dict[str, Any], what: str) -> bytes:
        """Return the file of an image, which is in this one or beside it.

        Parameters
        ----------
        described : the image
        what : as in "image 3"

        Raises
        ------
        MeshFileError : it is missing, too large, or not beside this file.
        """
        if "uri" in described:
            return resource(described["uri"], self._path, MAX_FILE_BYTES, what)
        views, index = self.objects("bufferViews"), described.get("bufferView")
        view = element(views, index, f"for {what} the buffer view")
        length = whole(view.get("byteLength"), f"the length of {what}", 0, MAX_FILE_BYTES)
        return self._view(described, what, length, 1, np.dtype("u1")).tobytes()


def compressed(extension: str) -> MeshFileError:
    """Return the error for data that an extension compresses and nothing else holds."""
    return MeshFileError(
        f"its meshes are compressed by {COMPRESSIONS[extension]}, which is not read",
        "export it without compression",
    )


def as_float(values: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Return numbers of a file as float64; a NaN of any kind is none to warn of."""
    with np.errstate(invalid="ignore"):
        return values.astype(np.float64)


def element(items: Sequence[T] | None, index: object, what: str) -> T:
    """Return one of a list of the file, or raise `MeshFileError` where it has none such."""
    n = len(items or ())
    if items is None or type(index) is not int or not 0 <= index < n:
        raise MeshFileError(f"names {what} {quoted(index)}, there are {n}", where="it")
    return items[index]


def whole(value: object, what: str, low: int, high: int) -> int:
    """Return a whole number of the file, or raise `MeshFileError` where it is out of range."""
    if type(value) is not int or not low <= value <= high:
        raise MeshFileError.must_be(what, f"a whole number from {low} to {high}", quoted(value))
    return value


def numbers(values: object, what: str, count: int) -> npt.NDArray[np.float64]:
    """Return a list of finite numbers of the file, or raise `MeshFileError`."""
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.empty(0)
    if array.shape != (count,) or not (np.abs(array) <= _LARGEST).all():
        raise MeshFileError.must_be(what, f"{count} finite numbers", quoted(values))
    return array


def _dtype(code: object, what: str) -> np.dtype[Any]:
    if type(code) is not int or code not in _DTYPES:
        raise MeshFileError.must_be(f"the type of {what}", "a number of glTF", quoted(code))
    return np.dtype(_DTYPES[code])


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """Return the text and the binary part of a file."""
    if not data.startswith(_GLB_MAGIC):
        return data, None
    found: dict[bytes, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        length = int.from_bytes(data[at : at + 4], "little")
        if at + 8 + length > len(data):
            raise MeshFileError("it is a truncated GLB file")
        found.setdefault(data[at + 4 : at + 8], data[at + 8 : at + 8 + length])
        at += 8 + length
    if not found.get(_JSON):
        raise MeshFileError("it is a truncated GLB file")
    return found[_JSON], found.get(_BINARY)


def _parsed(text: bytes) -> dict[str, Any]:
    """Return a description with the structure of glTF."""
    try:
        values = parse_json(text)
    except ValueError as error:
        raise MeshFileError("it contains no readable glTF description") from error
    if b"null" in text:
        _remove_nulls(values)
    _require_kind(values, _STRUCTURE, "")
    described: dict[str, Any] = values
    return described


def _remove_nulls(values: Any) -> None:
    """Remove the keys of a description whose value is null: they say nothing."""
    left = [values]
    while left:
        one = left.pop()
        if isinstance(one, dict):
            for key in [key for key, held in one.items() if held is None]:
                del one[key]
            left += [held for key, held in one.items() if key not in _FREE]
        elif isinstance(one, list):
            left += one


def _require_kind(value: Any, kind: Any, where: str) -> None:
    """Refuse a value of a description that is of another kind than `_STRUCTURE` says."""
    if isinstance(kind, list):
        (each,) = kind
        of = type(each) if isinstance(each, dict) else each
        types = (int, float) if of is float else (of,)
        if not isinstance(value, list) or not all(type(item) in types for item in value):
            raise MeshFileError.must_be(where, f"a list of {_KINDS[of]}s", quoted(value))
        for number, item in enumerate(value if isinstance(each, dict) and each else ()):
            _require_kind(item, each, f"{where} {number}")
        return
    if not isinstance(value, dict):
        raise MeshFileError.must_be(where or "its description", "an object", quoted(value))
    for name, held in kind.items():
        if name in value:
            _require_kind(value[name], held, f"{name} of {where}" if where else name)


def resource(uri: object, path: Path, most_bytes: int, what: str = "its buffer") -> bytes:
    """Read a data URI, or a regular file in the folder of the scene or below it."""
    if not isinstance(uri, str):
        raise MeshFileError.must_be(f"the URI of {what}", "a text", quoted(uri))
    try:
        if uri.startswith("data:"):
            head, comma, content = uri.partition(",")
            if not comma or not head.endswith(";base64"):
                raise ValueError("it is not base64 data")
            return base64.b64decode(content, validate=True)
        name = unquote(uri)
        # Other drives, and addresses, which some systems would look for on the network.
        if name.startswith("/") or "\\" in name or ":" in name:
            raise ValueError("it is not beside the file")
        folder = path.parent.resolve()
        file = (folder / name).resolve()
        if not file.is_relative_to(folder):
            raise ValueError("it is not beside the file")
        return read_regular(file, most_bytes)
    except (OSError, ValueError, binascii.Error) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise MeshFileError.unreadable(f"{what} {quoted(uri)}", reason) from error
