"""Self-collision of real poses and of shapes, against brute force and against a peer, FCL."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.contact import DEPTH_TOLERANCE, CollisionDetector
from lcollision_core.files import PoseSet
from tests.core.brute_force import exact_depth
from tests.core.contact.detector_checks import check_against_brute_force, detector_for
from tests.core.shapes import (
    Mesh,
    figure_eight,
    interlocked_tori,
    join,
    random_rotation,
    sphere,
)


def test_two_scape_meshes_collide(scape: PoseSet) -> None:
    detector = CollisionDetector(scape.topology, scape.vertices[0])
    batch = detector.detect_batch(scape.vertices)
    expected = np.zeros(71, dtype=int)
    expected[[7, 70]] = [69, 70]
    assert batch.n_pairs.tolist() == expected.tolist()
    assert detector.are_colliding(scape.vertices).tolist() == (expected > 0).tolist()
    assert [detector.detect(pose).colliding for pose in scape.vertices] == (expected > 0).tolist()


def test_62_frames_of_the_jump_collide(jumping: PoseSet) -> None:
    detector = CollisionDetector(jumping.topology, jumping.vertices[0])
    colliding = detector.detect_batch(jumping.vertices).colliding
    assert np.count_nonzero(colliding) == 62
    assert np.array_equal(detector.are_colliding(jumping.vertices), colliding)


@pytest.mark.parametrize("pose", [7, 70, 0, 35])
def test_scape_against_brute_force(scape: PoseSet, pose: int) -> None:
    detector = CollisionDetector(scape.topology, scape.vertices[0])
    check_against_brute_force(detector, scape.vertices[pose], scape.faces)


def test_bent_scape_against_brute_force(scape: PoseSet) -> None:
    """Twist the body about its long axis and fold it, so that limbs penetrate limbs."""
    detector = CollisionDetector(scape.topology, scape.vertices[0])
    body = scape.vertices[20].astype(float) / detector.body_size
    bent = body + 0.08 * np.sin(body @ np.array([[9.0, 3, 7], [-5, 8, 11], [8, -9, 6]]))
    found = check_against_brute_force(detector, bent, scape.faces)
    assert len(found.pairs) > 100


def test_scape_in_another_frame_and_unit(scape: PoseSet) -> None:
    rng = np.random.default_rng(3)
    detector = CollisionDetector(scape.topology, scape.vertices[0])
    for pose in (7, 70):
        at_home = detector.detect(scape.vertices[pose])
        for scale, shift in ((1.0, 5.0), (1e-3, 0.1), (1e4, 0.0)):
            rotation = random_rotation(rng)
            frame = [
                scale * (scape.vertices[p].astype(float) @ rotation.T + shift) for p in (0, pose)
            ]
            moved = CollisionDetector(scape.topology, scale * scape.vertices[0].astype(float))
            found = moved.detect(frame[1])
            assert np.array_equal(found.pairs, at_home.pairs)
            np.testing.assert_allclose(
                found.penetration_depth, at_home.penetration_depth, rtol=0, atol=1e-13 * (1 + shift)
            )
            assert not moved.are_colliding(frame[0][None])[0]


def fcl_pairs(vertices: np.ndarray, faces: np.ndarray) -> set[tuple[int, int]]:
    """Return the pairs without a common vertex that FCL finds in a mesh against itself."""
    fcl = pytest.importorskip("fcl")
    model = fcl.BVHModel()
    model.beginModel(len(vertices), len(faces))
    model.addSubModel(vertices.astype(np.float64), faces)
    model.endModel()
    one, two = (fcl.CollisionObject(model, fcl.Transform()) for _ in range(2))
    result = fcl.CollisionResult()
    room = 4_000_000
    fcl.collide(one, two, fcl.CollisionRequest(num_max_contacts=room), result)
    assert len(result.contacts) < room
    pairs = np.unique(np.sort([(c.b1, c.b2) for c in result.contacts], axis=1), axis=0)
    pairs = pairs[pairs[:, 0] < pairs[:, 1]]
    shared = (faces[pairs[:, 0]][:, :, None] == faces[pairs[:, 1]][:, None]).any(axis=(1, 2))
    return set(map(tuple, pairs[~shared].tolist()))


def check_against_fcl(detector: CollisionDetector, vertices: np.ndarray, faces: np.ndarray) -> int:
    """FCL counts touching faces too, so it may add pairs with depths within the tolerance."""
    ours = set(map(tuple, detector.detect(vertices).pairs.tolist()))
    theirs = fcl_pairs(vertices, faces)
    assert ours <= theirs
    for a, b in theirs - ours:
        depth = exact_depth(vertices[faces[a]], vertices[faces[b]])
        assert depth <= DEPTH_TOLERANCE * detector.body_size
    return len(ours)


@pytest.mark.parametrize("mesh", [interlocked_tori(0.6), figure_eight(0.2, 0.15)])
def test_fcl_agrees_on_shapes_that_collide(mesh: Mesh) -> None:
    assert check_against_fcl(detector_for(mesh), mesh.vertices, mesh.faces) > 20


@pytest.mark.parametrize("mesh", [interlocked_tori(0.4), join(sphere(), sphere(0.5))])
def test_fcl_agrees_on_shapes_that_do_not(mesh: Mesh) -> None:
    assert check_against_fcl(detector_for(mesh), mesh.vertices, mesh.faces) == 0


def test_fcl_agrees_on_crumpled_shapes() -> None:
    rng = np.random.default_rng(17)
    mesh = sphere(n=24)
    detector = detector_for(mesh)
    for amplitude in (0.1, 0.3):
        pose = mesh.vertices + rng.normal(scale=amplitude, size=mesh.vertices.shape)
        assert check_against_fcl(detector, pose, mesh.faces) > 50


def test_fcl_agrees_on_real_poses(scape: PoseSet) -> None:
    detector = CollisionDetector(scape.topology, scape.vertices[0])
    counts = [
        check_against_fcl(detector, scape.vertices[pose].astype(float), scape.faces)
        for pose in (7, 70, 0, 20)
    ]
    assert counts == [69, 70, 0, 0]
