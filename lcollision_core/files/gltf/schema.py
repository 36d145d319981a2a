"""A glTF 2.0 file (.glb, .gltf or .vrm), to be read, edited and written."""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import re
import struct
from collections.abc import Iterable, Sequence
from copy import copy, deepcopy
from pathlib import Path
from typing import Any, TypeAlias, TypeVar
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.files.mesh.polygons import MAX_FACES, MAX_FILE_BYTES, MAX_NUMBERS
from lcollision_core.files.safe import read_regular
from lcollision_core.files.scene.transforms import compose, decompose
from lcollision_core.json_values import parse_json, quoted
from lcollision_core.meshes.topology import FloatArray

_VERTEX_DATA, INDICES = 34962, 34963
"""Targets of buffer views: for attributes of vertices, and for faces."""

_GLB_MAGIC = b"glTF"
_MOST_BYTES = (1 << 32) - 1
_MEDIA_TYPES = {b"\x89PNG": "image/png", b"\xff\xd8\xff": "image/jpeg", b"RIFF": "image/webp"}
_OF_ANY_READER = ("image/png", "image/jpeg")
_JSON, _BINARY = b"JSON", b"BIN\0"
_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_CODES = {dtype: code for code, dtype in _DTYPES.items()}
_N_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_TYPES = {width: name for name, width in _N_COMPONENTS.items()}
DRACO = "KHR_draco_mesh_compression"
MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
COMPRESSIONS = {DRACO, *MESHOPT}
"""Extensions that compress meshes; `packed` unpacks them."""

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
"""The parts of a description that are read: objects by key, and lists of one type."""

_KINDS = {dict: "object", str: "text", int: "whole number", float: "number"}

_FREE = ("extras", "extensions")
"""Keys whose values may be anything."""

_CHANGED = ("nodes", "meshes", "scenes", "images", "extensions")
"""Parts of a description that an editable copy may change in any way."""

_ESCAPES = re.compile(rb"(\\[^u]|\\u[dD][89abAB]..\\u[dD][c-fC-F])|\\u[dD][89a-fA-F]..")
"""Escaped characters of JSON, of which the first group is whole."""

_LARGEST = 1e100
"""Largest number in a description, so that products of a few are finite."""

T = TypeVar("T")
_Bytes: TypeAlias = bytes | memoryview


class GltfDocument:
    """A parsed glTF file whose arrays are read on demand.

    Parameters
    ----------
    data : bytes of the file
    path : its path, beside which buffers may lie

    Attributes
    ----------
    path : as given
    sha256 : hash of `data`
    description : the file's JSON, in which the types of objects and lists have been checked, single
        values have not, and nulls are removed
    notes : sentences on what an editable copy lacks

    Raises
    ------
    MeshFileError : the file is truncated or not glTF.
    """

    def __init__(self, data: bytes, path: Path) -> None:
        # Remove a byte order mark.
        text, self._blob = _chunks(data.removeprefix(b"\xef\xbb\xbf"))
        self.path = path
        self.sha256 = hashlib.sha256(data).digest()
        self.notes: tuple[str, ...] = ()
        self._buffers: dict[int, _Bytes] = {}
        self._left = MAX_NUMBERS
        self.description = _parsed(text)
        # In an editable copy, the data in the order in which they are written.
        self._pieces: list[_Bytes] = []

    @classmethod
    def empty(cls, path: Path) -> GltfDocument:
        """Return an editable document without content, for a file beside `path`."""
        asset = {"asset": {"version": "2.0", "generator": "LCollision"}}
        return cls(json.dumps(asset).encode(), path).editable()

    @property
    def has_skin(self) -> bool:
        """Whether a node of the file shows a mesh that a skin moves."""
        return any("skin" in node and "mesh" in node for node in self.objects("nodes"))

    def editable(self) -> GltfDocument:
        """Return a copy to write as GLB, with all data, and images beside the file, in one buffer.

        Read arrays from the original only. A missing image keeps its reference.

        Raises
        ------
        MeshFileError : the file is damaged, possibly in parts that reading ignores.
        """
        other = self.copy()
        description = other.description
        _without_compression(description)
        _require_complete(self)
        starts = [
            other._append(self.buffer(number, f"buffer {number}")) if self.has_buffer(number) else 0
            for number in range(len(self.objects("buffers")))
        ]
        views = description.get("bufferViews", [])
        for number, view in enumerate(views):
            what = f"of buffer view {number}"
            start = starts[
                require_int(view.get("buffer"), f"the buffer {what}", 0, len(starts) - 1)
            ]
            offset = require_int(view.get("byteOffset", 0), f"the offset {what}", 0, MAX_FILE_BYTES)
            views[number] = {**view, "buffer": 0, "byteOffset": start + offset}
        if starts:
            first = {**description["buffers"][0]}
            first.pop("uri", None)
            description["buffers"] = [first]
        for image in description.get("images", []):
            other._embed(image)
        return other

    def copy(self) -> GltfDocument:
        """Return a copy that can be changed independently.

        Its nodes, meshes, scenes, images and extensions may be changed in any way; in other lists,
        objects may be added, removed or replaced, but not changed.
        """
        other = copy(self)
        # Deep copies only where needed: animations may be most of a file.
        other.description = {
            name: deepcopy(entry) if name in _CHANGED else copy(entry)
            for name, entry in self.description.items()
        }
        other._pieces = self._pieces.copy()
        return other

    def described(self, description: dict[str, Any]) -> GltfDocument:
        """Return the same data with another description.

        Raises
        ------
        MeshFileError : it does not have the structure of glTF.
        """
        _remove_nulls(description)
        _require_kind(description, _STRUCTURE, "")
        other = copy(self)
        other.description = description
        return other

    def objects(self, kind: str) -> list[dict[str, Any]]:
        """Return a list of the description, such as "nodes"; empty if the file has none."""
        objects: list[dict[str, Any]] = self.description.get(kind, [])
        return objects

    def array(
        self,
        index: object,
        what: str,
        types: Sequence[str],
        count: int | None = None,
        *,
        again: bool = False,
    ) -> npt.NDArray[Any]:
        """Read an accessor.

        Parameters
        ----------
        index : its index in the file
        what : name in error messages, such as "the positions of mesh 3"
        types : allowed types, such as "SCALAR" or "VEC3"
        count : required number of elements
        again : whether it was read before, and so is already counted towards `MAX_NUMBERS`

        Returns
        -------
        (n, k) array in the type of the file; normalised integers become float64 up to 1

        Raises
        ------
        MeshFileError : a number of the description is wrong, or points outside the data.
        """
        accessor = require_element(self.objects("accessors"), index, f"accessor of {what}")
        kind: Any = accessor.get("type")
        if kind not in types:
            raise MeshFileError.must_be(what, " or ".join(types), quoted(kind))
        n = require_int(accessor.get("count"), f"the count of {what}", 0, MAX_FACES * 3)
        if count is not None and n != count:
            raise MeshFileError(f"have {n} values, {count} are needed", where=what)
        dtype = component_dtype(accessor.get("componentType"), what)
        width = _N_COMPONENTS[kind]
        self._left -= 0 if again else n * width
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
        """Insert the sparse values of an accessor."""
        n = require_int(sparse.get("count"), f"the sparse count of {what}", 0, len(values))
        if not sparse.keys() >= {"indices", "values"}:
            raise MeshFileError("lack their sparse indices or values", where=what)
        dtype = component_dtype(sparse["indices"].get("componentType"), what)
        places = self._view(sparse["indices"], what, n, 1, dtype)[:, 0]
        if n and not (dtype.kind == "u" and places.max() < len(values)):
            raise MeshFileError("have sparse indices out of range", where=what)
        values[places] = self._view(sparse["values"], what, n, values.shape[1], values.dtype)
        return values

    def _view(
        self, stored: dict[str, Any], what: str, n: int, width: int, dtype: np.dtype[Any]
    ) -> npt.NDArray[Any]:
        """Return (n, width) numbers of the buffer view of an object, without copying."""
        view = require_element(
            self.objects("bufferViews"), stored.get("bufferView"), f"buffer view of {what}"
        )
        content = self.bytes_of(view, what)
        length = len(content)
        inside = require_int(stored.get("byteOffset", 0), f"the offset of {what}", 0, length)
        size = width * dtype.itemsize
        stride = require_int(view.get("byteStride", size), f"the stride of {what}", size, 1 << 16)
        needed = (n - 1) * stride + size if n else 0
        if inside + needed > length:
            raise MeshFileError(
                f"it is truncated: {what} need {needed} bytes, there are {length - inside}"
            )
        strides = (stride, dtype.itemsize)
        return np.ndarray((n, width), dtype, content if n else b"", inside if n else 0, strides)

    def has_buffer(self, index: object) -> bool:
        """Whether a buffer has bytes; one without stands for compressed data."""
        buffer = require_element(self.objects("buffers"), index, "the buffer")
        return "uri" in buffer or index in self._buffers or (index == 0 and self._blob is not None)

    def add_unpacked(self, data: bytes) -> int:
        """Add a buffer of uncompressed data, and return its index."""
        buffers = self.description.setdefault("buffers", [])
        self._buffers[len(buffers)] = data
        buffers.append({"byteLength": len(data)})
        return len(buffers) - 1

    def buffer(self, index: object, what: str) -> _Bytes:
        """Return the bytes of a buffer, which may be a file beside this one.

        Parameters
        ----------
        index : its index in the file
        what : its content for error messages, such as "the positions of mesh 3"

        Raises
        ------
        MeshFileError : it is missing, too large, or not beside this file.
        """
        buffers = self.objects("buffers")
        number = require_int(index, f"the buffer of {what}", 0, len(buffers) - 1)
        if number not in self._buffers:
            buffer = buffers[number]
            if "uri" in buffer:
                n_bytes = sum(map(len, self._buffers.values()))
                self._buffers[number] = resource(buffer["uri"], self.path, MAX_FILE_BYTES - n_bytes)
            elif number == 0 and self._blob is not None:
                self._buffers[number] = self._blob
            else:
                raise MeshFileError(f"it has no data for {what}")
        return self._buffers[number]

    def bytes_of(self, stored: dict[str, Any], what: str) -> memoryview:
        """View the bytes of an object with the fields of a buffer view; raises as `buffer`."""
        buffer = self.buffer(stored.get("buffer"), what)
        start = require_int(stored.get("byteOffset", 0), f"the offset of {what}", 0, len(buffer))
        most = len(buffer) - start
        length = require_int(stored.get("byteLength"), f"the length of {what}", 0, most)
        return memoryview(buffer)[start : start + length]

    def image(self, described: dict[str, Any], what: str) -> bytes:
        """Return the bytes of an image file, which is in this file or beside it.

        Parameters
        ----------
        described : description of the image
        what : name in error messages, such as "image 3"

        Raises
        ------
        MeshFileError : it is missing, too large, or not beside this file.
        """
        if "uri" in described:
            return resource(described["uri"], self.path, MAX_FILE_BYTES, what)
        views, index = self.objects("bufferViews"), described.get("bufferView")
        view = require_element(views, index, f"the buffer view of {what}")
        return bytes(self.bytes_of(view, what))

    def _embed(self, image: dict[str, Any]) -> None:
        uri = image.get("uri")
        if not isinstance(uri, str) or uri.startswith("data:"):
            return
        try:
            content = resource(uri, self.path, MAX_FILE_BYTES - self._size)
        except MeshFileError:
            # It is missing beside the source already.
            content = b""
        media_type = _media_type(content)
        if media_type is None:
            self.notes += (f"texture {quoted(uri)} was not embedded; keep it beside the export",)
            return
        del image["uri"]
        image["bufferView"] = self._add_view(content)
        image["mimeType"] = media_type

    def add_image(self, content: bytes) -> int | None:
        """Add an image file to an editable document; return None if its format is not allowed."""
        media_type = _media_type(content)
        if media_type not in _OF_ANY_READER:
            return None
        images = self.description.setdefault("images", [])
        images.append({"bufferView": self._add_view(content), "mimeType": media_type})
        return len(images) - 1

    @property
    def _size(self) -> int:
        return sum(map(len, self._pieces))

    def _append(self, content: _Bytes) -> int:
        start = self._size
        self._pieces += [content, bytes(-len(content) % 4)]
        return start

    def _add_view(self, content: bytes, **fields: int) -> int:
        views = self.description.setdefault("bufferViews", [])
        start = self._append(content)
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(content), **fields})
        return len(views) - 1

    def add_array(
        self, values: npt.NDArray[Any], *, has_bounds: bool = False, target: int | None = None
    ) -> int:
        """Add an accessor of (n, k) numbers to an editable document, k from 1 to 4, or 16.

        Parameters
        ----------
        values : unsigned integers of 1, 2 or 4 bytes keep their type, all else is stored as
            float32; 16 numbers are a column-major matrix
        has_bounds : whether to store the minimum and maximum, as required for positions and times
        target : `INDICES` for faces; see `add_vertex_data` for attributes of vertices

        Returns
        -------
        its index
        """
        dtype = values.dtype.newbyteorder("<") if values.dtype.kind == "u" else np.dtype("<f4")
        stored = values.astype(dtype)
        fields = {} if target is None else {"target": target}
        accessor: dict[str, Any] = {
            "bufferView": self._add_view(stored.tobytes(), **fields),
            "componentType": _CODES[stored.dtype.str.replace("|", "<")],
            "count": len(stored),
            "type": _TYPES[stored.shape[1]],
        }
        if has_bounds and len(stored):
            accessor["min"] = stored.min(axis=0).tolist()
            accessor["max"] = stored.max(axis=0).tolist()
        accessors = self.description.setdefault("accessors", [])
        accessors.append(accessor)
        return len(accessors) - 1

    def add_vertex_data(self, values: npt.NDArray[Any], *, has_bounds: bool = False) -> int:
        """Add an attribute of vertices, (n, k): see `add_array`."""
        return self.add_array(values, has_bounds=has_bounds, target=_VERTEX_DATA)

    def add_channel(
        self, animation: dict[str, Any], times: int, node: int, path: str, values: FloatArray
    ) -> None:
        """Add linear keys of a node's property to an animation with `channels` and `samplers`.

        Parameters
        ----------
        times : the accessor of the T times
        values : (T, k) array
        """
        samplers = animation["samplers"]
        target = {"node": node, "path": path}
        animation["channels"].append({"sampler": len(samplers), "target": target})
        output = self.add_array(values)
        samplers.append({"input": times, "output": output, "interpolation": "LINEAR"})

    def digest(self, key: str) -> str:
        """Return the SHA-256 of everything but the entry `key` of the asset's extras, in hex.

        It is equal for an editable document and the file written from it.
        """
        asset = self.description["asset"]
        extras = {name: value for name, value in asset["extras"].items() if name != key}
        content = self.description | {"asset": asset | {"extras": extras}, "buffers": []}
        digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode())
        for piece in self._pieces or ([] if self._blob is None else [self._blob]):
            digest.update(piece)
        return digest.hexdigest()

    def encoded(self) -> bytes:
        """Return an editable document as the bytes of a GLB file.

        Raises
        ------
        MeshFileError : it is too large for a GLB file.
        """
        n_bytes = self._size
        first = self.description.get("buffers", [{}])[0]
        self.description["buffers"] = [{**first, "byteLength": n_bytes}]
        text = json.dumps(self.description, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        size = 12 + 8 + len(text) + 8 + n_bytes
        if size > _MOST_BYTES:
            raise MeshFileError(f"it would have {size} bytes, GLB files have less than 4 GiB")
        return b"".join(
            (
                struct.pack("<4sII", _GLB_MAGIC, 2, size),
                struct.pack("<I4s", len(text), _JSON),
                text,
                struct.pack("<I4s", n_bytes, _BINARY),
                *self._pieces,
            )
        )


def _of_version_1() -> MeshFileError:
    return MeshFileError("it is glTF 1.0, and only 2.0 is read", "export it as glTF 2.0")


def as_float(values: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Return numbers of a file as float64, without warnings about NaN."""
    with np.errstate(invalid="ignore"):
        return values.astype(np.float64)


def require_element(items: Sequence[T] | None, index: object, what: str) -> T:
    """Return an element of a list of the file, or raise `MeshFileError` if it does not exist."""
    n = len(items or ())
    if items is None or type(index) is not int or not 0 <= index < n:
        raise MeshFileError(f"refers to {what} {quoted(index)}, but has only {n}", where="it")
    return items[index]


def require_int(value: object, what: str, low: int, high: int) -> int:
    """Return an integer of the file, or raise `MeshFileError` if it is out of range."""
    if type(value) is not int or not low <= value <= high:
        raise MeshFileError.must_be(what, f"a whole number from {low} to {high}", quoted(value))
    return value


def numbers(values: object, what: str, count: int) -> npt.NDArray[np.float64]:
    """Return `count` finite numbers of the file as an array, or raise `MeshFileError`."""
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.empty(0)
    if array.shape != (count,) or not (np.abs(array) <= _LARGEST).all():
        raise MeshFileError.must_be(what, f"{count} finite numbers", quoted(values))
    return array


def require_finite(values: npt.NDArray[Any], what: str) -> None:
    """Raise `MeshFileError` if a number of an array is not finite."""
    if not np.isfinite(values).all():
        raise MeshFileError("are not all finite", where=what)


def extension_of(holder: dict[str, Any], name: str) -> dict[str, Any]:
    """Return an extension of an object; empty if it has none."""
    return inner(inner(holder, "extensions"), name)


def inner(holder: dict[str, Any], key: str) -> dict[str, Any]:
    """Return an object in another one; empty if there is none."""
    value = holder.get(key)
    return value if isinstance(value, dict) else {}


def _media_type(content: bytes) -> str | None:
    return next((kind for magic, kind in _MEDIA_TYPES.items() if content.startswith(magic)), None)


def component_dtype(code: object, what: str) -> np.dtype[Any]:
    """Return the dtype for a `componentType`."""
    if type(code) is not int or code not in _DTYPES:
        raise MeshFileError.must_be(f"the type of {what}", "a number of glTF", quoted(code))
    return np.dtype(_DTYPES[code])


def _chunks(data: bytes) -> tuple[bytes, memoryview | None]:
    """Return the text and the binary chunk of a file, the latter without copying."""
    if not data.startswith(_GLB_MAGIC):
        return data, None
    if data[4:8] == b"\1\0\0\0":
        raise _of_version_1()
    chunks: dict[bytes, memoryview] = {}
    at = 12
    while at + 8 <= len(data):
        length = int.from_bytes(data[at : at + 4], "little")
        if at + 8 + length > len(data):
            raise MeshFileError("it is a truncated GLB file")
        chunks.setdefault(data[at + 4 : at + 8], memoryview(data)[at + 8 : at + 8 + length])
        at += 8 + length
    if not chunks.get(_JSON):
        raise MeshFileError("it is a truncated GLB file")
    return bytes(chunks[_JSON]), chunks.get(_BINARY)


def _parsed(text: bytes) -> dict[str, Any]:
    """Parse a description and check that it has the structure of glTF."""
    # A lone surrogate can neither be printed nor be written again.
    text = _ESCAPES.sub(lambda escape: escape[1] or rb"\ufffd", text)
    try:
        values = parse_json(text)
    except ValueError as error:
        raise MeshFileError("it contains no readable glTF description") from error
    asset = values.get("asset") if isinstance(values, dict) else None
    if isinstance(asset, dict) and str(asset.get("version")).partition(".")[0] == "1":
        raise _of_version_1()
    if b"null" in text:
        _remove_nulls(values)
    _require_kind(values, _STRUCTURE, "")
    described: dict[str, Any] = values
    return described


def _remove_nulls(values: Any) -> None:
    """Remove the keys of a description whose value is null."""
    left = [values]
    while left:
        one = left.pop()
        if isinstance(one, dict):
            for key in [key for key, value in one.items() if value is None]:
                del one[key]
            left += [value for key, value in one.items() if key not in _FREE]
        elif isinstance(one, list):
            left += one


def _require_kind(value: Any, kind: Any, where: str) -> None:
    """Refuse a value of a description whose type differs from `_STRUCTURE`."""
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
    for name, entry in kind.items():
        if name in value:
            _require_kind(value[name], entry, f"{name} of {where}" if where else name)


def resource(uri: object, path: Path, most_bytes: int, what: str = "its buffer") -> bytes:
    """Read a data URI, or a regular file in or below the folder of the scene."""
    if not isinstance(uri, str):
        raise MeshFileError.must_be(f"the URI of {what}", "a string", quoted(uri))
    try:
        if uri.startswith("data:"):
            head, comma, content = uri.partition(",")
            if not comma or not head.endswith(";base64"):
                raise ValueError("it is not base64 data")
            return base64.b64decode(content, validate=True)
        name = unquote(uri)
        # Other drives and network addresses.
        if name.startswith("/") or "\\" in name or ":" in name:
            raise ValueError("it is not beside the file")
        folder = path.parent.resolve()
        file = (folder / name).resolve()
        if not file.is_relative_to(folder):
            raise ValueError("it is not beside the file")
        return read_regular(file, most_bytes)
    except (OSError, ValueError, binascii.Error) as error:
        reason = getattr(error, "strerror", None) or str(error)
        advice = "put it beside the file" * isinstance(error, FileNotFoundError)
        raise MeshFileError.unreadable(f"{what} {quoted(uri)}", reason, advice) from error


def _require_complete(document: GltfDocument) -> None:
    """Refuse defects that reading tolerates but writing does not.

    Raises
    ------
    MeshFileError : primitives without attributes, channels without target, or an unknown scene.
    """
    for kind, one, path, name in (
        ("meshes", "mesh", "primitives", "attributes"),
        ("animations", "animation", "channels", "target"),
    ):
        for number, holder in enumerate(document.objects(kind)):
            if not all(name in item for item in holder.get(path, ())):
                raise MeshFileError(f"has {path} without {name}", where=f"{one} {number}")
    last = max(len(document.objects("scenes")) - 1, 0)
    require_int(document.description.get("scene", 0), "the scene", 0, last)


def _without_compression(description: dict[str, Any]) -> None:
    """Remove compressed copies of data that a description also has uncompressed."""
    for holder in (description, *description.get("meshes", ())):
        for kind in ("bufferViews", "buffers", "primitives"):
            if kind in holder:
                holder[kind] = [_plain(entry) for entry in holder[kind]]
    for kind in ("extensionsUsed", "extensionsRequired"):
        named = [name for name in description.pop(kind, ()) if name not in COMPRESSIONS]
        if named:
            description[kind] = named


def _plain(holder: dict[str, Any]) -> dict[str, Any]:
    extensions = holder.get("extensions")
    if not isinstance(extensions, dict) or extensions.keys().isdisjoint(COMPRESSIONS):
        return holder
    kept_extensions = {
        name: extension for name, extension in extensions.items() if name not in COMPRESSIONS
    }
    others = {name: item for name, item in holder.items() if name != "extensions"}
    return others | {"extensions": kept_extensions} if kept_extensions else others


PARTS: dict[str, tuple[float, ...]] = {
    "translation": (0.0, 0.0, 0.0),
    "rotation": (0.0, 0.0, 0.0, 1.0),
    "scale": (1.0, 1.0, 1.0),
}
"""The parts of a node's transform, with their default values."""


def stored_parts(
    node: dict[str, Any], where: str = "a node"
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the translation, rotation (x, y, z, w) and scale of a node of a file.

    Raises
    ------
    MeshFileError : one of them is damaged; the message calls the node `where`.
    """
    if "matrix" in node:
        return decompose(local_transform(node, where))
    moved, turned, scaled = (
        numbers(node.get(name, default), f"the {name} of {where}", len(default))
        for name, default in PARTS.items()
    )
    return moved, turned, scaled


def set_parts(node: dict[str, Any], parts: Iterable[FloatArray]) -> None:
    """Store a translation, rotation and scale in a node, in place of a matrix."""
    node.pop("matrix", None)
    node |= {name: part.tolist() for name, part in zip(PARTS, parts, strict=True)}


def local_transform(node: dict[str, Any], where: str = "a node") -> FloatArray:
    """Return the (4, 4) local transform of a node of a file; raises as `stored_parts` does."""
    if "matrix" not in node:
        return compose(*stored_parts(node, where))
    # Column-major.
    matrix = numbers(node["matrix"], f"the matrix of {where}", 16).reshape(4, 4).T
    matrix[3] = 0.0, 0.0, 0.0, 1.0
    return matrix
