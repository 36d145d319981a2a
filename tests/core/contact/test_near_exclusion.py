"""Pairs that are folds of the skin: exact distance along the reference mesh."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.contact import DEPTH_TOLERANCE, CollisionDetector, ContactRules, exclusions
from lcollision_core.errors import ShapeError
from tests.core.brute_force import all_pairs
from tests.core.contact.detector_checks import near_pairs, near_penetration_depth
from tests.core.shapes import Mesh, grid, join, random_rotation, soup, strip

STRAIGHT = strip([[x, 0.0] for x in range(9)])
"""The reference: 8 segments of length 1, so the body size is 8."""

LOOP = strip(
    [[0, 0], [2, 0], [4, 0], [4, 2], [3, 3], [1.5, 1.5], [0, -1], [0, -2], [0, -3]]
)  # fmt: skip
"""A pose of it whose segment 5 returns through segment 0.

It crosses at 0.45 of segment 0 and at 0.6 of its own length. So from y = 0 the two lower faces
meet up to y = 0.45, then upper 0 meets lower 5 up to 0.6, then the two upper faces meet.
"""
LOWER_0, UPPER_0, LOWER_5, UPPER_5 = 0, 1, 10, 11
AT_DISTANCE_4 = [[LOWER_0, LOWER_5], [UPPER_0, UPPER_5]]
"""Four edges lie between columns 1 and 5, in a row in which both faces have a corner."""
AT_DISTANCE_5 = [[UPPER_0, LOWER_5]]
"""They share no such row: one edge more."""


def path_lengths(mesh: Mesh) -> np.ndarray:
    """Return the shortest edge paths (V, V) by Floyd and Warshall."""
    distance = np.full((len(mesh.vertices),) * 2, np.inf)
    np.fill_diagonal(distance, 0.0)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        a, b = mesh.faces[:, i], mesh.faces[:, j]
        length = np.linalg.norm(mesh.vertices[a] - mesh.vertices[b], axis=1)
        distance[a, b] = distance[b, a] = length
    for k in range(len(distance)):
        np.minimum(distance, distance[:, k, None] + distance[None, k], out=distance)
    return distance


def pair_distances(mesh: Mesh, pairs: np.ndarray) -> np.ndarray:
    distance = path_lengths(mesh)
    a, b = mesh.faces[pairs[:, 0]], mesh.faces[pairs[:, 1]]
    return distance[a[:, :, None], b[:, None, :]].min(axis=(1, 2))


def test_the_loop_is_what_it_is_said_to_be() -> None:
    pairs = all_pairs(LOOP.vertices, LOOP.faces, 1e-6).pairs
    assert pairs.tolist() == sorted(AT_DISTANCE_4 + AT_DISTANCE_5)
    distances = dict(
        zip(map(tuple, pairs.tolist()), pair_distances(STRAIGHT, pairs).tolist(), strict=True)
    )
    assert distances == {(0, 10): 4.0, (1, 11): 4.0, (1, 10): 5.0}


@pytest.mark.parametrize(
    ("near_exclusion", "near"),
    [
        (0.0, []),
        (np.nextafter(0.5, 0.0), []),
        (0.5, AT_DISTANCE_4),
        (np.nextafter(0.625, 0.0), AT_DISTANCE_4),
        (0.625, AT_DISTANCE_4 + AT_DISTANCE_5),
        (2.0, AT_DISTANCE_4 + AT_DISTANCE_5),
    ],
)
def test_pairs_up_to_the_distance_are_near(near_exclusion: float, near: list[list[int]]) -> None:
    everything = CollisionDetector(STRAIGHT.topology, STRAIGHT.vertices).detect(LOOP.vertices)
    depth_of = {
        tuple(pair): depth
        for pair, depth in zip(everything.pairs.tolist(), everything.penetration_depth, strict=True)
    }
    far = sorted(pair for pair in AT_DISTANCE_4 + AT_DISTANCE_5 if pair not in near)

    detector = CollisionDetector(
        STRAIGHT.topology, STRAIGHT.vertices, rules=ContactRules(near_exclusion)
    )
    found = detector.detect(LOOP.vertices)
    assert found.pairs.tolist() == far
    assert near_pairs(found).tolist() == sorted(near)
    assert found.penetration_depth.tolist() == [depth_of[tuple(pair)] for pair in far]
    assert near_penetration_depth(found).tolist() == [
        depth_of[tuple(pair)] for pair in sorted(near)
    ]
    assert found.colliding == (len(far) > 0)

    expected = np.zeros(len(STRAIGHT.vertices))
    for pair in far:
        expected[STRAIGHT.faces[pair]] += depth_of[tuple(pair)] ** 2 / 6
    np.testing.assert_allclose(found.vertex_energy, expected, rtol=1e-14)

    batch = detector.detect_batch([LOOP.vertices, STRAIGHT.vertices])
    assert batch.n_pairs.tolist() == [len(far), 0]
    assert batch.n_near_pairs.tolist() == [len(near), 0]
    assert batch.colliding.tolist() == [len(far) > 0, False]
    assert np.array_equal(batch.vertex_energy[0], found.vertex_energy)
    are_colliding = detector.are_colliding([LOOP.vertices, STRAIGHT.vertices])
    assert are_colliding.tolist() == [len(far) > 0, False]


def test_lengths_are_those_of_the_reference_not_of_the_pose() -> None:
    # On the loop itself, the way around is longer than its height.
    detector = CollisionDetector(LOOP.topology, LOOP.vertices, rules=ContactRules(0.625))
    round_trip = pair_distances(LOOP, np.array(AT_DISTANCE_4 + AT_DISTANCE_5))
    assert round_trip.min() > 0.625 * detector.body_size
    assert len(detector.detect(LOOP.vertices).pairs) == 3


def test_the_path_is_along_the_mesh_not_through_the_air() -> None:
    # The Euclidean distance of faces that pass through each other is 0.
    detector = CollisionDetector(LOOP.topology, LOOP.vertices, rules=ContactRules(1e-3))
    found = detector.detect(LOOP.vertices)
    assert (len(found.pairs), len(near_pairs(found))) == (3, 0)


def test_another_component_is_never_near() -> None:
    floor, blade = [[0, 0, 0], [4, 0, 0], [0, 4, 0]], [[1, 1, -1], [1, 1, 1], [2, 1, 1]]
    mesh = soup([floor, blade])
    detector = CollisionDetector(mesh.topology, mesh.vertices, rules=ContactRules(1e6))
    assert detector.detect(mesh.vertices).pairs.tolist() == [[0, 1]]
    assert detector.are_colliding(mesh.vertices[None]).tolist() == [True]


def test_duplicate_vertices_are_at_distance_zero_and_linked() -> None:
    # A duplicate column: the path is neither longer nor interrupted.
    columns = [[x, 0.0] for x in (0, 1, 2, 2, 3, 4, 5, 6, 7, 8)]
    reference = strip(columns)
    pose = strip(np.insert(LOOP.vertices[::2][:, [0, 2]], 3, [4, 1], axis=0))
    pairs = all_pairs(pose.vertices, pose.faces, 1e-6).pairs
    assert len(pairs) == 3
    assert pair_distances(reference, pairs).tolist() == [4.0, 5.0, 4.0]
    for near_exclusion, n_near in ((np.nextafter(0.5, 0), 0), (0.5, 2), (0.625, 3)):
        detector = CollisionDetector(
            reference.topology, reference.vertices, rules=ContactRules(near_exclusion)
        )
        assert len(near_pairs(detector.detect(pose.vertices))) == n_near


def test_the_first_hit_is_sought_past_near_pairs_in_whatever_order() -> None:
    """A crumpled sheet with only near pairs, and one blade somewhere in the mesh."""
    rng = np.random.default_rng(4)
    sheet = grid(12)
    crumpled = Mesh(sheet.vertices + rng.normal(scale=0.2, size=sheet.vertices.shape), sheet.faces)
    through = soup([[[0.5, 0.5, -1.0], [0.5, 0.5, 1.0], [0.6, 0.5, 1.0]]])
    apart = through.moved([0.0, 0.0, 5.0])
    for seed in range(20):
        shuffled = np.random.default_rng(seed)
        order = shuffled.permutation(len(sheet.faces) + 1)
        reference = join(sheet, through)
        topology = Mesh(reference.vertices, reference.faces[order]).topology
        rotation = random_rotation(shuffled)
        detector = CollisionDetector(
            topology, reference.vertices @ rotation.T, rules=ContactRules(3)
        )
        poses = np.stack([join(crumpled, blade).vertices for blade in (through, apart)])
        batch = detector.detect_batch(poses)
        # More than the initial buffer of a search.
        assert batch.n_near_pairs.min() > 600
        assert batch.n_pairs[0] > 0
        assert batch.n_pairs[1] == 0
        assert detector.are_colliding(poses).tolist() == [True, False]


@pytest.mark.parametrize("near_exclusion", [0.05, 0.11, 0.2, 0.45])
def test_near_pairs_of_a_crumpled_sheet_against_brute_force(near_exclusion: float) -> None:
    rng = np.random.default_rng(9)
    sheet = grid(10)
    # An uneven reference, so that no path happens to equal the limit.
    uneven = Mesh(sheet.vertices + rng.normal(scale=0.02, size=sheet.vertices.shape), sheet.faces)
    pose = uneven.vertices + rng.normal(scale=0.3, size=sheet.vertices.shape)
    detector = CollisionDetector(
        sheet.topology, uneven.vertices, rules=ContactRules(near_exclusion)
    )
    expected = all_pairs(pose, sheet.faces, DEPTH_TOLERANCE * detector.body_size)
    limit = near_exclusion * detector.body_size
    is_near = pair_distances(uneven, expected.pairs) <= limit
    assert 0 < np.count_nonzero(is_near) < len(is_near)

    found = detector.detect(pose)
    assert np.array_equal(found.pairs, expected.pairs[~is_near])
    assert np.array_equal(near_pairs(found), expected.pairs[is_near])
    np.testing.assert_allclose(
        near_penetration_depth(found) * detector.body_size, expected.depth[is_near], atol=1e-12
    )


@pytest.mark.parametrize("near_exclusion", [-0.1, np.nan])
def test_a_limit_that_is_no_length_is_refused(near_exclusion: float) -> None:
    with pytest.raises(ShapeError, match="near exclusion"):
        CollisionDetector(STRAIGHT.topology, STRAIGHT.vertices, rules=ContactRules(near_exclusion))


def test_a_table_beyond_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = grid(30)
    all_pairs = len(mesh.vertices) * (len(mesh.vertices) - 1) // 2
    monkeypatch.setattr(exclusions, "MAX_EXCLUDED", all_pairs)
    CollisionDetector(mesh.topology, mesh.vertices, rules=ContactRules(10.0))
    monkeypatch.setattr(exclusions, "MAX_EXCLUDED", all_pairs - 1)
    with pytest.raises(ShapeError, match=r"near exclusion .* make it smaller"):
        CollisionDetector(mesh.topology, mesh.vertices, rules=ContactRules(10.0))
