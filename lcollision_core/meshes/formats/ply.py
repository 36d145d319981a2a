"""Stanford PLY, text and binary of either byte order.

An own reader, because the vertex order and count must survive and counts must be known before
memory is taken: trimesh splits vertices at texture seams and reads the body first.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.meshes.formats.polygons import Polygons, read_rest, require_plausible_count
from lcollision_core.meshes.formats.text import numbers_of_text

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_FORMATS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNER_NAMES = ("vertex_indices", "vertex_index")
_MAX_HEADER_LINES = 10_000
_MAX_LINE_BYTES = 10_000


@dataclass(frozen=True)
class _Property:
    name: str
    dtype: str
    count_dtype: str | None = None
    """The type of the count before a list; None for a single value."""


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)


@dataclass(frozen=True)
class _Column:
    values: npt.NDArray[Any]
    """All values of a property, lists joined."""
    sizes: npt.NDArray[np.int64] | None
    """The length of each row's list; None for single values."""


def read(file: BinaryIO) -> Polygons:
    """Read the vertices' x, y, z and the faces; every other property is passed over.

    Parameters
    ----------
    file : open binary file at its start

    Returns
    -------
    the polygons, vertices in the file's order

    Raises
    ------
    MeshFileError : the header is not understood, announces too much, or the body is shorter than
        announced or not readable.
    """
    byte_order, elements = _read_header(file)
    body = read_rest(file)
    source = _TextBody(body) if byte_order is None else _BinaryBody(body, byte_order)
    columns: dict[str, dict[str, _Column]] = {}
    for element in elements:
        columns[element.name] = source.read(element)
        if {"vertex", "face"} <= columns.keys():
            break
    vertices = np.stack(
        [columns["vertex"][axis].values for axis in "xyz"], axis=1, dtype=np.float64
    )
    corners = next(columns["face"][name] for name in _CORNER_NAMES if name in columns["face"])
    if corners.sizes is None:
        raise MeshFileError("its faces have no list of vertices", "export the mesh again")
    is_single = byte_order is not None and columns["vertex"]["x"].values.dtype.itemsize == 4
    return Polygons(vertices, corners.sizes, corners.values.astype(np.int64), is_single=is_single)


def _read_header(file: BinaryIO) -> tuple[str | None, list[_Element]]:
    if file.readline(_MAX_LINE_BYTES).strip() != b"ply":
        raise MeshFileError("it does not start with the word ply as a PLY file does")
    byte_order: str | None = None
    has_format = False
    elements: list[_Element] = []
    for _ in range(_MAX_HEADER_LINES):
        line = file.readline(_MAX_LINE_BYTES)
        words = line.decode("latin-1").split()
        match words:
            case ["end_header"]:
                break
            case ["format", name, _] if name in _FORMATS:
                byte_order, has_format = _FORMATS[name], True
            case ["element", name, count] if count.isdecimal() and len(count) < 20:
                elements.append(_Element(name, int(count)))
                require_plausible_count(int(count), "vertices" if name == "vertex" else f"{name}s")
            case ["property", "list", count_type, value_type, name] if (
                elements and {count_type, value_type} <= _TYPES.keys()
            ):
                elements[-1].properties.append(
                    _Property(name, _TYPES[value_type], _TYPES[count_type])
                )
            case ["property", value_type, name] if elements and value_type in _TYPES:
                elements[-1].properties.append(_Property(name, _TYPES[value_type]))
            case ["comment" | "obj_info", *_]:
                continue
            case _ if not line:
                raise MeshFileError("its header has no end, it is truncated")
            case _:
                raise MeshFileError(
                    f"its header has a line that is not understood: {' '.join(words)[:60]!r}"
                )
    else:
        raise MeshFileError("its header has no end")
    if not has_format:
        raise MeshFileError("its header names no format")
    _require_mesh(elements)
    return byte_order, elements


def _require_mesh(elements: list[_Element]) -> None:
    names = [element.name for element in elements]
    for wanted in ("vertex", "face"):
        if names.count(wanted) != 1:
            raise MeshFileError(
                f"its header names {names.count(wanted)} elements {wanted!r}, one is needed",
                "export it as a triangle mesh",
            )
    for element in elements:
        properties = [item.name for item in element.properties]
        if len(set(properties)) != len(properties):
            raise MeshFileError(f"its header names a property of {element.name!r} twice")
    vertex = {item.name: item for item in elements[names.index("vertex")].properties}
    if not all(axis in vertex and vertex[axis].count_dtype is None for axis in "xyz"):
        raise MeshFileError("its vertices have no x, y and z", "export the mesh again")
    face = {item.name: item for item in elements[names.index("face")].properties}
    corners = next((face[name] for name in _CORNER_NAMES if name in face), None)
    if corners is None or corners.count_dtype is None or corners.dtype.startswith("f"):
        raise MeshFileError("its faces have no list vertex_indices", "export the mesh again")


def _truncated(element: _Element, row: int | None = None) -> MeshFileError:
    where = "" if row is None else f" at {element.name} {row} (from 0)"
    return MeshFileError(
        f"it is truncated: it announces {element.count} of element {element.name!r} but ends "
        f"before{where}"
    )


class _BinaryBody:
    """The rows of a binary body, read from the front."""

    def __init__(self, data: bytes, byte_order: str) -> None:
        self._data = data
        self._order = byte_order
        self._offset = 0

    def read(self, element: _Element) -> dict[str, _Column]:
        """Read the next element's rows."""
        if element.count == 0 or not element.properties:
            return _no_rows(element)
        columns = self._read_alike(element)
        return self._read_ragged(element) if columns is None else columns

    def _read_alike(self, element: _Element) -> dict[str, _Column] | None:
        """Read rows as one table, if every list is as long as in the first row."""
        fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
        for index, item in enumerate(element.properties):
            if item.count_dtype is None:
                fields.append((f"values{index}", self._order + item.dtype))
                continue
            fields.append((f"sizes{index}", self._order + item.count_dtype))
            ahead = np.dtype(fields)
            first = self._table(ahead, 1)
            if first is None:
                raise _truncated(element, 0)
            length = int(first[f"sizes{index}"][0])
            if not 0 <= length <= len(self._data):
                return None
            fields.append((f"values{index}", self._order + item.dtype, (length,)))
        row = np.dtype(fields)
        table = self._table(row, element.count)
        if table is None:
            if all(item.count_dtype is None for item in element.properties):
                raise _truncated(element)
            return None
        columns = {}
        for index, item in enumerate(element.properties):
            values = table[f"values{index}"]
            sizes = None
            if item.count_dtype is not None:
                sizes = table[f"sizes{index}"].astype(np.int64)
                if (sizes != sizes[0]).any():
                    return None
            columns[item.name] = _Column(values.reshape(-1), sizes)
        self._offset += row.itemsize * element.count
        return columns

    def _table(self, row: np.dtype[Any], count: int) -> npt.NDArray[Any] | None:
        if self._offset + row.itemsize * count > len(self._data):
            return None
        return np.frombuffer(self._data, dtype=row, count=count, offset=self._offset)

    def _read_ragged(self, element: _Element) -> dict[str, _Column]:
        """Read row by row: polygons of different sizes."""
        kinds = [
            (
                np.dtype(self._order + item.dtype),
                None if item.count_dtype is None else np.dtype(self._order + item.count_dtype),
            )
            for item in element.properties
        ]
        data, offset = self._data, self._offset
        sizes: list[list[int]] = [[] for _ in kinds]
        pieces: list[list[bytes]] = [[] for _ in kinds]
        for row in range(element.count):
            for index, (dtype, count_dtype) in enumerate(kinds):
                length = 1
                if count_dtype is not None:
                    if offset + count_dtype.itemsize > len(data):
                        raise _truncated(element, row)
                    length = int(np.frombuffer(data, count_dtype, count=1, offset=offset)[0])
                    offset += count_dtype.itemsize
                    sizes[index].append(length)
                end = offset + length * dtype.itemsize
                if not offset <= end <= len(data):
                    raise _truncated(element, row)
                pieces[index].append(data[offset:end])
                offset = end
        self._offset = offset
        return {
            item.name: _Column(
                np.frombuffer(b"".join(pieces[index]), dtype=kinds[index][0]),
                None if item.count_dtype is None else np.array(sizes[index], dtype=np.int64),
            )
            for index, item in enumerate(element.properties)
        }


class _TextBody:
    """The rows of a text body, read from the front."""

    def __init__(self, data: bytes) -> None:
        self._values = numbers_of_text(data, "the rows")
        self._offset = 0

    def read(self, element: _Element) -> dict[str, _Column]:
        """Read the next element's rows."""
        if element.count == 0 or not element.properties:
            return _no_rows(element)
        values = self._values
        sizes = [array("q") for _ in element.properties]
        starts = [array("q") for _ in element.properties]
        offset = self._offset
        if all(item.count_dtype is None for item in element.properties):
            width = len(element.properties)
            end = offset + width * element.count
            if end > len(values):
                raise _truncated(element)
            table = values[offset:end].reshape(-1, width)
            self._offset = end
            return {
                item.name: _Column(table[:, index], None)
                for index, item in enumerate(element.properties)
            }
        alike = self._read_alike(element)
        if alike is not None:
            return alike
        for row in range(element.count):
            for index, item in enumerate(element.properties):
                length = 1
                if item.count_dtype is not None:
                    if offset >= len(values):
                        raise _truncated(element, row)
                    announced = values[offset]
                    if not (0 <= announced <= len(values) and announced.is_integer()):
                        raise MeshFileError(
                            f"announces a list of {announced:g} items",
                            where=f"{element.name} {row} (from 0)",
                        )
                    length = int(announced)
                    offset += 1
                    sizes[index].append(length)
                if offset + length > len(values):
                    raise _truncated(element, row)
                starts[index].append(offset)
                offset += length
        self._offset = offset
        columns = {}
        for index, item in enumerate(element.properties):
            counts = np.array(sizes[index] or [1] * element.count, dtype=np.int64)
            shift = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
            chosen = values[np.repeat(np.array(starts[index], dtype=np.int64), counts) + shift]
            if item.name in _CORNER_NAMES:
                _require_vertex_numbers(element, chosen, counts)
            columns[item.name] = _Column(chosen, None if item.count_dtype is None else counts)
        return columns

    def _read_alike(self, element: _Element) -> dict[str, _Column] | None:
        """Read rows as one table, if every list is as long as in the first row; else None."""
        counts, at = [], self._offset
        for item in element.properties:
            count = 1
            if item.count_dtype is not None:
                if at >= len(self._values) or not 0 <= self._values[at] <= len(self._values):
                    return None
                count = int(self._values[at])
                at += 1
            counts.append(count)
            at += count
        end = self._offset + (at - self._offset) * element.count
        if end > len(self._values):
            return None
        table = self._values[self._offset : end].reshape(element.count, -1)
        columns, at = {}, 0
        for item, count in zip(element.properties, counts, strict=True):
            sizes = None
            if item.count_dtype is not None:
                if (table[:, at] != count).any():
                    return None
                sizes = np.full(element.count, count, dtype=np.int64)
                at += 1
            chosen = table[:, at : at + count].reshape(-1)
            at += count
            if item.name in _CORNER_NAMES:
                _require_vertex_numbers(element, chosen, np.full(element.count, count))
            columns[item.name] = _Column(chosen, sizes)
        self._offset = end
        return columns


def _require_vertex_numbers(
    element: _Element, chosen: npt.NDArray[np.float64], counts: npt.NDArray[np.int64]
) -> None:
    """Refuse corners that only a decimal parser would accept, such as 1.5 or inf."""
    bad = np.flatnonzero(~(np.abs(chosen) < 2**53) | (chosen != np.floor(chosen)))
    if len(bad):
        row = int(np.searchsorted(np.cumsum(counts), bad[0], side="right"))
        raise MeshFileError(
            f"has a corner that is no vertex number: {chosen[bad[0]]:g}",
            where=f"{element.name} {row} (from 0)",
        )


def _no_rows(element: _Element) -> dict[str, _Column]:
    return {
        item.name: _Column(
            np.empty(0, dtype=item.dtype),
            None if item.count_dtype is None else np.empty(0, dtype=np.int64),
        )
        for item in element.properties
    }


def encode(vertices: npt.NDArray[Any], faces: npt.NDArray[np.int32]) -> bytes:
    """Write triangles as binary little-endian PLY, in the precision of `vertices`.

    Parameters
    ----------
    vertices : (V, 3) float32 or float64 array
    faces : (F, 3) int32 array, indices from 0
    """
    scalar = "float" if vertices.dtype == np.float32 else "double"
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\n"
        f"property {scalar} x\nproperty {scalar} y\nproperty {scalar} z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=[("size", "u1"), ("corners", "<i4", (3,))])
    rows["size"] = 3
    rows["corners"] = faces
    points = vertices.astype(vertices.dtype.newbyteorder("<"))
    return header.encode("ascii") + points.tobytes() + rows.tobytes()
