"""Unpack the compressed data of a glTF file, so that it can be read like any other.

The decoder follows the appendices of EXT_meshopt_compression and KHR_meshopt_compression: rows of
bytes (versions 0 and 1), triangles, index sequences, and row filters. Draco is DracoPy's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled, compiled_part
from lcollision_core.errors import MeshFileError, MissingExtraError
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


def _meshopt(document: GltfDocument, packed: dict[str, Any], what: str) -> bytes:
    count = require_int(packed.get("count"), f"the count of {what}", 0, 3 * MAX_FACES)
    most = min(_MOST_STRIDE, MAX_FILE_BYTES // max(count, 1))
    stride = require_int(packed.get("byteStride"), f"the stride of {what}", 1, most)
    data = bytes(document.bytes_of(packed, what))
    return decode(data, count, stride, str(packed.get("mode")), str(packed.get("filter", "NONE")))


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
    packed: dict[str, Any],
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
        packed.get("bufferView"), f"the compressed data of {where}", 0, len(views) - 1
    )
    if number not in unpacked:
        try:
            unpacked[number] = DracoPy.decode(bytes(document.bytes_of(views[number], where)))
        except (ValueError, RuntimeError, DracoPy.FileTypeException) as error:
            raise MeshFileError(
                "its compressed data (Draco) are damaged", "export it again", where=where
            ) from error
    mesh = unpacked[number]
    stored = {one["unique_id"]: one["data"] for one in mesh.attributes}
    decoded_attributes = {
        name: stored.get(own) for name, own in inner(packed, "attributes").items()
    }
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


Bytes = npt.NDArray[np.uint8]

_PADDING = 512
"""Zeros after the data, more than are read between two checks for its end."""

_BLOCK_BYTES, _BLOCK_ROWS, _GROUP = 8192, 256, 16


def decode(data: bytes, count: int, stride: int, mode: str, kind: str = "NONE") -> bytes:
    """Decode one buffer.

    Parameters
    ----------
    data : the compressed bytes
    count, stride : number of elements, and bytes per element
    mode : ATTRIBUTES, TRIANGLES or INDICES
    kind : the filter: NONE, OCTAHEDRAL, QUATERNION, EXPONENTIAL or COLOR

    Returns
    -------
    count * stride bytes

    Raises
    ------
    MeshFileError : the data are damaged, or of an unknown format.
    """
    packed = np.frombuffer(data + bytes(_PADDING), dtype=np.uint8)
    if mode == "ATTRIBUTES" and stride % 4 == 0:
        rows = _filtered(_rows(packed, count, stride), kind)
        return rows.tobytes()
    indices = np.zeros(count, dtype=np.uint32)
    read = {("TRIANGLES", 0xE1): _triangles, ("INDICES", 0xD1): _sequence}.get(
        (mode, int(packed[0]))
    )
    if read is None or stride not in (2, 4) or not read(packed, indices):
        raise _damaged()
    return indices.astype(f"<u{stride}").tobytes()


def _damaged() -> MeshFileError:
    return MeshFileError("its compressed data (meshopt) are damaged", "export it again")


def _rows(packed: Bytes, count: int, stride: int) -> Bytes:
    """Return (count, stride) bytes by summing the deltas of each 8, 16 or 32-bit number."""
    version = int(packed[0]) - 0xA0
    tail = stride if version == 0 else stride + stride // 4
    end = len(packed) - _PADDING - max(tail, 32 if version == 0 else 24)
    deltas: Bytes = np.zeros((count, stride), dtype=np.uint8)
    if version not in (0, 1) or end < 1 or _read_deltas(packed, end, deltas) != end:
        raise _damaged()
    start = len(packed) - _PADDING - tail
    base, channels = packed[start : start + stride], packed[start + stride : start + tail]
    rows = np.empty((count + 1, stride), dtype=np.uint8)
    rows[0] = base
    for channel in range(stride // 4):
        channel_bytes = slice(4 * channel, 4 * channel + 4)
        form = int(channels[channel]) if version else 0
        if form & 3 == 3:
            raise _damaged()
        width = (np.uint8, np.uint16, np.uint32)[form & 3]
        first = base[channel_bytes].copy().view(width)
        changes: npt.NDArray[Any] = np.ascontiguousarray(deltas[:, channel_bytes]).view(width)
        if form & 3 == 2:
            turn = np.uint32(form >> 4)
            changes = changes >> turn | changes << (np.uint32(32) - turn) if turn else changes
            values = np.bitwise_xor.accumulate(np.concatenate([first[None], changes]), axis=0)
        else:
            signed = changes >> width(1) ^ (~(changes & width(1)) + width(1))
            values = np.cumsum(np.concatenate([first[None], signed]), axis=0, dtype=width)
        rows[:, channel_bytes] = values.view(np.uint8)
    return rows[1:]


@compiled
def _read_deltas(packed: Bytes, end: int, deltas: Bytes) -> int:
    """Fill (n, stride) deltas, column by column per block; return the end of the data, or -1."""
    n, stride = deltas.shape
    is_new, at = packed[0] == 0xA1, 1
    most = min((_BLOCK_BYTES // stride) & ~(_GROUP - 1), _BLOCK_ROWS)
    for start in range(0, n, most):
        size = min(most, n - start)
        n_groups, control = (size + _GROUP - 1) // _GROUP, at
        if is_new:
            at += stride // 4
        for column in range(stride):
            kind = 0
            if is_new:
                kind = (int(packed[control + column // 4]) >> 2 * (column % 4)) & 3
            if at > end:
                return -1
            if kind == 2:
                continue
            if kind == 3:
                for row in range(size):
                    deltas[start + row, column] = packed[at + row]
                at += size
                continue
            header = at
            at += (n_groups + 3) // 4
            for group in range(n_groups):
                if at > end:
                    return -1
                mode = (int(packed[header + group // 4]) >> 2 * (group % 4)) & 3
                n_bits = 1 << mode + kind >> 1 if is_new else 1 << mode if mode else 0
                if n_bits == 0:
                    continue
                first = start + _GROUP * group
                # All bits set is an escape: the byte itself follows.
                escape, more = (1 << n_bits) - 1, at + 2 * n_bits
                for place in range(_GROUP):
                    bit = place * n_bits
                    shift = bit % 8 if n_bits == 1 else 8 - n_bits - bit % 8
                    value = (int(packed[at + bit // 8]) >> shift) & escape
                    if value == escape and n_bits < 8:
                        value = int(packed[more])
                        more += 1
                    if first + place < start + size:
                        deltas[first + place, column] = value
                at = more
    return at


def _filtered(rows: Bytes, kind: str) -> npt.NDArray[Any]:
    """Undo the filter of (n, stride) rows."""
    stride = rows.shape[1]
    rows = np.ascontiguousarray(rows)
    if kind == "NONE":
        return rows
    if kind == "EXPONENTIAL":
        stored = rows.view("<i4")
        with np.errstate(over="ignore"):
            undone: npt.NDArray[Any] = np.ldexp((stored << 8 >> 8).astype("<f4"), stored >> 24)
        return undone
    whole = f"<i{stride // 4}"
    most = (1 << (2 * stride - 1)) - 1
    if kind == "OCTAHEDRAL" and stride in (4, 8):
        values = rows.view(whole)
        x, y = (values[:, :2] / values[:, 2:3].astype(np.float32)).T
        z = 1.0 - np.abs(x) - np.abs(y)
        over = np.maximum(-z, 0.0)
        ways = np.stack([x - np.copysign(over, x), y - np.copysign(over, y), z], axis=1)
        ways *= most / np.linalg.norm(ways, axis=1, keepdims=True)
        return np.concatenate([np.rint(ways), values[:, 3:]], axis=1).astype(whole)
    if kind == "QUATERNION" and stride == 8:
        values = rows.view("<i2").astype(np.int64)
        largest, scale = values[:, 3] & 3, np.sqrt(0.5) / (values[:, 3] | 3)
        others = values[:, :3] * scale[:, None]
        left = np.sqrt(np.maximum(1.0 - (others**2).sum(axis=1), 0.0))
        turns, at = np.empty((len(rows), 4)), np.arange(len(rows))
        for place, part in enumerate((*others.T, left), 1):
            turns[at, (largest + place) % 4] = part
        return np.asarray(np.rint(turns * most), dtype=np.int16)
    if kind == "COLOR" and stride in (4, 8):
        signed, alpha = rows.view(whole).astype(np.int64), rows.view(whole.replace("i", "u"))[:, 3]
        alpha = alpha.astype(np.int64)
        full = (1 << np.maximum(np.frexp(alpha)[1].astype(np.int64), 1)) - 1
        luma = signed[:, 0] & 2 * most + 1
        red, green = luma + signed[:, 1] - signed[:, 2], luma + signed[:, 2]
        blue, alpha_bits = luma - signed[:, 1] - signed[:, 2], alpha & full >> 1
        colours = np.stack([red, green, blue, alpha_bits << 1 | alpha_bits & 1], axis=1)
        colours = np.rint(colours * ((2 * most + 1) / full[:, None]))
        return np.asarray(colours, dtype=np.uint8 if stride == 4 else np.uint16)
    raise _damaged()


@compiled_part
def _signed(value: int) -> int:
    return value >> 1 ^ -(value & 1)


@compiled_part
def _number(packed: Bytes, at: int) -> tuple[Any, int]:
    """Return a number with 7 bits per byte, and the position after it."""
    value = np.int64(0)
    for shift in range(0, 35, 7):
        byte = np.int64(packed[at])
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            break
    return value, at


@compiled
def _sequence(packed: Bytes, indices: npt.NDArray[np.uint32]) -> bool:
    """Read indices as differences from either of two previous ones; False if truncated."""
    at, end, last = 1, len(packed) - _PADDING - 4, np.zeros(2, dtype=np.int64)
    for place in range(len(indices)):
        if at >= end:
            return False
        value, at = _number(packed, at)
        last[value & 1] += _signed(value >> 1)
        indices[place] = np.uint32(last[value & 1] & 0xFFFFFFFF)
    return True


@compiled
def _triangles(packed: Bytes, indices: npt.NDArray[np.uint32]) -> bool:
    """Read triangles that reuse edges and vertices of earlier ones; False if truncated."""
    n = len(indices) // 3
    code, at, table = 1, 1 + n, len(packed) - _PADDING - 16
    if at > table or len(indices) % 3:
        return False
    edges, vertices = np.zeros((16, 2), dtype=np.int64), np.zeros(16, dtype=np.int64)
    n_edges, n_vertices, following, last = 0, 0, 0, 0
    corners, is_new = np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.bool_)
    for triangle in range(n):
        if at > table:
            return False
        high, low = np.int64(packed[code + triangle]) >> 4, np.int64(packed[code + triangle]) & 15
        if high < 15:
            a, b = edges[(n_edges - 1 - high) & 15]
            is_pushed = True
            if low == 0:
                c = following
                following += 1
            elif low < 13:
                c = vertices[(n_vertices - 1 - low) & 15]
                is_pushed = False
            else:
                if low == 15:
                    value, at = _number(packed, at)
                    last += _signed(value)
                else:
                    last += 1 if low == 14 else -1
                c = last
            if is_pushed:
                vertices[n_vertices & 15] = c
                n_vertices += 1
            edges[n_edges & 15] = c, b
            edges[(n_edges + 1) & 15] = a, c
            n_edges += 2
            corners[0], corners[1], corners[2] = a, b, c
        else:
            if low < 14:
                pair, first = np.int64(packed[table + low]), 0
            else:
                pair, first = np.int64(packed[at]), 0 if low == 14 else 15
                at += 1
                if pair == 0:
                    following = 0
            for corner in range(3):
                form = first if corner == 0 else (pair >> 4 if corner == 1 else pair & 15)
                if form == 0:
                    corners[corner] = following
                    following += 1
                elif form == 15 and low >= 14:
                    value, at = _number(packed, at)
                    last += _signed(value)
                    corners[corner] = last
                else:
                    corners[corner] = vertices[(n_vertices - form) & 15]
                is_new[corner] = form == 0 or (form == 15 and low >= 14)
            for corner in range(3):
                if is_new[corner]:
                    vertices[n_vertices & 15] = corners[corner]
                    n_vertices += 1
                end = corners[(corner + 1) % 3]
                edges[(n_edges + corner) & 15] = end, corners[corner]
            n_edges += 3
        for corner in range(3):
            indices[3 * triangle + corner] = np.uint32(corners[corner] & 0xFFFFFFFF)
    return True
