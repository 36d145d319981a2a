"""A rigged character as a body: names, drags, Resolve, mirroring, encoding, files."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from lcollision_core.bodies import Body, RigBody, open_body, propose_rules, sample_poses
from lcollision_core.bodies.mirror import find_joint_sides, named_pairs
from lcollision_core.bodies.poses import NamedPose, read_poses, write_poses
from lcollision_core.bodies.rig_body import _frame_rate
from lcollision_core.errors import LCollisionError, ModelFileError
from lcollision_core.files import Character
from lcollision_core.meshes import RigidTransform
from lcollision_core.meshes.face_groups import without_joints
from lcollision_core.posing import DragOptions, Pin, Twist, make_grip
from lcollision_core.resolve import PoseResolver, ResolveOptions, Step
from tests.core.gltf_builder import arm, rotation
from tests.core.shapes import random_rotation
from tests.independent_check import IndependentRules, crossing_pairs, faces_about_joints
from tests.rigged_shapes import rigged_body, rigged_tube, write_gltf

FloatArray = npt.NDArray[np.float64]

SCALE = 100.0


@pytest.fixture(scope="module")
def model() -> RigBody:
    return RigBody.of(rigged_body(SCALE, n_frames=20))


def code_of(model: RigBody, joint: str, axis: int) -> int:
    number = model.space.rig.joint_names.index(joint)
    is_it = (model.space.joint_of_code == number) & (model.space.axis_of_code == axis)
    (code,) = np.flatnonzero(is_it)
    return int(code)


def test_it_is_a_body(model: RigBody) -> None:
    body: Body = model
    assert (body.name, body.card.source, body.up_axis) == ("body", "body.glb", 2)
    assert body.body_size == pytest.approx(1.8 * SCALE, rel=0.05)
    np.testing.assert_array_equal(body.front, [0.0, -1.0, 0.0])
    assert (body.has_predictor, body.can_resolve) == (False, True)
    assert body.card.pose_names[:2] == ("rest", "moves 0")
    assert body.known_poses.shape == (len(body.card.pose_names), body.latent_size)
    np.testing.assert_allclose(body.decode(body.known_poses[0]), body.reference, atol=1e-9)
    assert body.latent_space.size == body.latent_size
    assert body.latent_space.groups[0].name == "Whole body"
    with pytest.raises(ModelFileError, match="no predictor"):
        body.predict(np.zeros(body.latent_size))


def test_its_codes_have_names(model: RigBody) -> None:
    assert len(model.code_names) == len(model.code_effects) == model.latent_size
    assert model.code_names[:6] == (
        "move left", "move up", "move forward", "tilt forward", "turn left", "lean right",
    )  # fmt: skip
    names = {
        (model.space.rig.joint_names[joint], int(axis)): name
        for joint, axis, name in zip(
            model.space.joint_of_code[6:],
            model.space.axis_of_code[6:],
            model.code_names[6:],
            strict=True,
        )
    }
    assert names["LeftForeArm", 0] == names["RightLeg", 0] == "bend"
    assert names["LeftForeArm", 1] == "twist"
    assert names["LeftArm", 0] == names["RightUpLeg", 0] == "forward"
    assert {names["LeftArm", 2], names["RightArm", 2]} == {"up", "down"}
    assert {names["LeftUpLeg", 2], names["RightUpLeg", 2]} == {"in", "out"}
    # The neck, which has no vertices of its own, is part of the spine.
    assert (names["Spine", 0], names["Neck", 0]) == ("spine forward", "neck forward")
    effects = dict(zip(names, model.code_effects[6:], strict=True))
    assert model.domain_names[effects["LeftForeArm", 0].domain] == "Left forearm"


def test_names_are_those_of_the_motion(model: RigBody) -> None:
    hands = {
        side: make_grip(model.space, int(np.argmax(sign * model.reference[:, 0])))
        for side, sign in (("Left", 1.0), ("Right", -1.0))
    }
    ways = {"up": (2, 1.0), "down": (2, -1.0), "forward": (1, -1.0)}
    for side, grip in hands.items():
        for axis in (0, 2):
            code = code_of(model, f"{side}Arm", axis)
            codes = np.zeros(model.latent_size)
            codes[code] = 0.2
            moved = grip.position(model.decode(codes)) - grip.position(model.reference)
            along, sign = ways[model.code_names[code]]
            assert np.abs(moved).argmax() == along
            assert moved[along] * sign > 0.0


def test_limits_are_kept_and_reset_is_the_rest_pose(model: RigBody) -> None:
    space = model.latent_space
    assert (space.low < 0.0).all()
    assert (space.high > 0.0).all()
    bend = code_of(model, "LeftForeArm", 0)
    assert np.degrees(space.high[bend]) >= 150.0
    # A drag may exceed human limits; a random pose does not.
    poses = model.sample(200, np.random.default_rng(0))
    assert ((space.low <= poses) & (poses <= space.high)).all()
    assert 80.0 < np.degrees(poses[:, bend].max()) <= 135.0
    decoded = model.decode(poses)
    assert np.isfinite(decoded).all()
    np.testing.assert_array_equal(decoded, model.decode(poses, n_threads=1))
    # Random poses do not move the body as a whole.
    assert not poses[:, :6].any()
    assert (np.ptp(poses[:, 6:], axis=0) > 0.0).mean() > 0.7


def test_other_characters_are_told_apart() -> None:
    character = rigged_body(SCALE)
    model = RigBody.of(character)
    assert RigBody.of(rigged_body(SCALE)).fingerprint == model.fingerprint
    assert RigBody.of(rigged_body(2.0 * SCALE)).fingerprint == model.fingerprint
    assert character.rig is not None
    weights = character.rig.weights.copy()
    weights[0] = weights[0, ::-1]
    other = replace(character, rig=replace(character.rig, weights=weights))
    assert RigBody.of(other).fingerprint != model.fingerprint
    assert RigBody.of(rigged_tube()).fingerprint != model.fingerprint
    with pytest.raises(LCollisionError, match="no joints"):
        RigBody.of(replace(character, rig=None))


def test_a_body_part_without_codes_of_its_own_can_be_locked_and_twisted(model: RigBody) -> None:
    hips = model.domain_names.index("Hips")
    assert model.space.group_sizes[1 + hips] == 0
    np.testing.assert_array_equal(model.space.codes_of([hips]), np.arange(model.latent_size) < 6)
    dragger = model.dragger()
    dragger.begin(
        np.zeros(model.latent_size), Twist(hips), (), DragOptions(solid=False, standing=False)
    )
    # The last target is repeated until it is reached, as in the window.
    for angle in (*np.linspace(0.0, 0.4, 12)[1:], *[0.4] * 10):
        step = dragger.move([angle])
    assert step.miss < 0.05


def test_a_hand_is_dragged_while_the_feet_stay(model: RigBody) -> None:
    hand, foot = (
        int(np.argmax(model.reference @ np.array(way)))
        for way in ((1.0, 0.0, 0.0), (0.01, -1.0, -1.0))
    )
    grip, pinned = make_grip(model.space, hand), make_grip(model.space, foot)
    pin = Pin.of(pinned, model.reference)
    dragger = model.dragger()
    dragger.begin(np.zeros(model.latent_size), grip, [pin], DragOptions(solid=True))
    begin = grip.position(model.reference)
    target = begin + SCALE * np.array([-0.35, -0.4, 0.2])
    for event in range(1, 41):
        step = dragger.move(begin + min(1.0, event / 30) * (target - begin))
        assert step.exactly_free
    assert step.miss < 0.01
    moved = pinned.position(step.vertices) - pinned.position(model.reference)
    assert np.linalg.norm(moved) < 0.01 * model.body_size


def assert_resolved(model: RigBody, poses: FloatArray) -> set[Step]:
    """Resolve colliding poses, and judge the results by independent code."""
    faces = model.faces.astype(np.int64)
    touching = crossing_pairs(model.reference, faces)
    # The check has no depths, so no pair may be tolerated; these rules tolerate none.
    assert model.rules.tolerated_depth == 0.0
    named: dict[str, set[int]] = {}
    for group in without_joints(model.groups):
        named.setdefault(group.name, set()).update(group.faces.tolist())
    rig = model.space.rig
    main = rig.joint_of[np.arange(len(rig.joint_of)), rig.weights.argmax(axis=1)]
    joints = faces_about_joints(
        model.reference, faces, rig.parents.tolist(), rig.rest[:, :3, 3], main.tolist()
    )
    rules = model.rules.to_json()
    applied = IndependentRules(model.reference, faces, touching, rules, named, joints)

    def counted(vertices: npt.NDArray[np.floating]) -> list[tuple[int, int]]:
        crossing = crossing_pairs(vertices.astype(np.float64), faces)
        return sorted(crossing - applied.excluding(dict.fromkeys(crossing, np.inf)).keys())

    steps = set()
    for latent in poses:
        assert counted(model.exported_vertices(latent))
        result = model.resolve(latent)
        assert result.exactly_free
        np.testing.assert_array_equal(result.vertices, model.exported_vertices(result.latent))
        assert counted(result.vertices) == []
        assert result.predicted_free is None
        assert result.vertex_distance_mean < 0.35
        steps.add(result.step)
    return steps


@pytest.mark.slow
def test_fifty_colliding_poses_are_resolved_and_confirmed_independently(model: RigBody) -> None:
    steps = assert_resolved(model, sample_poses(model, 50, seed=4, colliding=True))
    assert {Step.POLISH, Step.TOWARDS} <= steps


@pytest.mark.parametrize("name", ["mannequin", "xbot"])
def test_colliding_poses_of_a_real_character_are_resolved(characters: Path, name: str) -> None:
    body = open_body(characters / f"{name}-moves.glb")
    assert isinstance(body, RigBody)
    n_poses = int(os.environ.get("LCOLLISION_POSES", "1"))
    assert_resolved(body, sample_poses(body, n_poses, seed=1, colliding=True))
    # Most frames of their clips are free, or collide not only because of shells.
    assert propose_rules(body) is None


def test_a_motion_is_resolved_frame_by_frame(model: RigBody) -> None:
    alone = PoseResolver(model.exact_check(), None, np.empty((0, model.latent_size)))
    poses = sample_poses(model, 20, seed=8, colliding=True)
    target = next(pose for pose in poses if not alone.resolve(pose).exactly_free)
    frames = np.linspace(0.0, 1.0, 13)[:, None] * target
    colliding = ~model.exact_check().are_free(frames)
    assert 1 < colliding.sum() < len(frames)
    results = model.resolver.resolve_many(frames, workers=1, sequence=True)
    assert all(result.exactly_free for result in results)
    assert [result.step == Step.UNCHANGED for result in results] == (~colliding).tolist()
    # The previous frame's pose is known to be free.
    after = alone.resolve(target, before=frames[int(colliding.argmax()) - 1])
    assert (after.exactly_free, after.step) == (True, Step.TOWARDS)


def test_locked_parts_stay_while_others_are_resolved(model: RigBody) -> None:
    leg = model.domain_names.index("Left thigh")
    latent = np.zeros(model.latent_size)
    code = code_of(model, "LeftUpLeg", 2)
    latent[code] = 0.3 if model.code_names[code] == "in" else -0.3
    assert not model.exact_check().is_free(latent)
    result = model.resolve(latent, ResolveOptions(locked_domains=frozenset({leg})))
    assert result.exactly_free
    own = model.space.codes_of([leg])
    np.testing.assert_array_equal(result.latent[own], latent[own])


def test_mirroring_exchanges_the_sides(model: RigBody) -> None:
    latent = np.zeros(model.latent_size)
    latent[code_of(model, "LeftArm", 0)] = 0.8
    latent[code_of(model, "LeftForeArm", 0)] = 1.0
    latent[code_of(model, "RightUpLeg", 0)] = 0.7
    latent[code_of(model, "Spine", 1)] = 0.3
    latent[1] = 0.05
    mirrored = model.mirror(latent)
    assert mirrored.fit_error_mean < 1e-3
    assert mirrored.latent[code_of(model, "RightForeArm", 0)] == pytest.approx(1.0, abs=0.02)
    assert mirrored.latent[code_of(model, "LeftForeArm", 0)] == pytest.approx(0.0, abs=0.02)
    back = model.mirror(mirrored.latent, mirrored.placement, mirrored.source)
    assert back.restored
    np.testing.assert_array_equal(back.latent, latent)


def with_joint(name: str, parent: str, place: tuple[float, float, float]) -> RigBody:
    """Return the body with an additional joint that moves the end of its parent's skin."""
    body = rigged_body()
    rig = body.rig
    assert rig is not None
    above = rig.joint_names.index(parent)
    rest = np.concatenate([rig.rest, np.eye(4)[None]])
    rest[-1, :3, 3] = place
    led = np.flatnonzero(rig.joint_of[:, 0] == above)[-3:]
    joint_of = rig.joint_of.copy()
    joint_of[led, 0] = len(rig.parents)
    rig = replace(
        rig,
        joint_names=(*rig.joint_names, name),
        parents=np.append(rig.parents, above),
        rest=rest,
        nodes=np.arange(len(rest)),
        joint_of=joint_of,
    )
    return RigBody.of(replace(body, rig=rig))


@pytest.mark.parametrize(
    ("place", "parent"),
    [((-1.6, 0.3, 1.2), "RightHand"), ((-0.75, 0.0, 1.45), "RightHand"), ((0.2, 0.1, 1.7), "Head")],
)
def test_what_only_one_side_has_does_not_keep_from_mirroring(
    place: tuple[float, float, float], parent: str
) -> None:
    model = with_joint("Sword", parent, place)
    latent = np.zeros(model.latent_size)
    latent[code_of(model, "LeftForeArm", 0)] = 1.0
    latent[code_of(model, "Sword", 0)] = 0.4
    mirrored = model.mirror(latent)
    assert mirrored.latent[code_of(model, "RightForeArm", 0)] == pytest.approx(1.0, abs=0.02)
    assert mirrored.latent[code_of(model, "LeftForeArm", 0)] == pytest.approx(0.0, abs=0.02)
    assert mirrored.latent[code_of(model, "Sword", 0)] == pytest.approx(0.4)


def test_a_limb_of_one_side_alone_keeps_its_turn() -> None:
    model = with_joint("RightHandThumb1", "RightHand", (-0.8, -0.1, 1.45))
    latent = np.zeros(model.latent_size)
    latent[code_of(model, "RightHandThumb1", 0)] = 0.4
    latent[code_of(model, "LeftForeArm", 0)] = 1.0
    mirrored = model.mirror(latent).latent
    assert mirrored[code_of(model, "RightHandThumb1", 0)] == pytest.approx(0.4)
    assert mirrored[code_of(model, "RightForeArm", 0)] == pytest.approx(1.0, abs=0.02)


def hanging_arm() -> Character:
    """Return the body with its left arm down at rest, the right one stretched out."""
    body = rigged_body()
    rig = body.rig
    assert rig is not None
    arm = [n for n, name in enumerate(rig.joint_names) if re.match("Left(Arm|Fore|Hand)", name)]
    down = Rotation.from_euler("y", 60.0, degrees=True).as_matrix()
    shoulder = rig.rest[arm[0], :3, 3].copy()
    rest, points, vertices = rig.rest.copy(), rig.points.copy(), body.rest_vertices.copy()
    rest[arm, :3, 3] = (rest[arm, :3, 3] - shoulder) @ down.T + shoulder
    led = np.isin(rig.joint_of[:, 0], arm)
    vertices[led] = (vertices[led] - shoulder) @ down.T + shoulder
    points[led] = vertices[led, None]
    return replace(body, rest_vertices=vertices, rig=replace(rig, rest=rest, points=points))


def test_joints_without_names_are_paired_by_what_they_are() -> None:
    """In an asymmetric rest pose, positions do not pair them."""
    hanging = hanging_arm()
    rig = hanging.rig
    assert rig is not None
    numbered = tuple(f"Bone.{joint:03d}" for joint in range(len(rig.joint_names)))
    model = RigBody.of(replace(hanging, rig=replace(rig, joint_names=numbered)))
    sides = find_joint_sides(model.space)
    assert sides is not None
    for limb in ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot"):
        left, right = (rig.joint_names.index(side + limb) for side in ("Left", "Right"))
        assert (sides.partner[left], sides.partner[right]) == (right, left), limb


def test_an_arm_that_hangs_at_rest_is_mirrored_to_one_that_is_stretched_out() -> None:
    """The posed mesh is mirrored, not the rotations from an asymmetric rest pose."""
    model = RigBody.of(hanging_arm())
    rig = model.space.rig
    posed = np.zeros(model.latent_size)
    posed[code_of(model, "RightForeArm", 0)] = 1.0
    mirrored = model.mirror(posed)
    symmetry = model.symmetry
    assert symmetry is not None
    before, after = (model.space.transforms(one)[:, :3, 3] for one in (posed, mirrored.latent))
    left, right = (rig.joint_names.index(f"{side}HandEnd") for side in ("Left", "Right"))
    assert np.abs(after[left] - symmetry.reflect(before[right])).max() < 0.02
    assert np.abs(after[right] - symmetry.reflect(before[left])).max() < 0.02
    assert mirrored.fit_error_max < 0.02
    again = model.mirror(mirrored.latent).latent
    np.testing.assert_allclose(again, posed, atol=1e-6)


SPELLINGS = {
    "mixamorig:{}Arm": ("Left", "Right"),
    "upperarm_{}": ("l", "r"),
    "{}Shldr": ("l", "r"),
    "Bip01 {} UpperArm": ("L", "R"),
    "Arm{}": ("L", "R"),
    "Bone.001.{}": ("L", "R"),
    "arm_{}_01": ("Lft", "Rgt"),
    "{}腕": ("左", "右"),
    "J_Bip_{}_UpperArm": ("L", "R"),
    "{}UpperArm": ("L", "R"),
    "ARM_{}": ("LEFT", "RIGHT"),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_joints_are_paired_by_their_names(spelling: str) -> None:
    left, right = (spelling.format(side) for side in SPELLINGS[spelling])
    assert named_pairs(["Hips", right, "Coil", left, "Coir.L", "Spine_l"]).tolist() == [[3, 1]]


def test_a_mesh_of_the_character_is_encoded_wherever_it_lies(model: RigBody) -> None:
    generator = np.random.default_rng(3)
    latent = 0.35 * generator.uniform(model.space.low, model.space.high)
    latent[:6] = 0.0
    placed = RigidTransform(random_rotation(generator), np.array([10.0, -20.0, 5.0]))
    mesh = placed.apply(model.decode(latent))
    encoded = model.encode(mesh)
    assert encoded.fit_error_max < 1e-3
    assert encoded.placement is not None
    again = encoded.placement.apply(model.decode(encoded.latent))
    np.testing.assert_allclose(again, mesh, atol=2e-3 * model.body_size)
    codes = model.nearest(model.decode(latent) / model.body_size)
    np.testing.assert_allclose(
        model.decode(codes), model.decode(latent), atol=1e-3 * model.body_size
    )


def test_poses_are_saved_and_read_again(model: RigBody, tmp_path: Path) -> None:
    path = tmp_path / "poses.json"
    poses = [
        NamedPose("one", model.known_poses[3]),
        NamedPose("rest", np.zeros(model.latent_size)),
    ]
    write_poses(path, model, poses)
    read = read_poses(path, model)
    assert [pose.name for pose in read] == ["one", "rest"]
    np.testing.assert_allclose(read[0].latent, model.known_poses[3])


def test_frames_are_spread_over_clips_of_any_length(tmp_path: Path) -> None:
    builder = arm(split=False)
    for name, seconds in (("short", 2.0), ("dance", 600.0)):
        turned = {"node": 2, "path": "rotation", "times": [0.0, seconds]}
        builder.animation(name, turned | {"values": [rotation(0, 0.0), rotation(0, 1.0)]})
    body = open_body(builder.write(tmp_path / "dancer.glb"))
    assert isinstance(body, RigBody)
    assert body.character.clips == {"wave": 1.0, "short": 2.0, "dance": 600.0}
    assert 290 <= len(body.card.pose_names) <= 301
    rate = _frame_rate(body.character)
    assert rate == pytest.approx(297 / 603)
    # The last frame of the longest clip is among them, although its vertices were not computed.
    assert body.card.pose_names[-1] == "dance 295"
    bend = body.known_poses[-1]
    assert np.abs(bend).max() == pytest.approx(1.0, abs=0.1)
    frames = body.character.sample("dance", rate)
    assert "vertices" not in vars(frames)
    assert frames.vertices.shape == (296, body.n_vertices, 3)
    assert "vertices" in vars(frames)


def test_a_character_file_is_opened_as_a_body(tmp_path: Path) -> None:
    made = rigged_body(n_frames=6)
    body = open_body(write_gltf(made, tmp_path / "walker.glb"))
    assert isinstance(body, RigBody)
    assert (body.name, body.up_axis, body.body_size) == ("walker", 1, pytest.approx(1.8, rel=0.05))
    np.testing.assert_allclose(body.front, [0.0, 0.0, 1.0])
    assert set(body.domain_names) == set(RigBody.of(made).domain_names)
    assert body.card.pose_names[0] == "rest"
    frames = body.character.sample("moves", None)
    assert frames.transforms is not None
    codes = body.space.codes_of_transforms(frames.transforms)
    np.testing.assert_allclose(body.decode(codes), frames.vertices, atol=1e-5)
    rest = made.rest_vertices[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    np.testing.assert_allclose(body.reference, rest[np.argsort(body.character.joined)], atol=1e-6)


def tube_of(*names: str) -> RigBody:
    tube = rigged_tube(len(names))
    assert tube.rig is not None
    return RigBody.of(replace(tube, rig=replace(tube.rig, joint_names=names)))


def test_below_a_parts_name_its_codes_do_not_repeat_it() -> None:
    hand = tube_of("rig:Hips", "rig:LeftHand", "rig:LeftHandThumb1", "rig:LeftHandIndex1")
    (codes,) = [g.codes for g in hand.latent_space.groups if g.name == "Left hand"]
    names = hand.code_names[codes]
    assert [name for name in names if "hand" in name or "left" in name] == []
    assert {"thumb 1 bend", "thumb 1 sideways", "index 1 bend"} < set(names)
    # Names that differ only by a number keep it, and non-Latin names are kept.
    tail = tube_of("Hips", "Tail", "Tail2", "Schw\u00e4nzchen\u5c3e", "Tail3")
    labels = {name.rsplit(" ", 1)[0] for name in tail.code_names[6:]}
    assert labels == {"tail", "tail 2", "schw\u00e4nzchen\u5c3e", "tail 3"}
    named = tube_of("Hips", "LeftHand", "LeftHand2", "LeftHandThumb1")
    labels = {name.rsplit(" ", 1)[0] for name in named.code_names[6:]}
    assert "joint 2" in labels


def test_general_words_find_the_codes_of_their_region(model: RigBody) -> None:
    hand = tube_of("Hips", "LeftForeArm", "LeftHand", "LeftHandRing1", "LeftHandRing2")

    def found(body: RigBody, words: str) -> set[str]:
        numbers = body.space.joint_of_code.tolist()
        return {
            body.space.rig.joint_names[joint]
            for joint, text in zip(numbers, body.code_words, strict=True)
            if joint >= 0 and all(word in text for word in words.split())
        }

    fingers = {"LeftHandRing1", "LeftHandRing2"}
    assert found(hand, "finger") == fingers
    assert found(hand, "hand") == {"LeftHand", *fingers}
    assert found(hand, "arm") == {"LeftForeArm", "LeftHand", *fingers}
    assert found(hand, "wrist") >= {"LeftHand"}
    assert found(hand, "string") == found(hand, "leg") == set()
    sides = {"Left": found(model, "left leg"), "Right": found(model, "right leg")}
    for side, joints in sides.items():
        assert joints >= {f"{side}UpLeg", f"{side}Leg", f"{side}Foot"}
        assert all(joint.startswith(side) for joint in joints)
    assert found(model, "spine") >= {"Spine"}
    assert found(model, "elbow") == {"LeftForeArm", "RightForeArm"}
    # A hand without fingers is also found by a search for fingers.
    assert found(model, "finger") == found(model, "hand")


def test_a_region_is_found_in_a_rig_whose_names_are_no_words(model: RigBody) -> None:
    rig = model.space.rig
    numbers = replace(rig, joint_names=tuple(f"J{n:03}" for n in range(len(rig.parents))))
    codes = RigBody.of(replace(model.character, rig=numbers))
    places = codes.space.origins[codes.space.joint_of_code[6:]]
    left = np.cross(codes.space.up, codes.space.front)
    found = {"left": 0, "right": 0}
    for text, name, place in zip(
        codes.code_words[6:], codes.code_names[6:], places @ left, strict=True
    ):
        for side in found:
            if side in text.split() and side not in name:
                found[side] += 1
                assert (side == "left") == (place > 0.0)
    assert found["left"] == found["right"] >= 12
    assert any("leg" in text for text in codes.code_words)
