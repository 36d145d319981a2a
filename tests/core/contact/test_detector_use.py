"""Use of the detector: batches, threads, cancelling, odd input, imports, cached code."""

from __future__ import annotations

import copy
import dataclasses
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from lcollision_core.contact import CollisionDetector, search
from lcollision_core.errors import CancelledError, ShapeError
from lcollision_core.jobs import Job
from lcollision_core.meshes import Topology
from tests.core.contact.detector_checks import detector_for
from tests.core.shapes import (
    interlocked_tori,
    torus,
)


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
    # A tree that fits no pose is slow but still correct.
    scattered = np.random.default_rng(5).uniform(0, 10, poses[0].shape)
    other = CollisionDetector(detector.topology, scattered)
    for pose in poses[::5]:
        expected, found = detector.detect(pose), other.detect(pose)
        assert np.array_equal(found.pairs, expected.pairs)
        np.testing.assert_allclose(
            found.penetration_depth * other.body_size,
            expected.penetration_depth * detector.body_size,
            atol=1e-14,
        )


@pytest.mark.parametrize("clearance", [0.0, 0.01])
def test_what_collides_where_the_last_did_is_known_without_a_search(
    crumpled: tuple[CollisionDetector, np.ndarray],
    clearance: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plain, poses = crumpled
    fresh = CollisionDetector(plain.topology, poses[0])
    expected = [fresh.with_clearance(clearance).detect(pose).colliding for pose in poses]
    detector = CollisionDetector(plain.topology, poses[0]).with_clearance(clearance)
    for pose in np.random.default_rng(3).permutation(np.repeat(np.arange(len(poses)), 3)):
        assert detector.are_colliding(poses[pose][None], workers=1)[0] == expected[pose]
    assert detector.are_colliding(poses[-1:], workers=1)[0]
    with monkeypatch.context() as without:
        without.setattr(search, "search_pose", None)
        assert detector.are_colliding(poses[-1:] + 5.0, workers=1)[0]
    # The remembered pair is shared with detectors of other clearances, where it may not count.
    others = [detector.with_clearance(other) for other in (0.0, 1e-7, 0.05)]
    verdicts = []
    for other in others:
        alone = CollisionDetector(plain.topology, poses[0]).with_clearance(other.clearance)
        verdicts.append([alone.detect(pose).colliding for pose in poses])
        for pose, collides in zip(poses, verdicts[-1], strict=True):
            detector.are_colliding(pose[None], workers=1)
            assert other.are_colliding(pose[None], workers=1)[0] == collides
    assert verdicts[0] != verdicts[2]


def test_results_own_their_arrays(crumpled: tuple[CollisionDetector, np.ndarray]) -> None:
    detector, poses = crumpled
    found = detector.detect(poses[-1])
    kept = [copy.deepcopy(getattr(found, field.name)) for field in dataclasses.fields(found)]
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
        barrier.wait(timeout=300)
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

        getattr(detector, mode)(poses[:n_poses], workers=workers, job=Job(note))
        assert calls[-1] == (n_poses, n_poses)
        assert [done for done, _ in calls] == sorted({done for done, _ in calls})
        assert {total for _, total in calls} == {n_poses}
        # Even a small batch has work for every thread.
        assert len(calls) >= min(workers, n_poses)
        assert threads == {threading.get_ident()}


class PolledBy(Job):
    """A job that records the threads that poll it."""

    def __init__(self) -> None:
        super().__init__()
        self.threads: set[int] = set()

    @property
    def cancelled(self) -> bool:
        self.threads.add(threading.get_ident())
        return False


def test_one_pose_starts_no_thread(crumpled: tuple[CollisionDetector, np.ndarray]) -> None:
    detector, poses = crumpled
    token = PolledBy()
    detector.are_colliding(poses[:1], job=token)
    detector.detect_batch(poses, workers=1, job=token)
    assert token.threads == {threading.get_ident()}


class CancelledAtPoll(Job):
    """A job that is cancelled just before its n-th poll."""

    def __init__(self, n: int) -> None:
        super().__init__()
        self._polls_left = n
        self._lock = threading.Lock()

    @property
    def cancelled(self) -> bool:
        with self._lock:
            self._polls_left -= 1
            return self._polls_left <= 0


@pytest.mark.parametrize("mode", ["detect_batch", "are_colliding"])
@pytest.mark.parametrize("workers", [1, 3])
def test_cancelling(
    crumpled: tuple[CollisionDetector, np.ndarray], mode: str, workers: int
) -> None:
    detector, poses = crumpled
    search = getattr(detector, mode)
    before = Job()
    before.cancel()
    with pytest.raises(CancelledError):
        search(poses, workers=workers, job=before)

    many = np.tile(poses, (20, 1, 1))
    n_threads = threading.active_count()
    done_at = [0]
    with pytest.raises(CancelledError):
        search(
            many,
            workers=workers,
            job=CancelledAtPoll(5).part(lambda done, _: done_at.append(done)),
        )
    # Four tasks of a few poses ran on, and no thread is left.
    assert done_at[-1] < len(many) // 4
    assert threading.active_count() == n_threads
    # A job that is never cancelled changes nothing, and the detector still works.
    idle = search(poses, job=Job())
    verdict = idle.colliding if mode == "detect_batch" else idle
    assert verdict.tolist() == [detector.detect(pose).colliding for pose in poses]


def test_no_poses(crumpled: tuple[CollisionDetector, np.ndarray]) -> None:
    detector, poses = crumpled
    batch = detector.detect_batch(poses[:0])
    assert batch.n_pairs.shape == batch.n_near_pairs.shape == batch.colliding.shape == (0,)
    assert batch.vertex_energy.shape == (0, poses.shape[1])
    assert detector.are_colliding(poses[:0]).shape == (0,)


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
    # It leaves no state behind.
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
    with pytest.raises(ShapeError, match="all vertices are at one point"):
        CollisionDetector(detector.topology, np.ones_like(poses[0]))


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


@pytest.mark.slow
def test_compiled_code_is_taken_from_the_cache_by_the_next_process() -> None:
    code = """
import numpy as np
from lcollision_core.contact import CollisionDetector, search
from lcollision_core.contact.kernels import search_pose, add_vertex_energy
from lcollision_core.meshes import Topology
from lcollision_core.meshes.contact_rules import ContactRules
vertices = np.random.default_rng(0).random((30, 3))
detector = CollisionDetector(Topology(np.arange(30).reshape(10, 3), 30), vertices)
assert detector.detect(vertices).colliding
assert detector.are_colliding(vertices[None].astype(np.float32)).all()
print([(f.stats.cache_hits.total(), f.stats.cache_misses.total())
       for f in (search_pose, add_vertex_energy)])
"""
    # The first run may find the code cached by earlier tests, or compile and store it.
    for _ in range(2):
        answer = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        )
    # One compiled version each, for both modes and any precision of the poses.
    assert answer.stdout.strip() == "[(1, 0), (1, 0)]"
