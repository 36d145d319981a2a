"""A glTF file again as GLB, some of its description changed and arrays added behind its data."""

from __future__ import annotations

import json
import struct
from copy import copy, deepcopy
from pathlib import Path
from typing import Any

import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.json_values import parse_json, quoted
from lcollision_core.meshes.formats.gltf_document import chunks, resource, whole
from lcollision_core.meshes.formats.polygons import MAX_FILE_BYTES

_MOST_BYTES = (1 << 32) - 1
_FLOAT = 5126
_TYPES = ("SCALAR", "VEC2", "VEC3", "VEC4")
VERTEX_DATA = 34962
"""The target of a buffer view whose numbers are of the vertices of a mesh."""

_MEDIA_TYPES = {b"\x89PNG": "image/png", b"\xff\xd8\xff": "image/jpeg", b"RIFF": "image/webp"}


class GltfPatch:
    """The description of a glTF file as plain values, and its data as one binary chunk.

    Buffers, and images in files beside a .gltf, come into the chunk byte for byte; an image that is
    not there stays named as it was.

    Parameters
    ----------
    data : the file's bytes, which `GltfDocument` has read
    path : where it is; buffers and images may lie beside it

    Attributes
    ----------
    description : the file's JSON, to be changed
    notes : sentences on what is not in the file

    Raises
    ------
    MeshFileError : the file is damaged.
    """

    def __init__(self, data: bytes, path: Path) -> None:
        text, blob = chunks(data.removeprefix(b"\xef\xbb\xbf"))
        self.description: dict[str, Any] = parse_json(text)
        _require_structure(self.description)
        self._binary = bytearray()
        starts = []
        for number, buffer in enumerate(self.description.get("buffers", [])):
            content = blob
            if "uri" in buffer:
                content = resource(buffer["uri"], path, MAX_FILE_BYTES - len(self._binary))
            elif number or blob is None:
                raise MeshFileError(f"it has no data for buffer {number}")
            starts.append(self._append(content or b""))
        for number, view in enumerate(self.description.get("bufferViews", [])):
            what = f"the buffer of buffer view {number}"
            start = starts[whole(view.get("buffer"), what, 0, len(starts) - 1)]
            view["buffer"] = 0
            if start:
                view["byteOffset"] = view.get("byteOffset", 0) + start
        if starts:
            first = self.description["buffers"][0]
            first.pop("uri", None)
            self.description["buffers"] = [first]
        self.notes: tuple[str, ...] = ()
        for image in self.description.get("images", []):
            self._embed(image, path)

    def copy(self) -> GltfPatch:
        """Return the same, to be changed on its own."""
        other = copy(self)
        other.description = deepcopy(self.description)
        other._binary = self._binary.copy()
        return other

    def _embed(self, image: dict[str, Any], path: Path) -> None:
        uri = image.get("uri")
        if not isinstance(uri, str) or uri.startswith("data:"):
            return
        try:
            content = resource(uri, path, MAX_FILE_BYTES - len(self._binary))
        except MeshFileError:
            # Missing beside the source, or elsewhere: it is no more missing afterwards.
            content = b""
        media_type = next(
            (t for magic, t in _MEDIA_TYPES.items() if content.startswith(magic)), None
        )
        if media_type is None:
            self.notes += (
                f"its picture {quoted(uri)} is not in the written file, which looks for it beside "
                "itself",
            )
            return
        del image["uri"]
        image["bufferView"] = self._view(content)
        image["mimeType"] = media_type

    def _append(self, content: bytes) -> int:
        start = len(self._binary)
        self._binary += content + bytes(-len(content) % 4)
        return start

    def _view(self, content: bytes, **fields: int) -> int:
        views = self.description.setdefault("bufferViews", [])
        start = self._append(content)
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(content), **fields})
        return len(views) - 1

    def add_array(
        self, values: npt.NDArray[Any], *, has_bounds: bool = False, target: int | None = None
    ) -> int:
        """Add an accessor of (n, k) float32 numbers, k from 1 to 4, and return its number.

        Parameters
        ----------
        has_bounds : whether it says its least and greatest numbers, as positions and times have to
        target : `VERTEX_DATA` for what the vertices of a mesh have
        """
        stored = values.astype("<f4")
        fields = {} if target is None else {"target": target}
        accessor: dict[str, Any] = {
            "bufferView": self._view(stored.tobytes(), **fields),
            "componentType": _FLOAT,
            "count": len(stored),
            "type": _TYPES[stored.shape[1] - 1],
        }
        if has_bounds:
            accessor["min"] = stored.min(axis=0).tolist()
            accessor["max"] = stored.max(axis=0).tolist()
        accessors = self.description.setdefault("accessors", [])
        accessors.append(accessor)
        return len(accessors) - 1

    def encoded(self) -> bytes:
        """Return the bytes of the GLB file.

        Raises
        ------
        MeshFileError : it is larger than GLB files can be.
        """
        buffers = self.description.setdefault("buffers", [{}])
        buffers[0]["byteLength"] = len(self._binary)
        text = json.dumps(self.description, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        size = 12 + 8 + len(text) + 8 + len(self._binary)
        if size > _MOST_BYTES:
            raise MeshFileError(f"it would have {size} bytes, GLB files have less than 4 GiB")
        return b"".join(
            (
                struct.pack("<4sII", b"glTF", 2, size),
                struct.pack("<I4s", len(text), b"JSON"),
                text,
                struct.pack("<I4s", len(self._binary), b"BIN\0"),
                bytes(self._binary),
            )
        )


_STRUCTURE: dict[str, dict[str, Any]] = {
    "buffers": {},
    "bufferViews": {},
    "accessors": {},
    "images": {},
    "skins": {},
    "scenes": {"nodes": int},
    "nodes": {"children": int, "weights": float},
    "meshes": {"weights": float, "primitives": {"targets": {}}},
    "animations": {"channels": {}},
}
"""Lists that are changed, with what their objects' own lists hold: objects, or numbers."""


def _require_structure(description: dict[str, Any]) -> None:
    """Refuse lists that hold anything else: what reads the file passes over some that are changed.

    Raises
    ------
    MeshFileError : one does.
    """
    _require_lists(description, _STRUCTURE, "the file")
    whole(
        description.get("scene", 0), "the scene", 0, max(len(description.get("scenes", ())) - 1, 0)
    )
    for number, mesh in enumerate(description.get("meshes", ())):
        for primitive in mesh.get("primitives", ()):
            if not isinstance(primitive.get("attributes"), dict):
                raise MeshFileError.must_be(f"the attributes of mesh {number}", "an object", "none")
    for number, animation in enumerate(description.get("animations", ())):
        for channel in animation.get("channels", ()):
            if not isinstance(channel.get("target"), dict):
                raise MeshFileError.must_be(f"a target of animation {number}", "an object", "none")


def _require_lists(held: dict[str, Any], lists: dict[str, Any], where: str) -> None:
    for name, kind in lists.items():
        if name not in held:
            continue
        what, items = f"{name} of {where}", held[name]
        is_objects = isinstance(kind, dict)
        types = (dict,) if is_objects else (int, float) if kind is float else (int,)
        if not isinstance(items, list) or not all(type(item) in types for item in items):
            expected = "a list of objects" if is_objects else "a list of numbers"
            raise MeshFileError.must_be(what, expected, quoted(items))
        for number, item in enumerate(items if is_objects else ()):
            _require_lists(item, kind, f"{name} {number}")
