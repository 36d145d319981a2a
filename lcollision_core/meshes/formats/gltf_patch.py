"""A glTF file again as GLB, some of its description changed and arrays added behind its data."""

from __future__ import annotations

import hashlib
import json
import struct
from copy import copy, deepcopy
from pathlib import Path
from typing import Any

import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.json_values import quoted
from lcollision_core.meshes.formats.gltf_document import GltfDocument, resource, whole
from lcollision_core.meshes.formats.gltf_extensions import without_compression
from lcollision_core.meshes.formats.polygons import MAX_FILE_BYTES

_CHANGED = ("nodes", "meshes", "scenes", "images", "extensions")
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
    document : the file
    path : where it is; images may lie beside it

    Attributes
    ----------
    description : the file's JSON, to be changed: its nodes, meshes, scenes and extensions in any
        way, of its other lists only which objects are in them
    notes : sentences on what is not in the file

    Raises
    ------
    MeshFileError : the file is damaged.
    """

    def __init__(self, document: GltfDocument, path: Path) -> None:
        self.description = _copied(document.description)
        without_compression(self.description)
        _require_complete(document)
        self._binary = bytearray()
        starts = [
            self._append(document.buffer(number, f"buffer {number}"))
            for number in range(len(document.objects("buffers")))
        ]
        views = self.description.get("bufferViews", [])
        for number, view in enumerate(views):
            what = f"of buffer view {number}"
            start = starts[whole(view.get("buffer"), f"the buffer {what}", 0, len(starts) - 1)]
            offset = whole(view.get("byteOffset", 0), f"the offset {what}", 0, MAX_FILE_BYTES)
            views[number] = {**view, "buffer": 0, "byteOffset": start + offset}
        if starts:
            first = {**self.description["buffers"][0]}
            first.pop("uri", None)
            self.description["buffers"] = [first]
        self.notes: tuple[str, ...] = ()
        for image in self.description.get("images", []):
            self._embed(image, path)

    def copy(self) -> GltfPatch:
        """Return the same, to be changed on its own."""
        other = copy(self)
        other.description = _copied(self.description)
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
            self.notes += (f"texture {quoted(uri)} was not embedded; keep it beside the export",)
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
        if has_bounds and len(stored):
            accessor["min"] = stored.min(axis=0).tolist()
            accessor["max"] = stored.max(axis=0).tolist()
        accessors = self.description.setdefault("accessors", [])
        accessors.append(accessor)
        return len(accessors) - 1

    def digest(self, key: str) -> str:
        """Return 64 hexadecimal digits of all but the entry `key` of the extras of its asset."""
        asset = self.description["asset"]
        extras = {name: value for name, value in asset["extras"].items() if name != key}
        held = self.description | {"asset": asset | {"extras": extras}, "buffers": []}
        digest = hashlib.sha256(json.dumps(held, sort_keys=True).encode())
        digest.update(self._binary)
        return digest.hexdigest()

    def encoded(self) -> bytes:
        """Return the bytes of the GLB file.

        Raises
        ------
        MeshFileError : it is larger than GLB files can be.
        """
        first = self.description.get("buffers", [{}])[0]
        self.description["buffers"] = [{**first, "byteLength": len(self._binary)}]
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


def _copied(description: dict[str, Any]) -> dict[str, Any]:
    """Copy a description as deeply as it is changed: most of a file may be its animations."""
    return {
        name: deepcopy(held) if name in _CHANGED else copy(held)
        for name, held in description.items()
    }


def _require_complete(document: GltfDocument) -> None:
    """Refuse what reading passes over and writing needs.

    Raises
    ------
    MeshFileError : primitives without attributes, channels without target, or an unknown scene.
    """
    for kind, one, held, name in (
        ("meshes", "mesh", "primitives", "attributes"),
        ("animations", "animation", "channels", "target"),
    ):
        for number, holder in enumerate(document.objects(kind)):
            if not all(name in item for item in holder.get(held, ())):
                raise MeshFileError(f"has {held} without {name}", where=f"{one} {number}")
    last = max(len(document.objects("scenes")) - 1, 0)
    whole(document.description.get("scene", 0), "the scene", 0, last)
