from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.errors import PoseSetError, ShapeError
from lcollision_core.meshes import Topology, degenerate_faces
from tests.core.shapes import sphere

TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def test_tetrahedron_is_a_watertight_sphere() -> None:
    topology = Topology(TETRAHEDRON, 4)
    assert topology.n_faces == 4
    assert topology.edges.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]
    assert topology.is_watertight
    assert topology.vertex_components[0] == 1
    assert len(topology.boundary_edges) == 0
    assert len(topology.non_manifold_edges) == 0
    assert topology.adjacency.toarray().tolist() == (1 - np.eye(4)).tolist()


def test_missing_face_zero_opens_three_edges() -> None:
    topology = Topology(TETRAHEDRON[1:], 4)
    assert not topology.is_watertight
    assert topology.boundary_edges.tolist() == [[0, 1], [0, 2], [1, 2]]


def test_flipped_face_is_not_watertight() -> None:
    faces = TETRAHEDRON.copy()
    faces[0] = faces[0, ::-1]
    topology = Topology(faces, 4)
    assert len(topology.boundary_edges) == 0
    assert not topology.is_watertight


def test_fin_makes_a_non_manifold_edge() -> None:
    topology = Topology(np.vstack([TETRAHEDRON, [[0, 1, 4]]]), 5)
    assert topology.non_manifold_edges.tolist() == [[0, 1]]
    assert not topology.is_watertight


def test_fans_that_touch_in_a_vertex_alone_pinch_it() -> None:
    apexes_joined = Topology(np.vstack([TETRAHEDRON, TETRAHEDRON + 3]), 7)
    assert apexes_joined.is_watertight
    assert apexes_joined.pinched_vertices.tolist() == [3]
    assert Topology([[0, 1, 2], [0, 3, 4]], 5).pinched_vertices.tolist() == [0]
    for whole in (TETRAHEDRON, TETRAHEDRON[1:], np.vstack([TETRAHEDRON, [[0, 1, 4]]])):
        assert Topology(whole, 5).pinched_vertices.tolist() == []


def _fans(faces: np.ndarray, vertex: int) -> int:
    """Count the fans around a vertex by growing each from any of its faces."""
    left = [set(face.tolist()) for face in faces if vertex in face]
    fans = 0
    while left:
        fans += 1
        grown = [left.pop()]
        while grown:
            face = grown.pop()
            grown += [other for other in left if len(face & other) >= 2]
            left = [other for other in left if len(face & other) < 2]
    return fans


@pytest.mark.parametrize("seed", range(20))
def test_pinched_vertices_agree_with_fans_grown_face_by_face(seed: int) -> None:
    rng = np.random.default_rng(seed)
    faces = np.array([rng.permutation(12)[:3] for _ in range(14)])
    expected = [vertex for vertex in range(12) if _fans(faces, vertex) > 1]
    assert Topology(faces, 12).pinched_vertices.tolist() == expected
    assert 0 < len(expected) < 12


def test_unused_vertices_are_components_but_not_of_the_surface() -> None:
    topology = Topology(np.vstack([TETRAHEDRON, TETRAHEDRON + 5]), 9)
    assert topology.unused_vertices.tolist() == [4]
    count, labels = topology.vertex_components
    assert count == 3
    assert len({labels[0], labels[4], labels[5]}) == 3


def test_edges_agree_with_a_set_of_pairs() -> None:
    rng = np.random.default_rng(0)
    faces = np.array([rng.choice(500, 3, replace=False) for _ in range(800)])
    topology = Topology(faces, 500)
    expected: dict[tuple[int, int], int] = {}
    for a, b, c in faces.tolist():
        for i, j in ((a, b), (b, c), (c, a)):
            pair = (min(i, j), max(i, j))
            expected[pair] = expected.get(pair, 0) + 1
    assert topology.edges.tolist() == [list(pair) for pair in sorted(expected)]
    assert len(topology.boundary_edges) == sum(n == 1 for n in expected.values())
    assert len(topology.non_manifold_edges) == sum(n > 2 for n in expected.values())


def test_edge_lengths_of_a_right_triangle() -> None:
    vertices = np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 0]])
    assert Topology([[0, 1, 2]], 3).edge_lengths(vertices).tolist() == [3.0, 4.0, 5.0]


def test_equality_needs_vertex_count_and_order_of_faces() -> None:
    topology = Topology(TETRAHEDRON, 4)
    assert topology == Topology(TETRAHEDRON.astype(np.uint8), 4)
    assert hash(topology) == hash(Topology(TETRAHEDRON, 4))
    assert topology != Topology(TETRAHEDRON, 5)
    assert topology != Topology(TETRAHEDRON[::-1], 4)


def test_faces_are_read_only_and_copied() -> None:
    faces = TETRAHEDRON.astype(np.int32)
    topology = Topology(faces, 4)
    faces[0] = 3
    assert topology.faces[0].tolist() == [0, 2, 1]
    with pytest.raises(ValueError, match="read-only"):
        topology.faces[0, 0] = 1


@pytest.mark.parametrize(
    ("faces", "error", "message"),
    [
        ([[0, 1, 4]], PoseSetError, "face 0 names vertices"),
        ([[0, 1, 2], [0, -1, 2]], PoseSetError, "face 1 names vertices"),
        ([[0, 1, 2], [3, 1, 3]], PoseSetError, "face 1 names a vertex twice"),
        (np.empty((0, 3), dtype=int), ShapeError, "no faces"),
        ([[0.0, 1.0, 2.0]], ShapeError, "integer"),
        ([[0, 1, 2, 3]], ShapeError, r"\(F, 3\)"),
    ],
)
def test_bad_faces_are_refused_by_number(
    faces: object, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        Topology(np.array(faces), 4)


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
    flat = degenerate_faces(Topology(faces, len(vertices)), vertices)
    assert flat.tolist() == [len(ball.faces)]
