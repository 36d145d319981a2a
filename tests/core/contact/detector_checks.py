"""Comparison of all modes of the detector with brute force."""

from __future__ import annotations

import numpy as np

from lcollision_core.contact import DEPTH_TOLERANCE, CollisionDetector, SelfCollisions
from lcollision_core.contact.kernels import NEAR
from tests.core.brute_force import all_pairs
from tests.core.shapes import Mesh


def detector_for(mesh: Mesh) -> CollisionDetector:
    return CollisionDetector(mesh.topology, mesh.vertices)


def near_pairs(found: SelfCollisions) -> np.ndarray:
    """Return the (Q, 2) pairs within the near exclusion: folds of the skin."""
    return found.excluded_pairs[found.excluded_rule == NEAR]


def near_penetration_depth(found: SelfCollisions) -> np.ndarray:
    """Return the (Q,) penetration depths of `near_pairs`."""
    return found.excluded_depth[found.excluded_rule == NEAR]


def check_against_brute_force(
    detector: CollisionDetector, vertices: np.ndarray, faces: np.ndarray
) -> SelfCollisions:
    """Compare every mode with the reference: the same pairs, depths to 1e-12 normalised."""
    found = detector.detect(vertices)
    expected = all_pairs(vertices, faces, DEPTH_TOLERANCE * detector.body_size)
    assert found.pairs.dtype == np.int32
    assert found.pairs.tolist() == expected.pairs.tolist()
    np.testing.assert_allclose(
        found.penetration_depth, expected.depth / detector.body_size, rtol=0, atol=1e-12
    )
    assert len(found.excluded_pairs) == len(found.excluded_depth) == len(found.excluded_rule) == 0
    batch = detector.detect_batch(vertices[None], workers=1)
    assert batch.n_pairs.tolist() == [len(expected.pairs)]
    assert batch.n_near_pairs.tolist() == [0]
    assert batch.colliding.tolist() == [found.colliding] == [len(expected.pairs) > 0]
    assert np.array_equal(batch.vertex_energy[0], found.vertex_energy)
    assert detector.are_colliding(vertices[None], workers=1).tolist() == [found.colliding]
    return found


def check_mesh(mesh: Mesh) -> SelfCollisions:
    return check_against_brute_force(detector_for(mesh), mesh.vertices, mesh.faces)
