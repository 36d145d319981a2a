"""Unpack the compressed data of a glTF file, so that it can be read like any other."""

from __future__ import annotations

from typing import Any

import numpy as np

from lcollision_core.errors import MeshFileError, MissingExtraError
from lcollision_core.files.gltf.meshopt import decode
from lcollision_core.files.gltf.schema import (
    DRACO,
    MESHOPT,
    GltfDocument,
    component_dtype,
    extension_of,
    inner,
    require_element,
    require_int,
)
from lcollision_core.files.mesh.polygons import MAX_FACES, MAX_FILE_BYTES

_MOST_STRIDE = 256


def unpack(document: GltfDocument) -> None:
    """Add uncompressed copies of the buffer views and primitives that lack them.

    Raises
    ------
    MeshFileError : compressed data are damaged.
    MissingExtraError : data are compressed by Draco, and DracoPy is not installed.
    """
    for number, view in enumerate(document.objects("bufferViews")):
        compression = next((one for name in MESHOPT if (one := extension_of(view, name))), None)
        if compression is not None and not document.has_buffer(view.get("buffer")):
            data = _meshopt(document, compression, f"buffer view {number}")
            plain = {"buffer": document.add_unpacked(data), "byteLength": len(data)}
            view_fields = {
                name: view[name] for name in ("byteStride", "target", "name") if name in view
            }
            document.objects("bufferViews")[number] = view_fields | plain
    unpacked: dict[int, Any] = {}
    for number, mesh in enumerate(document.objects("meshes")):
        for primitive in mesh.get("primitives", ()):
            compression = extension_of(primitive, DRACO)
            if compression and not _has_data(document, primitive):
                _draco(document, primitive, compression, f"mesh {number}", unpacked)


def _meshopt(document: GltfDocument, held: dict[str, Any], what: str) -> bytes:
    count = require_int(held.get("count"), f"the count of {what}", 0, 3 * MAX_FACES)
    most = min(_MOST_STRIDE, MAX_FILE_BYTES // max(count, 1))
    stride = require_int(held.get("byteStride"), f"the stride of {what}", 1, most)
    data = document.bytes_of(held, what)
    return decode(data, count, stride, str(held.get("mode")), str(held.get("filter", "NONE")))


def _has_data(document: GltfDocument, primitive: dict[str, Any]) -> bool:
    """Whether the accessors of a primitive's attributes point to data."""
    accessors = document.objects("accessors")
    return all(
        not {"bufferView", "sparse"}.isdisjoint(
            require_element(accessors, index, f"an accessor ({name})")
        )
        for name, index in primitive["attributes"].items()
    )


def _draco(
    document: GltfDocument,
    primitive: dict[str, Any],
    held: dict[str, Any],
    where: str,
    unpacked: dict[int, Any],
) -> None:
    """Add the data that Draco compresses to the accessors of a primitive."""
    try:
        import DracoPy
    except ImportError as error:
        raise MissingExtraError(
            "its meshes are compressed by Draco, which needs the extra 'draco'",
            "install lcollision[draco], or export it without compression",
            where=document.path,
        ) from error
    views, accessors = document.objects("bufferViews"), document.objects("accessors")
    number = require_int(
        held.get("bufferView"), f"the compressed data of {where}", 0, len(views) - 1
    )
    if number not in unpacked:
        try:
            unpacked[number] = DracoPy.decode(document.bytes_of(views[number], where))
        except (ValueError, RuntimeError, DracoPy.FileTypeException) as error:
            raise MeshFileError(
                "its compressed data (Draco) are damaged", "export it again", where=where
            ) from error
    mesh = unpacked[number]
    stored = {one["unique_id"]: one["data"] for one in mesh.attributes}
    decoded_attributes = {name: stored.get(own) for name, own in inner(held, "attributes").items()}
    decoded_attributes["indices"] = None if len(mesh.faces) == 0 else mesh.faces.reshape(-1, 1)
    for name, index in (*primitive["attributes"].items(), ("indices", primitive.get("indices"))):
        values = decoded_attributes.get(name)
        if index is None or values is None:
            continue
        accessor = require_element(accessors, index, f"an accessor ({name})")
        dtype = component_dtype(accessor.get("componentType"), f"an accessor ({name})")
        data = np.ascontiguousarray(values, dtype=dtype).tobytes()
        views.append({"buffer": document.add_unpacked(data), "byteLength": len(data)})
        accessor |= {"bufferView": len(views) - 1, "byteOffset": 0, "count": len(values)}
