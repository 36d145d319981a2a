"""Drags of bodies with limbs: the parts that move, follow and stay."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody, RigBody, open_body
from lcollision_core.bodies.rig_space import RigPoseSpace
from lcollision_core.meshes import Topology
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing import DragOptions, DragStep, Grip, Pin, far_end, frame_round, make_grip
from tests.rigged_shapes import rigged_body

PLAIN = DragOptions(solid=False)
UP = np.eye(3)[2]


@pytest.fixture(scope="module")
def body() -> RigBody:
    return RigBody.of(rigged_body())


def dragged(
    model: RigBody | LearnedBody,
    grip: Grip,
    way: FloatArray,
    pins: tuple[Pin, ...] = (),
    options: DragOptions = PLAIN,
    start: FloatArray | None = None,
    n_events: int = 30,
) -> DragStep:
    """Drag a patch slowly by a normalised vector, and let it settle."""
    dragger = model.dragger()
    step = dragger.begin(
        np.zeros(model.latent_size) if start is None else start, grip, pins, options
    )
    begin = grip.position(step.vertices)
    for share in np.linspace(0.0, 1.0, n_events)[1:]:
        step = dragger.move(begin + share * way * model.body_size)
    for _ in range(60):
        if step.settled:
            break
        step = dragger.move(begin + way * model.body_size)
    return step


def grip_on(model: RigBody, joint: str, radius: float = 0.03) -> Grip:
    """Return the patch around the vertex of a joint that is nearest to it."""
    space = model.space
    names = [name.split(":")[-1] for name in space.rig.joint_names]
    heaviest = space.rig.joint_of[np.arange(model.n_vertices), space.rig.weights.argmax(axis=1)]
    led = np.flatnonzero(heaviest == names.index(joint))
    away = np.linalg.norm(space.rest_vertices[led] - space.origins[names.index(joint)], axis=1)
    return make_grip(space, int(led[away.argmin()]), radius)


def moved_joints(model: RigBody, latent: FloatArray) -> set[str]:
    """Return the joints turned relative to their parents by more than a tenth of a degree."""
    turned = model.space.joint_of_code[6:][np.abs(latent[6:]) > np.radians(0.1)]
    return {model.space.rig.joint_names[joint].split(":")[-1] for joint in turned}


def test_what_hangs_on_the_hips_follows_them_and_feet_stay(body: RigBody) -> None:
    step = dragged(body, grip_on(body, "Hips"), -0.12 * UP)
    assert step.miss < 0.005
    assert moved_joints(body, step.latent) <= {
        f"{side}{name}" for side in ("Left", "Right") for name in ("UpLeg", "Leg", "Foot")
    }
    away = (step.vertices - body.reference) / body.body_size
    for name, foot in enumerate(body.domain_names):
        if "foot" in foot.lower():
            inside = body.space.vertex_domain == name
            assert np.linalg.norm(away[inside], axis=1).mean() < 0.005
    hand = body.space.vertex_domain == body.domain_names.index("Left hand")
    np.testing.assert_allclose(away[hand].mean(axis=0), [0.0, 0.0, -0.12], atol=0.01)
    assert len(step.standing) == 6
    without = dragged(
        body, grip_on(body, "Hips"), -0.12 * UP, options=DragOptions(False, standing=False)
    )
    assert moved_joints(body, without.latent) == set()
    assert len(without.standing) == 0


def test_a_hand_moves_its_arm_then_the_trunk_and_no_other_limb(body: RigBody) -> None:
    grip = grip_on(body, "RightHand")
    arm = {"RightArm", "RightForeArm", "RightHand"}
    pins = tuple(
        Pin.of(make_grip(body.space, far_end(body.space, domain)), body.reference)
        for domain, name in enumerate(body.domain_names)
        if "foot" in name.lower()
    )
    near = dragged(body, grip, np.array([0.1, -0.1, 0.1]), pins)
    assert near.miss < 0.005
    assert moved_joints(body, near.latent) <= arm
    assert not near.latent[:6].any()
    far = dragged(body, grip, np.array([-0.3, -0.3, 0.1]), pins)
    assert "Spine" in moved_joints(body, far.latent) <= arm | {"Spine", "Neck"}
    assert not far.latent[:6].any()
    helped = dragged(
        body, grip, np.array([-0.3, -0.3, 0.1]), pins, DragOptions(False, whole_body=True)
    )
    assert helped.miss < far.miss
    assert helped.latent[:6].any()


def test_who_holds_what_carries_the_legs_holds_the_root() -> None:
    """In rigs whose trunk and pelvis are children of a separate root."""
    character = rigged_body()
    rig = character.rig
    assert rig is not None
    names = list(rig.joint_names)
    root, spine = names.index("Hips"), names.index("Spine")
    # A root at the hips, the parent of the pelvis and the spine.
    parents = np.concatenate([[-1], rig.parents + 1])
    parents[1 + root], parents[1 + spine] = 0, 0
    below = replace(
        rig,
        joint_names=("Groove", *rig.joint_names),
        parents=parents,
        rest=np.concatenate([rig.rest[root][None], rig.rest]),
        nodes=np.arange(len(parents)),
        joint_of=rig.joint_of + 1,
    )
    model = RigBody.of(replace(character, rig=below))
    step = dragged(model, grip_on(model, "Hips"), -0.12 * UP)
    assert step.miss < 0.005
    assert "Hips" not in moved_joints(model, step.latent)
    assert step.latent[:3].any()


def test_a_pinned_foot_keeps_its_orientation(body: RigBody) -> None:
    space = body.space
    (foot,) = (k for k, name in enumerate(body.domain_names) if name == "Left foot")
    grip = make_grip(space, far_end(space, foot))
    inside = space.vertex_domain == foot
    options = DragOptions(False, standing=False)
    drifts = {}
    for frame in ((), tuple(frame_round(space, grip.vertex))):
        pin = Pin.of(grip, body.reference, frame)
        step = dragged(body, grip_on(body, "Hips"), np.array([0.0, 0.1, -0.1]), (pin,), options)
        away = np.linalg.norm(step.vertices[inside] - body.reference[inside], axis=1)
        drifts[len(frame)] = float(away.max()) / body.body_size
    assert drifts[2] < 0.01 < drifts[0]


@pytest.mark.parametrize("n_events", [30, 120])
def test_an_arm_with_a_pinned_hand_bends_and_the_trunk_stays(body: RigBody, n_events: int) -> None:
    space = body.space
    hand = make_grip(space, far_end(space, body.domain_names.index("Left hand")))
    bent = dragged(body, hand, np.array([-0.15, -0.2, -0.05])).latent
    pin = Pin.of(hand, body.decode(bent))
    # The elbow swings about the line from shoulder to hand.
    way, grip = np.array([0.0, -0.03, -0.05]), grip_on(body, "LeftForeArm")
    step = dragged(body, grip, way, (pin,), start=bent, n_events=n_events)
    assert step.miss < 0.1 * np.linalg.norm(way)
    moved = hand.position(step.vertices) - hand.position(body.decode(bent))
    assert np.linalg.norm(moved) < 0.001 * body.body_size
    assert moved_joints(body, step.latent - bent) == {"LeftArm", "LeftForeArm", "LeftHand"}


def test_an_arm_in_a_tight_sleeve_shows_what_keeps_it(body: RigBody) -> None:
    """A sleeve of the trunk: contacts on all sides, none of which the pose has reached."""
    character, rig = body.character, body.space.rig
    (arm,) = (group for group in character.groups if group.name == "LeftArm")
    own = np.unique(body.faces[arm.faces])
    middle = character.rest_vertices[own].mean(axis=0)
    sleeve = middle + 1.03 * (character.rest_vertices[own] - middle)
    number = np.full(body.n_vertices, -1)
    number[own] = body.n_vertices + np.arange(len(own))
    faces = np.concatenate([body.faces, number[body.faces[arm.faces]].astype(np.int32)])
    rest = np.concatenate([character.rest_vertices, sleeve])
    of_trunk = np.zeros_like(rig.weights[own])
    of_trunk[:, 0] = 1.0
    dressed = RigBody.of(
        replace(
            character,
            topology=Topology(faces, len(rest)),
            rest_vertices=rest,
            joined=np.arange(len(rest)),
            rig=replace(
                rig,
                points=np.concatenate([rig.points, np.repeat(sleeve[:, None], 3, axis=1)]),
                joint_of=np.concatenate([rig.joint_of, np.zeros_like(rig.joint_of[own])]),
                weights=np.concatenate([rig.weights, of_trunk]),
            ),
        )
    )
    dragger, grip = dressed.dragger(), grip_on(dressed, "LeftForeArm")
    step = dragger.begin(np.zeros(dressed.latent_size), grip, (), DragOptions(standing=False))
    assert not len(step.contacts)
    target = grip.position(step.vertices) + [0.0, -0.1 * dressed.body_size, 0.0]
    for _ in range(3):
        step = dragger.move(target)
    assert step.exactly_free
    assert not step.latent.any()
    assert len(step.contacts)


def test_a_smaller_patch_takes_a_finger(characters: Path) -> None:
    model = open_body(str(characters / "mannequin-moves.glb"))
    assert isinstance(model, RigBody)
    space: RigPoseSpace = model.space
    start = model.known_poses[0].astype(np.float64)
    tip = grip_on(model, "RightHandIndex3").vertex
    bent = start.copy()
    bends = [
        "RightHandIndex" in space.rig.joint_names[joint] and axis == 0
        for joint, axis in zip(space.joint_of_code, space.axis_of_code, strict=True)
    ]
    bent[bends] = np.minimum(start[bends] + 0.2, space.high[bends])
    way = (model.decode(bent) - model.decode(start))[tip] / model.body_size
    large, small = (
        moved_joints(
            model, dragged(model, make_grip(space, tip, radius), way, start=start).latent - start
        )
        for radius in (0.06, 0.008)
    )
    assert "RightArm" in large
    assert not any("Index" in name for name in large)
    assert small <= {f"RightHandIndex{number}" for number in (1, 2, 3)}
    assert small


@pytest.mark.parametrize("name", ["mannequin-moves.glb", "xbot-moves.glb"])
def test_the_knees_of_a_real_character_take_up_a_drag_of_its_hips(
    characters: Path, name: str
) -> None:
    model = open_body(str(characters / name))
    assert isinstance(model, RigBody)
    step = dragged(model, grip_on(model, "Hips", 0.05), -0.12 * model.space.up)
    legs = {
        side + name for side in ("Left", "Right") for name in ("UpLeg", "Leg", "Foot", "ToeBase")
    }
    assert step.miss < 0.005
    assert {"LeftLeg", "RightLeg"} <= moved_joints(model, step.latent) <= legs
    away = np.linalg.norm(step.vertices - model.reference, axis=1) / model.body_size
    for domain, part in enumerate(model.domain_names):
        if "foot" in part.lower():
            assert away[model.space.vertex_domain == domain].mean() < 0.005


def test_domains_of_a_learned_model_hang_on_its_trunk() -> None:
    model = LearnedBody.load("body")
    limbs, names = model.space.limbs, model.domain_names
    on = {names[k]: names[parent] if parent >= 0 else "" for k, parent in enumerate(limbs.parents)}
    assert on["belly & chest"] == ""
    assert on["right hand"] == "right upper arm"
    assert on["left shin & foot"] == "left thigh"
    assert {on[name] for name in ("head", "left thigh", "right upper arm")} == {"belly & chest"}


def test_a_hand_of_a_learned_model_leaves_the_codes_of_other_limbs() -> None:
    model = LearnedBody.load("body")
    start = model.known_poses[0].astype(np.float64)
    names = model.domain_names
    grip = make_grip(model.space, far_end(model.space, names.index("right hand")))
    step = dragged(model, grip, np.array([0.0, -0.1, 0.1]), start=start)
    assert step.miss < 0.005
    own = {names.index("right hand"), names.index("right upper arm")}
    others = model.embedding.codes_of(set(range(len(names))) - own)
    np.testing.assert_array_equal(step.latent[others], start[others])
    away = np.linalg.norm(step.vertices - model.decode(start), axis=1) / model.body_size
    for part in ("left hand & forearm", "left shin & foot", "right shin & foot"):
        assert away[model.space.vertex_domain == names.index(part)].mean() < 0.005


def test_an_arm_that_is_drawn_in_by_its_fingers_bends_at_the_elbow(characters: Path) -> None:
    model = open_body(str(characters / "xbot-moves.glb"))
    assert isinstance(model, RigBody)
    space = model.space
    left = np.cross(space.up, space.front)
    grip = grip_on(model, "RightHandMiddle2")
    way = 0.34 * left + 0.06 * space.up + 0.05 * space.front
    step = dragged(model, grip, way, options=DragOptions())
    names = [name.split(":")[-1] for name in space.rig.joint_names]
    turns = {
        joint: np.degrees(np.abs(step.latent[space.joint_of_code == names.index(joint)]).max())
        for joint in ("RightForeArm", "RightHand")
    }
    assert step.exactly_free
    assert step.miss < 0.01
    assert turns["RightHand"] < 45.0 < 90.0 < turns["RightForeArm"]


def test_a_drag_has_not_settled_where_a_step_overshot(characters: Path) -> None:
    """The trunk starts to follow when the arm is stretched, and its first steps overshoot."""
    model = open_body(str(characters / "mannequin-moves.glb"))
    space = model.space
    grip = make_grip(space, 12665, 0.03)
    latent = np.zeros(model.latent_size)
    for axis in (space.front, space.up):
        dragger = model.dragger()
        step = dragger.begin(latent, grip, options=PLAIN)
        home = grip.position(step.vertices)
        for way in np.linspace(0.0, 0.08, 8)[1:]:
            for _ in range(3 if way < 0.08 else 40):
                step = dragger.move(home + way * model.body_size * axis)
                if step.settled:
                    break
        assert step.settled
        assert step.miss < 0.002
        latent = step.latent
