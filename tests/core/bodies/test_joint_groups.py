"""Faces around a joint, and the pairs that the joint exclusion leaves out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lcollision_core.bodies import LearnedBody, RigBody
from lcollision_core.bodies.rig_body import joint_groups
from lcollision_core.contact import CollisionDetector, ContactRules
from lcollision_core.files import Character, read_character
from tests.independent_check import faces_about_joints
from tests.rigged_shapes import rigged_body, rigged_tube, skinned, turned


def groups_of(character: Character) -> dict[str, set[int]]:
    return {group.name: set(group.faces.tolist()) for group in joint_groups(character)}


def main_joints(character: Character) -> np.ndarray:
    rig = character.rig
    assert rig is not None
    return rig.joint_of[np.arange(len(rig.joint_of)), rig.weights.argmax(axis=1)]


def by_the_text(character: Character) -> list[set[int]]:
    rig = character.rig
    assert rig is not None
    return faces_about_joints(
        character.rest_vertices,
        character.topology.faces.astype(np.int64),
        rig.parents.tolist(),
        rig.rest[:, :3, 3],
        main_joints(character).tolist(),
    )


@pytest.mark.parametrize("scale", [1.0, 170.0])
def test_the_faces_about_joints_are_those_of_the_text(scale: float) -> None:
    body = rigged_body(scale)
    found = sorted(map(sorted, groups_of(body).values()))
    assert found == sorted(map(sorted, by_the_text(body)))
    # The elbow's faces are those of the arm's tube, radius 0.045, within twice that radius.
    rig, elbow = body.rig, groups_of(body)["LeftForeArm"]
    assert rig is not None
    place = rig.rest[rig.joint_names.index("LeftForeArm"), :3, 3]
    middles = body.rest_vertices[body.topology.faces].mean(axis=1)
    away = np.linalg.norm(middles - place, axis=1)
    assert away[list(elbow)].max() <= 0.09 * scale
    arm = {f for g in body.groups if g.name == "LeftArm" for f in g.faces.tolist()}
    assert elbow == {f for f in arm if away[f] <= 2.0 * 0.045 * scale}


def test_of_real_characters_too(characters: Path) -> None:
    mannequin = read_character(characters / "mannequin-moves.glb")
    found = sorted(map(sorted, groups_of(mannequin).values()))
    assert found == sorted(map(sorted, by_the_text(mannequin)))


def test_without_links_there_are_none() -> None:
    assert joint_groups(replace(rigged_tube(), rig=None)) == ()
    assert joint_groups(rigged_tube(1)) == ()
    assert not RigBody.of(rigged_tube(1)).rules.joint_exclusion


def test_a_twist_joint_and_joints_that_move_nothing_count_as_one_limb() -> None:
    """The tube's middle third is a sibling of its end, or all are children of unused joints."""
    tube = rigged_tube(3)
    rig = tube.rig
    assert rig is not None
    plain = groups_of(tube)
    assert set(plain) == {"link 1", "link 2"}
    twist = replace(tube, rig=replace(rig, parents=np.array([-1, 0, 0])))
    # The end's group covers the whole limb, although the middle is a sibling twist joint.
    assert groups_of(twist)["link 2"] >= plain["link 2"]
    doubled = replace(
        rig,
        joint_names=(*(f"control {n}" for n in range(3)), *rig.joint_names),
        parents=np.array([-1, 0, 1, 0, 1, 2]),
        rest=np.concatenate([rig.rest, rig.rest]),
        nodes=np.arange(6),
        joint_of=rig.joint_of + 3,
    )
    assert groups_of(replace(tube, rig=doubled)) == plain


def bent(body: Character, **degrees: tuple[float, float, float]) -> np.ndarray:
    """Turn joints by Euler angles, in the character's axes."""
    rig = body.rig
    assert rig is not None
    turns = np.stack(
        [
            Rotation.from_euler("xyz", degrees.get(name, (0.0, 0.0, 0.0)), degrees=True).as_matrix()
            for name in rig.joint_names
        ]
    )
    return skinned(rig, turned(rig, turns))


def faces_of_part(body: RigBody, *names: str) -> np.ndarray:
    parts = body.groups_by_kind["body parts"]
    return np.concatenate([part.faces for part in parts if part.name in names])


def detectors(body: Character) -> tuple[CollisionDetector, CollisionDetector]:
    groups = joint_groups(body)
    strict = CollisionDetector(body.topology, body.rest_vertices, ContactRules(), groups)
    return strict, strict.with_rules(ContactRules(joint_exclusion=True), groups)


def test_a_crease_is_no_collision_and_a_limb_through_the_body_is() -> None:
    body = rigged_body()
    strict, ruled = detectors(body)
    elbow = bent(body, LeftForeArm=(0.0, 0.0, 105.0))
    pairs = strict.detect(elbow).pairs
    rig = body.rig
    assert rig is not None
    place = rig.rest[rig.joint_names.index("LeftForeArm"), :3, 3]
    away = np.linalg.norm(body.rest_vertices[body.topology.faces].mean(axis=1) - place, axis=1)
    # In a coarse, sharply folded tube, some of the overlap is beyond the arm's thickness.
    crease = (away[pairs] <= 2.0 * 0.045).all(axis=1)
    found = ruled.detect(elbow)
    assert 0 < crease.sum() == found.excluded.joint == found.excluded.total
    np.testing.assert_array_equal(found.pairs, pairs[~crease])
    # An arm turned into the trunk, and a leg through the other.
    for limb, pose in (
        ("LeftArm", bent(body, LeftArm=(0.0, 95.0, 0.0))),
        ("LeftUpLeg", bent(body, LeftUpLeg=(0.0, 35.0, 0.0))),
    ):
        found = ruled.detect(pose)
        (own,) = (group.faces for group in body.groups if group.name == limb)
        through = np.isin(found.pairs, own).sum(axis=1) == 1
        assert through.sum() > 20
    # With other rules again, the lists equal those of a new detector.
    again = ruled.with_rules(ContactRules())
    np.testing.assert_array_equal(again.detect(elbow).pairs, strict.detect(elbow).pairs)


def test_a_character_starts_with_the_rule_and_what_is_learned_from_it_keeps_it(
    tube_model: LearnedBody, tmp_path: Path
) -> None:
    model = RigBody.of(rigged_tube(3))
    assert model.rules.joint_exclusion
    assert model.has_joints
    assert model.detector.rules.joint_exclusion
    # Joint groups cannot be named in ignored pairs.
    named = {group.name for kind in model.groups_by_kind.values() for group in kind}
    assert "link 1" not in {g.name for g in model.groups_by_kind["meshes and materials"]}
    assert len(named) == sum(map(len, model.groups_by_kind.values()))
    card = replace(tube_model.card, rules=model.rules, groups=model.groups)
    tube_model.with_card(card).save(tmp_path / "m.safetensors")
    again = LearnedBody.load(tmp_path / "m.safetensors")
    assert again.rules == model.rules
    stored = [(g.name, g.faces.tolist(), g.about_joint) for g in again.groups]
    assert stored == [(g.name, g.faces.tolist(), g.about_joint) for g in model.groups]


def test_the_real_robot_s_shells_overlap_at_joints_and_the_mannequin_s_limbs_elsewhere(
    characters: Path,
) -> None:
    """In 31 frames of each clip: see docs/results.md."""
    for name, without, then in (("xbot", 28, 8), ("mannequin", 19, 19)):
        body = RigBody.of(read_character(characters / f"{name}-moves.glb"))
        poses = body.decode(body.known_poses)
        off = body.with_rules(replace(body.rules, joint_exclusion=False))
        assert len(poses) == 31
        assert off.detector.are_colliding(poses).sum() == without
        assert body.detector.are_colliding(poses).sum() == then
        # An arm turned down into the trunk, far from its shoulder, is still a collision.
        space, latent = body.space, np.zeros(body.latent_size)
        (arm,) = (k for k, n in enumerate(space.rig.joint_names) if n.endswith("LeftArm"))
        codes = np.flatnonzero(space.joint_of_code == arm)
        latent[next(code for code in codes if body.code_names[code] == "up")] = -1.6
        found = body.detector.detect(body.decode(latent))
        of_arm = np.isin(found.pairs, faces_of_part(body, "Left upper arm", "Left forearm"))
        assert (of_arm.sum(axis=1) == 1).sum() > 50
