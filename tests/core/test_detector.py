"""Self-collision of whole meshes: analytic truths, brute force over all pairs, and a peer."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcollision_core.contact import DEPTH_TOLERANCE, CollisionDetector, SelfCollisions
from lcollision_core.errors import CancelledError, ShapeError
from lcollision_core.jobs import CancelToken
from lcollision_core.meshes import PoseSet, Topology
from tests.core.brute_force import all_pairs, exact_depth
from tests.core.shapes import (
    Mesh,
    box,
    figure_eight,
    grid,
    interlocked_tori,
    join,
    random_rotation,
    soup,
    sphere,
    torus,
)


def detector_for(mesh: Mesh) -> CollisionDetector:
    return CollisionDetector(mesh.topology, mesh.vertices)


def check_against_brute_force(
    detector: CollisionDetector, vertices: np.ndarray, faces: np.ndarray
) -> SelfCollisions:
    """Compare every mode with the reference: the same pairs, depths to 1e-12 heights."""
    found = detector.detect(vertices)
    expected = all_pairs(vertices, faces, DEPTH_TOLERANCE * detector.height)
    assert found.pairs.dtype == np.int32
    assert found.pairs.tolist() == expected.pairs.tolist()
    np.testing.assert_allclose(
        found.penetration_depth, expected.depth / detector.height, rtol=0, atol=1e-12
    )
    assert len(found.near_pairs) == len(found.near_penetration_depth) == 0
    batch = detector.detect_batch(vertices[None], workers=1)
    assert batch.n_pairs.tolist() == [len(expected.pairs)]
    assert batch.n_near_pairs.tolist() == [0]
    assert batch.colliding.tolist() == [found.colliding] == [len(expected.pairs) > 0]
    assert np.array_equal(batch.vertex_energy[0], found.vertex_energy)
    assert detector.are_colliding(vertices[None], workers=1).tolist() == [found.colliding]
    return found


def check_mesh(mesh: Mesh) -> SelfCollisions:
    return check_against_brute_force(detector_for(mesh), mesh.vertices, mesh.faces)


# --- Analytic shapes: positive, negative, touching --------------------------------------------

BLOCK = box([0, 0, 0], [1, 1, 1])


def pressed_block(overlap: float) -> Mesh:
    """Press a smaller block into the face x = 1 of a block, to a height of 1.5."""
    return join(BLOCK, box([1 - overlap, 0.25, 0.125], [1.5, 0.75, 0.5]))


COLLIDING = {
    "tori, thick enough to meet": interlocked_tori(0.6),
    "a tube threaded through itself": figure_eight(0.2, 0.15),
    "a plus of two bars, no corner inside the other": join(
        box([-3, -1, -1], [3, 1, 1]), box([-0.5, -3, -0.5], [0.5, 3, 0.5])
    ),
    "a plus of two bars of one size, moved off the planes": join(
        box([-3, -1, -1], [3, 1, 1]), box([-1.1, -3, -0.9], [0.9, 3, 1.1])
    ),
    "spheres that overlap": join(sphere(), sphere().moved([1.5, 0, 0])),
    "a block pressed in by 1e-6 heights": pressed_block(1.5e-6),
    "a block pressed in by 2e-9 heights": pressed_block(3e-9),
    "a corner in a face": join(BLOCK, box([0.9, 0.9, 0.9], [2, 2, 2])),
}

FREE = {
    "tori, linked and apart": interlocked_tori(0.4),
    "a torus": torus(1.0, 0.4),
    "a tube that passes over itself": figure_eight(0.2, 0.25),
    "a sphere": sphere(),
    "a block": BLOCK,
    "nested spheres": join(sphere(1.0), sphere(0.5)),
    "nested equal blocks": join(BLOCK, box([0.25] * 3, [0.75] * 3)),
    "blocks apart": join(BLOCK, BLOCK.moved([1.01, 0, 0])),
    "blocks that share a face": join(BLOCK, BLOCK.moved([1, 0, 0])),
    "blocks that share a part of a face": join(BLOCK, BLOCK.moved([1, 0.25, 0.5])),
    "blocks that share an edge": join(BLOCK, BLOCK.moved([1, 1, 0])),
    "blocks that share a corner": join(BLOCK, BLOCK.moved([1, 1, 1])),
    "the same block twice": join(BLOCK, BLOCK),
    "a block pressed in by 1e-10 heights": pressed_block(1.5e-10),
    "a sheet": grid(5),
}


@pytest.mark.parametrize("name", COLLIDING)
def test_shapes_that_collide(name: str) -> None:
    assert check_mesh(COLLIDING[name]).colliding


@pytest.mark.parametrize("name", FREE)
def test_shapes_that_do_not(name: str) -> None:
    found = check_mesh(FREE[name])
    assert not found.colliding
    assert found.energy == 0.0


@pytest.mark.parametrize("relative", [1e-3, 1e-6, 1e-8, 1.001e-9])
def test_a_pressed_block_is_as_deep_as_it_was_pressed(relative: float) -> None:
    mesh = pressed_block(1.5 * relative)
    found = detector_for(mesh).detect(mesh.vertices)
    # The four walls of the small block cross the face of the large one: each of 8 wall
    # triangles that reach it meets one or both of its halves.
    assert set(found.pairs[:, 0]) <= {2, 3}
    assert 8 <= len(found.pairs) <= 16
    # Coordinates near 1 are rounded by 1e-16.
    np.testing.assert_allclose(found.penetration_depth.max(), relative, atol=1e-15)


@pytest.mark.parametrize("shift", [0.0, 10.0, 1e3, 1e6])
def test_results_do_not_depend_on_the_frame(shift: float) -> None:
    rng = np.random.default_rng(0)
    # Turned, so that no two faces touch exactly, which rounding could turn into either.
    mesh = interlocked_tori(0.6).turned(random_rotation(rng))
    detector = detector_for(mesh)
    at_home = detector.detect(mesh.vertices)
    away = mesh.turned(random_rotation(rng)).moved(shift * detector.height * np.ones(3))
    found = detector.detect(away.vertices)
    # Coordinates of `shift` heights are rounded by 2^-53 of them.
    rounding = 1e-14 + 1e-15 * shift
    assert at_home.penetration_depth.min() > 1e-7
    assert np.array_equal(found.pairs, at_home.pairs)
    np.testing.assert_allclose(found.penetration_depth, at_home.penetration_depth, atol=rounding)
    # And with a reference that moved along.
    assert np.array_equal(check_mesh(away).pairs, at_home.pairs)
    apart = interlocked_tori(0.4).turned(random_rotation(rng)).moved(shift * np.ones(3))
    assert not check_mesh(apart).colliding


@pytest.mark.parametrize("scale", [1e-30, 1e-6, 1e-3, 1.7, 1e3, 1e6, 1e30])
@pytest.mark.parametrize("rotated", [False, True])
def test_results_do_not_depend_on_the_unit(scale: float, rotated: bool) -> None:
    rng = np.random.default_rng(1)
    for mesh in (figure_eight(0.2, 0.15), figure_eight(0.2, 0.25), pressed_block(1e-4)):
        if rotated:
            mesh = mesh.turned(random_rotation(rng))
        at_home = detector_for(mesh).detect(mesh.vertices)
        scaled = Mesh(mesh.vertices * scale, mesh.faces)
        found = detector_for(scaled).detect(scaled.vertices)
        assert found.pairs.tolist() == at_home.pairs.tolist()
        np.testing.assert_allclose(found.penetration_depth, at_home.penetration_depth, atol=1e-14)
        np.testing.assert_allclose(found.vertex_energy, at_home.vertex_energy, atol=1e-14)


def test_a_pose_may_be_larger_or_smaller_than_the_reference() -> None:
    mesh = interlocked_tori(0.6)
    detector = detector_for(mesh)
    at_home = detector.detect(mesh.vertices)
    for factor in (1e-3, 0.5, 1e3, 1e9, 1e30):
        found = detector.detect(factor * mesh.vertices)
        deep = at_home.penetration_depth * factor > 1e-8
        assert {tuple(p) for p in at_home.pairs[deep].tolist()} <= set(
            map(tuple, found.pairs.tolist())
        )
        assert found.penetration_depth.max() == pytest.approx(
            factor * at_home.penetration_depth.max(), rel=1e-9
        )


# --- Counts, indices, sharing -----------------------------------------------------------------


@pytest.mark.parametrize("last", [1, 2, 7, 8, 9, 40])
def test_face_0_is_a_face(last: int) -> None:
    floor = [[0, 0, 0], [4, 0, 0], [0, 4, 0]]
    blade = [[1, 1, -0.25], [1, 1, 2], [1.5, 1, 2]]
    aloof = [[[9.0 + 2 * k, 9, 9], [10.0 + 2 * k, 9, 9], [9.0 + 2 * k, 10, 9]] for k in range(60)]
    for first, second in ((floor, blade), (blade, floor)):
        mesh = soup([first, *aloof[: last - 1], second])
        found = check_mesh(mesh)
        assert found.pairs.tolist() == [[0, last]]
        np.testing.assert_allclose(
            found.penetration_depth * detector_for(mesh).height, 0.25, rtol=1e-12
        )
    alone = soup([floor, *aloof[: last - 1]])
    assert not check_mesh(alone).colliding


def test_all_of_many_pairs_are_reported() -> None:
    # 3000 blades through one floor: many times the room that a search starts with.
    rng = np.random.default_rng(8)
    feet = rng.uniform(0, 1, (3000, 2))
    depth = rng.uniform(0.001, 0.002, 3000)
    blades = np.zeros((3000, 3, 3))
    blades[:, :, :2] = feet[:, None]
    blades[:, :, 2] = np.stack([-depth, np.ones(3000), np.ones(3000)], axis=1)
    blades[:, 2, 1] += 1e-7
    floor = np.array([[[-9.0, -9, 0], [9, -9, 0], [0, 18, 0]]])
    mesh = soup(np.concatenate([floor, blades]))
    detector = detector_for(mesh)
    found = detector.detect(mesh.vertices)
    with_floor = found.pairs[:, 0] == 0
    assert found.pairs[with_floor, 1].tolist() == list(range(1, 3001))
    np.testing.assert_allclose(
        found.penetration_depth[with_floor] * detector.height, depth, rtol=1e-11
    )
    # Again, now that there is room, and a sparse pose after a crowded one.
    again = detector.detect(mesh.vertices)
    assert np.array_equal(again.pairs, found.pairs)
    assert np.array_equal(again.vertex_energy, found.vertex_energy)
    lifted = mesh.vertices.copy()
    lifted[3:, 2] += 1.0
    lifted[3:6, 2] -= 1.0
    few = detector.detect(lifted)
    assert few.pairs[few.pairs[:, 0] == 0].tolist() == [[0, 1]]


def test_two_fine_sheets_through_each_other() -> None:
    sheet, wave = grid(20), grid(20)
    vertices = wave.vertices.copy()
    vertices[:, 2] = np.where(np.arange(len(vertices)) % 2 == 0, 0.02, -0.03)
    vertices[:, :2] = 0.93 * vertices[:, :2] + [0.0211, 0.0347]
    found = check_mesh(join(sheet, Mesh(vertices, wave.faces)))
    assert len(found.pairs) > 1000


@pytest.mark.parametrize("n_faces", [1, 2, 3, 7, 8, 9, 15, 16, 17, 63, 64, 65, 100])
def test_any_number_of_faces(n_faces: int) -> None:
    rng = np.random.default_rng(n_faces)
    n_pairs = 0
    for _ in range(5):
        mesh = soup(rng.uniform(0, 1, (n_faces, 3, 3)))
        n_pairs += len(check_mesh(mesh).pairs)
    assert n_pairs > 0 or n_faces < 7


def test_faces_that_share_one_vertex_do_not_count() -> None:
    # Two blades stand in a floor; one of them hangs on a corner of the floor.
    floor, stem, blade = [0, 1, 2], [3, 4], [5, 6, 7]
    vertices = np.array(
        [[0, 0, 0], [4, 0, 0], [0, 4, 0]]
        + [[1, 1, -1], [1, 1, 1]]
        + [[2, 1, -1], [2, 1, 1], [3, 1, 1]],
        dtype=np.float64,
    )
    # By depth alone the hanging blade would count.
    assert exact_depth(vertices[floor], vertices[[1, *stem]]) > 0.1
    for corner in range(3):
        faces = np.array([floor, [corner, *stem], blade], dtype=np.int32)
        found = check_mesh(Mesh(vertices, faces))
        assert [0, 1] not in found.pairs.tolist()
        assert [0, 2] in found.pairs.tolist()


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_faces=st.integers(1, 60),
    n_vertices=st.integers(3, 120),
    on_lattice=st.booleans(),
)
def test_random_meshes_against_brute_force(
    seed: int, n_faces: int, n_vertices: int, on_lattice: bool
) -> None:
    rng = np.random.default_rng(seed)
    faces = np.stack([rng.permutation(n_vertices)[:3] for _ in range(n_faces)]).astype(np.int32)
    vertices = rng.uniform(0, 1, (n_vertices, 3))
    if on_lattice:
        # Coplanar, touching, degenerate and duplicate faces in plenty.
        vertices = rng.integers(0, 5, (n_vertices, 3)).astype(float)
        vertices[:2] = [[0, 0, 0], [4, 4, 4]]
    reference = rng.uniform(0, 1, (n_vertices, 3))
    detector = CollisionDetector(Topology(faces, n_vertices), reference)
    check_against_brute_force(detector, vertices, faces)


@pytest.mark.parametrize("amplitude", [0.02, 0.1, 0.3])
@pytest.mark.parametrize(
    "mesh", [sphere(n=20), torus(1.0, 0.3), figure_eight(0.15, 0.3)], ids=["ball", "ring", "eight"]
)
def test_crumpled_surfaces_against_brute_force(mesh: Mesh, amplitude: float) -> None:
    rng = np.random.default_rng(int(100 * amplitude))
    detector = detector_for(mesh)
    for kind in range(2):
        pose = mesh.vertices.copy()
        if kind == 0:
            pose += rng.normal(scale=amplitude, size=pose.shape)
        else:
            # Smooth folds: what a bad pose looks like.
            waves = rng.normal(size=(3, 3)) * 4
            pose += 4 * amplitude * np.sin(pose @ waves)
        check_against_brute_force(detector, pose, mesh.faces)


def test_bodies_that_lie_far_apart_collide_no_less() -> None:
    # The boxes are single precision: 1000 heights apart, their padding must still hold a touch.
    small = pressed_block(1e-5)
    mesh = join(small, small.moved([1500.0, 3.0, 0.0]))
    detector = CollisionDetector(mesh.topology, join(small, small.moved([2.0, 0, 0])).vertices)
    found = check_against_brute_force(detector, mesh.vertices, mesh.faces)
    assert np.count_nonzero(found.pairs[:, 0] < 24) * 2 == len(found.pairs)


# --- Real poses -------------------------------------------------------------------------------


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
    """Wring the body about its long axis and fold it: limbs go through limbs."""
    detector = CollisionDetector(scape.topology, scape.vertices[0])
    body = scape.vertices[20].astype(float) / detector.height
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


# --- A peer -----------------------------------------------------------------------------------


def fcl_pairs(vertices: np.ndarray, faces: np.ndarray) -> set[tuple[int, int]]:
    """Return the pairs that FCL finds in a mesh against itself and that share no vertex."""
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
    """FCL counts touching faces too, so it may add pairs of a depth within the tolerance."""
    ours = set(map(tuple, detector.detect(vertices).pairs.tolist()))
    theirs = fcl_pairs(vertices, faces)
    assert ours <= theirs
    for a, b in theirs - ours:
        depth = exact_depth(vertices[faces[a]], vertices[faces[b]])
        assert depth <= DEPTH_TOLERANCE * detector.height
    return len(ours)


@pytest.mark.parametrize("name", ["tori, thick enough to meet", "a tube threaded through itself"])
def test_fcl_agrees_on_shapes_that_collide(name: str) -> None:
    mesh = COLLIDING[name]
    assert check_against_fcl(detector_for(mesh), mesh.vertices, mesh.faces) > 20


@pytest.mark.parametrize("name", ["tori, linked and apart", "nested spheres"])
def test_fcl_agrees_on_shapes_that_do_not(name: str) -> None:
    mesh = FREE[name]
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


# --- Batches, threads, cancelling -------------------------------------------------------------


@pytest.fixture(scope="module")
def crumpled() -> tuple[CollisionDetector, np.ndarray]:
    """Return a detector and 30 poses of a ring, from smooth to crumpled: some collide."""
    rng = np.random.default_rng(21)
    ring = torus(1.0, 0.3, rings=24, sides=9)
    amplitudes = np.linspace(0.0, 0.12, 30)
    noise = rng.normal(size=(30, *ring.vertices.shape))
    return detector_for(ring), ring.vertices + amplitudes[:, None, None] * noise


@pytest.mark.parametrize("workers", [1, 2, 5, None])
def test_batches_are_poses_one_by_one_to_the_last_bit(
    crumpled: tuple[CollisionDetector, np.ndarray], workers: int | None
) -> None:
    detector, poses = crumpled
    single = [detector.detect(pose) for pose in poses]
    assert 3 < sum(found.colliding for found in single) < 27
    batch = detector.detect_batch(poses, workers=workers)
    assert batch.n_pairs.tolist() == [len(found.pairs) for found in single]
    assert batch.n_near_pairs.tolist() == [0] * 30
    assert np.array_equal(batch.vertex_energy, [found.vertex_energy for found in single])
    assert batch.colliding.tolist() == [found.colliding for found in single]
    first = detector.are_colliding(poses, workers=workers)
    assert first.dtype == np.bool_
    assert first.tolist() == [found.colliding for found in single]


def test_the_same_pose_gives_the_same_answer(
    crumpled: tuple[CollisionDetector, np.ndarray],
) -> None:
    detector, poses = crumpled
    once = detector.detect(poses[-1])
    detector.are_colliding(poses)
    again = detector.detect(poses[-1])
    equal = CollisionDetector(detector.topology, poses[0]).detect(poses[-1])
    for other in (again, equal):
        for field in dataclasses.fields(once):
            assert np.array_equal(getattr(other, field.name), getattr(once, field.name))


def test_another_reference_changes_the_unit_alone(
    crumpled: tuple[CollisionDetector, np.ndarray],
) -> None:
    detector, poses = crumpled
    # A tree that fits no pose is slow, and still right.
    scattered = np.random.default_rng(5).uniform(0, 10, poses[0].shape)
    other = CollisionDetector(detector.topology, scattered)
    for pose in poses[::5]:
        expected, found = detector.detect(pose), other.detect(pose)
        assert np.array_equal(found.pairs, expected.pairs)
        np.testing.assert_allclose(
            found.penetration_depth * other.height,
            expected.penetration_depth * detector.height,
            atol=1e-14,
        )


def test_results_own_their_arrays(crumpled: tuple[CollisionDetector, np.ndarray]) -> None:
    detector, poses = crumpled
    found = detector.detect(poses[-1])
    kept = [getattr(found, field.name).copy() for field in dataclasses.fields(found)]
    detector.detect_batch(poses)
    detector.detect(poses[20])
    for field, before in zip(dataclasses.fields(found), kept, strict=True):
        assert np.array_equal(getattr(found, field.name), before)


def test_several_threads_may_share_a_detector(
    crumpled: tuple[CollisionDetector, np.ndarray],
) -> None:
    detector, poses = crumpled
    expected = [detector.detect(pose) for pose in poses]
    fresh = CollisionDetector(detector.topology, poses[0] * 1.0)
    barrier = threading.Barrier(6)

    def work(seed: int) -> list[str]:
        barrier.wait(timeout=30)
        wrong = []
        for pose in np.random.default_rng(seed).permutation(len(poses)):
            found = fresh.detect(poses[pose])
            if not np.array_equal(found.pairs, expected[pose].pairs):
                wrong.append(f"detect {pose}")
            some = poses[pose : pose + 3]
            truth = [e.colliding for e in expected[pose : pose + 3]]
            if fresh.are_colliding(some, workers=2).tolist() != truth:
                wrong.append(f"are_colliding {pose}")
            counts = [len(e.pairs) for e in expected[pose : pose + 3]]
            if fresh.detect_batch(some, workers=2).n_pairs.tolist() != counts:
                wrong.append(f"detect_batch {pose}")
        return wrong

    with ThreadPoolExecutor(6) as pool:
        assert list(pool.map(work, range(6))) == [[]] * 6


@pytest.mark.parametrize("mode", ["detect_batch", "are_colliding"])
@pytest.mark.parametrize("workers", [1, 3])
def test_progress_rises_to_the_total(
    crumpled: tuple[CollisionDetector, np.ndarray], mode: str, workers: int
) -> None:
    detector, poses = crumpled
    for n_poses in (1, 8, 30):
        calls: list[tuple[int, int]] = []
        threads = set()

        def note(done: int, total: int, calls: list = calls, threads: set = threads) -> None:
            calls.append((done, total))
            threads.add(threading.get_ident())

        getattr(detector, mode)(poses[:n_poses], workers=workers, progress=note)
        assert calls[-1] == (n_poses, n_poses)
        assert [done for done, _ in calls] == sorted({done for done, _ in calls})
        assert {total for _, total in calls} == {n_poses}
        assert threads == {threading.get_ident()}


@pytest.mark.parametrize("mode", ["detect_batch", "are_colliding"])
def test_cancelling(crumpled: tuple[CollisionDetector, np.ndarray], mode: str) -> None:
    detector, poses = crumpled
    poses = np.tile(poses, (20, 1, 1))
    search = getattr(detector, mode)
    before = CancelToken()
    before.cancel()
    with pytest.raises(CancelledError):
        search(poses, cancel=before)

    midway = CancelToken()
    done_at: list[int] = []

    def cancel_soon(done: int, _total: int) -> None:
        done_at.append(done)
        midway.cancel()

    n_threads = threading.active_count()
    with pytest.raises(CancelledError):
        search(poses, workers=2, progress=cancel_soon, cancel=midway)
    assert done_at[-1] < len(poses) // 2
    assert threading.active_count() == n_threads
    # A token that nobody sets changes nothing, and the detector is as good as before.
    idle = search(poses[:30], cancel=CancelToken())
    verdict = idle.colliding if mode == "detect_batch" else idle
    assert verdict.tolist() == [detector.detect(pose).colliding for pose in poses[:30]]


def test_no_poses(crumpled: tuple[CollisionDetector, np.ndarray]) -> None:
    detector, poses = crumpled
    batch = detector.detect_batch(poses[:0])
    assert batch.n_pairs.shape == batch.n_near_pairs.shape == batch.colliding.shape == (0,)
    assert batch.vertex_energy.shape == (0, poses.shape[1])
    assert detector.are_colliding(poses[:0]).shape == (0,)


# --- What goes in -----------------------------------------------------------------------------


def test_any_layout_and_precision_of_input(
    crumpled: tuple[CollisionDetector, np.ndarray],
) -> None:
    detector, poses = crumpled
    single = poses.astype(np.float32)
    single.flags.writeable = False
    before = single.copy()
    expected = detector.detect_batch(single.astype(np.float64))
    strided = np.repeat(single, 2, axis=2)[:, :, ::2]
    big_endian = single.astype(">f4")
    for variant in (single, strided, np.asfortranarray(single), big_endian, single.tolist()):
        batch = detector.detect_batch(variant, workers=2)
        assert np.array_equal(batch.n_pairs, expected.n_pairs)
        assert np.array_equal(batch.vertex_energy, expected.vertex_energy)
        assert np.array_equal(detector.are_colliding(variant), expected.colliding)
    found = detector.detect(single[-1])
    assert len(found.pairs) == expected.n_pairs[-1]
    assert np.array_equal(single, before)


def test_whole_numbers_are_coordinates_too() -> None:
    vertices = np.array(
        [[0, 0, 0], [8, 0, 0], [0, 8, 0], [2, 2, -1], [2, 2, 4], [3, 2, 4]], dtype=np.int64
    )
    detector = CollisionDetector(Topology([[0, 1, 2], [3, 4, 5]], 6), vertices)
    assert detector.detect(vertices).pairs.tolist() == [[0, 1]]
    assert detector.detect(vertices).penetration_depth.tolist() == [1 / 8]


def test_the_reference_is_copied() -> None:
    mesh = interlocked_tori(0.6)
    reference = mesh.vertices.copy()
    detector = CollisionDetector(mesh.topology, reference)
    expected = detector.detect(mesh.vertices)
    reference[:] = 0.0
    assert np.array_equal(detector.detect(mesh.vertices).pairs, expected.pairs)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_vertex_that_is_not_finite_is_named(
    crumpled: tuple[CollisionDetector, np.ndarray], bad: float
) -> None:
    detector, poses = crumpled
    broken = poses.copy()
    broken[13, 41, 2] = bad
    with pytest.raises(ShapeError, match="vertex 41 "):
        detector.detect(broken[13])
    for workers in (1, 4):
        with pytest.raises(ShapeError, match=r"vertex 41 of pose 13 "):
            detector.detect_batch(broken, workers=workers)
        with pytest.raises(ShapeError, match=r"vertex 41 of pose 13 "):
            detector.are_colliding(broken, workers=workers)
    with pytest.raises(ShapeError, match=r"vertex 41 of the reference"):
        CollisionDetector(detector.topology, broken[13])
    # Nothing of it is left behind.
    assert detector.are_colliding(poses[13:14])[0] == detector.detect(poses[13]).colliding


def test_other_shapes_are_refused(crumpled: tuple[CollisionDetector, np.ndarray]) -> None:
    detector, poses = crumpled
    for wrong in (poses[0, :-1], poses[0, :, :2], poses[0].ravel(), poses):
        with pytest.raises(ShapeError):
            detector.detect(wrong)
    for wrong in (poses[:, :-1], poses[:, :, :2], poses[0], poses[None]):
        with pytest.raises(ShapeError):
            detector.detect_batch(wrong)
        with pytest.raises(ShapeError):
            detector.are_colliding(wrong)
    with pytest.raises(ShapeError):
        CollisionDetector(detector.topology, poses[0, :-1])
    with pytest.raises(ShapeError, match="one point"):
        CollisionDetector(detector.topology, np.ones_like(poses[0]))


# --- What is imported and cached --------------------------------------------------------------


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("lcollision_core", ["torch", "numba", "PySide6", "vtk", "vtkmodules", "pyvista"]),
        ("lcollision_core.contact", ["torch", "PySide6", "vtk", "vtkmodules", "pyvista", "fcl"]),
    ],
)
def test_an_import_brings_nothing_heavy(module: str, absent: list[str]) -> None:
    code = f"import sys, {module}; print([m for m in {absent} if m in sys.modules])"
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert answer.stdout.strip() == "[]"


def test_compiled_code_is_taken_from_the_cache_by_the_next_process() -> None:
    code = """
import numpy as np
from lcollision_core.contact import CollisionDetector
from lcollision_core.contact.kernels import search_pose, add_vertex_energy
from lcollision_core.meshes import Topology
vertices = np.random.default_rng(0).random((30, 3))
detector = CollisionDetector(Topology(np.arange(30).reshape(10, 3), 30), vertices)
assert detector.detect(vertices).colliding
assert detector.are_colliding(vertices[None].astype(np.float32)).all()
print([(f.stats.cache_hits.total(), f.stats.cache_misses.total())
       for f in (search_pose, add_vertex_energy)])
"""
    # The first may find the code of earlier runs of the tests, or compile it and store it.
    for _ in range(2):
        answer = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        )
    # One version each, for one mode or the other and any precision of the poses.
    assert answer.stdout.strip() == "[(1, 0), (1, 0)]"
