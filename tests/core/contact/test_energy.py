"""Algorithm 1 on values by hand, and the sums of its vector."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.contact import CollisionDetector
from lcollision_core.files import PoseSet
from lcollision_core.meshes import Topology
from tests.core.shapes import interlocked_tori, soup

FLOOR = [[0, 0, 0], [4, 0, 0], [0, 4, 0]]
SHALLOW = [[1, 1, -0.25], [1, 1, 2], [1.5, 1, 2]]
DEEP = [[1, 2, -0.5], [1, 2, 2], [1.5, 2, 2]]
ALOOF = [[9, 9, 9], [10, 9, 9], [9, 10, 9]]


def detector_of(triangles: list, height: float) -> CollisionDetector:
    mesh = soup(triangles)
    assert np.ptp(mesh.vertices, axis=0).max() == height
    return CollisionDetector(mesh.topology, mesh.vertices)


def test_one_pair_gives_a_sixth_of_its_squared_depth_to_each_vertex() -> None:
    mesh = soup([FLOOR, SHALLOW])
    found = detector_of([FLOOR, SHALLOW], 4.0).detect(mesh.vertices)
    # 0.25 deep, 4 high: (1/16)^2 / 6 at all six vertices.
    np.testing.assert_allclose(found.penetration_depth, [1 / 16], rtol=1e-14)
    np.testing.assert_allclose(found.vertex_energy, np.full(6, 1 / 1536), rtol=1e-14)
    assert found.energy == pytest.approx(1 / 256, rel=1e-14)


def test_a_vertex_gathers_from_all_pairs_of_its_faces() -> None:
    mesh = soup([ALOOF, DEEP, FLOOR, SHALLOW])
    found = detector_of([ALOOF, DEEP, FLOOR, SHALLOW], 10.0).detect(mesh.vertices)
    assert found.pairs.tolist() == [[1, 2], [2, 3]]
    deep, shallow = (0.5 / 10.0) ** 2 / 6, (0.25 / 10.0) ** 2 / 6
    expected = np.repeat([0.0, deep, deep + shallow, shallow], 3)
    np.testing.assert_allclose(found.vertex_energy, expected, rtol=1e-13)
    assert found.energy == pytest.approx(6 * (deep + shallow), rel=1e-13)


def test_a_vertex_of_two_faces_gathers_from_both() -> None:
    # A folded sheet of two faces along the edge (1, 2), each stabbed once: face 0 by face 2.
    vertices = np.array(
        [[0, 0, 0], [4, 0, 0], [0, 4, 0], [4, 4, 0]]
        + [[1, 1, -0.25], [1, 1, 2], [1.5, 1, 2]]
        + [[3, 3, -0.5], [3, 3, 2], [2.5, 3, 2]],
        dtype=float,
    )
    topology = Topology([[0, 1, 2], [1, 3, 2], [4, 5, 6], [7, 8, 9]], 10)
    found = CollisionDetector(topology, vertices).detect(vertices)
    assert found.pairs.tolist() == [[0, 2], [1, 3]]
    s, d = (0.25 / 4) ** 2 / 6, (0.5 / 4) ** 2 / 6
    np.testing.assert_allclose(
        found.vertex_energy, [s, s + d, s + d, d, s, s, s, d, d, d], rtol=1e-13
    )


def test_the_vector_sums_to_the_squared_depths() -> None:
    tori = interlocked_tori(0.6)
    detector = CollisionDetector(tori.topology, tori.vertices)
    found = detector.detect(tori.vertices)
    assert len(found.pairs) > 100
    assert found.energy == pytest.approx(np.sum(found.penetration_depth**2), rel=1e-12)
    touched = np.zeros(len(tori.vertices), dtype=bool)
    touched[tori.faces[found.pairs]] = True
    assert np.array_equal(found.vertex_energy > 0, touched)
    batch = detector.detect_batch(tori.vertices[None])
    assert np.array_equal(batch.vertex_energy[0], found.vertex_energy)


def test_the_energy_is_relative_to_the_reference_not_to_the_pose() -> None:
    mesh = soup([FLOOR, SHALLOW])
    detector = CollisionDetector(mesh.topology, mesh.vertices)
    twice = detector.detect(2.0 * mesh.vertices)
    assert twice.energy == pytest.approx(4 / 256, rel=1e-14)


def test_the_energy_of_a_real_pose_sums_to_the_squared_depths(scape: PoseSet) -> None:
    detector = CollisionDetector(scape.topology, scape.vertices[0])
    for pose in (7, 70):
        found = detector.detect(scape.vertices[pose])
        assert found.energy == pytest.approx(np.sum(found.penetration_depth**2), rel=1e-12)
        by_hand = np.zeros(scape.topology.n_vertices)
        for pair, depth in zip(found.pairs, found.penetration_depth, strict=True):
            for vertex in scape.faces[pair].ravel():
                by_hand[vertex] += depth**2 / 6
        np.testing.assert_allclose(found.vertex_energy, by_hand, rtol=1e-12)
