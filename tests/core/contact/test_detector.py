"""Self-collision of whole meshes: analytic results and brute force over all pairs."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcollision_core.contact import CollisionDetector, ContactRules
from lcollision_core.errors import ShapeError
from lcollision_core.meshes import Topology
from tests.core.brute_force import exact_depth
from tests.core.contact.detector_checks import (
    check_against_brute_force,
    check_mesh,
    detector_for,
    near_pairs,
)
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
    "a block pressed in by 1e-6 body sizes": pressed_block(1.5e-6),
    "a block pressed in by 2e-9 body sizes": pressed_block(3e-9),
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
    "a block pressed in by 1e-10 body sizes": pressed_block(1.5e-10),
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
    # triangles that reach it meets one or both of the face's halves.
    assert set(found.pairs[:, 0]) <= {2, 3}
    assert 8 <= len(found.pairs) <= 16
    # Coordinates near 1 are rounded by 1e-16.
    np.testing.assert_allclose(found.penetration_depth.max(), relative, atol=1e-15)


@pytest.mark.parametrize("shift", [0.0, 10.0, 1e3, 1e6])
def test_results_do_not_depend_on_the_frame(shift: float) -> None:
    rng = np.random.default_rng(0)
    # Rotated, so that no two faces touch exactly, which rounding could decide either way.
    mesh = interlocked_tori(0.6).turned(random_rotation(rng))
    detector = detector_for(mesh)
    at_home = detector.detect(mesh.vertices)
    away = mesh.turned(random_rotation(rng)).moved(shift * detector.body_size * np.ones(3))
    found = detector.detect(away.vertices)
    # Coordinates of `shift` body sizes have a relative rounding error of 2^-53.
    rounding = 1e-14 + 1e-15 * shift
    assert at_home.penetration_depth.min() > 1e-7
    assert np.array_equal(found.pairs, at_home.pairs)
    np.testing.assert_allclose(found.penetration_depth, at_home.penetration_depth, atol=rounding)
    # Also with a reference that is moved along.
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
    for factor in (1e-3, 0.5, 1e3, 1e8):
        found = detector.detect(factor * mesh.vertices)
        deep = at_home.penetration_depth * factor > 1e-8
        assert {tuple(p) for p in at_home.pairs[deep].tolist()} <= set(
            map(tuple, found.pairs.tolist())
        )
        assert found.penetration_depth.max() == pytest.approx(
            factor * at_home.penetration_depth.max(), rel=1e-9
        )


@pytest.mark.parametrize("factor", [1e10, 1e60, 1e300])
def test_an_absurdly_large_pose_is_refused_rather_than_called_free(factor: float) -> None:
    mesh = interlocked_tori(0.6)
    detector = detector_for(mesh)
    with pytest.raises(ShapeError, match=r"vertex \d+ is more than 1e\+09 body sizes away"):
        detector.detect(factor * mesh.vertices)
    with pytest.raises(ShapeError, match=r"vertex \d+ of pose 1 is more than"):
        detector.are_colliding(np.stack([mesh.vertices, factor * mesh.vertices]))


@pytest.mark.parametrize("factor", [1e-320, 1e-200, 1e200, 1e307, 1.7e308])
def test_a_unit_beyond_arithmetic_is_refused_rather_than_called_free(factor: float) -> None:
    mesh = figure_eight(0.2, 0.15)
    vertices = mesh.vertices / np.abs(mesh.vertices).max() * factor
    with pytest.raises(ShapeError, match=r"(body size|one point).*(scale it|extent)$"):
        CollisionDetector(mesh.topology, vertices)


@pytest.mark.parametrize("factor", [1e-149, 1e149])
def test_results_hold_up_to_the_largest_unit(factor: float) -> None:
    mesh = figure_eight(0.2, 0.15)
    at_home = detector_for(mesh).detect(mesh.vertices)
    scaled = Mesh(mesh.vertices * factor, mesh.faces)
    found = CollisionDetector(scaled.topology, scaled.vertices, rules=ContactRules(0.1)).detect(
        scaled.vertices
    )
    near = CollisionDetector(mesh.topology, mesh.vertices, rules=ContactRules(0.1)).detect(
        mesh.vertices
    )
    assert at_home.colliding
    assert found.pairs.tolist() == near.pairs.tolist()
    assert near_pairs(found).tolist() == near_pairs(near).tolist()


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
            found.penetration_depth * detector_for(mesh).body_size, 0.25, rtol=1e-12
        )
    alone = soup([floor, *aloof[: last - 1]])
    assert not check_mesh(alone).colliding


def test_all_of_many_pairs_are_reported() -> None:
    # 3000 blades through one floor: many times the initial buffer of a search.
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
        found.penetration_depth[with_floor] * detector.body_size, depth, rtol=1e-11
    )
    # Again with the grown buffer, and a sparse pose after a crowded one.
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
    # Two blades stand in a floor; one of them shares a corner with the floor.
    floor, stem, blade = [0, 1, 2], [3, 4], [5, 6, 7]
    vertices = np.array(
        [[0, 0, 0], [4, 0, 0], [0, 4, 0]]
        + [[1, 1, -1], [1, 1, 1]]
        + [[2, 1, -1], [2, 1, 1], [3, 1, 1]],
        dtype=np.float64,
    )
    # By its depth alone, the blade with the shared corner would count.
    assert exact_depth(vertices[floor], vertices[[1, *stem]]) > 0.1
    for of_floor, of_blade in itertools.product(range(3), repeat=2):
        hanging = np.roll([of_floor, *stem], of_blade)
        faces = np.array([floor, hanging, blade], dtype=np.int32)
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
        # Many coplanar, touching, degenerate and duplicate faces.
        vertices = rng.integers(0, 5, (n_vertices, 3)).astype(float)
        vertices[:2] = [[0, 0, 0], [4, 4, 4]]
    reference = rng.uniform(0, 1, (n_vertices, 3))
    detector = CollisionDetector(Topology(faces, n_vertices), reference)
    check_against_brute_force(detector, vertices, faces)


def test_faces_at_one_point_are_not_compared_with_each_other() -> None:
    """Most of a mesh that a broken export put at one point: their pairs would take minutes."""
    crossing = figure_eight(0.2, 0.15)
    n, n_points = len(crossing.vertices), 30_000
    at_one_point = np.arange(n, n + n_points).reshape(-1, 3)
    vertices = np.concatenate([crossing.vertices, np.repeat(crossing.vertices[:1], n_points, 0)])
    faces = np.concatenate([crossing.faces, at_one_point]).astype(np.int32)
    detector = CollisionDetector(Topology(faces, n + n_points), vertices)
    expected = detector_for(crossing).detect(crossing.vertices)
    assert expected.n_pairs > 0
    assert detector.detect(vertices).pairs.tolist() == expected.pairs.tolist()
    summary = detector.summarise(vertices)
    assert (summary.n_pairs, summary.n_coincident_pairs) == (expected.n_pairs, 0)


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
            # Smooth folds, as in a bad pose.
            waves = rng.normal(size=(3, 3)) * 4
            pose += 4 * amplitude * np.sin(pose @ waves)
        check_against_brute_force(detector, pose, mesh.faces)


@pytest.mark.parametrize("spread", [1.0, 300.0])
def test_no_shallow_pair_slips_between_the_boxes(spread: float) -> None:
    """Floors touched from above and below: boxes overlap by less than float32 resolves."""
    rng = np.random.default_rng(12)
    n = 150
    floor = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    blade = np.array([[0.25, 0.25, 0], [0.25, 0.25, 1], [0.5, 0.25, 1]])
    depth = 10 ** rng.uniform(-8, -7, n) * spread
    positions = rng.uniform(0, spread, (n, 1, 3))
    size = 1e-3 * spread
    lift = np.zeros((n, 1, 3))
    lift[:, 0, 2] = depth
    side = np.where(np.arange(n) % 2 == 0, 1.0, -1.0)[:, None, None]
    blades = (size * blade - lift) * np.concatenate([side**2, side**2, side], axis=2)
    triangles = np.stack([size * floor + positions, blades + positions], axis=1).reshape(-1, 3, 3)
    mesh = soup(triangles)
    # The reference has body size 1, whatever the spread of the pose.
    reference = soup(triangles / spread)
    detector = detector_for(reference)
    found = detector.detect(mesh.vertices)
    assert {(2 * k, 2 * k + 1) for k in range(n)} <= set(map(tuple, found.pairs.tolist()))
    check_against_brute_force(detector, mesh.vertices, mesh.faces)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("up", [1.0, -1.0])
def test_boxes_that_only_touch_in_single_precision(axis: int, up: float) -> None:
    # A leaf of 8 floors in one plane, and a leaf of 8 blades whose tips are 1e-8 behind it.
    positions = np.arange(8)[:, None, None] * np.array([0.03, 0.0, 0.0])
    floors = 0.02 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]) + positions
    blades = np.array([[0.005, 0.005, -1e-8], [0.005, 0.005, 1], [0.006, 0.005, 1]]) + positions
    triangles = np.roll(np.concatenate([floors, blades]) * [1, 1, up], axis + 1, axis=2)
    found = check_mesh(soup(triangles))
    assert found.pairs.tolist() == [[k, k + 8] for k in range(8)]
