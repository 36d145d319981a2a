"""Wavefront OBJ.

An own reader, because the vertex order and count must survive: trimesh splits a vertex where its
texture coordinates or normals differ.
"""

from __future__ import annotations

import re
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.meshes.formats.polygons import (
    MAX_FACES,
    Polygons,
    read_rest,
    require_plausible_count,
)
from lcollision_core.meshes.formats.text import (
    decimals,
    number_rows,
    plain_lines,
    points,
    vertex_numbers,
)

_SHORTEST_LINE = len(b"f 1 2 3\n")


def read(file: BinaryIO) -> Polygons:
    """Read `v` and `f` lines; texture coordinates, normals, groups and materials are passed over.

    Parameters
    ----------
    file : open binary file at its start

    Returns
    -------
    the polygons, vertices in the file's order

    Raises
    ------
    MeshFileError : a vertex or face is not readable, named by its number from 0.
    """
    data = read_rest(file)
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
    is_lone = text[np.minimum(starts + 1, len(text) - 1)] <= ord(" ")
    is_vertex, is_face = ((text[starts] == ord(letter)) & is_lone for letter in "vf")
    text[starts] = ord(" ")
    vertex_text, face_text = (
        text[np.repeat(chosen, lengths)].tobytes() for chosen in (is_vertex, is_face)
    )
    vertices = points(vertex_text, "vertex")
    return Polygons(vertices, *_faces(face_text, np.cumsum(is_vertex)[is_face]))


def _faces(
    text: bytes, n_before: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return sizes and corners of `f` lines; `n_before` vertices precede each."""
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


def encode(vertices: npt.NDArray[Any], faces: npt.NDArray[np.int32]) -> bytes:
    """Write triangles as OBJ text, each number as the shortest decimal that reads back the same.

    Parameters
    ----------
    vertices : (V, 3) float32 or float64 array
    faces : (F, 3) int32 array, indices from 0 (written from 1)
    """
    rows = "v %s %s %s\n" * len(vertices) % decimals(vertices)
    return (
        rows + "f %d %d %d\n" * len(faces) % tuple((faces.astype(np.int64) + 1).ravel().tolist())
    ).encode("ascii")
