"""Pairs that are too near, against brute force over all pairs and analytic shapes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest

from lcollision_core.bodies import Body, open_body
from lcollision_core.contact import (
    DEPTH_TOLERANCE,
    CollisionDetector,
    ContactRules,
    SelfCollisions,
)
from lcollision_core.errors import ShapeError
from lcollision_core.meshes import FaceGroup
from tests.core.brute_force import ReferencePairs, distances, signed_distances
from tests.core.shapes import Mesh, box, grid, join, random_rotation, soup, sphere

FloatArray = npt.NDArray[np.float64]

CLEARANCE = 0.004


@pytest.fixture(scope="module")
def body() -> Body:
    return open_body("body")


@pytest.fixture(scope="module")
def poses(body: Body) -> npt.NDArray[np.float32]:
    """Return poses as exported, some of which collide."""
    return body.decode(body.sample(4, np.random.default_rng(3))).astype(np.float32)


@dataclass(frozen=True)
class NearPairs:
    """Pairs nearer than a clearance by brute force, with their posed and rest distances."""

    pairs: npt.NDArray[np.int64]
    apart: FloatArray
    at_rest: FloatArray

    @classmethod
    def of(
        cls, detector: CollisionDetector, vertices: npt.ArrayLike, clearance: float
    ) -> NearPairs:
        faces, size = detector.topology.faces, detector.body_size
        near = signed_distances(np.asarray(vertices, np.float64) / size, faces, clearance)
        rest = detector.reference[faces] / size
        at_rest = distances(rest[near.pairs[:, 0]], rest[near.pairs[:, 1]])
        return cls(near.pairs, near.depth, at_rest)

    def lacking(self, clearance: float) -> ReferencePairs:
        """Return the pairs that violate the clearance beyond the tolerance, and by how much."""
        lacks = np.minimum(clearance, 0.5 * self.at_rest) - self.apart
        return ReferencePairs(self.pairs[lacks > 1e-9], lacks[lacks > 1e-9])


@pytest.fixture(scope="module")
def near_pairs(body: Body, poses: npt.NDArray[np.float32]) -> list[NearPairs]:
    return [NearPairs.of(body.detector, pose, CLEARANCE) for pose in poses]


def check(
    detector: CollisionDetector,
    vertices: npt.ArrayLike,
    clearance: float,
    expected: ReferencePairs | None = None,
) -> SelfCollisions:
    """Compare every detector method with brute force."""
    near = detector.with_clearance(clearance)
    if expected is None:
        expected = NearPairs.of(detector, vertices, clearance).lacking(clearance)
    found, pose = near.detect(vertices), np.asarray(vertices)
    assert found.pairs.tolist() == expected.pairs.tolist()
    np.testing.assert_allclose(found.penetration_depth, expected.depth, rtol=0.0, atol=1e-9)
    batch = near.detect_batch(pose[None])
    assert batch.n_pairs.tolist() == [found.n_pairs]
    np.testing.assert_array_equal(batch.vertex_energy[0], found.vertex_energy)
    assert near.are_colliding(pose[None]).tolist() == [found.colliding]
    assert near.summarise(vertices, n_deepest=3).n_pairs == found.n_pairs
    least = detector.least_distance(vertices, clearance)
    assert (least is not None) == found.colliding
    return found


def test_posed_bodies_are_those_of_brute_force(
    body: Body, poses: npt.NDArray[np.float32], near_pairs: list[NearPairs]
) -> None:
    n_near = [
        check(body.detector, pose, CLEARANCE, near.lacking(CLEARANCE)).n_pairs
        for pose, near in zip(poses, near_pairs, strict=True)
    ]
    plain = body.detector.detect_batch(poses)
    assert 0 < plain.colliding.sum() < len(poses)
    assert (n_near >= plain.n_pairs).all()
    assert (n_near > plain.n_pairs).sum() > 1


def test_the_least_distance_is_that_of_brute_force(
    body: Body, poses: npt.NDArray[np.float32], near_pairs: list[NearPairs]
) -> None:
    size = body.detector.body_size
    n_apart = 0
    for pose, near in zip(poses, near_pairs, strict=True):
        counts = near.apart < 0.5 * near.at_rest
        if not counts.any():
            assert body.detector.least_distance(pose, CLEARANCE) is None
            continue
        first = np.flatnonzero(counts)[near.apart[counts].argmin()]
        least = body.detector.least_distance(pose, CLEARANCE)
        assert least is not None
        assert least.distance == pytest.approx(near.apart[first], abs=1e-9)
        assert least.faces.tolist() == near.pairs[first].tolist()
        apart = np.linalg.norm(least.points[0] - least.points[1]) / size
        assert apart == pytest.approx(max(least.distance, 0.0), abs=1e-9)
        # The least distance is the largest clearance with which the pose is free.
        if least.distance > 0.0:
            n_apart += 1
            for more, collides in ((-1e-6, False), (1e-6, True)):
                detector = body.detector.with_clearance(least.distance + more)
                assert detector.are_colliding(pose[None]).tolist() == [collides]
    assert n_apart > 0


def test_the_rest_pose_is_free_with_any_clearance(body: Body) -> None:
    assert not body.detector.are_colliding(body.reference[None])[0]
    for clearance in (1e-4, 1e-2, 0.05):
        detector = body.detector.with_clearance(clearance)
        assert not detector.are_colliding(body.reference[None])[0]
    assert body.detector.least_distance(body.reference, 0.05) is None


def test_without_a_clearance_all_is_as_before(body: Body, poses: npt.NDArray[np.float32]) -> None:
    again = body.detector.with_clearance(CLEARANCE).with_clearance(0.0)
    assert body.detector.with_clearance(0.0) is body.detector
    assert (again.clearance, body.detector.with_clearance(CLEARANCE).clearance) == (0.0, CLEARANCE)
    for pose in poses:
        one, other = body.detector.detect(pose), again.detect(pose)
        np.testing.assert_array_equal(one.pairs, other.pairs)
        np.testing.assert_array_equal(one.penetration_depth, other.penetration_depth)
        np.testing.assert_array_equal(one.vertex_energy, other.vertex_energy)


def test_contact_rules_hold_with_a_clearance(
    body: Body, poses: npt.NDArray[np.float32], near_pairs: list[NearPairs]
) -> None:
    rules = ContactRules(near_exclusion=0.06)
    detector = body.detector.with_rules(rules).with_clearance(CLEARANCE)
    assert detector.rules == rules
    n_excluded = 0
    for pose, near in zip(poses, near_pairs, strict=True):
        expected = near.lacking(CLEARANCE)
        rule = body.detector.with_rules(rules).rules_of(expected.pairs, expected.depth)
        found = detector.detect(pose)
        assert found.pairs.tolist() == expected.pairs[rule == 0].tolist()
        # Excluded pairs are reported only if they penetrate, as without a clearance.
        plain = body.detector.with_rules(rules).detect(pose)
        assert found.excluded == plain.excluded
        assert plain.excluded.near <= (rule > 0).sum()
        counted = detector.detect(pose, counted_only=True)
        np.testing.assert_array_equal(counted.pairs, found.pairs)
        least = detector.least_distance(pose, CLEARANCE)
        assert (least is not None) == found.colliding
        n_excluded += plain.excluded.near
    assert n_excluded > 0
    blind = body.detector.with_rules(ContactRules(near_exclusion=0.9))
    assert all(blind.least_distance(pose, CLEARANCE) is None for pose in poses)
    # Rules that need separate lists keep the clearance, in either order.
    assert body.detector.with_clearance(CLEARANCE).with_rules(rules).clearance == CLEARANCE


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("thin", [False, True])
def test_soups_are_those_of_brute_force(seed: int, thin: bool) -> None:
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-1, 1, (80, 1, 3)) + rng.uniform(-0.3, 0.3, (80, 3, 3))
    if thin:
        middle = corners[:, :2].mean(axis=1)
        thickness = 10.0 ** rng.uniform(-9, -1, (80, 1))
        corners[:, 2] = middle + thickness * (corners[:, 2] - middle)
    corners[0] = [[-1.2] * 3, [1.2] * 3, [1.2, -1.2, 1.2]]
    mesh = soup(corners)
    # At rest all are far apart, except some that touch or cross.
    spread = 4.0 * rng.permutation(80)[:, None, None] * np.array([1.0, 0.3, 0.1])
    spread[:8] = spread[0]
    detector = CollisionDetector(mesh.topology, (corners + spread).reshape(-1, 3))
    clearance = 0.05 / detector.body_size
    found = check(detector, mesh.vertices, clearance)
    assert found.n_pairs > (5 if thin else 20)
    turned = mesh.turned(random_rotation(rng)).moved([100.0, 50.0, -30.0]).vertices
    assert check(detector, turned, clearance).n_pairs == found.n_pairs


@pytest.mark.slow
def test_more_pairs_than_fit_the_buffer_are_found() -> None:
    rng = np.random.default_rng(8)
    corners = rng.uniform(-1, 1, (200, 3, 3))
    mesh = soup(corners)
    rest = corners + 100.0 * np.arange(200)[:, None, None]
    detector = CollisionDetector(mesh.topology, rest.reshape(-1, 3))
    found = check(detector, mesh.vertices, 0.9 / detector.body_size)
    assert found.n_pairs > 1 << 14


def blocks_apart(gap: float) -> tuple[CollisionDetector, Mesh]:
    """Two blocks with a gap, and the detector of a rest pose with a gap of 1."""
    one = box([0, 0, 0], [1, 1, 1])

    def with_gap(gap: float) -> Mesh:
        return join(one, one.moved([1.0 + gap, 0.25, 0.125]))

    rest = with_gap(1.0)
    return CollisionDetector(rest.topology, rest.vertices), with_gap(gap)


def test_blocks_collide_below_the_clearance() -> None:
    for gap, lacks in ((0.08, None), (0.04, 0.02), (0.0, 0.06), (-0.01, 0.07)):
        detector, mesh = blocks_apart(gap)
        found = detector.with_clearance(0.06 / detector.body_size).detect(mesh.vertices)
        assert found.colliding == (lacks is not None)
        if lacks is not None:
            deepest = found.penetration_depth.max() * detector.body_size
            assert deepest == pytest.approx(lacks, abs=1e-12)
        least = detector.least_distance(mesh.vertices, 0.2 / detector.body_size)
        assert least is not None
        assert least.distance * detector.body_size == pytest.approx(gap, abs=1e-12)
        np.testing.assert_allclose(np.diff(least.points[:, 0]), max(gap, 0.0), atol=0.0101)


def test_the_unit_of_a_pose_changes_no_verdict() -> None:
    detector, mesh = blocks_apart(0.04)
    near = detector.with_clearance(0.06 / detector.body_size)
    found = near.detect(1000.0 * mesh.vertices, unit=0.001)
    np.testing.assert_allclose(
        found.penetration_depth, near.detect(mesh.vertices).penetration_depth, atol=1e-12
    )
    least = detector.least_distance(1000.0 * mesh.vertices, 0.05, unit=0.001)
    assert least is not None
    assert np.diff(least.points[:, 0])[0] == pytest.approx(40.0)


def folded(angle: float) -> Mesh:
    """Fold a sheet of 1 x 1 in the middle; at pi its halves lie on each other."""
    sheet = grid(12)
    x, y = sheet.vertices[:, 0], sheet.vertices[:, 1]
    middle = 0.5 * (x.min() + x.max())
    past = np.maximum(x - middle, 0.0)
    vertices = np.stack(
        [np.minimum(x, middle) + past * np.cos(angle), y, past * np.sin(angle)], axis=1
    )
    return Mesh(vertices, sheet.faces)


def test_skin_may_bend_and_not_close() -> None:
    flat = folded(0.0)
    detector = CollisionDetector(flat.topology, flat.vertices)
    for clearance in (0.001, 0.01, 0.2):
        near = detector.with_clearance(clearance)
        assert not near.detect(folded(0.5 * np.pi).vertices).colliding
        assert near.detect(folded(0.999 * np.pi).vertices).colliding
    # The same sheet with the bent pose as the reference.
    bent = folded(0.9 * np.pi)
    unknown = CollisionDetector(bent.topology, bent.vertices)
    own_rest = unknown.with_clearance(0.05)
    assert not own_rest.detect(bent.vertices).colliding
    by_skin = unknown.with_clearance(0.05, rest_is_known=False)
    found = by_skin.detect(bent.vertices)
    assert found.colliding
    # None of them is joined by the surface.
    apart = np.abs(
        bent.faces[found.pairs[:, 0]].mean(axis=1) - bent.faces[found.pairs[:, 1]].mean(axis=1)
    )
    assert apart.min() > 1.0
    right = folded(0.5 * np.pi)
    by_skin = CollisionDetector(right.topology, right.vertices).with_clearance(
        0.05, rest_is_known=False
    )
    assert not by_skin.detect(right.vertices).colliding
    assert by_skin.least_distance(right.vertices, 0.05, rest_is_known=False) is None


def test_shells_without_a_rest_pose_are_measured_at_once() -> None:
    mesh = join(sphere(1.0), sphere(0.98))
    detector = CollisionDetector(mesh.topology, mesh.vertices)
    assert not detector.with_clearance(0.02).detect(mesh.vertices).colliding
    found = detector.with_clearance(0.02, rest_is_known=False).detect(mesh.vertices)
    n = len(sphere().faces)
    assert found.colliding
    assert ((found.pairs < n).sum(axis=1) == 1).all()


def test_a_tolerated_depth_is_what_a_pair_may_lack() -> None:
    detector, mesh = blocks_apart(0.04)
    clearance = 0.06 / detector.body_size
    n = len(box([0, 0, 0], [1, 1, 1]).faces)
    groups = (FaceGroup("one", np.arange(n)), FaceGroup("other", np.arange(n, 2 * n)))
    for tolerated, collides in ((0.019, True), (0.021, False)):
        depth = tolerated / detector.body_size
        rules = ContactRules(tolerated_depth=depth)
        own = ContactRules(tolerated_pairs=(("other", "one", depth),))
        of_pair = detector.with_rules(own, groups).with_clearance(clearance)
        assert of_pair.detect(mesh.vertices).colliding == collides
        assert of_pair.least_distance(mesh.vertices, clearance) is not None
        near = detector.with_rules(rules).with_clearance(clearance)
        assert near.detect(mesh.vertices).colliding == collides
        # The reported value is still the distance.
        least = near.least_distance(mesh.vertices, clearance)
        assert least is not None
        assert least.distance * detector.body_size == pytest.approx(0.04)


def test_groups_that_may_touch_are_too_near_where_they_penetrate() -> None:
    n = len(box([0, 0, 0], [1, 1, 1]).faces)
    one, other = np.arange(n), np.arange(n, 2 * n)
    for gap, expected in ((0.02, False), (0.0, False), (-0.01, True)):
        detector, mesh = blocks_apart(gap)
        clearance = 0.06 / detector.body_size
        touching = detector.with_touching([(one, other)])
        for rest_is_known in (True, False):
            near = touching.with_clearance(clearance, rest_is_known=rest_is_known)
            found = near.detect(mesh.vertices)
            assert found.colliding == expected
            assert near.are_colliding(mesh.vertices[None]).tolist() == [expected]
        if expected:
            deepest = found.penetration_depth.max() * detector.body_size
            assert deepest == pytest.approx(0.01)
        # Other groups keep the clearance, and those that may touch keep it from others.
        some = detector.with_touching([(one, one), (other[:1], one[:1])]).with_clearance(clearance)
        assert some.detect(mesh.vertices).colliding
        assert touching.with_rules(ContactRules(near_exclusion=1e-6)).may_touch


@pytest.mark.parametrize("clearance", [-1e-3, 1.0, float("nan"), float("inf")])
def test_a_clearance_out_of_range_is_refused(clearance: float) -> None:
    detector, mesh = blocks_apart(0.1)
    with pytest.raises(ShapeError, match="the clearance must be 0 or more and below 1 body size"):
        detector.with_clearance(clearance)
    with pytest.raises(ShapeError, match="the clearance must be"):
        detector.least_distance(mesh.vertices, clearance)


def test_two_faces_just_below_the_clearance_are_never_lost() -> None:
    """Boxes have less precision than distances."""
    rng = np.random.default_rng(2)
    for _ in range(200):
        clearance = 10.0 ** rng.uniform(-7, -1)
        place, size = rng.uniform(-0.4, 0.4, 3), 10.0 ** rng.uniform(-3, -1)
        triangle = place + np.array([[0, 0, 0], [size, 0, 0], [0, size, 0]])
        # A violation below the tolerance is not a collision.
        gap = np.array([0.0, 0.0, clearance - 3.0 * DEPTH_TOLERANCE])
        corner = np.array([[[-0.5] * 3, [-0.5, -0.5, -0.4], [-0.4, -0.5, -0.5]]])
        mesh = soup(np.concatenate([[triangle, triangle + gap], corner, corner + 0.9]))
        rest = mesh.vertices.copy()
        rest[3:6] += [0.0, 0.0, 0.3]
        detector = CollisionDetector(mesh.topology, rest)
        near = detector.with_clearance(clearance / detector.body_size)
        assert [0, 1] in near.detect(mesh.vertices).pairs.tolist()


def test_what_touches_at_rest_but_for_rounding_may_touch() -> None:
    """Two sheets lie on each other, like a skirt on a belt, nearer than float32 resolves."""
    sheet, gap = folded(0.0), np.array([0.0, 0.0, 1e-8])
    up = sheet.vertices + [0.0, 0.0, 1.0]
    sheets = join(Mesh(up, sheet.faces), Mesh(up + gap, sheet.faces))
    detector = CollisionDetector(sheets.topology, sheets.vertices)
    near = detector.with_clearance(0.001)
    exported = sheets.vertices.astype(np.float32)
    assert not near.detect(exported).colliding
    # Sheets that cross still count.
    crossing = exported.copy()
    crossing[: len(up), 2] += 0.1 * (exported[: len(up), 0] - 0.47)
    assert near.detect(crossing).colliding
