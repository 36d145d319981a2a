from __future__ import annotations

import io
import itertools
import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from lcollision_core.errors import MeshFileError
from lcollision_core.files import Mesh, read_mesh, read_pose_set, write_mesh
from lcollision_core.files.formats import WRITABLE_SUFFIXES
from lcollision_core.files.mesh import obj
from lcollision_core.files.mesh.polygons import first_at_each_position
from lcollision_core.files.mesh.text import number_rows, points
from lcollision_core.meshes import Topology
from lcollision_core.meshes.precision import can_hold
from tests.core.background import peak_memory

# One file per test function: Hypothesis overwrites it with every example.
SHARED_FOLDER = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=60
)

# Vertices not in order of first use, two at the same position and one in no face: cases that a
# careless reader would merge, drop or renumber.
VERTICES = np.array(
    [[0.1, 0.2, 0.3], [1, 0, 0], [-1.5, 2e-7, 1e5], [0, 1, 0], [0, 1, 0], [1 / 3, 2 / 3, -0.7]]
)
FACES = np.array([[3, 1, 0], [0, 4, 5], [5, 1, 3]], dtype=np.int32)


def _assert_valid(mesh: Mesh) -> None:
    assert mesh.vertices.dtype == np.float64
    assert mesh.vertices.shape == (mesh.topology.n_vertices, 3)
    assert np.isfinite(mesh.vertices).all()
    assert not mesh.vertices.flags.writeable
    assert len(mesh.faces) > 0
    assert mesh.faces.min() >= 0
    assert mesh.faces.max() < len(mesh.vertices)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("suffix", WRITABLE_SUFFIXES)
def test_round_trip_keeps_every_vertex_and_face(
    tmp_path: Path, suffix: str, dtype: type[np.floating]
) -> None:
    vertices = VERTICES.astype(dtype)
    faces = FACES
    if suffix == ".stl":  # it cannot store a vertex without faces
        vertices, faces = np.delete(vertices, 2, axis=0), np.where(FACES > 2, FACES - 1, FACES)
    path = tmp_path / f"mesh{suffix.upper()}"
    write_mesh(path, vertices, faces)
    topology = Topology(faces, len(vertices))
    mesh = read_mesh(path, topology=topology)
    _assert_valid(mesh)
    assert mesh.topology is topology
    assert mesh.source == path
    stored = np.float32 if suffix in (".stl", ".glb") else dtype
    assert np.array_equal(mesh.vertices.astype(stored), vertices.astype(stored))
    if suffix != ".stl":
        again = read_mesh(path)
        assert np.array_equal(again.faces, faces)
        assert np.array_equal(again.vertices, mesh.vertices)
        assert again.notes == ()


finite_floats = st.builds(
    lambda sign, exponent, fraction: struct.unpack(
        "<d", struct.pack("<Q", sign << 63 | exponent << 52 | fraction)
    ),
    st.integers(0, 1),
    st.integers(0, 2046),
    st.integers(0, 2**52 - 1),
)


@given(st.lists(finite_floats, min_size=3, max_size=30))
@example([(5e-324,), (-0.0,), (1.7976931348623157e308,)])
@SHARED_FOLDER
def test_any_float64_survives_text_formats_bit_for_bit(
    tmp_path: Path, numbers: list[tuple[float]]
) -> None:
    # A mesh of only subnormal numbers, coarser than its edges, would be refused: add 1.0.
    vertices = np.resize(np.array([(1.0,), *numbers]), (len(numbers), 3))
    # So would a mesh too far away for the precision of its edges.
    topology = Topology(np.array([[0, 1, 2]]), len(vertices))
    assume(can_hold(vertices, topology, np.float64))
    for suffix in (".obj", ".off", ".ply"):
        write_mesh(tmp_path / f"m{suffix}", vertices, np.array([[0, 1, 2]]))
        assert read_mesh(tmp_path / f"m{suffix}").vertices.tobytes() == vertices.tobytes()


@given(st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=9, max_size=9))
@SHARED_FOLDER
def test_any_float32_survives_with_short_decimals(tmp_path: Path, numbers: list[float]) -> None:
    vertices = np.array(numbers, dtype=np.float32).reshape(3, 3)
    write_mesh(tmp_path / "m.obj", vertices, np.array([[0, 1, 2]]))
    assert read_mesh(tmp_path / "m.obj").vertices.astype(np.float32).tobytes() == vertices.tobytes()
    words = (tmp_path / "m.obj").read_text().split("\n")[0].split()[1:]
    assert words == [str(x) for x in vertices[0]]


def test_coordinates_beyond_whole_numbers_of_64_bits(tmp_path: Path) -> None:
    text = "v 99999999999999999999 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    (tmp_path / "m.obj").write_text(text)
    assert read_mesh(tmp_path / "m.obj").vertices[0, 0] == 1e20


def test_obj_counts_vertices_from_one(tmp_path: Path) -> None:
    write_mesh(tmp_path / "m.obj", np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]))
    assert (tmp_path / "m.obj").read_text() == (
        "v 1.0 0.0 0.0\nv 0.0 1.0 0.0\nv 0.0 0.0 1.0\nf 1 2 3\n"
    )


@st.composite
def obj_texts(draw: st.DrawFn) -> tuple[str, np.ndarray, list[list[int]]]:
    """Draw an OBJ file in one of its many dialects, and its expected content."""
    n = draw(st.integers(3, 12))
    coordinate = st.floats(-1e6, 1e6, allow_subnormal=False)
    vertices = np.array(
        draw(st.lists(st.lists(coordinate, min_size=3, max_size=3), min_size=n, max_size=n))
    )
    blank = st.sampled_from([" ", "  ", "\t", " \t "])
    margin = st.sampled_from(["", " ", "\t"])
    end = draw(st.sampled_from(["\n", "\r\n", "\r"]))
    comment = st.sampled_from(["", " # f 1 2 3"])
    corner = draw(st.sampled_from(["{}", "{}/1", "{}//1", "{}/1/1", "{}/"]))
    signs = draw(st.sampled_from(["positive", "negative", "mixed"]))
    lines = ["# made up", "mtllib none.mtl", "o thing", "vt 0 0", "vn 0 0 1"]
    for vertex in vertices:
        extra = draw(st.sampled_from(["", " 1.0", " 0.5 0.5 0.5"]))
        words = draw(blank).join(["v", *map(repr, vertex.tolist())])
        lines.append(draw(margin) + words + extra + draw(comment))
        lines += draw(st.sampled_from([[], [""], ["s off"], ["g part"], ["#"]]))
    polygons = []
    for _ in range(draw(st.integers(1, 6))):
        polygon = draw(st.permutations(range(n)))[: draw(st.integers(3, min(n, 6)))]
        polygons.append(polygon)
        words = []
        for vertex in polygon:
            negative = signs == "negative" or (signs == "mixed" and draw(st.booleans()))
            words.append(corner.format(vertex - n if negative else vertex + 1))
        joint = draw(st.sampled_from([" ", "\t", f" \\{end} "])) if end != "\r" else " "
        lines.append(draw(margin) + "f " + joint.join(words) + draw(margin) + draw(comment))
    text = end.join(lines) + draw(st.sampled_from(["", end]))
    return text, vertices, polygons


@given(obj_texts())
@settings(SHARED_FOLDER, max_examples=150)
def test_obj_dialects_mean_the_same(drawn: tuple[str, np.ndarray, list[list[int]]]) -> None:
    text, vertices, polygons = drawn
    held = obj.read(io.BytesIO(text.encode()))
    assert np.array_equal(held.vertices, vertices)
    assert held.sizes.tolist() == list(map(len, polygons))
    assert held.corners.tolist() == list(itertools.chain(*polygons))


def test_obj_negative_numbers_count_back_from_where_they_stand(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 0 0 1\nf -4 -1 -3\nf 2 3 -1\n"
    )
    assert read_mesh(tmp_path / "m.obj").faces.tolist() == [[0, 1, 2], [0, 3, 1], [1, 2, 3]]


def test_byte_order_mark_hides_no_vertex(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_bytes(b"\xef\xbb\xbf" + (TRIANGLE + "f 1 2 3\n").encode())
    assert len(read_mesh(tmp_path / "m.obj").vertices) == 3


def test_seams_of_textures_and_normals_split_no_vertex(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nvn 0 0 1\nvn 0 0 -1\n"
        "f 1/1/1 2/2/1 3/3/1\nf 2/3/2 4/1/2 3/2/2\n"
    )
    mesh = read_mesh(tmp_path / "m.obj")
    assert len(mesh.vertices) == 4
    assert mesh.faces.tolist() == [[0, 1, 2], [1, 3, 2]]


@pytest.mark.parametrize(
    ("suffix", "text"),
    [
        (
            ".obj",
            "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv -1 0.5 0\nf 1 2 3 4\nf 1 2 5\nf 1 2 3 4 5\n",
        ),
        (
            ".off",
            "OFF # comment\n\n5 3 0\n0 0 0\n1 0 0\n1 1 0\n# more\n0 1 0\n-1 0.5 0\n"
            "4 0 1 2 3 255 0 0\n3 0 1 4\n5 0 1 2 3 4\n",
        ),
        (
            ".off",
            "OFF5 3 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n-1 0.5 0\n4 0 1 2 3\n3 0 1 4\n5 0 1 2 3 4\n",
        ),
        (
            ".ply",
            "ply\nformat ascii 1.0\ncomment x\nelement vertex 5\nproperty float x\n"
            "property float y\n"
            "property float z\nproperty uchar red\nelement face 3\nproperty uchar flag\n"
            "property list uchar int vertex_indices\nend_header\n0 0 0 9\n1 0 0 9\n1 1 0 9\n"
            "0 1 0 9\n-1 0.5 0 9\n7 4 0 1 2 3\n7 3 0 1 4\n7 5 0 1 2 3 4\n",
        ),
    ],
)
def test_polygons_become_fans_and_the_notes_say_so(tmp_path: Path, suffix: str, text: str) -> None:
    (tmp_path / f"m{suffix}").write_text(text)
    mesh = read_mesh(tmp_path / f"m{suffix}")
    assert mesh.faces.tolist() == [
        [0, 1, 2], [0, 2, 3], [0, 1, 4], [0, 1, 2], [0, 2, 3], [0, 3, 4]
    ]  # fmt: skip
    assert mesh.notes == (
        "1 quad was triangulated",
        "1 polygon of more than four corners was triangulated",
    )


def _binary_ply(order: str, rows: list[list[int]], vertices: np.ndarray = VERTICES) -> bytes:
    """Write a PLY with a further element before, a property between and an element after."""
    name = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    header = (
        f"ply\nformat {name} 1.0\nelement camera 2\nproperty short id\n"
        f"property list uchar float lens\nelement vertex {len(vertices)}\nproperty uchar red\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(rows)}\nproperty list uchar ushort vertex_index\nproperty float q\n"
        "element edge 1\nproperty int a\nend_header\n"
    )
    body = struct.pack(f"{order}hB2fhB", 1, 2, 0.5, 0.5, 2, 0)
    body += b"".join(struct.pack(f"{order}Bddd", 7, *vertex) for vertex in vertices)
    body += b"".join(struct.pack(f"{order}B{len(row)}Hf", len(row), *row, 1.5) for row in rows)
    return header.encode() + body + b"\0\0\0\0"


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("rows", [FACES.tolist(), [[0, 1, 3, 5], [0, 4, 5]]])
def test_binary_ply_in_both_byte_orders(tmp_path: Path, order: str, rows: list[list[int]]) -> None:
    (tmp_path / "m.ply").write_bytes(_binary_ply(order, rows))
    mesh = read_mesh(tmp_path / "m.ply")
    assert np.array_equal(mesh.vertices, VERTICES)
    expected = rows if rows == FACES.tolist() else [[0, 1, 3], [0, 3, 5], [0, 4, 5]]
    assert mesh.faces.tolist() == expected


TEXT_STL = """solid body
facet normal 0 0 1
 outer loop
  vertex 0 0 0
  vertex 1 0 0
  vertex -0.0 1 0
 endloop
endfacet
facet normal 0 0 1
 outer loop
  vertex 0 1 0
  vertex 1 0 0
  vertex 1 1 2.5E-1
 endloop
endfacet
endsolid body
"""


def test_text_stl_joins_equal_corners_by_first_appearance(tmp_path: Path) -> None:
    (tmp_path / "m.stl").write_text(TEXT_STL)
    mesh = read_mesh(tmp_path / "m.stl")
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.25]]
    assert mesh.faces.tolist() == [[0, 1, 2], [2, 1, 3]]
    assert mesh.notes == (
        "STL stores no shared vertices; corners at equal coordinates were joined",
    )


def test_stl_of_another_topology_is_joined_not_forced(tmp_path: Path) -> None:
    (tmp_path / "m.stl").write_text(TEXT_STL)
    other = Topology([[0, 1, 2], [0, 1, 3]], 4)
    assert read_mesh(tmp_path / "m.stl", topology=other).faces.tolist() == [[0, 1, 2], [2, 1, 3]]


def test_glb_node_places_the_mesh(tmp_path: Path) -> None:
    import trimesh

    scene = trimesh.Scene()
    scene.add_geometry(
        trimesh.Trimesh(VERTICES[[0, 1, 3, 5]], [[0, 1, 2], [0, 2, 3]], process=False),
        transform=trimesh.transformations.translation_matrix([1.0, 2.0, 3.0]),
    )
    (tmp_path / "m.glb").write_bytes(scene.export(file_type="glb"))
    mesh = read_mesh(tmp_path / "m.glb")
    assert np.abs(mesh.vertices - VERTICES[[0, 1, 3, 5]] - [1, 2, 3]).max() < 1e-6


def test_glb_whose_vertices_were_split_gets_the_order_of_its_topology(tmp_path: Path) -> None:
    import trimesh

    split = trimesh.Trimesh(
        VERTICES[FACES.reshape(-1)], np.arange(3 * len(FACES)).reshape(-1, 3), process=False
    )
    path = tmp_path / "m.glb"
    path.write_bytes(trimesh.Scene(split).export(file_type="glb"))
    used = np.unique(FACES)
    faces = np.searchsorted(used, FACES)
    mesh = read_mesh(path, topology=Topology(faces, len(used)))
    assert np.array_equal(mesh.faces, faces)
    assert np.array_equal(mesh.vertices, VERTICES[used].astype(np.float32))
    assert mesh.notes == ("vertices that had been split were put back into the set's vertex order",)
    assert len(read_mesh(path).vertices) == 3 * len(FACES)
    other = Topology(np.roll(faces, 1, axis=0), len(used))
    assert len(read_mesh(path, topology=other).vertices) == 3 * len(FACES)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_glb_is_written_upright(tmp_path: Path, axis: int, sign: float) -> None:
    """Rotated by exact right angles; other formats do not define the up axis."""
    up = sign * np.eye(3)[axis] + [0.1, 0.2, -0.3]
    for suffix in (".glb", ".obj"):
        write_mesh(tmp_path / f"m{suffix}", VERTICES, FACES, up=up)
    turned = read_mesh(tmp_path / "m.glb").vertices
    was = VERTICES.astype(np.float32).astype(np.float64)
    assert np.array_equal(turned[:, 1], sign * was[:, axis])
    assert np.array_equal(np.sort(np.abs(turned), axis=1), np.sort(np.abs(was), axis=1))
    turn, *_ = np.linalg.lstsq(was - was.mean(axis=0), turned - turned.mean(axis=0), rcond=None)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    assert np.array_equal(read_mesh(tmp_path / "m.obj").vertices, VERTICES)


def test_glb_has_smooth_normals(tmp_path: Path) -> None:
    write_mesh(tmp_path / "m.glb", VERTICES, FACES)
    data = (tmp_path / "m.glb").read_bytes()
    held = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    attributes = held["meshes"][0]["primitives"][0]["attributes"]
    accessors = held["accessors"]
    assert accessors[attributes["NORMAL"]]["count"] == len(VERTICES)


def test_gltf_finds_the_buffers_beside_it(tmp_path: Path) -> None:
    import trimesh

    files = trimesh.Scene(trimesh.Trimesh(VERTICES, FACES, process=False)).export(file_type="gltf")
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    mesh = read_mesh(tmp_path / "model.gltf")
    assert np.array_equal(mesh.vertices, VERTICES.astype(np.float32))
    assert np.array_equal(mesh.faces, FACES)
    for buffer in tmp_path.glob("*.bin"):
        buffer.unlink()
    missing = r"its buffer '.*' cannot be read: No such file or directory; put it beside the file$"
    with pytest.raises(MeshFileError, match=rf"model\.gltf .* {missing}"):
        read_mesh(tmp_path / "model.gltf")


def test_glb_with_two_meshes_is_read_as_one(tmp_path: Path) -> None:
    import trimesh

    box = trimesh.creation.box()
    scene = trimesh.Scene([box, box.copy().apply_translation([3, 0, 0])])
    (tmp_path / "m.glb").write_bytes(scene.export(file_type="glb"))
    mesh = read_mesh(tmp_path / "m.glb")
    assert mesh.topology.vertex_components[0] == 2
    assert np.ptp(mesh.vertices, axis=0).tolist() == [4.0, 1.0, 1.0]


HEADER = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\n"
HEADER += "property float z\nelement face {}\nproperty list uchar int vertex_indices\nend_header\n"
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.obj", "", "is empty"),
        ("a.obj", "hello\n", "contains no vertices"),
        ("a.obj", TRIANGLE, "contains vertices but no faces"),
        ("a.obj", TRIANGLE + "f 1 2 3\nf 1 2 4\n", "face 1 names vertices"),
        ("a.obj", TRIANGLE + "f 1 2 0\n", "face 0 .* names vertex 0, but OBJ counts"),
        ("a.obj", TRIANGLE + "f 1 2 -4\n", "face 0 .* names vertex -4"),
        ("a.obj", TRIANGLE + "f 1 2 3\nf 1 2\n", "face 1 .* has 2 corners"),
        ("a.obj", TRIANGLE + "f\n", "face 0 .* has 0 corners"),
        ("a.obj", TRIANGLE + "f 1 2 2\n", "contains vertices but no faces"),
        ("a.obj", TRIANGLE + "f 1 2 3\nf 1 x 3\n", "face 1 .* holds 'x', which is not a number"),
        ("a.obj", TRIANGLE + "f 1 2 /3\n", "face 0 .* holds '/3', which is not a number"),
        ("a.obj", TRIANGLE + "f 1 2 99999999999999999999\n", "face 0 .* not a vertex number"),
        ("a.obj", TRIANGLE + "f 1/1 2/2 99999999999999999999/3\n", "face 0 .* not a vertex number"),
        ("a.obj", TRIANGLE + "v 1 nan 2\nf 1 2 3\n", "vertex 3 .* not finite"),
        ("a.obj", TRIANGLE + "v 1 2 1e999\nf 1 2 3\n", "vertex 3 .* not finite"),
        ("a.obj", TRIANGLE + "v 1 2\nf 1 2 3\n", "vertex 3 .* has 2 coordinates"),
        ("a.obj", TRIANGLE + "v 1 2 y\nf 1 2 3\n", "vertex 3 .* not a number"),
        ("a.obj", TRIANGLE + "\0", "not a text file"),
        ("a.obj", TRIANGLE + "f 1 2 3\nf 1 2 \\", "face 1 .* has 2 corners"),
        ("a.off", "OFX\n", "does not start with OFF"),
        ("a.off", "OFF\n", "counts .* missing"),
        ("a.off", "OFF BINARY\n3 1 0\n", "does not start with OFF"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n", "truncated"),
        ("a.off", "OFF\n-3 1 0\n0 0 0\n", "damaged"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0\n0 1 0\n3 0 1 2\n", "vertex 1 .* 2 coordinates"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 x\n0 1 0\n3 0 1 2\n", "not a number"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1\n", "face 0 .* 3 corners but has 2"),
        (
            "a.off",
            "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 z\n",
            "face 0 .* holds 'z', which is not a number",
        ),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", "face 0 names vertices"),
        ("a.off", "OFF\n1 50000000 0\n0 0 0\n", "holds 50000000 faces"),
        ("a.ply", "plx\n", "does not start with the word ply"),
        ("a.ply", "ply\nformat ascii 1.0\n", "header has no end"),
        ("a.ply", "ply\nformat ascii 1.0\nbanana\n", "not understood: 'banana'"),
        ("a.ply", HEADER.format(3, 50_000_000), "holds 50000000 faces"),
        ("a.ply", HEADER.format(50_000_000, 1), "holds 50000000 vertices"),
        ("a.ply", HEADER.format(3, 1) + "0 0 0\n1 0 0\n", "'vertex' but ends before"),
        ("a.ply", HEADER.format(3, 1) + "0 0 0\n1 0 0\n0 1 0\n3 0 1", "ends before at face 0"),
        ("a.ply", HEADER.format(3, 1) + "0 0 0\n1 0 0\n0 1 0\n-3 0 1 2", "face 0 .* announces"),
        ("a.ply", HEADER.format(3, 1) + "0 0 0\n1 0 0\n0 1 0\n3 0 1 1.5", "face 0 .*: 1.5"),
        ("a.ply", HEADER.format(3, 1) + "0 0 0\n1 0 0\n0 1 0\n3 0 1 inf", "face 0 .*: inf"),
        (
            "a.ply",
            HEADER.format(3, 1) + "0 0 0\n1 0 0\n0 x 0\n3 0 1 2",
            "holds 'x', which is not a number",
        ),
        ("a.ply", HEADER.format(3, 1) + "0 0 0\n1 0 0\n0 inf 0\n3 0 1 2", "vertex 2 .* not finite"),
        ("a.ply", HEADER.format(3, 1).replace("float z", "float w"), "no x, y and z"),
        ("a.ply", HEADER.format(3, 1).replace("element face", "element tri"), "0 elements 'face'"),
        ("a.ply", HEADER.format(3, 1).replace("list uchar int", "int"), "no list vertex_indices"),
        ("a.stl", "solid x\n", "truncated or damaged"),
        ("a.stl", TEXT_STL[:-60], "truncated or damaged"),
        ("a.stl", "x" * 50, "too few"),
        ("a.stl", "x" * 80 + "\1\0\0\0", "announces 1 triangles, which take 134 bytes, but has 84"),
        (
            "a.stl",
            "\xff" * 200,
            "truncated or not an STL file: it announces 4294967295 triangles",
        ),
        ("a.glb", "glTF\2\0\0\0", "truncated GLB"),
        ("a.glb", "glTF\1\0\0\0", "it is glTF 1.0, and only 2.0 is read"),
        ("a.gltf", '{"asset": {"version": "1.0"}, "meshes": {}}', "it is glTF 1.0, and only"),
        ("a.gltf", '{"asset": {"version": 1}, "accessors": {}}', "it is glTF 1.0, and only"),
        ("a.gltf", "{", "no readable glTF"),
        ("a.gltf", '{"meshes": []}', "it shows no triangles"),
        (
            "a.gltf",
            '{"nodes": [{"mesh": 0}], "accessors": [{"count": 900000000}], "meshes": [{"primitives"'
            ': [{"attributes": {"POSITION": 0}}]}]}',
            "count of positions of mesh 0 must be a whole number from 0 to 5000000, got 900000000",
        ),
        ("a.fbx", "x", "damaged or unsupported FBX"),
        ("a.dae", "x", r"\.dae is not a known mesh format"),
        ("a", "x", "without extension"),
    ],
)
def test_bad_files_get_one_sentence_with_file_and_element(
    tmp_path: Path, name: str, content: str, message: str
) -> None:
    path = tmp_path / name
    path.write_bytes(content.encode("latin-1"))
    with pytest.raises(MeshFileError, match=message) as caught:
        read_mesh(path)
    assert str(caught.value).startswith(f"{path} cannot be read: ")
    assert "; " in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file_folder_and_forbidden_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MeshFileError, match=r"none\.obj .* no such file"):
        read_mesh(tmp_path / "none.obj")
    with pytest.raises(MeshFileError, match="is a folder"):
        read_mesh(tmp_path)
    os.mkfifo(tmp_path / "pipe.obj")
    with pytest.raises(MeshFileError, match="not a plain file"):
        read_mesh(tmp_path / "pipe.obj")
    with pytest.raises(MeshFileError, match=r"no such file|too long"):
        read_mesh(tmp_path / ("x" * 300 + ".obj"))


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is forbidden to root")
def test_forbidden_files_and_folders_are_refused(tmp_path: Path) -> None:
    shut = tmp_path / "shut"
    shut.mkdir()
    (shut / "m.obj").write_text("v 0 0 0\n")
    path = tmp_path / "m.obj"
    path.write_text("v 0 0 0\n")
    path.chmod(0)
    with pytest.raises(MeshFileError, match=r"m\.obj .* permission is denied"):
        read_mesh(path)
    shut.chmod(0)
    try:
        with pytest.raises(MeshFileError, match=r"m\.obj .* permission is denied"):
            read_mesh(shut / "m.obj")
        with pytest.raises(MeshFileError, match="Permission denied"):
            write_mesh(shut / "m.obj", VERTICES, FACES)
        for place in (shut, shut / "s.npz"):
            with pytest.raises(MeshFileError, match="Permission denied"):
                read_pose_set(place)
    finally:
        shut.chmod(0o700)


def _sparse(path: Path, head: bytes, size: int) -> None:
    with path.open("wb") as file:
        file.write(head)
        file.truncate(size)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".obj", ".ply", ".off", ".stl", ".glb"])
def test_fifty_million_faces_are_refused_without_taking_memory(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"big{suffix}"
    n = 50_000_000
    if suffix == ".obj":
        path.write_bytes(b"v 0 0 0\n" * 3 + b"f 1 2 3\n" * (n // 8))
    elif suffix == ".ply":
        _sparse(path, HEADER.replace("ascii", "binary_little_endian").format(n, n).encode(), n * 25)
    elif suffix == ".off":
        _sparse(path, f"OFF\n{n} {n} 0\n".encode(), n * 20)
    elif suffix == ".stl":
        _sparse(path, bytes(80) + n.to_bytes(4, "little"), 84 + 50 * n)
    else:
        _sparse(path, b"glTF", (1 << 30) + 1)

    def read() -> None:
        with pytest.raises(MeshFileError, match=r"holds .* faces|triangles|vertices|larger than"):
            read_mesh(path)

    assert peak_memory(read) < 100 << 20


def test_triangles_follow_each_other_in_any_unit(tmp_path: Path) -> None:
    # STL stores float32, so at a scale where float32 is coarse, equality shows a mix-up.
    vertices = VERTICES[[0, 1, 3, 5]] * 1e-30
    write_mesh(tmp_path / "m.stl", vertices, np.array([[0, 1, 2], [3, 2, 1]]))
    corners = read_mesh(tmp_path / "m.stl")
    expected = vertices[[0, 1, 2, 3, 2, 1]].astype(np.float32)
    assert np.array_equal(corners.vertices[corners.faces.reshape(-1)], expected)


def test_equal_points_are_found_by_their_first() -> None:
    points = np.random.default_rng(2).integers(-2, 3, (500, 3)).astype(np.float64)
    points[::3] *= -1.0  # zeros of either sign are one position
    seen: dict[tuple[float, ...], int] = {}
    expected = [seen.setdefault(tuple(point), place) for place, point in enumerate(points.tolist())]
    assert first_at_each_position(points).tolist() == expected
    assert len(seen) < 126


def test_stl_of_corners_that_are_not_finite_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "nan.stl"
    n_faces = 60
    corners = np.full((3 * n_faces, 3), 1.0)
    write_mesh(path, corners, np.arange(3 * n_faces).reshape(-1, 3))
    path.write_bytes(path.read_bytes().replace(b"\x00\x00\x80\x3f", b"\x00\x00\xc0\x7f"))
    with pytest.raises(Exception, match="not finite"):
        read_mesh(path)


@given(
    st.lists(
        st.lists(st.one_of(st.integers(), st.floats(allow_nan=False)), max_size=5), max_size=6
    ),
    st.booleans(),
)
@SHARED_FOLDER
def test_lines_of_numbers_are_read_alike_at_once_and_word_by_word(
    rows: list[list[float]], is_odd: bool
) -> None:
    text = "".join(" ".join(map(repr, row)) + "\n" for row in rows)
    odd = "1_0\n" if is_odd else "10\n"  # which only the slow path reads
    values, sizes = number_rows((text + odd).encode(), "row")
    assert values.tolist() == [float(value) for row in rows for value in row] + [10.0]
    assert sizes.tolist() == [len(row) for row in rows] + [1]


@pytest.mark.parametrize("word", [b"x", b"1.2.3", b"1e", b"1-2", b"+", b"1,5", b"0x1", b"a"])
def test_a_word_that_is_no_number_is_named(word: bytes) -> None:
    with pytest.raises(
        MeshFileError, match=r"vertex 1 \(from 0\) holds '.*', which is not a number"
    ):
        points(b"0 0 0\n0 " + word + b" 0\n", "vertex")
