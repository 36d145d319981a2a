"""Contact rules proposed from a character's own poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lcollision_core.bodies import RigBody, propose_rules, typical_poses
from lcollision_core.bodies.proposed_rules import places_of
from lcollision_core.contact import ContactRules
from lcollision_core.contact.kernels import TOUCHING
from lcollision_core.errors import CancelledError
from lcollision_core.files import Character
from lcollision_core.jobs import Job
from lcollision_core.meshes import FaceGroup, Topology
from lcollision_core.meshes.contact_rules import TOUCHING_RADIUS
from tests.rigged_shapes import head_in_torso, rigged_body, sunk_arm


def armoured(n_frames: int = 12) -> Character:
    """Return the body with a breastplate around its trunk, and bracers that penetrate its forearms.

    The breastplate is a quarter of the trunk's radius away from it, and moves with it.
    """
    body = rigged_body(n_frames=n_frames)
    rig = body.rig
    assert rig is not None
    faces, vertices, points = [body.topology.faces], [body.rest_vertices], [rig.points]
    joint_of, weights, groups = [rig.joint_of], [rig.weights], list(body.groups)
    for limb, name, grown, shift in (
        ("Hips", "breastplate", 1.25, 0.0),
        ("LeftArm", "left bracer", 1.0, 0.01),
        ("RightArm", "right bracer", 1.0, 0.01),
    ):
        (group,) = (group for group in body.groups if group.name == limb)
        own = np.unique(body.topology.faces[group.faces])
        axis = body.rest_vertices[own].mean(axis=0)
        along = int(np.ptp(body.rest_vertices[own], axis=0).argmax())
        plate = axis + grown * (body.rest_vertices[own] - axis)
        plate[:, along] = body.rest_vertices[own][:, along]
        plate[:, 1 if along == 0 else 0] += shift
        number = np.full(body.topology.n_vertices, -1)
        number[own] = np.arange(len(own)) + sum(map(len, vertices))
        n_faces = sum(map(len, faces))
        faces.append(number[body.topology.faces[group.faces]].astype(np.int32))
        groups.append(FaceGroup(name, np.arange(n_faces, n_faces + len(group.faces))))
        vertices.append(plate)
        points.append(np.repeat(plate[:, None], 3, axis=1))
        joint_of.append(rig.joint_of[own])
        weights.append(rig.weights[own])
    rest = np.concatenate(vertices)
    return replace(
        body,
        topology=Topology(np.concatenate(faces), len(rest)),
        rest_vertices=rest,
        joined=np.arange(len(rest)),
        groups=tuple(groups),
        rig=replace(
            rig,
            points=np.concatenate(points),
            joint_of=np.concatenate(joint_of),
            weights=np.concatenate(weights),
        ),
    )


def faces_of(body: RigBody, *names: str) -> np.ndarray:
    return np.concatenate([group.faces for group in body.groups if group.name in names])


def with_turned(body: RigBody, joint: str, axis: int, angle: float) -> np.ndarray:
    space = body.space
    latent = np.zeros(body.latent_size)
    number = space.rig.joint_names.index(joint)
    for code in np.flatnonzero(space.joint_of_code == number):
        if np.abs(space.axes[number][space.axis_of_code[code]]).argmax() == axis:
            latent[code] = angle
    assert latent.any()
    return latent


def test_plates_that_always_touch_are_left_out_and_an_arm_in_the_breastplate_is_not() -> None:
    body = RigBody.of(armoured())
    # As for a file whose rest pose does not show the contacts.
    body = body.with_rules(ContactRules(joint_exclusion=True))
    poses = typical_poses(body)
    proposed = propose_rules(body)
    assert proposed is not None
    assert proposed.rules.ignored == ()
    assert proposed.rules.touching_radius == TOUCHING_RADIUS
    assert proposed.n_colliding == len(poses)
    assert proposed.n_colliding_then < 0.5 * len(poses)
    other = body.with_rules(proposed.rules)
    assert other.detector.are_colliding(poses).sum() == proposed.n_colliding_then
    # Arms and their plates, on both sides alike; the list names them.
    arms = faces_of(body, "LeftArm", "RightArm", "left bracer", "right bracer")
    assert np.isin(np.array(proposed.new), arms).all()
    assert sum(proposed.places.values()) == len(proposed.new)
    middle = body.reference[body.faces].mean(axis=1)[np.array(proposed.new)][:, :, 0]
    assert (middle.max(axis=1) > 0.0).sum() == (middle.max(axis=1) < 0.0).sum()
    assert ("LeftArm", "left bracer") in proposed.places
    # An arm sinks deeper and deeper into the breastplate; some of it is at the shoulder.
    breastplate = faces_of(body, "breastplate")
    for angle in (-1.9, 1.9, -2.1, 2.1):
        found = other.detector.detect(other.decode(with_turned(other, "LeftArm", 1, angle)))
        assert (np.isin(found.pairs, breastplate).sum(axis=1) == 1).sum() > 10
        assert not np.isin(found.excluded_pairs[found.excluded_rule == TOUCHING], breastplate).any()
    # Once the rules apply, there is nothing more to propose.
    assert propose_rules(other) is None


def test_what_touches_on_one_side_is_left_out_on_the_other_too() -> None:
    """Only the left bracer penetrates; the right one is as far away as allowed."""
    character = armoured()
    rig = character.rig
    assert rig is not None
    right = np.unique(character.topology.faces[character.groups[-1].faces])
    moved = np.zeros_like(character.rest_vertices)
    moved[right] = [0.0, 0.15, 0.0]
    character = replace(
        character,
        rest_vertices=character.rest_vertices + moved,
        rig=replace(rig, points=rig.points + moved[:, None]),
    )
    body = RigBody.of(character).with_rules(ContactRules(joint_exclusion=True))
    proposed = propose_rules(body)
    assert proposed is not None
    sides = np.sign(body.reference[body.faces].mean(axis=1)[np.array(proposed.new)][:, 0, 0])
    assert set(sides.tolist()) == {-1.0, 1.0}


def test_a_place_within_one_body_part_and_mesh_has_the_name_of_the_part() -> None:
    character = armoured()
    arm, bracer = (
        int(group.faces[0])
        for group in character.groups
        if group.name in ("LeftArm", "left bracer")
    )
    (pair,) = places_of(RigBody.of(character), [(arm, bracer)])
    assert "left bracer" in pair
    (pair,) = places_of(RigBody.of(replace(character, groups=())), [(arm, bracer)])
    assert pair[0] == pair[1] == "Left upper arm"


@pytest.mark.parametrize("n_frames", [0, 12])
def test_pieces_that_stand_in_each_other_are_proposed_where_they_do(n_frames: int) -> None:
    body = RigBody.of(head_in_torso(n_frames)).with_rules(ContactRules())
    poses = typical_poses(body)
    # The frames of its clip, otherwise random poses.
    assert len(poses) == (n_frames or 40)
    assert len(np.unique(poses, axis=0)) == len(poses)
    proposed = propose_rules(body)
    assert proposed is not None
    assert proposed.n_poses == len(poses)
    assert proposed.n_colliding > 0.9 * len(poses) > 1.2 * proposed.n_colliding_then
    head, trunk = faces_of(body, "Head"), faces_of(body, "Hips", "Torso")
    for pair in proposed.new:
        assert np.isin(pair, np.concatenate([head, trunk])).all()
    assert all("Head" in pair for pair in proposed.places)


def test_a_place_that_all_frames_of_a_short_clip_share_is_proposed_by_the_own_rules() -> None:
    """It frees no frame, as other limbs cross alternately elsewhere."""
    body = RigBody.of(sunk_arm())
    assert body.rules.joint_exclusion
    assert body.rules.rest_exclusion > 0.0
    proposed = propose_rules(body)
    assert proposed is not None
    assert (proposed.n_poses, proposed.n_colliding) == (10, 10)
    assert proposed.n_colliding_then == 10
    assert ("Hips", "LeftArm") in proposed.places
    # Rules are only offered unasked if they free poses.
    assert propose_rules(body, unasked=True) is None


def test_nothing_is_proposed_where_most_poses_are_free() -> None:
    assert propose_rules(RigBody.of(rigged_body(n_frames=12))) is None
    # By a character's default rules, pairs that touch at rest do not count.
    assert propose_rules(RigBody.of(head_in_torso(12))) is None


def test_looking_for_proposals_can_be_cancelled() -> None:
    job = Job()
    job.cancel()
    with pytest.raises(CancelledError):
        propose_rules(RigBody.of(head_in_torso(12)).with_rules(ContactRules()), job=job)
