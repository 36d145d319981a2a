"""The quick ways for large meshes: each does what the careful one does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lcollision_core.contact import CollisionDetector, tree
from lcollision_core.meshes import Topology, audit_mesh, read_mesh, write_mesh
from lcollision_core.meshes.formats import obj, ply
from lcollision_core.meshes.formats.polygons import first_at_each_place
from tests.core.shapes import box, interlocked_tori, join, soup, sphere


@pytest.mark.parametrize(
    "mesh",
    [
        interlocked_tori(0.6),
        soup(np.random.default_rng(8).random((333, 3, 3))),
        # All centroids alike along two axes, and in sorted order along the third.
        join(*(box([0, 0, z], [1, 1, z + 1.5]) for z in range(40))),
        soup(np.tile(np.random.default_rng(8).random((1, 3, 3)), (100, 1, 1))),
    ],
    ids=["tori", "soup", "tower", "one place"],
)
def test_a_tree_from_the_compiled_loop_finds_the_same_pairs(
    mesh: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    vertices, topology = mesh.vertices, mesh.topology  # type: ignore[attr-defined]
    expected = CollisionDetector(topology, vertices).detect(vertices)
    monkeypatch.setattr(tree, "COMPILED_FROM", 0)
    built = tree.build_tree(vertices, topology.faces)
    found = CollisionDetector(topology, vertices).detect(vertices)
    assert np.array_equal(found.pairs, expected.pairs)
    assert np.array_equal(found.penetration_depth, expected.penetration_depth)
    assert found.energy == pytest.approx(expected.energy, rel=1e-12)
    slots = built.slot_face[built.slot_face >= 0]
    assert sorted(slots.tolist()) == list(range(topology.n_faces))
    inner = built.leaf < 0
    below = built.size[built.left[inner]] + built.size[built.right[inner]]
    assert np.array_equal(built.size[inner], below)
    assert sorted(built.leaf[~inner].tolist()) == list(range(len(built.slot_face) // 8))


PLAIN_OBJ = {
    "with comments": b"# made by hand\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1 2 3\n",
    "mixed lines": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nv 1 1 1.5e-3\nf 2 3 4\ng x\nf 4 3 1\n",
    "colours": b"v 0 0 0 .1 .2 .3\nv 1 0 0 .1 .2 .3\nv 0 1 0 1 1 1\nf 1 2 3",
    "normals": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1 3//1\n",
    "quads": b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1/1/1 2/2 3 4\nf 1 2 3\n",
    "exponents": b"v -1.25E+2 +3 .5\nv 1e-320 1 0\nv 0.1 0.30000000000000004 7.\nf 3 2 1\n",
}


@pytest.mark.parametrize("name", PLAIN_OBJ)
def test_plain_obj_files_are_read_alike_at_once_and_line_by_line(name: str) -> None:
    at_once, by_line = obj._read_plain(PLAIN_OBJ[name]), obj._read_any(PLAIN_OBJ[name])
    assert at_once is not None
    assert np.array_equal(at_once.vertices, by_line.vertices)
    assert np.array_equal(at_once.sizes, by_line.sizes)
    assert np.array_equal(at_once.corners, by_line.corners)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"f 1 2 3\n",
        b" v 0 0 0\n",
        b"v\t0 0 0\nf 1 2 3\n",
        b"v 0 0 0 # here\nf 1 2 3\n",
        b"v 1.2.3 4\nf 1 2 3\n",
        b"v 0 0 0\nv 1 0\nv 0 1 0 0\nf 1 2 3\n",
        b"v nan 0 0\nf 1 2 3\n",
        b"v 0 0 0\nf 0 1 2\n",
        b"v 0 0 0\nf -1 -2 -3\n",
        b"v 0 0 0\nf 1 /2 3\n",
        b"v 1e 0 0\nf 1 2 3\n",
    ],
)
def test_what_is_odd_is_left_to_the_careful_reader(content: bytes) -> None:
    assert obj._read_plain(content) is None


def test_text_ply_is_read_as_a_table_where_rows_are_alike(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    head = (
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty double y\n"
        "property float z\nelement face 2\nproperty uchar flag\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    path = tmp_path / "a.ply"
    path.write_text(head + "0 0 0\n1 0 0\n1 1.5e-7 0\n0 1 0.1\n7 3 0 1 2\n8 3 0 2 3\n")
    at_once = read_mesh(path)
    monkeypatch.setattr(ply._TextBody, "_read_alike", lambda *_: None)
    by_row = read_mesh(path)
    assert at_once.faces.tolist() == by_row.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert np.array_equal(at_once.vertices, by_row.vertices)
    monkeypatch.undo()
    path.write_text(head + "0 0 0\n1 0 0\n1 1 0\n0 1 0\n7 3 0 1 2\n8 4 0 1 2 3\n")
    assert read_mesh(path).faces.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3]]


def test_equal_points_are_found_by_their_first() -> None:
    points = np.random.default_rng(2).integers(-2, 3, (500, 3)).astype(np.float64)
    points[::3] *= -1.0  # zeros of either sign are one place
    seen: dict[tuple[float, ...], int] = {}
    expected = [seen.setdefault(tuple(point), place) for place, point in enumerate(points.tolist())]
    assert first_at_each_place(points).tolist() == expected
    assert len(seen) < 126


def test_stl_of_corners_that_are_not_finite_is_refused_soon(tmp_path: Path) -> None:
    path = tmp_path / "nan.stl"
    n_faces = 60_000
    corners = np.full((3 * n_faces, 3), 1.0)
    write_mesh(path, corners, np.arange(3 * n_faces).reshape(-1, 3))
    path.write_bytes(path.read_bytes().replace(b"\x00\x00\x80\x3f", b"\x00\x00\xc0\x7f"))
    with pytest.raises(Exception, match="not finite"):
        read_mesh(path)


def test_edges_of_a_star_of_many_faces() -> None:
    n_faces = 5000
    rim = np.arange(1, n_faces + 1)
    faces = np.stack([np.zeros_like(rim), rim, np.roll(rim, -1)], axis=1)
    topology = Topology(faces, n_faces + 1)
    assert len(topology.edges) == 2 * n_faces
    assert len(topology.boundary_edges) == n_faces
    assert (np.diff(topology.edges[:, 0] * (n_faces + 1) + topology.edges[:, 1]) > 0).all()
    assert not topology.is_watertight


def test_faces_without_area_are_found_far_from_the_origin() -> None:
    ball = sphere()
    vertices = np.concatenate([ball.vertices, [[0, 0, 2], [0, 0, 3], [0, 0, 4]]]) + 2.0**24
    faces = np.concatenate([ball.faces, [np.arange(3) + len(ball.vertices)]])
    flat = audit_mesh(Topology(faces, len(vertices)), vertices).degenerate_faces
    assert flat.tolist() == [len(ball.faces)]
