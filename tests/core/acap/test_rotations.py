"""Polar factors, the exponential map, and consistent logarithms along the mesh."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from lcollision_core.acap.codec import cotangent_weights
from lcollision_core.acap.features import (
    exponential,
    exponential_coefficients,
    gradients_from_features,
)
from lcollision_core.acap.rotations import component_roots, consistent_logarithms, split_gradients
from lcollision_core.meshes import Topology
from lcollision_core.meshes.topology import length_graph
from tests.core.acap.jumps import n_jumps
from tests.core.shapes import grid, join, random_rotation, sphere

FloatArray = npt.NDArray[np.float64]


def split(matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the unit quaternions (w, x, y, z) and the stretches' upper triangles."""
    quaternions, stretches = np.empty((len(matrices), 4)), np.empty((len(matrices), 6))
    split_gradients(matrices, quaternions, stretches)
    return quaternions, stretches


def polar(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the rotation and the symmetric stretch of a (3, 3) matrix."""
    quaternions, stretches = split(matrix[None])
    rotation = Rotation.from_quat(quaternions[0, [1, 2, 3, 0]]).as_matrix()
    return rotation, stretches[0, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


def exponential_of(vector: npt.ArrayLike) -> FloatArray:
    rotation = np.empty((3, 3))
    x, y, z = np.asarray(vector, dtype=np.float64)
    exponential(x, y, z, rotation)
    return rotation


def assert_is_rotation(rotation: FloatArray) -> None:
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-12)


def test_polar_factors_are_those_of_the_singular_values() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        matrix = rng.normal(size=(3, 3))
        rotation, stretch = polar(matrix)
        assert_is_rotation(rotation)
        assert rotation @ stretch == pytest.approx(matrix, abs=1e-12)
        left, values, right = np.linalg.svd(matrix)
        sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
        assert rotation == pytest.approx(left @ sign @ right, abs=1e-7)
        assert np.sort(np.abs(np.linalg.eigvalsh(stretch))) == pytest.approx(
            np.sort(values), abs=1e-12
        )


@pytest.mark.parametrize(
    "matrix",
    [
        np.zeros((3, 3)),
        np.eye(3),
        -np.eye(3),
        np.diag([1.0, 1.0, 0.0]),
        np.diag([1.0, 0.0, 0.0]),
        np.diag([0.0, 0.0, 2.0]),
        np.diag([1.0, 1e-200, 1.0]),
        np.diag([1e-100, 2e-100, 3e-100]),
        np.full((3, 3), 1.0),
        np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
        np.diag([1e12, 1.0, 1e-12]),
    ],
    ids=str,
)
def test_polar_factors_of_special_matrices(matrix: FloatArray) -> None:
    rotation, stretch = polar(matrix)
    assert_is_rotation(rotation)
    assert rotation @ stretch == pytest.approx(matrix, rel=1e-12, abs=1e-15 * np.abs(matrix).max())


def test_quaternion_agrees_with_the_exponential_in_every_branch() -> None:
    rng = np.random.default_rng(1)
    axes = np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(50, 3))])
    for axis in axes / np.linalg.norm(axes, axis=1, keepdims=True):
        for angle in (0.0, 1e-9, 0.3, 2.0, np.pi - 1e-9, np.pi):
            quaternion = split(exponential_of(angle * axis)[None])[0][0]
            assert quaternion[0] == pytest.approx(np.cos(angle / 2), abs=1e-9)
            expected = np.sin(angle / 2) * axis
            if angle == np.pi:
                # Both signs of the axis give the same half turn.
                expected = expected * np.sign(expected @ quaternion[1:])
            assert quaternion[1:] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-3, 0.0999, 0.1001, 1.0, np.pi, 5.0, 4 * np.pi])
def test_exponential_is_the_rotation_by_that_angle(angle: float) -> None:
    rotation = exponential_of([0.0, 0.0, angle])
    cosine, sine = np.cos(angle), np.sin(angle)
    expected = [[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]
    assert rotation == pytest.approx(np.array(expected), abs=1e-14)


def test_series_meets_the_closed_forms() -> None:
    below, above = np.nextafter(1e-2, 0.0), np.nextafter(1e-2, 1.0)
    assert exponential_coefficients(below) == pytest.approx(
        exponential_coefficients(above), rel=1e-12
    )
    assert exponential_coefficients(0.0) == pytest.approx((1.0, 1 / 2, 1 / 6), abs=0.0)


def test_features_of_gradients_give_the_gradients_back() -> None:
    rng = np.random.default_rng(2)
    gradients = rng.normal(size=(300, 3, 3))
    quaternions, stretches = split(gradients)
    rotations = Rotation.from_quat(quaternions[:, [1, 2, 3, 0]])
    features = np.concatenate([rotations.as_rotvec(), stretches], axis=1)
    back = np.empty_like(gradients)
    gradients_from_features(features[None], back[None])
    assert back == pytest.approx(gradients, abs=1e-11)


def logarithms(topology: Topology, vectors: FloatArray, roots: list[int]) -> tuple[FloatArray, int]:
    """Drop the full turns of rotation vectors, and restore consistent ones."""
    quaternions, _ = split(np.stack([exponential_of(vector) for vector in vectors]))
    ring = topology.adjacency
    logs = np.empty_like(vectors)
    consistent_logarithms(
        quaternions, ring.indptr, ring.indices, np.array(roots, dtype=np.int32), logs
    )
    return logs, n_jumps(logs[None], topology)[0]


@pytest.mark.parametrize("most", [1.0, 3.1, 3.2, 6.2, 6.4, 13.0])
def test_smooth_vectors_about_one_axis_are_found_again(most: float) -> None:
    mesh = grid(12)
    axis = np.array([1.0, 2.0, -2.0]) / 3.0
    vectors = most * np.linalg.norm(mesh.vertices, axis=1)[:, None] / np.sqrt(2.0) * axis
    logs, jumps = logarithms(mesh.topology, vectors, [0])
    assert logs == pytest.approx(vectors, abs=1e-6)
    assert jumps == 0


def test_root_takes_the_turn_that_keeps_most_vertices_small() -> None:
    mesh = grid(12)
    vectors = np.zeros((169, 3))
    vectors[:, 0] = 3.5 - 4.0 * mesh.vertices[:, 0]
    logs, jumps = logarithms(mesh.topology, vectors, [0])
    assert logs == pytest.approx(vectors, abs=1e-6)
    assert jumps == 0


def test_walk_goes_round_a_cut_and_not_across() -> None:
    mesh = grid(12)
    x, y = mesh.vertices[:, 0] - 0.52, mesh.vertices[:, 1] - 0.52
    # It winds by 4 radians around the middle; across the cut, the shorter way is -2.3.
    vectors = np.zeros((169, 3))
    vectors[:, 2] = 4.0 * (np.arctan2(y, x) % (2 * np.pi)) / (2 * np.pi)
    root = int(np.argmin(np.abs(vectors[:, 2] - 2.0)))
    logs, jumps = logarithms(mesh.topology, vectors, [root])
    assert logs == pytest.approx(vectors, abs=1e-9)
    start, end = mesh.topology.edges.T
    assert jumps == (np.abs(vectors[start, 2] - vectors[end, 2]) > np.pi).sum() > 0


def test_components_are_walked_apart() -> None:
    mesh = join(grid(3), grid(3), grid(3))
    vectors = np.zeros((48, 3))
    vectors[:16, 0], vectors[16:32, 1], vectors[32:, 2] = 1.0, 2.0, 3.0
    logs, jumps = logarithms(mesh.topology, vectors, [0, 20, 47])
    assert logs == pytest.approx(vectors, abs=1e-9)
    assert jumps == 0


def test_roots_lie_in_the_middle() -> None:
    flat = grid(10)
    mesh = join(flat, flat.moved([5.0, 0.0, 0.0]))
    roots = component_roots(length_graph(mesh.topology.edges, mesh.vertices))
    assert mesh.vertices[roots] == pytest.approx(
        np.array([[0.5, 0.5, 0.0], [5.5, 0.5, 0.0]]), abs=0.25
    )


def test_cotangent_weights_of_right_and_obtuse_triangles() -> None:
    square = grid(1)
    weights = cotangent_weights(square.topology, square.vertices, 0.05)
    by_edge = {
        tuple(edge): weight for edge, weight in zip(square.topology.edges, weights, strict=True)
    }
    (diagonal,) = {(0, 3), (1, 2)} & by_edge.keys()
    assert by_edge.pop(diagonal) == pytest.approx(0.05)
    assert list(by_edge.values()) == pytest.approx([0.5] * 4)
    obtuse = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [1.0, 0.1, 0.0]])
    clamped = cotangent_weights(Topology([[0, 1, 2]], 3), obtuse, 0.05)
    assert clamped == pytest.approx([0.05, 5.0, 5.0])


def test_cotangent_weights_do_not_depend_on_the_frame() -> None:
    mesh = sphere(n=12)
    weights = cotangent_weights(mesh.topology, mesh.vertices, 0.05)
    moved = 1e3 * mesh.vertices @ random_rotation(np.random.default_rng(0)).T + 7.0
    assert cotangent_weights(mesh.topology, moved, 0.05) == pytest.approx(weights, rel=1e-9)
