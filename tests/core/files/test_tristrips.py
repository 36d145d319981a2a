"""Triangle strips of PLY files."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.contact import CollisionDetector
from lcollision_core.errors import MeshFileError
from lcollision_core.files import read_mesh

CUBE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
STRIPS = [[0, 4, 1, 5, 2, 6, 3, 7, 0, 4], [0, 1, 3, 2], [4, 7, 5, 6]]
VERTICES = [*CUBE, *((x + 0.5, y + 0.3, z + 0.2) for x, y, z in CUBE)]
SECOND = [[corner + 8 for corner in strip] for strip in STRIPS]


def _joined(strips: list[list[int]]) -> list[int]:
    return [corner for strip in strips for corner in (*strip, -1)]


def _ply(path: Path, rows: list[list[int]], order: str, faces: list[list[int]] = ()) -> Path:
    """Write strips, and faces before them, as text or as binary in either byte order."""
    name = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    header = [f"ply\nformat {name} 1.0", f"element vertex {len(VERTICES)}"]
    header += [f"property double {axis}" for axis in "xyz"]
    if faces:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header += [f"element tristrips {len(rows)}", "property list int int vertex_indices"]
    data = "\n".join([*header, "end_header\n"]).encode()
    if order:
        data += b"".join(struct.pack(f"{order}3d", *vertex) for vertex in VERTICES)
        data += b"".join(struct.pack(f"{order}B{len(row)}i", len(row), *row) for row in faces)
        data += b"".join(struct.pack(f"{order}i{len(row)}i", len(row), *row) for row in rows)
    else:
        lines = [" ".join(map(repr, vertex)) for vertex in VERTICES]
        lines += [" ".join(map(str, (len(row), *row))) for row in (*faces, *rows)]
        data += "\r\n".join([*lines, ""]).encode()
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("order", ["", "<", ">"])
@pytest.mark.parametrize(
    "rows",
    [
        [_joined(STRIPS + SECOND)],
        [_joined(STRIPS)[:-1], _joined(SECOND)],
        [*STRIPS, [], *SECOND, [-1], [0, 1]],
        # Strips joined by degenerate triangles.
        [[*STRIPS[0], 4, 0, *STRIPS[1], -1, *STRIPS[2]], *SECOND],
    ],
)
def test_two_boxes_of_strips(tmp_path: Path, rows: list[list[int]], order: str) -> None:
    mesh = read_mesh(_ply(tmp_path / "boxes.ply", rows, order))
    assert len(mesh.faces) == 24
    assert mesh.topology.is_watertight
    a, b, c = mesh.vertices[mesh.faces.T]
    volume = np.einsum("fi,fi->", np.cross(a, b), c) / 6.0
    assert abs(volume) == pytest.approx(2.0)
    assert CollisionDetector(mesh.topology, mesh.vertices).summarise(mesh.vertices).n_pairs == 13


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_strips_beside_faces(tmp_path: Path, order: str) -> None:
    mesh = read_mesh(_ply(tmp_path / "a.ply", [[8, 9, 10, 11]], order, [[0, 1, 2, 3], [4, 5, 6]]))
    expected = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [8, 9, 10], [10, 9, 11]]
    assert mesh.faces.tolist() == expected


@pytest.mark.parametrize(
    ("row", "message"),
    [([0, 1, -2], "names vertices"), ([0, 1, 99], "names vertices"), ([0, 1], "no faces")],
)
def test_strips_of_no_triangles_are_refused(tmp_path: Path, row: list[int], message: str) -> None:
    with pytest.raises(MeshFileError, match=message):
        read_mesh(_ply(tmp_path / "a.ply", [row], "<"))


@pytest.mark.parametrize(("kind", "code"), [("uchar", "B"), ("ushort", "H"), ("uint", "I")])
@pytest.mark.parametrize("n_unused", [0, 240])
def test_unsigned_strips_end_with_the_largest_number_unless_it_is_a_vertex(
    tmp_path: Path, kind: str, code: str, n_unused: int
) -> None:
    row = np.array(_joined(STRIPS + SECOND), dtype=f"<{code}".lower().replace("b", "i1"))
    header = [
        "ply\nformat binary_little_endian 1.0",
        f"element vertex {len(VERTICES) + n_unused}",
        *(f"property float {axis}" for axis in "xyz"),
        f"element tristrips 1\nproperty list int {kind} vertex_indices\nend_header\n",
    ]
    path = tmp_path / "boxes.ply"
    points = np.concatenate([VERTICES, np.zeros((n_unused, 3))])
    path.write_bytes(
        "\n".join(header).encode()
        + points.astype("<f4").tobytes()
        + struct.pack("<i", len(row))
        + row.tobytes()
    )
    n_faces = len(read_mesh(path).faces)
    assert (n_faces == 24) == (kind != "uchar" or n_unused == 0)
