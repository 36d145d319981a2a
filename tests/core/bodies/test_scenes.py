"""Scenes of several bodies: poses, rules and files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import random as random_sparse

from lcollision_core.bodies import NamedPose, open_body, write_poses
from lcollision_core.bodies.scene_body import SceneBody, SceneFile, ScenePart
from lcollision_core.bodies.scene_file import (
    body_of_scene,
    open_scene_file,
    write_scene_file,
)
from lcollision_core.errors import LCollisionError, ModelFileError
from lcollision_core.files import read_character, write_mesh
from lcollision_core.files.motion.caches import write_point_cache
from lcollision_core.options import ExportRequest, MotionChoice, ResolveOptions
from lcollision_core.posing import DragOptions, Grip
from lcollision_core.tasks.exporting import write_members
from lcollision_core.tasks.opening import open_any, pose_of_member
from lcollision_core.tasks.scenes import carried_domains, read_scene_poses, scene_motion
from tests.core.fbx_builder import arm_fbx
from tests.core.gltf_builder import GltfBuilder, rotation
from tests.independent_check import crossing_pairs
from tests.rigged_shapes import FloatArray, rigged_body, write_gltf
from tests.small_models import DATA

_BOX = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
_BOX_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    + [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)
_HAND = 0.9, 1.45, 0.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder with a hero, and a box of 0.1 at its left hand."""
    made = tmp_path_factory.mktemp("scene")
    write_gltf(rigged_body(), made / "hero.glb")
    write_mesh(made / "box.obj", (_BOX - 0.5) * 0.1 + _HAND, _BOX_FACES)
    return made


@pytest.fixture(scope="module")
def two(folder: Path) -> SceneBody:
    """Open two heroes whose arms cross, on the ground."""
    parts = ScenePart(str(folder / "hero.glb")), ScenePart(str(folder / "hero.glb"), "villain")
    placed = replace(parts[1], at=(0.5, 0.02, 0.0), turn=180.0)
    return body_of_scene(SceneFile((parts[0], placed), "rest"))


def test_codes_are_those_of_the_bodies_and_move_their_vertices_alone(two: SceneBody) -> None:
    hero = open_body(two.members[0].body.own_file or "")
    assert two.latent_size == 2 * hero.latent_size
    codes = 0.2 * np.random.default_rng(0).normal(size=(2, hero.latent_size))
    latent = two.joined_codes([codes[0], codes[1], None])
    assert np.array_equal(two.codes_of_member("villain", latent), codes[1])
    decoded = two.decode(latent)
    assert np.allclose(decoded[two.vertices_of["hero"]], hero.decode(codes[0]))
    villain = hero.decode(codes[1]) * [-1.0, 1.0, -1.0] + [0.5, 0.02, 0.0]
    assert np.allclose(decoded[two.vertices_of["villain"]], villain)


def test_a_body_whose_file_says_that_up_is_down_stands_upright(
    folder: Path, tmp_path: Path
) -> None:
    upright = arm_fbx(tmp_path / "arm.fbx")
    sign = '"UpAxisSign", "int", "Integer", "",'
    down = tmp_path / "down.fbx"
    down.write_text(upright.read_text().replace(f"{sign}1", f"{sign}-1"))
    parts = [ScenePart(str(file)) for file in (folder / "hero.glb", upright, down)]
    body = body_of_scene(SceneFile(tuple(parts)))
    arm, turned = (body.reference[body.vertices_of[name]] for name in ("arm", "down"))
    np.testing.assert_allclose(turned[:, 1], -arm[:, 1], atol=1e-6)
    stood = body_of_scene(SceneFile((parts[2], parts[0]), "rest"))
    assert stood.up == (0.0, -1.0, 0.0)
    bodies = [stood.reference[stood.vertices_of[name]] @ stood.up for name in ("down", "hero")]
    assert bodies[1].max() > 1.0
    assert stood.ground is not None
    lowest = min(float(heights.min()) for heights in bodies)
    assert stood.ground[0] * stood.body_size == pytest.approx(lowest, abs=1e-2)


def test_a_learned_body_is_posed_by_its_codes(folder: Path) -> None:
    tube = DATA / "tube.safetensors"
    model, codes = open_body(tube), 0.5 * open_body(tube).sample(1, np.random.default_rng(3))[0]
    at = model.decode(codes)[len(model.reference) // 2]
    parts = ScenePart(str(tube)), ScenePart(str(folder / "hero.glb"), at=tuple(at - [0, 1, 0]))
    body = body_of_scene(SceneFile(parts))
    latent = body.joined_codes([codes, None])
    rows, place = body.vertices_of["tube"], body.member("tube").place
    assert np.allclose(body.decode(latent)[rows], place.apply(model.decode(codes)))
    by_vertices = np.random.default_rng(1).normal(size=(1, body.n_vertices, 3))
    pulled = body.codes_of_member("tube", body.space.pull_back(latent, by_vertices))
    assert np.allclose(pulled, model.space.pull_back(codes, by_vertices[:, rows]))
    result = body.resolve(latent)
    assert result.pairs_before
    assert result.exactly_free
    written = write_members(
        folder / "out", body, [NamedPose("free", result.latent)], [result.vertices], ExportRequest()
    )
    assert np.allclose(written[0].vertices, result.vertices, atol=1e-4)
    assert (folder / "out" / "tube.obj").is_file()
    dragger, hand = body.dragger(), int(rows.start + model.reference[:, 1].argmax())
    dragger.begin(result.latent, Grip.at(hand))
    moved = dragger.move(body.decode(result.latent)[hand] - [0.0, 9.0, 0.0]).latent
    assert body.codes_of_member("tube", moved - result.latent).any()
    assert not body.codes_of_member("hero", moved - result.latent).any()


def test_derivatives_are_those_of_differences(two: SceneBody) -> None:
    space, generator = two.space, np.random.default_rng(1)
    latent, step = generator.uniform(0.2, 0.4, two.latent_size), 1e-6
    by_vertices = generator.normal(size=(2, two.n_vertices, 3))
    weights = random_sparse(2, two.n_vertices, 0.01, random_state=2).tocsr()
    pulled = space.pull_back(latent, by_vertices)
    slopes = space.mean_slopes(weights)(latent, by_vertices[:1])
    assert np.allclose(slopes[6:], pulled[:1])
    for code in (0, 4, 7, 9, 20, two.latent_size - 1):
        ends = latent + step * np.array([[1.0], [-1.0]]) * np.eye(two.latent_size)[code]
        moved = np.subtract(*space.decode(ends)) / (2.0 * step)
        assert np.abs(moved).max() > 0.0
        assert np.allclose((by_vertices * moved).sum(axis=(1, 2)), pulled[:, code], atol=1e-5)
        assert np.allclose((weights @ moved).ravel(), slopes[:6, code], atol=1e-5)


def test_pairs_between_bodies_count_and_are_called_after_them(two: SceneBody) -> None:
    assert {"hero: Left hand", "villain: Left hand", "ground"} <= set(two.domain_names)
    found = two.detector.detect(two.reference)
    owner = two.space.vertex_domain[two.faces[found.pairs[:, :]][:, :, 0]]
    names = {tuple(sorted(two.domain_names[k].split(":")[0] for k in row)) for row in owner}
    assert names == {("hero", "villain")}


def test_resolve_moves_all_bodies_apart_and_none_into_the_ground(two: SceneBody) -> None:
    result = two.resolve(np.zeros(two.latent_size))
    assert result.pairs_before
    assert result.exactly_free
    moved = np.linalg.norm(result.vertices - two.reference, axis=1)
    assert moved[two.vertices_of["hero"]].max() > 0.0
    assert moved[two.vertices_of["villain"]].max() > 0.0
    assert result.vertices[two.vertices_of["hero"], 1].min() >= two.reference[-1, 1]


def test_a_fixed_body_does_not_give_way(folder: Path) -> None:
    hero = str(folder / "hero.glb")
    villain = ScenePart(hero, "villain", (0.5, 0.02, 0.0), 180.0, fixed=True)
    body = body_of_scene(SceneFile((ScenePart(hero), villain)))
    options = ResolveOptions(locked_domains=body.fixed_domains)
    result = body.resolve(np.zeros(body.latent_size), options)
    assert result.exactly_free
    assert not body.codes_of_member("villain", result.latent).any()
    assert body.codes_of_member("hero", result.latent).any()


def crossed_by(prop: str, body: SceneBody, vertices: FloatArray) -> set[str]:
    """Return the parts that a prop crosses, by the independent check."""
    pairs = np.array(sorted(crossing_pairs(vertices, body.faces)), np.int64).reshape(-1, 2)
    names = np.array(body.domain_names)[body.space.vertex_domain[body.faces[pairs][:, :, 0]]]
    return {str(name) for row in names.tolist() if prop in row for name in row} - {prop}


def test_whole_bodies_are_shifted_apart_as_little_as_it_takes(
    two: SceneBody, tmp_path: Path, folder: Path
) -> None:
    # The legs stand 24 cm deep in a step.
    size = np.array([0.8, 0.3, 0.8])
    write_mesh(tmp_path / "step.obj", (_BOX - [0.5, 0.0, 0.5]) * size - [0, 0.05, 0], _BOX_FACES)
    step = ScenePart(str(tmp_path / "step.obj"), fixed=True)
    body = body_of_scene(SceneFile((ScenePart(str(folder / "hero.glb")), step)))
    assert crossed_by("step", body, body.reference) >= {"Left shin", "Right shin"}
    hero = body.vertices_of["hero"]
    poses = body.decode(body.least_separated(np.zeros(body.latent_size), body.exact_check()))
    assert len(poses)
    for pose in poses:
        assert not crossed_by("step", body, pose)
        moved = pose[hero] - body.reference[hero]
        assert np.allclose(moved, moved[0])
        assert 0.24 < np.linalg.norm(moved[0]) < 2.0 * 0.24
    (pose, *_) = two.decode(two.least_separated(np.zeros(two.latent_size), two.exact_check()))
    ways = [
        (pose - two.reference)[two.vertices_of[name]].mean(axis=0) for name in ("hero", "villain")
    ]
    assert np.allclose(*np.abs(ways))
    assert ways[0][0] < 0.0 < ways[1][0]


def test_what_a_held_prop_cannot_leave_does_not_keep_it_in_the_rest(
    tmp_path: Path, folder: Path
) -> None:
    # The grip crosses the forearm in every pose, and the blade the trunk at first.
    grip = (_BOX - [0.0, 0.5, 0.5]) * [0.2, 0.1, 0.02] + [0.66, 1.45, 0.0]
    blade = (_BOX - [0.0, 0.5, 0.5]) * [1.0, 0.02, 0.02] + [-0.05, 1.2, 0.0]
    faces = np.concatenate([_BOX_FACES, _BOX_FACES + len(_BOX)])
    write_mesh(tmp_path / "sword.obj", np.concatenate([grip, blade]), faces)
    sword = ScenePart(str(tmp_path / "sword.obj"), held_by="hero", joint="LeftHand")
    body = body_of_scene(SceneFile((ScenePart(str(folder / "hero.glb")), sword)))
    result = body.resolve(np.zeros(body.latent_size))
    assert crossed_by("sword", body, body.reference) == {"Torso", "Left forearm", "Left hand"}
    assert crossed_by("sword", body, result.vertices) == {"Left forearm", "Left hand"}
    assert not result.exactly_free
    assert result.note == "no pose without collisions was found"


def test_the_only_body_that_is_posed_keeps_its_names_and_its_mirror(folder: Path) -> None:
    hero = open_body(folder / "hero.glb")
    parts = ScenePart(str(folder / "hero.glb")), ScenePart(str(folder / "box.obj"), fixed=True)
    body = body_of_scene(SceneFile(parts, "rest"))
    assert body.domain_names == (*hero.domain_names, "box", "ground")
    assert {group.name for group in hero.groups} < {group.name for group in body.groups}
    codes = 0.3 * hero.sample(1, np.random.default_rng(5))[0]
    mirrored, expected = body.mirror(body.joined_codes([codes, None, None])), hero.mirror(codes)
    if mirrored.resolution is None and expected.resolution is None:
        own = body.codes_of_member("hero", mirrored.latent)
        np.testing.assert_allclose(own, expected.latent, atol=1e-12)
    hand = hero.domain_names.index("Left hand")
    assert body.pose_mirror.partner(hand) == hero.pose_mirror.partner(hand) is not None
    assert [p.name for p in body.starter_poses] == [p.name for p in hero.starter_poses]


def test_starter_poses_of_several_bodies_are_named_after_them_and_move_one(two: SceneBody) -> None:
    hero = open_body(two.members[0].body.own_file or "")
    names = [f"{body}: {pose.name}" for body in ("hero", "villain") for pose in hero.starter_poses]
    assert [pose.name for pose in two.starter_poses] == names != []
    latent = 0.2 * np.random.default_rng(1).normal(size=two.latent_size)
    for pose, expected in zip(two.starter_poses[-2:], hero.starter_poses[-2:], strict=True):
        posed = NamedPose(pose.name, pose.codes, moves=pose.moves).applied_to(latent)
        own = NamedPose("", expected.codes, moves=expected.moves)
        assert np.array_equal(
            two.codes_of_member("hero", posed), two.codes_of_member("hero", latent)
        )
        of_villain = two.codes_of_member("villain", latent)
        assert np.array_equal(two.codes_of_member("villain", posed), own.applied_to(of_villain))


def test_a_drag_moves_the_body_that_is_held_alone(two: SceneBody) -> None:
    dragger, start = two.dragger(), two.separated_poses(np.zeros(two.latent_size))[0]
    decoded = two.decode(start)
    hand = int(decoded[two.vertices_of["hero"], 0].argmin())
    dragger.begin(start, Grip.at(hand), options=DragOptions(whole_body=True))
    moved = dragger.move(decoded[hand] + [0.1, -0.3, 0.1]).latent - start
    assert two.codes_of_member("hero", moved).any()
    assert not two.codes_of_member("villain", moved).any()


def test_what_a_hand_holds_moves_with_it_and_may_touch_it(folder: Path) -> None:
    parts = (
        ScenePart(str(folder / "hero.glb")),
        ScenePart(str(folder / "box.obj"), held_by="hero", joint="LeftHand"),
    )
    body = body_of_scene(SceneFile(parts))
    hero = body.members[0].body
    assert body.latent_size == hero.latent_size
    assert "box" in body.domain_names
    assert body.resolve(np.zeros(body.latent_size)).pairs_before == 0
    codes = 0.3 * np.random.default_rng(3).normal(size=body.latent_size)
    assert hero.joints is not None
    moves = hero.joints.transforms(codes) @ np.linalg.inv(hero.joints.rig.rest)
    move = moves[hero.joints.rig.joint_names.index("LeftHand")]
    rows = body.vertices_of["box"]
    at_rest = body.reference[rows] @ move[:3, :3].T + move[:3, 3]
    assert np.allclose(body.decode(codes)[rows], at_rest)


@pytest.mark.parametrize("deforms", [False, True])
def test_a_prop_plays_its_own_clip_unless_it_is_held(
    folder: Path, tmp_path: Path, deforms: bool
) -> None:
    builder, times = GltfBuilder(), [0.0, 0.5, 1.0]
    primitive = {
        "attributes": {"POSITION": builder.array((_BOX - 0.5) * [0.1, 0.4, 0.1])},
        "indices": builder.array(_BOX_FACES.reshape(-1), "u2"),
    }
    node = builder.add("nodes", mesh=builder.add("meshes", primitives=[primitive]))
    sizes = [[1.0, 1.0, 1.0], [2.0, 1.0, 1.0] if deforms else [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]
    flight = [[1.0, 1.2, 0.0], [0.0, 1.2, 0.0], [-2.0, 1.2, 0.0]]
    turns = [rotation(2, angle) for angle in (0.0, 1.0, 2.0)]
    builder.animation(
        "fly",
        *(
            {"node": node, "path": path, "times": times, "values": values}
            for path, values in (("translation", flight), ("rotation", turns), ("scale", sizes))
        ),
    )
    axe = builder.write(tmp_path / "axe.glb")
    parts = ScenePart(str(folder / "hero.glb")), ScenePart(str(axe))
    body = body_of_scene(SceneFile(parts))
    motion, _ = scene_motion(body, (), MotionChoice())
    frames = read_character(axe).sample("fly", motion.rate)
    check, rows = body.exact_check(), body.vertices_of["axe"]
    for number, vertices in enumerate(frames.vertices):
        assert np.allclose(motion.vertices(number, check)[rows], vertices, atol=1e-6)
    collides = ~check.are_free(motion.codes)
    assert 0 < collides.sum() < len(collides) == len(frames.times)
    held = body_of_scene(SceneFile((parts[0], replace(parts[1], held_by="hero", joint="LeftHand"))))
    assert held.notes == ("axe: it is held, so its own clips are left out",)


def test_between_frames_of_a_cache_a_body_of_a_scene_has_the_shape_between(
    folder: Path, tmp_path: Path
) -> None:
    parts = ScenePart(str(folder / "hero.glb")), ScenePart(str(folder / "box.obj"))
    body, cache = body_of_scene(SceneFile(parts)), tmp_path / "grows.pc2"
    box = body.members[1].body.reference
    # It does not grow alike everywhere.
    bulge = (box - box.mean(axis=0)) * [0.0, 1.0, 0.0] * (box[:, :1] > 0.9)
    write_point_cache(cache, np.stack([box, box + bulge]), fps=30.0)
    motion, _ = scene_motion(body, (f"box={cache}",), MotionChoice())
    check, rows = body.exact_check(), body.vertices_of["box"]
    at = (0, 0.0), (0, 0.5), (1, 0.0)
    first, middle, second = (motion.vertices(n, check, share)[rows] for n, share in at)
    assert np.abs(second - first).max() > 0.01
    np.testing.assert_allclose(middle, 0.5 * (first + second), atol=5e-4)


def test_a_point_cache_moves_a_whole_body_of_a_scene(folder: Path, tmp_path: Path) -> None:
    body = body_of_scene(SceneFile((ScenePart(str(folder / "hero.glb")),), "rest"))
    hero, walk = body.members[0].body, tmp_path / "walk.pc2"
    codes = 0.2 * np.random.default_rng(2).normal(size=(4, hero.latent_size))
    steps = np.linspace(0.0, 2.0, 4)[:, None, None] * [0.0, 0.0, 1.0]
    frames = hero.decode(codes) * [-1.0, 1.0, -1.0] + steps
    write_point_cache(walk, frames, fps=30.0)
    motion, _ = scene_motion(body, (f"hero={walk}",), MotionChoice())
    check, rows = body.exact_check(), body.vertices_of["hero"]
    pose, poses = hero.encode(frames[3]), tmp_path / "poses.json"
    write_poses(poses, hero, [NamedPose("a", pose.latent, pose.placement)])
    (given,) = read_scene_poses(body, [poses], 1.0)
    assert np.allclose(body.decode(given.pose.latent)[rows], frames[3], atol=1e-5)
    # As the window reads it; in centimetres, it stands at the same place.
    of_member = pose_of_member(body, poses)
    assert of_member is not None
    assert of_member.members == ("hero",)
    np.testing.assert_array_equal(of_member.pose.latent, given.pose.latent)
    in_centimetres = hero.encode(100.0 * frames[3], scale=0.01)
    write_poses(poses, hero, [NamedPose("a", in_centimetres.latent, in_centimetres.placement)])
    (given,) = read_scene_poses(body, [poses], 1.0)
    assert np.allclose(body.decode(given.pose.latent)[rows], frames[3], atol=1e-4)
    for number, frame in enumerate(frames):
        assert np.allclose(motion.vertices(number, check)[rows], frame, atol=1e-5)


def test_locks_stay_with_what_a_body_holds(folder: Path, tmp_path: Path) -> None:
    hero = ScenePart(str(folder / "hero.glb"))
    held = []
    for name in ("cup", "stick"):
        write_mesh(tmp_path / f"{name}.obj", (_BOX - 0.5) * 0.1, _BOX_FACES)
        held.append(ScenePart(str(tmp_path / f"{name}.obj"), held_by="hero", joint="lefthand"))
    both, stick = (body_of_scene(SceneFile((hero, *parts))) for parts in (held, held[1:]))
    cup_domain, stick_domain = map(both.domain_names.index, ("cup", "stick"))
    left = carried_domains({cup_domain, stick_domain, 2}, both, stick, "cup")
    assert left == {stick.domain_names.index("stick"), 2}
    assert carried_domains({cup_domain}, both, stick, "cup") == frozenset()


def test_a_prop_elsewhere_comes_to_the_joint_that_holds_it(tmp_path: Path, folder: Path) -> None:
    write_mesh(tmp_path / "sword.obj", (_BOX - 0.5) * 0.1, _BOX_FACES)
    sword = ScenePart(str(tmp_path / "sword.obj"), held_by="hero", joint="lefthand")
    body = body_of_scene(SceneFile((ScenePart(str(folder / "hero.glb")), sword)))
    assert np.allclose(body.reference[body.vertices_of["sword"]].mean(axis=0), [0.75, 1.45, 0.0])
    assert [group.name for group in body.groups if "word" in group.name] == ["sword", "sword: grip"]


def test_a_scene_file_is_found_again_with_its_bodies(folder: Path, tmp_path: Path) -> None:
    there, here = tmp_path / "there", tmp_path / "here"
    for place in (there, there / "bodies", here):
        place.mkdir()
    hero = there / "bodies" / "hero.glb"
    hero.write_bytes((folder / "hero.glb").read_bytes())
    scene = SceneFile((ScenePart(str(hero)), ScenePart(str(hero), "b", (2.0, 0.0, 0.0))), 0.0)
    write_scene_file(there / "scene.json", scene)
    said = json.loads((there / "scene.json").read_text())
    assert said["bodies"][1] == {"file": "bodies/hero.glb", "name": "b", "at": [2.0, 0.0, 0.0]}
    body = open_scene_file(there / "scene.json")
    assert [member.name for member in body.members] == ["hero", "b", "ground"]
    (here / "scene.json").write_bytes((there / "scene.json").read_bytes())
    with pytest.raises(ModelFileError, match=r"names bodies/hero.glb.*put hero.glb into"):
        open_scene_file(here / "scene.json")
    (here / "hero.glb").write_bytes(hero.read_bytes())
    assert open_any(here / "scene.json").fingerprint == body.fingerprint


def test_what_is_left_out_of_the_check_collides_with_nothing(folder: Path) -> None:
    hero = str(folder / "hero.glb")
    other = ScenePart(hero, "b", (0.5, 0.02, 0.0), 180.0, counts=False)
    body = body_of_scene(SceneFile((ScenePart(hero), other)))
    assert not body.detector.detect(body.reference).colliding


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"{}", "contains something else"),
        (b'{"format": "lcollision-scene", "format_version": 9, "bodies": []}', "version"),
        (b'{"format": "lcollision-scene", "format_version": 1, "bodies": []}', "bodies"),
    ],
)
def test_damaged_scene_files_are_refused(tmp_path: Path, content: bytes, sentence: str) -> None:
    path = tmp_path / "scene.json"
    path.write_bytes(content)
    with pytest.raises(ModelFileError, match=sentence):
        open_scene_file(path)


def test_a_joint_that_is_not_there_is_named(folder: Path) -> None:
    box = ScenePart(str(folder / "box.obj"), held_by="hero", joint="Tail")
    with pytest.raises(LCollisionError, match="no joint 'Tail'"):
        body_of_scene(SceneFile((ScenePart(str(folder / "hero.glb")), box)))
