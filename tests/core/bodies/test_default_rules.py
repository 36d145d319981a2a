"""The default contact rules of characters."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lcollision_core.bodies.rig_body import default_rules, joint_groups
from lcollision_core.contact import CollisionDetector, ContactRules
from lcollision_core.contact.exclusions import near_pairs_estimate
from lcollision_core.files import Character, read_character
from tests.core.brute_force import all_pairs
from tests.core.shapes import grid
from tests.independent_check import IndependentRules, crossing_pairs
from tests.rigged_shapes import rigged_body, rigged_tube, skinned, turned


def detector_of(character: Character, rules: ContactRules) -> CollisionDetector:
    return CollisionDetector(character.topology, character.rest_vertices, rules)


def touching_body() -> Character:
    """Return a body whose forearms cross at rest."""
    body = rigged_body()
    vertices = body.rest_vertices.copy()
    left = vertices[:, 0] > 0.5
    vertices[left] -= [1.2, 0.0, 0.01]
    return replace(body, rest_vertices=vertices)


def test_a_character_that_touches_itself_is_free_at_rest() -> None:
    body = touching_body()
    rest = body.rest_vertices
    touching = all_pairs(rest, body.topology.faces, 1e-9).pairs
    assert len(touching) > 0
    rules = default_rules(body)
    found = detector_of(body, rules).detect(rest)
    assert not found.colliding
    assert found.excluded.total == len(touching)
    assert rules.ignored == ()
    assert rules.tolerated_depth == 0.0


def test_only_a_rig_has_folds() -> None:
    tube = rigged_tube()
    assert default_rules(tube) == ContactRules(0.1, rest_exclusion=0.02)
    with_joints = default_rules(tube, joint_groups(tube))
    assert with_joints == ContactRules(0.1, 0.02, joint_exclusion=True, near_by_limb=True)
    # Every verdict states it.
    said = "1 pair within 0.1 along the surface, less at thin limbs is not counted"
    assert with_joints.sentence({"near": 1}) == said
    assert default_rules(replace(tube, rig=None)) == ContactRules(rest_exclusion=0.02)


def test_what_is_listed_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    body = touching_body()
    # The package exports a function with the module's name.
    module = sys.modules["lcollision_core.bodies.rig_body"]
    rest, size = body.rest_vertices, detector_of(body, ContactRules()).body_size
    fitting = near_pairs_estimate(body.topology, rest, 0.05 * size)
    monkeypatch.setattr(module, "MOST_NEAR_PAIRS", fitting)
    assert default_rules(body).near_exclusion == 0.05
    monkeypatch.setattr(module, "MOST_NEAR_PAIRS", 0)
    monkeypatch.setattr(module, "_MOST_TOUCHING", 0)
    assert default_rules(body) == ContactRules(rest_exclusion=0.0)


def test_the_estimate_is_close() -> None:
    mesh = grid(40)
    rng = np.random.default_rng(2)
    bent = mesh.vertices + rng.normal(scale=0.003, size=mesh.vertices.shape)
    detector = CollisionDetector(mesh.topology, bent, ContactRules(0.2))
    listed = len(detector._exclusions.near.entry)
    estimate = near_pairs_estimate(mesh.topology, bent, 0.2 * detector.body_size)
    assert estimate == pytest.approx(listed, rel=0.35)


@pytest.mark.parametrize("name", ["mannequin", "xbot"])
def test_real_characters_are_free_at_rest_by_an_independent_reading(
    name: str, characters: Path
) -> None:
    character = read_character(characters / f"{name}-moves.glb")
    rest, faces = character.rest_vertices, character.topology.faces.astype(np.int64)
    crossing = sorted(crossing_pairs(rest, faces))
    rules = default_rules(character)
    found = detector_of(character, rules).detect(rest.astype(np.float32))
    assert not found.colliding
    assert found.excluded.total > 0.9 * len(crossing)
    some = crossing[:: max(1, len(crossing) // 50)]
    applied = IndependentRules(rest, faces, some, rules.to_json(), groups={})
    assert set(applied.excluding(dict.fromkeys(some, 1.0))) == set(some)


def test_a_thin_limb_that_rolls_up_meets_itself() -> None:
    """All of it is near along the surface, but its ends are not a joint's crease."""
    tube = rigged_tube(7)
    groups = joint_groups(tube)
    limbs = replace(default_rules(tube, groups), near_exclusion=0.9)
    rig, rest = tube.rig, tube.rest_vertices
    assert rig is not None
    angles = [0, 1.1, 1.1, 1.1, 1.1, 1.1, 1.1]
    posed = skinned(
        rig, turned(rig, Rotation.from_rotvec(np.outer(angles, [1.0, 0.0, 0.0])).as_matrix())
    )
    strict, plain, by_limb = (
        CollisionDetector(tube.topology, rest, rules, groups).detect(posed)
        for rules in (ContactRules(), replace(limbs, near_by_limb=False), limbs)
    )
    assert plain.excluded.near == len(strict.pairs) > 0
    assert by_limb.colliding
