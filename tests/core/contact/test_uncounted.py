"""A search skips exactly the pairs that are known never to count."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.contact import CollisionDetector, ContactRules
from lcollision_core.contact import search as uncounted_module
from lcollision_core.contact.kernels import COUNTED, LEAF_SIZE
from lcollision_core.contact.search import NO_TABLES, make_uncounted
from lcollision_core.meshes import FaceGroup
from tests.core.shapes import Mesh, grid, join, soup, sphere

RULES = {
    "near": ContactRules(near_exclusion=0.2),
    "rest": ContactRules(rest_exclusion=0.5),
    "ignored": ContactRules(ignored=(("ball", "sheet"), ("sheet", "sheet"))),
    "joints": ContactRules(joint_exclusion=True),
    "touching": ContactRules(touching=((0, 30), (7, 240)), touching_radius=0.5),
    "all": ContactRules(
        0.1,
        0.05,
        (("ball", "ball"),),
        0.02,
        joint_exclusion=True,
        touching=((7, 240),),
        touching_radius=0.1,
        tolerated_pairs=(("ball", "sheet", 0.05),),
    ),
}


def _bodies(rules: ContactRules) -> tuple[CollisionDetector, np.ndarray]:
    """Return the detector of a sheet, a ball in it and loose faces, and poses of them."""
    rng = np.random.default_rng(5)
    ball = sphere(0.3, 8).moved([0.5, 0.5, 0.1])
    mesh = join(grid(11), ball, soup(0.2 * rng.uniform(size=(20, 3, 3))))
    rest = Mesh(mesh.vertices + rng.normal(scale=0.02, size=mesh.vertices.shape), mesh.faces)
    n_sheet = len(grid(11).faces)
    groups = (
        FaceGroup("sheet", np.arange(n_sheet)),
        FaceGroup("ball", np.arange(n_sheet, n_sheet + len(ball.faces))),
        FaceGroup("elbow", np.arange(10, 90), about_joint=True),
        FaceGroup("wrist", np.arange(70, n_sheet + 40), about_joint=True),
    )
    noise = rng.normal(scale=0.08, size=(12, *rest.vertices.shape))
    return CollisionDetector(rest.topology, rest.vertices, rules, groups), rest.vertices + noise


@pytest.mark.parametrize("rules", RULES.values(), ids=RULES)
def test_a_search_that_skips_finds_the_same_pairs(rules: ContactRules) -> None:
    detector, poses = _bodies(rules)
    assert detector._uncounted.nodes(wait=True).bits.any()
    n_pairs = 0
    for pose in poses:
        whole, counted = detector.detect(pose), detector.detect(pose, counted_only=True)
        n_pairs += len(whole.pairs)
        assert np.array_equal(counted.pairs, whole.pairs)
        assert np.array_equal(counted.penetration_depth, whole.penetration_depth)
        assert np.allclose(counted.vertex_energy, whole.vertex_energy, rtol=1e-12, atol=0.0)
        assert counted.excluded.total == 0 < whole.excluded.total
    assert n_pairs > 0
    batch, counted = detector.detect_batch(poses), detector.detect_batch(poses, counted_only=True)
    assert np.array_equal(counted.n_pairs, batch.n_pairs)
    assert np.array_equal(counted.vertex_energy, batch.vertex_energy)
    assert counted.n_excluded.sum() == 0 < batch.n_excluded.sum()
    # In one plane, nothing penetrates.
    asked = np.concatenate([poses[:2], poses[:1] * [1.0, 1.0, 0.0]])
    verdicts = [len(detector.detect(pose).pairs) > 0 for pose in asked]
    assert any(verdicts)
    assert not verdicts[-1]
    assert detector.are_colliding(asked).tolist() == verdicts


@pytest.mark.parametrize("rules", RULES.values(), ids=RULES)
def test_exactly_the_nodes_without_a_pair_that_can_count_are_skipped(rules: ContactRules) -> None:
    detector, _ = _bodies(rules)
    tree, made = detector._tree, detector._uncounted.nodes(wait=True)
    faces = detector.topology.faces
    n = len(faces)
    all_pairs = np.stack(np.divmod(np.arange(n * n), n), axis=1)
    apart = (faces[all_pairs[:, 0], :, None] != faces[all_pairs[:, 1], None, :]).all(axis=(1, 2))
    counts = detector.rules_of(all_pairs, np.ones(n * n)) == COUNTED
    can_count = (apart & counts & (all_pairs[:, 0] != all_pairs[:, 1])).reshape(n, n)

    below: list[set[int]] = [set() for _ in tree.left]
    for node in reversed(range(len(tree.left))):
        leaf = tree.leaf[node]
        slots = tree.slot_face[leaf * LEAF_SIZE : (leaf + 1) * LEAF_SIZE]
        below[node] = (
            set(slots[slots >= 0].tolist())
            if leaf >= 0
            else below[tree.left[node]] | below[tree.right[node]]
        )
    n_skipped = 0
    for a, faces_a in enumerate(below):
        for b, faces_b in enumerate(below):
            if made.level[a] == made.level[b]:
                row = made.start[made.level[a]] + made.number[a] * made.stride[made.level[a]]
                column = made.number[b]
                skipped = bool(made.bits[row + column // 8] >> column % 8 & 1)
                assert skipped == (not can_count[np.ix_(list(faces_a), list(faces_b))].any())
                n_skipped += skipped
    assert n_skipped > 0


def test_without_rules_of_places_nothing_is_made() -> None:
    own = ContactRules(tolerated_pairs=(("ball", "sheet", 0.1),))
    for rules in (ContactRules(), ContactRules(tolerated_depth=0.1), own):
        detector, poses = _bodies(rules)
        detector.detect(poses[0], counted_only=True)
        assert detector._uncounted.nodes(wait=True) is NO_TABLES


def test_no_more_memory_is_taken_than_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uncounted_module, "MOST_BYTES", 10)
    detector, poses = _bodies(RULES["all"])
    assert detector._uncounted.nodes(wait=True) is NO_TABLES
    pairs = detector.detect(poses[0], counted_only=True).pairs
    assert np.array_equal(pairs, detector.detect(poses[0]).pairs)


def test_other_rules_have_other_tables() -> None:
    detector, poses = _bodies(RULES["ignored"])
    detector._uncounted.nodes(wait=True)
    other = detector.with_rules(ContactRules(ignored=(("ball", "ball"),)), detector.groups)
    other._uncounted.nodes(wait=True)
    found = other.detect(poses[0], counted_only=True)
    assert np.array_equal(found.pairs, other.detect(poses[0]).pairs)
    assert not np.array_equal(found.pairs, detector.detect(poses[0]).pairs)


def test_making_tables_ends_with_the_program() -> None:
    detector, _ = _bodies(RULES["near"])
    assert make_uncounted(detector._tree, detector._exclusions, lambda: False) is None
