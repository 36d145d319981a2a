"""Contact rules, compared pair by pair with an independent implementation."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcollision_core.contact import (
    DEPTH_TOLERANCE,
    CollisionDetector,
    ContactRules,
    RuleCounts,
    SelfCollisions,
    exclusions,
)
from lcollision_core.errors import ShapeError
from lcollision_core.meshes import FaceGroup, Topology
from lcollision_core.meshes.face_groups import without_joints
from tests.core.brute_force import all_pairs
from tests.core.shapes import Mesh, grid, join, soup
from tests.independent_check import IndependentRules

RULES = ("near", "rest", "ignored", "tolerated", "joint", "touching", "shape")

FLOOR = [[0, 0, 0], [4, 0, 0], [0, 4, 0]]
BLADE = [[1, 1, -1], [1, 1, 1], [2, 1, 1]]
CROSSING = soup([FLOOR, BLADE])
"""Faces 0 and 1 collide with depth 1; the body size is 4."""


def check_by_the_text(
    rest: Mesh, pose: np.ndarray, rules: ContactRules, groups: tuple[FaceGroup, ...] = ()
) -> SelfCollisions:
    """Compare every mode of a detector with rules applied pair by pair."""
    detector = CollisionDetector(rest.topology, rest.vertices, rules, groups)
    size = detector.body_size
    colliding = all_pairs(pose, rest.faces, DEPTH_TOLERANCE * size)
    at_rest = all_pairs(rest.vertices, rest.faces, DEPTH_TOLERANCE * size).pairs
    named: dict[str, set[int]] = {}
    for group in without_joints(groups):
        named.setdefault(group.name, set()).update(group.faces.tolist())
    depth_of = dict(zip(map(tuple, colliding.pairs.tolist()), colliding.depth, strict=True))
    touching = map(tuple, at_rest.tolist())
    joints = [set(group.faces.tolist()) for group in groups if group.about_joint]
    applied = IndependentRules(rest.vertices, rest.faces, touching, rules.to_json(), named, joints)
    excluded = applied.excluding(depth_of)

    found = detector.detect(pose)
    assert list(map(tuple, found.pairs.tolist())) == [p for p in depth_of if p not in excluded]
    reported = zip(map(tuple, found.excluded_pairs.tolist()), found.excluded_rule, strict=True)
    assert {pair: RULES[rule - 1] for pair, rule in reported} == excluded
    expected = RuleCounts(**Counter(excluded.values()))
    assert found.excluded == expected
    batch = detector.detect_batch(pose[None], workers=1)
    assert RuleCounts(*batch.n_excluded[0].tolist()) == expected
    assert batch.n_pairs.tolist() == [len(found.pairs)]
    assert np.array_equal(batch.vertex_energy[0], found.vertex_energy)
    summary = detector.summarise(pose)
    assert (summary.n_pairs, summary.excluded) == (len(found.pairs), expected)
    assert detector.are_colliding(pose[None], workers=1).tolist() == [found.colliding]
    return found


@st.composite
def ruled_meshes(draw: st.DrawFn) -> tuple[Mesh, np.ndarray, ContactRules, tuple[FaceGroup, ...]]:
    """Return a crumpled sheet with loose faces, a pose of it, and some rules."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    sheet, loose = grid(4), soup(rng.uniform(size=(8, 3, 3)))
    mesh = join(sheet, loose)
    rest = Mesh(mesh.vertices + rng.normal(scale=0.06, size=mesh.vertices.shape), mesh.faces)
    pose = rest.vertices + rng.normal(scale=0.25, size=rest.vertices.shape)
    groups = tuple(
        FaceGroup(name, np.flatnonzero(rng.uniform(size=len(mesh.faces)) < 0.4), about_joint)
        for name, about_joint in (*((n, False) for n in "abcb"), *((n, True) for n in "abb"))
    )
    names = st.sampled_from(["a", "b", "c"])
    rules = ContactRules(
        near_exclusion=draw(st.sampled_from([0.0, 0.1, 0.31])),
        rest_exclusion=draw(st.sampled_from([None, 0.0, 0.03, 0.31])),
        ignored=tuple(draw(st.lists(st.tuples(names, names), max_size=2))),
        left_out=tuple(draw(st.lists(names, max_size=1))),
        tolerated_depth=draw(st.sampled_from([0.0, 0.02])),
        joint_exclusion=draw(st.booleans()),
        touching=tuple(map(tuple, rng.integers(len(mesh.faces), size=(3, 2)).tolist())),
        touching_radius=draw(st.sampled_from([0.0, 0.05, 0.31])),
        shape_touching=tuple(map(tuple, rng.integers(len(mesh.faces), size=(3, 2)).tolist())),
        tolerated_pairs=tuple(
            draw(st.lists(st.tuples(names, names, st.sampled_from([0.0, 0.03, 0.1])), max_size=3))
        ),
    )
    return rest, pose, rules, groups


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(ruled_meshes())
def test_random_meshes_and_rules_agree_with_the_text(
    case: tuple[Mesh, np.ndarray, ContactRules, tuple[FaceGroup, ...]],
) -> None:
    check_by_the_text(*case)


def test_each_rule_is_the_first_for_some_pair() -> None:
    """Otherwise the random comparison could pass on meshes to which no rule applies."""
    rng = np.random.default_rng(3)
    mesh = join(grid(6), soup(rng.uniform(size=(20, 3, 3))))
    rest = Mesh(mesh.vertices + rng.normal(scale=0.05, size=mesh.vertices.shape), mesh.faces)
    pose = rest.vertices + rng.normal(scale=0.1, size=rest.vertices.shape)
    even = FaceGroup("even", np.arange(0, len(mesh.faces), 2))
    elbow = FaceGroup("elbow", np.arange(10, len(mesh.faces), 3), about_joint=True)
    touching = ((88, 51), (81, 32), (45, 30))
    rules = ContactRules(
        0.2,
        0.05,
        (("even", "even"),),
        0.01,
        True,
        touching,
        0.3,
        shape_touching=((29, 88),),
    )
    found = check_by_the_text(rest, pose, rules, (even, elbow))
    assert found.colliding
    assert min(found.excluded.to_json().values()) > 0
    without = CollisionDetector(rest.topology, rest.vertices).detect(pose)
    assert len(without.pairs) == len(found.pairs) + found.excluded.total


def test_what_is_left_out_takes_part_in_no_pair() -> None:
    groups = (FaceGroup("floor", np.array([0])), FaceGroup("blade", np.array([1])))
    for name in ("floor", "blade"):
        rules = ContactRules(left_out=(name,))
        found = check_by_the_text(CROSSING, CROSSING.vertices, rules, groups)
        assert not found.colliding
        assert found.excluded == RuleCounts(ignored=1)
        said = rules.sentence(found.excluded)
        assert said == f"without {name}, 1 pair of parts left out is not counted"
        assert rules.sentence(RuleCounts()) == rules.summary() == f"without {name}"
    with pytest.raises(ShapeError, match="the group 'hilt' is unknown, expected 'floor', 'blade'"):
        check_by_the_text(CROSSING, CROSSING.vertices, ContactRules(left_out=("hilt",)), groups)


def test_face_0_is_excluded_like_any_other() -> None:
    rest = check_by_the_text(CROSSING, CROSSING.vertices, ContactRules(rest_exclusion=0.0))
    assert rest.excluded == RuleCounts(rest=1)
    groups = (FaceGroup("floor", np.array([0])), FaceGroup("blade", np.array([1])))
    for ignored in (("floor", "blade"), ("blade", "floor")):
        found = check_by_the_text(
            CROSSING, CROSSING.vertices, ContactRules(ignored=(ignored,)), groups
        )
        assert found.excluded == RuleCounts(ignored=1)
    strangers = ContactRules(ignored=(("floor", "floor"), ("blade", "blade")))
    assert check_by_the_text(CROSSING, CROSSING.vertices, strangers, groups).colliding


def test_a_pose_whose_rest_is_apart_is_not_excluded() -> None:
    apart = soup([FLOOR, np.add(BLADE, [0.0, 0.0, 3.0])])
    found = check_by_the_text(apart, CROSSING.vertices, ContactRules(rest_exclusion=0.5))
    assert found.colliding
    assert found.excluded == RuleCounts()


def test_faces_that_lie_on_each_other_at_rest_touch() -> None:
    """Cloth on skin has depth 0 at rest, and penetrates after the slightest movement."""
    rest = soup([FLOOR, [[0.5, 0.5, 0], [1.5, 0.5, 0], [0.5, 1.5, 0]]])
    through = rest.vertices + np.array([[0.0] * 3] * 3 + [[0, 0, -0.1], [0, 0, 0.1], [0, 0, 0.1]])
    strict = CollisionDetector(rest.topology, rest.vertices)
    assert not strict.detect(rest.vertices).colliding
    assert strict.detect(through).colliding
    rules = ContactRules(rest_exclusion=0.0)
    ruled = CollisionDetector(rest.topology, rest.vertices, rules)
    assert ruled.detect(through).excluded == RuleCounts(rest=1)
    assert ruled.summarise(rest.vertices).n_coincident_pairs == 1


def test_touching_at_rest_is_that_of_the_rest_pose_as_it_is_drawn_too() -> None:
    """Corners that end exactly on a face collide after rounding to float32."""
    tilted = np.array([[0.0, 0.0, 0.1], [0.7, 0.0, 0.23], [0.0, 0.9, 0.57]])
    on_it = tilted.T @ np.array([0.2, 0.3, 0.5])
    for shift in np.linspace(0.0, 1.0, 40):
        rest = soup(
            [tilted + shift, np.array([on_it, on_it + [0, 0, 1], on_it + [0, 1, 1]]) + shift]
        )
        detector = CollisionDetector(rest.topology, rest.vertices, ContactRules(rest_exclusion=0.0))
        assert not detector.detect(rest.vertices.astype(np.float32)).colliding


def test_the_tolerated_depth_is_a_limit_that_does_not_count() -> None:
    depth = float(
        CollisionDetector(CROSSING.topology, CROSSING.vertices)
        .detect(CROSSING.vertices)
        .penetration_depth[0]
    )
    for tolerated, is_free in ((np.nextafter(depth, 0.0), False), (np.nextafter(depth, 1.0), True)):
        rules = ContactRules(tolerated_depth=tolerated)
        found = CollisionDetector(CROSSING.topology, CROSSING.vertices, rules).detect(
            CROSSING.vertices
        )
        assert found.colliding != is_free
        assert found.energy == (0.0 if is_free else pytest.approx(depth**2))


def test_a_pair_of_groups_has_a_tolerated_depth_of_its_own() -> None:
    """A belly may yield and a hand may not; compared with all pairs."""
    rng = np.random.default_rng(8)
    parts = [soup(rng.uniform(size=(30, 3, 3))) for _ in range(3)]
    mesh = join(*parts)
    names = ("belly", "thigh", "hand")
    groups = tuple(FaceGroup(name, np.arange(30 * k, 30 * k + 30)) for k, name in enumerate(names))
    own = (("belly", "thigh", 0.1), ("hand", "belly", 0.0), ("hand", "hand", 0.2))
    rules = ContactRules(tolerated_depth=0.03, tolerated_pairs=own)
    found = check_by_the_text(mesh, mesh.vertices, rules, groups)
    limits = {frozenset(pair): depth for *pair, depth in own}
    size = CollisionDetector(mesh.topology, mesh.vertices).body_size
    deep = all_pairs(mesh.vertices, mesh.faces, DEPTH_TOLERANCE * size)
    expected, seen = [], set()
    for pair, depth in zip(deep.pairs.tolist(), deep.depth / size, strict=True):
        key = frozenset(names[face // 30] for face in pair)
        if depth > limits.get(key, 0.03):
            expected.append(pair)
            seen.add(key)
    assert found.pairs.tolist() == expected
    assert len(seen) == 6
    detector = CollisionDetector(mesh.topology, mesh.vertices, rules, groups)
    asked = np.array([[0, 31], [31, 0], [65, 3], [60, 70], [0, 1]])
    np.testing.assert_allclose(detector.tolerated_depths(asked), [0.1, 0.1, 0.0, 0.2, 0.03])
    # If several apply, the smallest counts.
    both = ContactRules(tolerated_pairs=(*own, ("belly", "thigh", 0.02), ("thigh", "belly", 0.3)))
    least = CollisionDetector(mesh.topology, mesh.vertices, both, groups)
    np.testing.assert_allclose(least.tolerated_depths(asked[:1]), 0.02)
    said = rules.sentence(found.excluded)
    assert "not deeper than 0.03 or 0.1 between belly and thigh or 0 between hand and belly" in said
    assert said.endswith(" or 0.2 within hand are not counted")


def test_rules_hold_in_any_unit() -> None:
    rng = np.random.default_rng(5)
    mesh = join(grid(4), soup(rng.uniform(size=(8, 3, 3))))
    pose = mesh.vertices + rng.normal(scale=0.2, size=mesh.vertices.shape)
    rules = ContactRules(0.31, 0.27, (), 0.013)
    here = CollisionDetector(mesh.topology, mesh.vertices, rules).detect(pose)
    there = CollisionDetector(mesh.topology, 1000.0 * mesh.vertices, rules).detect(1000.0 * pose)
    assert here.excluded == there.excluded
    assert min(here.excluded.near, here.excluded.rest, here.excluded.tolerated) > 0


def test_an_unknown_group_is_named_with_those_that_there_are() -> None:
    rules = ContactRules(ignored=(("floor", "Hair"),))
    floor = FaceGroup("floor", np.array([0]))
    with pytest.raises(ShapeError, match="the group 'Hair' is unknown, expected 'floor'"):
        CollisionDetector(CROSSING.topology, CROSSING.vertices, rules, (floor,))
    with pytest.raises(ShapeError, match="expected none: the mesh has no groups"):
        CollisionDetector(CROSSING.topology, CROSSING.vertices, rules)


def test_more_touching_pairs_than_memory_holds_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rules = ContactRules(rest_exclusion=0.0)
    blades = soup([FLOOR, *(np.add(BLADE, [0.01 * n, 0, 0]) for n in range(5))])
    detector = CollisionDetector(blades.topology, blades.vertices, rules)
    n_touching = detector.detect(blades.vertices).excluded.rest
    monkeypatch.setattr(exclusions, "MAX_EXCLUDED", n_touching - 1)
    with pytest.raises(ShapeError, match="the rest exclusion excludes more than"):
        CollisionDetector(blades.topology, blades.vertices, rules)


def test_strict_rules_are_the_default() -> None:
    topology = Topology(CROSSING.faces, 6)
    strict = CollisionDetector(topology, CROSSING.vertices)
    assert strict.rules == ContactRules()
    assert strict.detect(CROSSING.vertices).pairs.tolist() == [[0, 1]]
