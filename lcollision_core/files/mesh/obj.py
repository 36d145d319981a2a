"""Wavefront OBJ: read it, write it, and rewrite a file with other positions.

It has its own reader because the vertex order and count must be kept: trimesh splits a vertex where
its texture coordinates or normals differ.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError, ShapeError
from lcollision_core.files.mesh.polygons import (
    MAX_FACES,
    MAX_FILE_BYTES,
    Polygons,
    read_rest,
    require_plausible_count,
)
from lcollision_core.files.mesh.text import (
    decimals,
    number_rows,
    plain_lines,
    points,
    vertex_numbers,
)
from lcollision_core.files.safe import read_regular, write_bytes
from lcollision_core.meshes.normals import moved_normals
from lcollision_core.meshes.topology import FloatArray

_SHORTEST_LINE = len(b"f 1 2 3\n")
_NORMAL_OF_CORNER = re.compile(rb"[^\s/]+(?:/[^\s/]*)?(?:/([^\s/]*))?")


def read(file: BinaryIO, _: object = None) -> Polygons:
    """Read `v` and `f` lines; texture coordinates, normals, groups and materials are ignored.

    Parameters
    ----------
    file : open binary file at its start

    Returns
    -------
    the polygons, vertices in the file's order

    Raises
    ------
    MeshFileError : a vertex or face cannot be read; the message gives its number from 0.
    """
    lines = _Lines.of(read_rest(file))
    return Polygons(lines.points("v"), *lines.faces())


@dataclass(frozen=True, eq=False)
class ObjCorners:
    """The vertices and normals of an OBJ file, and the corners that use them.

    Attributes
    ----------
    vertices : (V, 3) float64 array
    normals : (N, 3) float64 array
    sizes : (P,) int64 array, number of corners of each polygon
    corners : (sum of sizes,) int64 array of vertex indices
    corner_normals : (sum of sizes,) int64 array of normal indices, -1 for none
    """

    vertices: npt.NDArray[np.float64]
    normals: npt.NDArray[np.float64]
    sizes: npt.NDArray[np.int64]
    corners: npt.NDArray[np.int64]
    corner_normals: npt.NDArray[np.int64]


def read_corners(data: bytes) -> ObjCorners:
    """Read `v`, `vn` and `f` lines from a file's bytes.

    Raises
    ------
    MeshFileError : see `read`.
    """
    lines = _Lines.of(data)
    sizes, corners = lines.faces()
    normals = lines.points("vn")
    return ObjCorners(
        lines.points("v"), normals, sizes, corners, lines.corner_normals(len(normals))
    )


@dataclass(frozen=True, eq=False)
class _Lines:
    """The text of a file without comments, and the kinds of its lines.

    Attributes
    ----------
    text : (n,) uint8 array, with keywords replaced by blanks
    lengths : (L,) int64 array, lengths of the lines
    is_kind : (L,) bool arrays by keyword, "v", "vn" or "f"
    """

    text: npt.NDArray[np.uint8]
    lengths: npt.NDArray[np.int64]
    is_kind: dict[str, npt.NDArray[np.bool_]]

    @classmethod
    def of(cls, data: bytes) -> _Lines:
        if b"\0" in data:
            raise MeshFileError("it is not a text file, so not an OBJ file")
        if len(data) > _SHORTEST_LINE * MAX_FACES:
            require_plausible_count(data.count(b"\nf"), "faces")
            require_plausible_count(data.count(b"\nv "), "vertices")
        data = plain_lines(data)
        if b"\\" in data:
            data = data.replace(b"\\\n", b" ") + b"\n"
        if data.startswith(b" ") or b"\n " in data:
            data = re.sub(rb"(?m)^ +", b"", data)
        text = np.frombuffer(bytearray(data), dtype=np.uint8)
        lengths = np.diff(np.flatnonzero(text == ord("\n")), prepend=-1)
        starts = np.cumsum(lengths) - lengths
        first, second, third = (text[np.minimum(starts + i, len(text) - 1)] for i in range(3))
        is_kind = {name: (first == ord(name)) & (second <= ord(" ")) for name in "vf"}
        is_kind["vn"] = (first == ord("v")) & (second == ord("n")) & (third <= ord(" "))
        text[starts] = ord(" ")
        text[starts[is_kind["vn"]] + 1] = ord(" ")
        return cls(text, lengths, is_kind)

    def _of_kind(self, kind: str) -> bytes:
        return self.text[np.repeat(self.is_kind[kind], self.lengths)].tobytes()

    def points(self, kind: str) -> npt.NDArray[np.float64]:
        return points(self._of_kind(kind), {"v": "vertex", "vn": "normal"}[kind])

    def faces(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        n_before = np.cumsum(self.is_kind["v"], dtype=np.int64)
        return _faces(self._of_kind("f"), n_before[self.is_kind["f"]])

    def corner_normals(self, n_normals: int) -> npt.NDArray[np.int64]:
        """Return the index of each corner's normal; -1 if it has none or is out of range."""
        named = _NORMAL_OF_CORNER.sub(lambda corner: corner[1] or b"0", self._of_kind("f"))
        values, sizes = number_rows(named, "face", whole=True)
        index = vertex_numbers(values, sizes)
        n_before = np.repeat(np.cumsum(self.is_kind["vn"])[self.is_kind["f"]], sizes)
        index = np.where(index < 0, n_before + index, index - 1)
        return np.where(index < n_normals, np.maximum(index, -1), -1)


def _faces(
    text: bytes, n_before: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the sizes and corners of `f` lines, each preceded by `n_before` vertices."""
    if b"/" in text:
        text = re.sub(rb"(?<=[0-9])/[^\s]*", b"", text)
    values, sizes = number_rows(text, "face", whole=True)
    named = vertex_numbers(values, sizes)
    owner = np.repeat(np.arange(len(sizes)), sizes)
    zero = np.flatnonzero(named == 0)
    if len(zero):
        raise MeshFileError(
            "names vertex 0, but OBJ counts vertices from 1",
            where=f"face {owner[zero[0]]} (from 0)",
        )
    n_before = n_before[owner]
    outside = np.flatnonzero(named < -n_before)
    if len(outside):
        raise MeshFileError(
            f"names vertex {named[outside[0]]}, but only {n_before[outside[0]]} vertices come "
            "before it",
            where=f"face {owner[outside[0]]} (from 0)",
        )
    return sizes, np.where(named < 0, n_before + named, named - 1)


@dataclass(frozen=True, eq=False)
class ObjDetail:
    """Further content of an OBJ file of triangles.

    Attributes
    ----------
    normals : (N, 3) array
    normal_faces : (F, 3) array, index of each corner's normal
    uv : (T, 2) array, from the lower left corner of the image; empty for none
    uv_faces : (F, 3) array, index of each corner in `uv`
    groups, materials : names
    group_of, material_of : (F,) arrays, index of each face's group and material; -1 for none
    """

    normals: npt.NDArray[np.floating[Any]]
    normal_faces: npt.NDArray[np.int64]
    uv: npt.NDArray[np.floating[Any]]
    uv_faces: npt.NDArray[np.int64]
    groups: tuple[str, ...]
    group_of: npt.NDArray[np.int64]
    materials: tuple[str, ...]
    material_of: npt.NDArray[np.int64]


def encode(
    vertices: npt.NDArray[Any], faces: npt.NDArray[np.int32], detail: ObjDetail | None = None
) -> bytes:
    """Write triangles as OBJ text, each number as the shortest decimal that reads back the same.

    Parameters
    ----------
    vertices : (V, 3) float32 or float64 array
    faces : (F, 3) int32 array, indices from 0 (written from 1); their order is kept
    detail : further content to write
    """
    rows = "v %s %s %s\n" * len(vertices) % decimals(vertices)
    if detail is None:
        return (rows + _face_lines("f %d %d %d\n", faces)).encode("ascii")
    rows += "vt %s %s\n" * len(detail.uv) % decimals(detail.uv.astype(np.float32))
    rows += "vn %s %s %s\n" * len(detail.normals) % decimals(detail.normals.astype(np.float32))
    line, places = "f %d//%d %d//%d %d//%d\n", [detail.uv_faces][: len(detail.uv)]
    if places:
        line = "f %d/%d/%d %d/%d/%d %d/%d/%d\n"
    named: npt.NDArray[np.int64] = np.stack([faces, *places, detail.normal_faces], axis=2)
    kinds = np.column_stack([detail.group_of, detail.material_of])
    begins = np.flatnonzero((np.diff(kinds, axis=0, prepend=-2) != 0).any(axis=1)).tolist()
    texts, before = [rows], (-1, -1)
    for begin, end in zip(begins, [*begins[1:], len(faces)], strict=True):
        group, material = kinds[begin].tolist()
        if group != before[0]:
            texts.append(f"g {_one_word(detail.groups[group])}\n" if group >= 0 else "g\n")
        if material != before[1] and material >= 0:
            texts.append(f"usemtl {_one_word(detail.materials[material])}\n")
        before = group, material
        texts.append(_face_lines(line, named[begin:end]))
    return "".join(texts).encode()


def _face_lines(line: str, named: npt.NDArray[np.integer]) -> str:
    return line * len(named) % tuple((named.astype(np.int64) + 1).ravel().tolist())


def _one_word(name: str) -> str:
    """Return a name with the characters replaced that would split it into several words."""
    return re.sub(r"[\s#\\]+", "_", name)


_BLANKS = rb"(?:[ \t\v\f]|\\(?:\r\n|\n|\r))"
_WORD = rb"[^\s\\]+"
_THREE = re.compile(
    rb"(?:(?<=[\r\n])|\A(?:\xef\xbb\xbf)?)(?P<head>%(b)s*(?P<kind>vn?)%(b)s+)"
    rb"(%(w)s)(%(b)s+)(%(w)s)(%(b)s+)(%(w)s)" % {b"b": _BLANKS, b"w": _WORD}
)


def rewrite_obj(
    path: str | os.PathLike[str], source: str | os.PathLike[str], vertices: npt.NDArray[Any]
) -> None:
    """Write an OBJ file with other positions, atomically: see `rewritten`.

    Raises
    ------
    ShapeError : `vertices` are not those of the source.
    MeshFileError : the source cannot be read, or the file cannot be written.
    """
    try:
        data = rewritten(read_regular(source, MAX_FILE_BYTES), vertices)
    except (MeshFileError, OSError) as error:
        raise MeshFileError.unreadable(source, error, "check the file") from error
    write_bytes(path, data)


def rewritten(data: bytes, vertices: npt.NDArray[Any]) -> bytes:
    """Replace the coordinates of an OBJ file's `v` and `vn` lines.

    Text after the coordinates, such as vertex colours, stays, and so does a line whose numbers do
    not change. A normal keeps its index and turns with the corners that use it: see
    `moved_normals`. If a program, such as Blender, wrote one normal for faces of equal direction,
    they still share it where the pose turns them apart.

    Parameters
    ----------
    data : bytes of an OBJ file
    vertices : (V, 3) finite array, in the file's order; written with the shortest decimals that
        read back as the same numbers

    Returns
    -------
    bytes of the new file

    Raises
    ------
    ShapeError : `vertices` has the wrong shape.
    MeshFileError : the file cannot be read, or its lines cannot be replaced.
    """
    corners = read_corners(data)
    if vertices.shape != corners.vertices.shape:
        raise ShapeError.must_be(
            "vertices for this OBJ file", f"of shape {corners.vertices.shape}", vertices.shape
        )
    points = np.asarray(vertices, np.float64)
    new = {b"v": points, b"vn": _moved_normals(corners, points)}
    old = {b"v": corners.vertices, b"vn": corners.normals}
    texts = {kind: decimals(rows) for kind, rows in new.items()}
    is_kept = {kind: (rows == old[kind]).all(axis=1).tolist() for kind, rows in new.items()}
    counts = dict.fromkeys(new, 0)

    def replaced(line: re.Match[bytes]) -> bytes:
        kind = line["kind"]
        row = counts[kind]
        counts[kind] += 1
        if row >= len(is_kept[kind]) or is_kept[kind][row]:
            return line[0]
        x, y, z = (word.encode("ascii") for word in texts[kind][3 * row : 3 * row + 3])
        start = line[0][: line.start("kind") - line.start()] + line["head"].lstrip()
        return b"".join((start, x, line[4], y, line[6], z))

    result = _THREE.sub(replaced, data)
    again = read_corners(result)
    if not np.array_equal(again.vertices, points) or not np.array_equal(
        again.corners, corners.corners
    ):
        raise MeshFileError(
            "its lines of vertices are not written as other programs write them",
            "export the mesh again",
        )
    return result


def _moved_normals(obj: ObjCorners, vertices: FloatArray) -> FloatArray:
    sizes, position = obj.sizes, np.arange(len(obj.corners))
    start, size = np.repeat(np.cumsum(sizes) - sizes, sizes), np.repeat(sizes, sizes)
    beside = [obj.corners[start + (position - start + step) % size] for step in (1, -1)]
    corners = np.stack([obj.corners, *beside], axis=1)[obj.corner_normals >= 0]
    owners = obj.corner_normals[obj.corner_normals >= 0]
    return moved_normals(obj.normals, owners, corners, obj.vertices, vertices)
