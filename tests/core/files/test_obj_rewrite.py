from __future__ import annotations

import re
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from scipy.spatial.transform import Rotation

from lcollision_core.errors import MeshFileError, ShapeError
from lcollision_core.files.mesh import obj
from lcollision_core.files.mesh.obj import rewrite_obj, rewritten
from tests.core.files.test_files import obj_texts

CUBE = b"""\
# a cube in quads\r
mtllib cube.mtl\r
o Cube.001\r
v -1.000000 -1.0 -1 0.25 0.5 0.75\r
v 1 -1 -1 0.1 0.2 0.3\r
v\t1  1 -1\r
  v -1 1 -1 # of the lid\r
vt 0.0 0.0\r
vt 1.0 0.125\r
vn 0 0 -1\r
g lid\r
usemtl Red Paint\r
s 1\r
f 4/1/1 3/2/1 2/2/1 1/1/1\r
v -1 -1 1\r
v 1 -1 1\r
v 1 1 1\r
v -1 1 1\r
vn 0 0 1.0\r
vn 0.0000 -1.0 0.0000\r
g sides bottom\r
f -4/1/-2 -3/1/-2 \\\r
  -2/2/-2 -1/2/-2\r
f 1//3 2//3 6//3 5//3\r
usemtl\r
f 3 7 6 2\r
# f 1 2 3\r
l 1 2"""
CORNERS = obj.read(BytesIO(CUBE)).vertices


def _without_coordinates(data: bytes) -> bytes:
    return re.sub(rb"(?m)^(\s*vn?)(\s+)\S+(\s+)\S+(\s+)\S+", rb"\1\2.\3.\4.", data)


def test_the_same_positions_give_the_same_bytes() -> None:
    assert rewritten(CUBE, CORNERS) == CUBE


def test_all_but_the_coordinates_stays_byte_for_byte() -> None:
    moved = CORNERS * [1.5, 0.7, 2.0] + 1.0 / 3.0
    result = rewritten(CUBE, moved)
    assert result != CUBE
    assert _without_coordinates(result) == _without_coordinates(CUBE)
    assert b" 0.25 0.5 0.75\r\n" in result
    assert np.array_equal(obj.read(BytesIO(result)).vertices, moved)


def test_a_vertex_that_stays_keeps_its_text() -> None:
    moved = CORNERS.copy()
    moved[2] += 0.5
    lines = zip(CUBE.split(b"\r\n"), rewritten(CUBE, moved).split(b"\r\n"), strict=True)
    changed = [after for before, after in lines if before != after]
    assert changed[0] == b"v\t1.5  1.5 -0.5"
    assert [line.split()[0] for line in changed] == [b"v", b"vn"]


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_normals_turn_with_the_mesh(scale: float) -> None:
    turn = Rotation.from_rotvec([0.3, -1.2, 0.5]).as_matrix()
    before, after = (
        obj.read_corners(data)
        for data in (CUBE, rewritten(CUBE, CORNERS @ turn.T * scale + [1.0, 2.0, 3.0]))
    )
    assert np.abs(after.normals - before.normals @ turn.T).max() < 1e-14
    assert after.corner_normals.tolist() == [0] * 4 + [1] * 4 + [2] * 4 + [-1] * 4


def test_flat_and_smooth_normals_are_those_of_the_new_shape() -> None:
    ridge = (
        b"v 0 0 0\nv 1 0 0\nv 2 0 0\nv 0 1 0\nv 1 1 0\nv 2 1 0\nvn 0 0 1\nvn 0 0 2\nvn 0 0 1\n"
        b"f 1//1 2//2 5//2 4//1\nf 2//2 3//3 6//3 5//2\n"
    )
    bent = np.array([[0, 0, -1], [1, 0, 0], [2, 0, -1], [0, 1, -1], [1, 1, 0], [2, 1, -1.0]])
    normals = obj.read_corners(rewritten(ridge, bent)).normals
    half = np.sqrt(0.5)
    assert np.abs(normals - [[-half, 0, half], [0, 0, 1], [half, 0, half]]).max() < 1e-15


def test_a_normal_that_several_faces_share_is_their_mean() -> None:
    sheet = (
        b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 2 0 0\nv 2 1 0\nvn 0 0 1\n"
        b"f 1//1 2//1 3//1 4//1\nf 2//1 5//1 6//1 3//1\n"
    )
    folded = obj.read(BytesIO(sheet)).vertices
    folded[4:] = [[1, 0, 1], [1, 1, 1]]
    (normal,) = obj.read_corners(rewritten(sheet, folded)).normals
    assert np.abs(normal - np.array([-1.0, 0.0, 1.0]) / np.sqrt(2.0)).max() < 1e-14


def test_normals_follow_the_inverse_transpose_of_a_stretch() -> None:
    slope = b"v 0 0 0\nv 1 0 1\nv 0 1 0\nvn -1 0 1\nf 1//1 2//1 3//1\n"
    stretched = obj.read(BytesIO(slope)).vertices * [3.0, 1.0, 1.0]
    (normal,) = obj.read_corners(rewritten(slope, stretched)).normals
    assert np.abs(normal - np.array([-1.0, 0.0, 3.0]) / np.sqrt(10.0)).max() < 1e-14


def test_a_triangle_without_area_leaves_its_normal() -> None:
    line = b"v 0 0 0\nv 1 0 0\nv 2 0 0\nvn 0 0 1\nf 1//1 2//1 3//1\n"
    result = rewritten(line, obj.read(BytesIO(line)).vertices + [0.0, 1.0, 0.0])
    assert b"vn 0 0 1\n" in result
    assert b"v 1.0 1.0 0.0\n" in result


@given(obj_texts())
@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=150
)
def test_every_dialect_is_rewritten(drawn: tuple[str, np.ndarray, list[list[int]]]) -> None:
    text, vertices, polygons = drawn
    data = text.encode()
    assert rewritten(data, vertices) == data
    moved = np.random.default_rng(0).normal(size=vertices.shape)
    held = obj.read_corners(rewritten(data, moved))
    assert np.array_equal(held.vertices, moved)
    assert held.sizes.tolist() == list(map(len, polygons))
    assert held.corners.tolist() == [corner for one in polygons for corner in one]


def test_a_byte_order_mark_stays() -> None:
    marked = b"\xef\xbb\xbfv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    assert rewritten(marked, np.eye(3)).startswith(b"\xef\xbb\xbfv 1.0 0.0 0.0\n")


def test_another_number_of_vertices_is_refused() -> None:
    with pytest.raises(ShapeError, match=r"of shape \(8, 3\), got \(7, 3\)"):
        rewritten(CUBE, CORNERS[:7])


def test_what_only_looks_like_a_vertex_is_refused() -> None:
    # The backslash continues the group's line.
    odd = b"v 0 0 0\nv 1 0 0\ng a \\\nv 9 9 9\nv 0 1 0\nf 1 2 3\n"
    assert rewritten(odd, obj.read(BytesIO(odd)).vertices) == odd
    with pytest.raises(MeshFileError, match="export the mesh again"):
        rewritten(odd, np.eye(3))


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    source, target = tmp_path / "cube.obj", tmp_path / "posed.obj"
    with pytest.raises(MeshFileError, match=r"cube\.obj cannot be read: No such file"):
        rewrite_obj(target, source, CORNERS)
    source.write_bytes(CUBE)
    with pytest.raises(ShapeError):
        rewrite_obj(target, source, CORNERS[1:])
    assert not target.exists()
    rewrite_obj(target, source, CORNERS * 2.0)
    assert target.read_bytes() == rewritten(CUBE, CORNERS * 2.0)
    # Also onto itself.
    rewrite_obj(source, source, CORNERS * 2.0)
    assert source.read_bytes() == target.read_bytes()
