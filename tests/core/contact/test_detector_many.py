"""More pairs than a buffer holds, coincident surfaces, unused vertices."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.contact import CollisionDetector
from lcollision_core.errors import CancelledError
from lcollision_core.jobs import Job
from lcollision_core.meshes import Topology
from tests.core.contact.detector_checks import detector_for
from tests.core.shapes import Mesh, box, grid, join, random_rotation, soup, sphere


@pytest.fixture(scope="module")
def scattered() -> tuple[CollisionDetector, np.ndarray]:
    """Return 700 large triangles: more than two buffers of pairs."""
    mesh = soup(np.random.default_rng(4).random((700, 3, 3)))
    return detector_for(mesh), mesh.vertices


def test_a_summary_counts_all_pairs_and_keeps_the_deepest(
    scattered: tuple[CollisionDetector, np.ndarray],
) -> None:
    detector, vertices = scattered
    told: list[tuple[int, int]] = []
    found = detector.detect(vertices)
    summary = detector.summarise(vertices, n_deepest=50, job=Job(lambda *one: told.append(one)))
    assert len(found.pairs) > 2 * 2**14
    assert (summary.n_pairs, summary.excluded.total) == (len(found.pairs), 0)
    assert np.array_equal(summary.vertex_energy, found.vertex_energy)
    assert summary.energy == found.energy
    order = np.argsort(-found.penetration_depth, kind="stable")[:50]
    assert np.array_equal(summary.pairs, found.pairs[order])
    assert np.array_equal(summary.penetration_depth, found.penetration_depth[order])
    shares = [done / total for done, total in told]
    assert len(shares) >= 3
    assert 0.0 < shares[0] < 0.9
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_batches_count_what_no_buffer_holds(
    scattered: tuple[CollisionDetector, np.ndarray],
) -> None:
    detector, vertices = scattered
    found, batch = detector.detect(vertices), detector.detect_batch(vertices[None])
    assert batch.n_pairs.tolist() == [len(found.pairs)]
    assert np.array_equal(batch.vertex_energy[0], found.vertex_energy)
    assert len(np.unique(found.pairs, axis=0)) == len(found.pairs)


def test_a_summary_can_be_cancelled(scattered: tuple[CollisionDetector, np.ndarray]) -> None:
    job = Job()
    job.cancel()
    with pytest.raises(CancelledError):
        scattered[0].summarise(scattered[1], job=job)


def test_no_pair_at_all_is_a_summary_too() -> None:
    mesh = sphere()
    summary = detector_for(mesh).summarise(mesh.vertices)
    assert (summary.n_pairs, summary.colliding, summary.energy) == (0, False, 0.0)
    assert summary.pairs.shape == (0, 2)
    assert summary.n_coincident_pairs == 0


def coincident(mesh: Mesh, unit: float = 1.0) -> tuple[int, int]:
    vertices = mesh.vertices * unit
    summary = CollisionDetector(mesh.topology, vertices).summarise(vertices)
    return summary.n_coincident_pairs, summary.n_pairs


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e5])
def test_each_face_of_a_surface_that_is_there_twice_coincides_with_its_twin(unit: float) -> None:
    ball = sphere().turned(random_rotation(np.random.default_rng(3)))
    assert coincident(join(ball, ball), unit) == (len(ball.faces), 0)
    assert coincident(join(ball, Mesh(ball.vertices, ball.faces[:, ::-1])), unit)[0] > 0


def test_walls_that_share_a_plane_coincide_however_they_are_cut() -> None:
    block = box([0, 0, 0], [1, 1, 1])
    # Two walls of two triangles each, with the same diagonal or with crossing ones.
    assert coincident(join(block, block.moved([1, 0, 0]))) == (2, 0)
    mirrored = Mesh(block.vertices * [1, -1, 1] + [1, 1, 0], block.faces[:, ::-1])
    assert coincident(join(block, mirrored)) == (4, 0)
    assert coincident(join(block, box([1, 0.25, 0.25], [2, 0.75, 0.5])))[0] > 0


def test_what_touches_in_a_line_or_a_point_does_not_coincide() -> None:
    block = box([0, 0, 0], [1, 1, 1])
    for shift in ([1, 1, 0], [1, 1, 1], [1.0001, 0, 0], [2, 0, 0]):
        assert coincident(join(block, block.moved(shift))) == (0, 0)
    # Faces of one plane, side by side.
    flat = grid(4)
    assert coincident(flat) == (0, 0)
    assert coincident(join(flat, flat.moved([1, 0, 0]))) == (0, 0)


def spheres_that_cross(*strays: tuple[float, float, float]) -> tuple[Topology, np.ndarray]:
    mesh = join(sphere(), sphere().moved([1.99, 0, 0]))
    vertices = np.concatenate([np.array(strays).reshape(-1, 3), mesh.vertices])
    return Topology(mesh.faces + len(strays), len(vertices)), vertices


@pytest.mark.parametrize("far", [1e3, 1e8, 1e12])
def test_a_vertex_that_no_face_uses_changes_nothing(far: float) -> None:
    expected = CollisionDetector(*spheres_that_cross()).detect(spheres_that_cross()[1])
    topology, vertices = spheres_that_cross((far, 0.0, 0.0), (0.0, -far, far))
    detector = CollisionDetector(topology, vertices)
    found = detector.detect(vertices)
    assert len(expected.pairs) > 0
    assert np.array_equal(found.pairs, expected.pairs)
    assert np.array_equal(found.penetration_depth, expected.penetration_depth)
    assert np.array_equal(found.vertex_energy[2:], expected.vertex_energy)
    assert detector.are_colliding(vertices[None]).all()
    assert detector.detect_batch(vertices[None]).n_pairs.tolist() == [len(expected.pairs)]


def test_vertices_may_come_in_another_unit() -> None:
    mesh = join(sphere(), sphere().moved([1.99, 0, 0]))
    detector = detector_for(mesh)
    expected = detector.detect(mesh.vertices)
    found = detector.detect(mesh.vertices * 1024.0, unit=2.0**-10)
    assert np.array_equal(found.pairs, expected.pairs)
    assert np.array_equal(found.penetration_depth, expected.penetration_depth)
    assert detector.are_colliding(mesh.vertices[None] * 1024.0, unit=2.0**-10).all()
