"""The description of a glTF 2.0 file, as .glb, .gltf or .vrm, and the arrays that it points to."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.json_values import parse_json, quoted
from lcollision_core.meshes.formats.polygons import MAX_FACES, MAX_FILE_BYTES
from lcollision_core.regular_files import read_regular

if TYPE_CHECKING:
    from pygltflib import GLTF2

MAX_NUMBERS = 1 << 27
"""The most numbers that are read of all arrays of a file together: 1 GiB as float64."""

_GLB_MAGIC = b"glTF"
_JSON, _BINARY = b"JSON", b"BIN\0"
_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_N_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_COMPRESSIONS = {
    "KHR_draco_mesh_compression": "Draco",
    "EXT_meshopt_compression": "meshopt",
    "KHR_meshopt_compression": "meshopt",
}

_LISTS = (
    *("accessors", "animations", "bufferViews", "buffers", "materials", "meshes", "nodes"),
    *("scenes", "skins"),
)
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
    description : of pygltflib; its values are those of the file, unchecked
    node_weights : by the number of a node the weights of its morph targets, unchecked

    Raises
    ------
    MeshFileError : it is truncated, no glTF, or compressed.
    """

    def __init__(self, data: bytes, path: Path) -> None:
        # Before a mark the text would not begin with its brace.
        text, self._blob = chunks(data.removeprefix(b"\xef\xbb\xbf"))
        self._path = path
        self._buffers: dict[int, bytes] = {}
        self._left = MAX_NUMBERS
        self.description, values = _parsed(text)
        # pygltflib leaves out the weights of nodes.
        self.node_weights = {
            number: node["weights"]
            for number, node in enumerate(values.get("nodes") or ())
            if node.get("weights") is not None
        }
        used = {*_texts(self.description.extensionsUsed)}
        used |= {*_texts(self.description.extensionsRequired)}
        for extension, name in _COMPRESSIONS.items():
            if extension in used:
                raise MeshFileError(
                    f"its meshes are compressed by {name}, which is not read",
                    "export it without compression",
                )

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
        accessor = element(self.description.accessors, index, f"accessor of {what}")
        if accessor.type not in types:
            raise MeshFileError.must_be(what, " or ".join(types), quoted(accessor.type))
        n = whole(accessor.count, f"the count of {what}", 0, MAX_FACES * 3)
        if count is not None and n != count:
            raise MeshFileError(f"have {n} values, {count} are needed", where=what)
        dtype = _dtype(accessor.componentType, what)
        width = _N_COMPONENTS[accessor.type]
        self._left -= n * width
        if self._left < 0:
            raise MeshFileError(
                f"its arrays hold more than {MAX_NUMBERS} numbers", "decimate the meshes"
            )
        if accessor.bufferView is None:
            values = np.zeros((n, width), dtype)
        else:
            values = self._view(accessor.bufferView, accessor.byteOffset, what, n, width, dtype)
        if accessor.sparse is not None:
            values = self._with_sparse(values.copy(), accessor.sparse, what)
        if accessor.normalized and dtype.kind in "iu":
            return np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values

    def _with_sparse(self, values: npt.NDArray[Any], sparse: Any, what: str) -> npt.NDArray[Any]:
        """Put the values that an accessor stores apart into their places."""
        n = whole(sparse.count, f"the sparse count of {what}", 0, len(values))
        if sparse.indices is None or sparse.values is None:
            raise MeshFileError("lack their sparse indices or values", where=what)
        where, given = sparse.indices, sparse.values
        dtype = _dtype(where.componentType, what)
        places = self._view(where.bufferView, where.byteOffset, what, n, 1, dtype)[:, 0]
        if n and not (dtype.kind == "u" and places.max() < len(values)):
            raise MeshFileError("are sparse at places that they do not have", where=what)
        values[places] = self._view(
            given.bufferView, given.byteOffset, what, n, values.shape[1], values.dtype
        )
        return values

    def _view(
        self, index: object, offset: object, what: str, n: int, width: int, dtype: np.dtype[Any]
    ) -> npt.NDArray[Any]:
        """Return (n, width) numbers of a buffer view, nothing copied."""
        view = element(self.description.bufferViews, index, f"buffer view of {what}")
        buffer = self._buffer(view.buffer, what)
        start = whole(view.byteOffset or 0, f"the offset of {what}", 0, len(buffer))
        length = whole(view.byteLength, f"the length of {what}", 0, len(buffer) - start)
        inside = whole(offset or 0, f"the offset of {what}", 0, length)
        size = width * dtype.itemsize
        stride = whole(view.byteStride or size, f"the stride of {what}", size, 1 << 16)
        needed = (n - 1) * stride + size if n else 0
        if inside + needed > length:
            raise MeshFileError(
                f"it is truncated: {what} need {needed} bytes, there are {length - inside}"
            )
        at = start + inside if n else 0
        strides = (stride, dtype.itemsize)
        return np.ndarray((n, width), dtype, buffer if n else b"", at, strides)

    def _buffer(self, index: object, what: str) -> bytes:
        number = whole(index, f"the buffer of {what}", 0, len(self.description.buffers) - 1)
        if number not in self._buffers:
            buffer = self.description.buffers[number]
            if buffer.uri is not None:
                held = sum(map(len, self._buffers.values()))
                self._buffers[number] = resource(buffer.uri, self._path, MAX_FILE_BYTES - held)
            elif number == 0 and self._blob is not None:
                self._buffers[number] = self._blob
            else:
                raise MeshFileError(f"it has no data for {what}")
        return self._buffers[number]


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


def _texts(values: object) -> list[str]:
    return [value for value in values if isinstance(value, str)] if isinstance(values, list) else []


def chunks(data: bytes) -> tuple[bytes, bytes | None]:
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


def _parsed(text: bytes) -> tuple[GLTF2, dict[str, Any]]:
    """Return the description, and the same as plain values."""
    from pygltflib import GLTF2

    try:
        values = parse_json(text)
        if not isinstance(values, dict) or _has_empty_place(values):
            raise ValueError("it is no object, or a list in it has an empty place")
        description = GLTF2.gltf_from_json(text.decode("utf-8-sig"))
    # On a damaged description pygltflib raises whatever its line at hand raises; nothing of ours
    # runs here.
    except Exception as error:
        raise MeshFileError("it holds no readable glTF description") from error
    for name in _LISTS:
        if getattr(description, name) is None:
            setattr(description, name, [])
    return description, values


def _has_empty_place(values: dict[str, Any]) -> bool:
    """Whether a list of a document has a null in it; as a value of a key it says nothing."""
    left: list[Any] = [values]
    while left:
        one = left.pop()
        if isinstance(one, dict):
            left += [held for key, held in one.items() if key not in _FREE and held is not None]
        elif isinstance(one, list):
            if None in one:
                return True
            left += [held for held in one if isinstance(held, dict | list)]
    return False


def resource(uri: object, path: Path, most_bytes: int) -> bytes:
    """Read a data URI, or a regular file in the folder of the scene or below it."""
    if not isinstance(uri, str):
        raise MeshFileError.must_be("the URI of its buffer", "a text", quoted(uri))
    try:
        if uri.startswith("data:"):
            head, comma, content = uri.partition(",")
            if not comma or not head.endswith(";base64"):
                raise ValueError("it is no base64 data")
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
        raise MeshFileError.unreadable(f"its buffer {quoted(uri)}", reason) from error
