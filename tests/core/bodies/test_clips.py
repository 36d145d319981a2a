"""Clips without a mesh and clips of other characters, on the joints of a character."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lcollision_core.bodies import RigBody, open_body
from lcollision_core.bodies.motions import body_of_motion, motion_of_transforms, read_motions
from lcollision_core.bodies.partners import remember_followed, with_joint_map
from lcollision_core.bodies.retargeting import joint_match
from lcollision_core.errors import MeshFileError, ModelFileError
from lcollision_core.files import Character, read_character
from lcollision_core.files.gltf.schema import GltfDocument
from lcollision_core.jobs import Job
from lcollision_core.options import MotionChoice, MotionOptions
from lcollision_core.tasks.checking import CheckRequest, check_clips
from lcollision_core.tasks.exporting import output_named
from lcollision_core.tasks.inputs import motion_files
from lcollision_core.tasks.resolving import (
    ResolveMotionsRequest,
    resolve_folder,
    resolve_motions,
)
from tests.core.fbx_builder import character_fbx
from tests.core.motion.swings import CLIP, N_FRAMES, OTHER, swinging_body
from tests.hostile_values import damaged_glbs
from tests.rigged_shapes import FloatArray, write_gltf

LIMBS = [
    (f"{side}{bone}", f"{side}{end}")
    for side in ("Left", "Right")
    for bone, end in (("Arm", "ForeArm"), ("ForeArm", "Hand"), ("UpLeg", "Leg"), ("Leg", "Foot"))
]


@pytest.fixture(scope="module")
def hero(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_gltf(swinging_body(), tmp_path_factory.mktemp("clips") / "hero.glb")


def changed(source: Path, path: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    document = GltfDocument(source.read_bytes(), source).editable()
    change(document.description)
    path.write_bytes(document.encoded())
    return path


def strip(description: dict[str, Any]) -> None:
    """Keep only the nodes and the animations."""
    for node in description["nodes"]:
        node.pop("mesh", None)
        node.pop("skin", None)
    for kind in ("meshes", "skins", "materials"):
        description.pop(kind, None)


def pose_as_in_the_middle(description: dict[str, Any], turns: dict[str, FloatArray]) -> None:
    """Store the nodes in a pose other than the rest pose, as exporters do."""
    strip(description)
    for node in description["nodes"]:
        if node.get("name") in turns:
            node["rotation"] = turns[node["name"]].tolist()


def of_clips(hero: Path, path: Path) -> Path:
    return changed(hero, path, strip)


def test_clips_without_a_mesh_move_their_character(hero: Path, tmp_path: Path) -> None:
    body = open_body(hero)
    expected = read_motions(body, hero)
    path = of_clips(hero, tmp_path / "without skin.glb")
    same, notes = body_of_motion(body, path)
    assert same is body
    assert not notes
    motions = read_motions(body, path)
    assert [motion.name for motion in motions] == [CLIP, OTHER]
    for motion, own in zip(motions, expected, strict=True):
        assert (len(motion), motion.rate) == (N_FRAMES, pytest.approx(30.0))
        difference = body.decode(motion.codes) - body.decode(own.codes)
        assert np.abs(difference).max() < 1e-6 * body.body_size
    (chosen,) = read_motions(body, path, OTHER, fps=10.0)
    assert (chosen.name, chosen.rate) == (OTHER, pytest.approx(10.0))
    with pytest.raises(MeshFileError, match="has no clip 'jump', its clips are"):
        read_motions(body, path, "jump")


def test_a_pose_that_the_file_stores_is_no_rest_pose(hero: Path, tmp_path: Path) -> None:
    body = open_body(hero)
    bent = Rotation.from_euler("xyz", [[0.4, 0.2, 0.1], [0.3, -0.8, 0.2], [0.9, 0.0, 0.3]])
    names = ("Hips", "LeftArm", "RightUpLeg")
    turns = dict(zip(names, bent.as_quat(), strict=True))
    path = changed(hero, tmp_path / "a.glb", lambda held: pose_as_in_the_middle(held, turns))
    for motion, own in zip(read_motions(body, path), read_motions(body, hero), strict=True):
        difference = body.decode(motion.codes) - body.decode(own.codes)
        assert np.abs(difference).max() < 1e-6 * body.body_size


def test_an_fbx_without_a_mesh_moves_its_character(hero: Path, tmp_path: Path) -> None:
    body = open_body(hero)
    path = character_fbx(swinging_body(), tmp_path / "swing.fbx")
    # Its geometry and its skin are not connected to anything.
    text = path.read_text().replace('C: "OO",1,2\n', "").replace('C: "OO",5,1\n', "")
    path.write_text(text)
    motions = read_motions(body, path)
    assert [motion.name for motion in motions] == [CLIP, OTHER]
    for motion, own in zip(motions, read_motions(body, hero), strict=True):
        assert len(motion) == len(own)
        assert np.abs(body.decode(motion.codes) - body.decode(own.codes)).max() < 1e-3


def villain(hero: Character, path: Path) -> Path:
    """Write a character with other names and another size, whose arms hang a little at rest."""
    rig = hero.rig
    assert rig is not None
    names = {"Hips": "pelvis", "Spine": "spine_01", "Neck": "neck_01", "Head": "head"}
    for side, end in (("Left", "_l"), ("Right", "_r")):
        parts = {"Arm": "upperarm", "ForeArm": "lowerarm", "Hand": "hand"}
        parts |= {"UpLeg": "thigh", "Leg": "calf", "Foot": "foot"}
        names |= {f"{side}{ours}": f"{theirs}{end}" for ours, theirs in parts.items()}
    rest, points = rig.rest.copy(), rig.points.copy()
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec([0.0, sign * 0.4, 0.0]).as_matrix()
        pivot = np.eye(4)
        arm = rig.joint_names.index(f"{side}Arm")
        pivot[:3, 3] = rest[arm, :3, 3]
        moved = pivot @ turn @ np.linalg.inv(pivot)
        below = [
            joint
            for joint, name in enumerate(rig.joint_names)
            if name.startswith(side) and ("Arm" in name or "Hand" in name)
        ]
        for joint in below:
            # Only positions change: all joints of these files have the same rotation at rest.
            rest[joint, :3, 3] = (moved @ rest[joint])[:3, 3]
            led = rig.joint_of == joint
            points[led] = points[led] @ moved[:3, :3].T + moved[:3, 3]
    rest[:, :3, 3] *= 1.3
    points *= 1.3
    vertices = (rig.weights[..., None] * points).sum(axis=1)
    other = replace(
        rig, joint_names=tuple(map(names.get, rig.joint_names, rig.joint_names)), rest=rest
    )

    def sample(clip: str, fps: Any) -> Any:
        frames = hero.sample(clip, fps)
        assert frames.transforms is not None
        moved = frames.transforms.copy()
        for joint, parent in enumerate(rig.parents.tolist()):
            if parent >= 0:
                step = rest[joint, :3, 3] - rest[parent, :3, 3]
                moved[:, joint, :3, 3] = moved[:, parent, :3, 3] + moved[:, parent, :3, :3] @ step
            else:
                moved[:, joint, :3, 3] *= 1.3
        return replace(frames, transforms=moved)

    return write_gltf(replace(hero, rig=other, rest_vertices=vertices, sample=sample), path)


def test_the_clips_of_another_character_move_the_limbs_alike(hero: Path, tmp_path: Path) -> None:
    body = open_body(hero)
    path = villain(swinging_body(), tmp_path / "villain.glb")
    other = read_character(path)
    assert other.rig is not None
    motions = read_motions(body, path)
    assert [motion.name for motion in motions] == [CLIP, OTHER]
    ours = list(body.space.rig.joint_names)
    for motion in motions:
        theirs = other.sample(motion.name, 30.0).transforms
        own = np.stack([body.space.transforms(row) for row in motion.codes])
        assert theirs is not None
        assert len(own) == len(theirs) == N_FRAMES
        for start, end in LIMBS:
            a, b = ours.index(start), ours.index(end)
            ways = [moved[:, b, :3, 3] - moved[:, a, :3, 3] for moved in (own, theirs)]
            units = [way / np.linalg.norm(way, axis=1, keepdims=True) for way in ways]
            assert np.degrees(np.arccos(np.clip((units[0] * units[1]).sum(1), -1, 1))).max() < 2.0


def test_joints_follow_as_a_file_says(
    hero: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    body, path, file = open_body(hero), of_clips(hero, tmp_path / "a.glb"), tmp_path / "joints.json"
    match = joint_match(body, path)
    assert match is not None
    assert match.followed["LeftArm"] == "LeftArm"
    file.write_text('{"joints": {"LeftArm": "RightArm", "LeftForeArm": null}}')
    other = with_joint_map(body, file)
    changed_match = joint_match(other, path)
    assert changed_match is not None
    expected = {**match.followed, "LeftArm": "RightArm", "LeftForeArm": None}
    assert changed_match.followed == expected
    assert other.fingerprint == body.fingerprint
    # The remembered match has the same effect without a file.
    remember_followed(match, expected)
    for own, theirs in zip(read_motions(body, path), read_motions(other, path), strict=True):
        np.testing.assert_array_equal(own.codes, theirs.codes)
    file.write_text('{"joints": {"LeftArm": "Tail"}}')
    with pytest.raises(MeshFileError, match="'Tail', no joint of the motion; its joints are"):
        read_motions(with_joint_map(body, file), path)
    file.write_text('{"joints": 3}')
    with pytest.raises(ModelFileError, match="joints"):
        with_joint_map(body, file)


def test_a_clip_is_checked_and_resolved_into_the_characters_own_file(
    hero: Path, tmp_path: Path
) -> None:
    body = open_body(hero)
    path, out = of_clips(hero, tmp_path / "moves.glb"), tmp_path / "out.glb"
    choice = MotionChoice(clip=CLIP)
    with pytest.raises(MeshFileError, match="an animation, but no mesh; name or open the char"):
        check_clips(path, CheckRequest())
    (tmp_path / "moves.usd").write_text("#usda 1.0")
    with pytest.raises(MeshFileError, match=r"is not a motion file; use one of .*\.bvh"):
        read_motions(body, tmp_path / "moves.usd")
    (verdict,) = check_clips(path, CheckRequest(body=str(hero), motion=choice))
    assert verdict.colliding
    assert verdict.frames == N_FRAMES
    target = output_named(str(out), of_motions=True)
    request = ResolveMotionsRequest(body, [path], target, MotionOptions(), choice)
    (row,) = resolve_motions(request, Job())
    assert row.free_before < row.free_after == N_FRAMES
    clips = [animation["name"] for animation in described(out)["animations"]]
    # The new clip comes first, and the character's own clips stay.
    assert clips == [f"{CLIP} 2", CLIP, OTHER]
    (free,) = check_clips(out, CheckRequest(motion=MotionChoice(clip=f"{CLIP} 2")))
    assert (free.frames, free.colliding_frames) == (N_FRAMES, [])


def described(path: Path) -> dict[str, Any]:
    return dict(GltfDocument(path.read_bytes(), path).description)


def test_a_folder_of_clips_comes_to_files_of_the_character(hero: Path, tmp_path: Path) -> None:
    body, folder, out = open_body(hero), tmp_path / "clips", tmp_path / "out"
    folder.mkdir()
    of_clips(hero, folder / "one.glb")
    (folder / "broken.glb").write_bytes((folder / "one.glb").read_bytes()[:500])
    files = motion_files(folder)
    assert [path.name for path in files] == ["broken.glb", "one.glb"]
    target = output_named(f"{out}/", of_motions=True)
    choice = MotionChoice(clip=OTHER)
    request = ResolveMotionsRequest(body, files, target, MotionOptions(), choice, root=folder)
    resolve_folder(request, Job())
    with (out / "motions.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [bool(row["error"]) for row in rows] == [True, False]
    assert described(out / "one.glb")["animations"][0]["name"] == f"{OTHER} 2"


@pytest.mark.slow
def test_two_hundred_damaged_clips_are_read_or_refused(hero: Path, tmp_path: Path) -> None:
    body, path = open_body(hero), tmp_path / "damaged.glb"
    whole, said = of_clips(hero, tmp_path / "whole.glb").read_bytes(), []
    for data in damaged_glbs(whole, 200, seed=13):
        path.write_bytes(data)
        try:
            read_motions(body, path, OTHER)
        except MeshFileError as error:
            said.append(str(error))
    assert 80 < len(said) < 200
    assert not [sentence for sentence in said if "\n" in sentence or "damaged.glb" not in sentence]


def test_a_root_that_carries_nothing_gives_frames_no_shape_of_their_own() -> None:
    character = swinging_body()
    rig, frames = character.rig, character.sample(CLIP, None)
    assert rig is not None
    assert frames.transforms is not None
    n_joints = len(rig.parents) + 1
    under = replace(
        rig,
        joint_names=("Root", *rig.joint_names),
        parents=np.concatenate([[-1], np.where(rig.parents < 0, 0, rig.parents + 1)]),
        rest=np.concatenate([np.eye(4)[None], rig.rest]),
        nodes=np.arange(n_joints),
        joint_of=rig.joint_of + 1,
    )
    body = RigBody.of(replace(character, rig=under, clips={}))
    walk = np.tile(np.eye(4), (N_FRAMES, 1, 1, 1))
    walk[:, 0, 0, 3] = np.linspace(0.0, 2.0, N_FRAMES)
    moved = np.concatenate([walk, walk @ frames.transforms], axis=1)
    motion = motion_of_transforms(body.space, "walk", frames.times, moved)
    assert motion.space_at is None
    hips = moved.copy()
    hips[:, 1, :3, :3] *= 1.1
    assert motion_of_transforms(body.space, "walk", frames.times, hips).space_at is not None
