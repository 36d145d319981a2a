"""Stanford PLY, text and binary of either byte order.

It has its own reader because trimesh reorders the triangles of quads, refuses binary polygons of
different sizes, accepts 1.5 as vertex 1, and writes single precision.
"""

from __future__ import annotations

import struct
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.files.mesh.polygons import Polygons, read_rest, require_plausible_count
from lcollision_core.files.mesh.text import number_rows, plain_lines, vertex_numbers
from lcollision_core.meshes.topology import name_twice

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_FORMATS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNER_NAMES = ("vertex_indices", "vertex_index")
_SURFACES = ("face", "tristrips")
_MAX_HEADER_LINES = 10_000
_MAX_LINE_BYTES = 10_000


class _Property(NamedTuple):
    name: str
    dtype: str
    count_dtype: str | None = None
    """Type of the count before a list; None for a single value."""


class _Element(NamedTuple):
    name: str
    n_rows: int
    properties: list[_Property]


_Column = tuple[npt.NDArray[Any], npt.NDArray[np.int64] | None]
"""All values of a property, lists concatenated, and the length of each list; None if single."""


def read(file: BinaryIO, _: object = None) -> Polygons:
    """Read the vertices' x, y, z, the faces and triangle strips; all else is ignored.

    Parameters
    ----------
    file : open binary file at its start

    Returns
    -------
    the polygons, vertices in the file's order

    Raises
    ------
    MeshFileError : the header is invalid or announces too much, or the body is truncated or
        unreadable.
    """
    byte_order, elements = _read_header(file)
    data = read_rest(file)
    if byte_order is None:
        # Convert a text body to a binary one in double precision.
        data = number_rows(plain_lines(data), "row")[0].tobytes()
        for element in elements:
            element.properties[:] = [
                _Property(item.name, "f8", item.count_dtype and "f8") for item in element.properties
            ]
    body = _Body(data, byte_order or "=")
    columns: dict[str, dict[str, _Column]] = {}
    element_names = {"vertex", *_SURFACES} & {element.name for element in elements}
    for element in elements:
        columns[element.name] = body.read(element)
        if element_names <= columns.keys():
            break
    x, y, z = (columns["vertex"][axis][0] for axis in "xyz")
    all_sizes, all_corners = [], []
    for element_name in _SURFACES:
        if element_name not in columns:
            continue
        columns_of = columns[element_name]
        values, sizes = next(columns_of[name] for name in _CORNER_NAMES if name in columns_of)
        assert sizes is not None  # checked in the header
        corners = vertex_numbers(values, sizes, element_name)
        if element_name == "tristrips":
            # Unsigned numbers store -1 as the largest one.
            if values.dtype.kind == "u" and (last := np.iinfo(values.dtype).max) >= len(x):
                corners[corners == last] = -1
            corners = _triangles_of_strips(corners, sizes)
            sizes = np.full(len(corners) // 3, 3)
        all_sizes.append(sizes)
        all_corners.append(corners)
    # Casting a signalling NaN of a damaged file warns; NaNs are refused later.
    with np.errstate(invalid="ignore"):
        vertices = np.stack([x, y, z], axis=1, dtype=np.float64)
    return Polygons(
        vertices,
        np.concatenate(all_sizes),
        np.concatenate(all_corners),
        is_single=x.dtype.itemsize == 4,
    )


def _triangles_of_strips(
    corners: npt.NDArray[np.int64], sizes: npt.NDArray[np.int64]
) -> npt.NDArray[np.int64]:
    """Return the corners of the triangles of strips with `sizes` corners.

    Every second triangle of a strip has opposite winding; -1 begins another strip. Triangles that
    repeat a vertex only join strips, and are left out.
    """
    places = np.arange(len(corners))
    begin = np.zeros_like(places)
    starts = (np.cumsum(sizes) - sizes)[sizes > 0]
    begin[starts] = starts
    begin = np.maximum.accumulate(np.where(corners == -1, places + 1, begin))
    first = np.flatnonzero(begin[2:] <= places[:-2])
    is_odd = (first - begin[first]) % 2
    triangles: npt.NDArray[np.int64] = corners[
        np.stack([first + is_odd, first + 1 - is_odd, first + 2], axis=1)
    ]
    return triangles[~name_twice(triangles)].reshape(-1)


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
                elements.append(_Element(name, int(count), []))
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
    surfaces = [name for name in _SURFACES if name in names] or ["face"]
    for wanted in ("vertex", *surfaces):
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
        raise MeshFileError("its vertices have no x, y and z")
    for surface in surfaces:
        face = {item.name: item for item in elements[names.index(surface)].properties}
        corners = next((face[name] for name in _CORNER_NAMES if name in face), None)
        if corners is None or corners.count_dtype is None or corners.dtype.startswith("f"):
            raise MeshFileError(f"its element {surface!r} has no list vertex_indices")


def _truncated(element: _Element, row: int | None = None) -> MeshFileError:
    where = "" if row is None else f" at {element.name} {row} (from 0)"
    return MeshFileError(
        f"it is truncated: it announces {element.n_rows} of element {element.name!r} but ends "
        f"before{where}"
    )


class _Body:
    """The rows of a body, read from the front."""

    def __init__(self, data: bytes, byte_order: str) -> None:
        self._data = data
        self._order = byte_order
        self._offset = 0

    def read(self, element: _Element) -> dict[str, _Column]:
        """Read the rows of the next element."""
        if element.n_rows == 0 or not element.properties:
            return {item.name: (np.empty(0), np.empty(0, np.int64)) for item in element.properties}
        columns = self._read_table(element)
        return self._read_ragged(element) if columns is None else columns

    def _read_table(self, element: _Element) -> dict[str, _Column] | None:
        """Read all rows as a table; return None unless lists are as long as in the first row."""
        fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
        for item in element.properties:
            dtype = self._order + item.dtype
            if item.count_dtype is None:
                fields.append((item.name, dtype))
                continue
            fields.append((f"{item.name} count", self._order + item.count_dtype))
            first = self._rows(fields, 1)
            if first is None:
                raise _truncated(element, 0)
            length = first[f"{item.name} count"][0]
            if not (0 <= length <= len(self._data) and length % 1 == 0):
                return None
            fields.append((item.name, dtype, (int(length),)))
        table = self._rows(fields, element.n_rows)
        if table is None:
            if all(item.count_dtype is None for item in element.properties):
                raise _truncated(element)
            return None
        columns: dict[str, _Column] = {}
        for item in element.properties:
            sizes = None
            if item.count_dtype is not None:
                counts = table[f"{item.name} count"]
                if (counts != counts[0]).any():
                    return None
                sizes = counts.astype(np.int64)
            columns[item.name] = table[item.name].reshape(-1), sizes
        self._offset += table.nbytes
        return columns

    def _rows(self, fields: list[Any], count: int) -> npt.NDArray[Any] | None:
        row = np.dtype(fields)
        if self._offset + row.itemsize * count > len(self._data):
            return None
        return np.frombuffer(self._data, dtype=row, count=count, offset=self._offset)

    def _read_ragged(self, element: _Element) -> dict[str, _Column]:
        """Read row by row, for polygons of different sizes."""
        data, offset = self._data, self._offset
        dtypes = [np.dtype(self._order + item.dtype) for item in element.properties]
        counts = [
            None
            if item.count_dtype is None
            else struct.Struct(self._order + np.dtype(item.count_dtype).char)
            for item in element.properties
        ]
        sizes: list[list[int]] = [[] for _ in dtypes]
        pieces: list[list[bytes]] = [[] for _ in dtypes]
        for row in range(element.n_rows):
            for index, (dtype, count) in enumerate(zip(dtypes, counts, strict=True)):
                length = 1
                if count is not None:
                    if offset + count.size > len(data):
                        raise _truncated(element, row)
                    (announced,) = count.unpack_from(data, offset)
                    if not (0 <= announced <= len(data) and announced % 1 == 0):
                        raise MeshFileError(
                            f"announces a list of {announced:g} items",
                            where=f"{element.name} {row} (from 0)",
                        )
                    length = int(announced)
                    offset += count.size
                    sizes[index].append(length)
                end = offset + length * dtype.itemsize
                if end > len(data):
                    raise _truncated(element, row)
                pieces[index].append(data[offset:end])
                offset = end
        self._offset = offset
        return {
            item.name: (
                np.frombuffer(b"".join(pieces[index]), dtype=dtypes[index]),
                None if counts[index] is None else np.array(sizes[index], dtype=np.int64),
            )
            for index, item in enumerate(element.properties)
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
