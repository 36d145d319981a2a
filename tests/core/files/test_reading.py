"""Characters from files: joined vertices, the rig, its parts and its clips."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies.anatomy import joint_parts, joint_roles
from lcollision_core.bodies.rig_space import RigPoseSpace
from lcollision_core.errors import LCollisionError, MeshFileError, ShapeError
from lcollision_core.files import Character, Rig, read_character
from lcollision_core.files.scene_files import open_scene
from lcollision_core.meshes.joint_kinds import Role
from tests.core.gltf_builder import arm, moved, rotation, tube


def _skinned(rig: Rig, transforms: np.ndarray) -> np.ndarray:
    """Return the vertices of one pose as `Rig` documents them."""
    turns = (transforms @ np.linalg.inv(rig.rest))[rig.joint_of]
    points = np.einsum("vijk,vik->vij", turns[..., :3, :3], rig.points) + turns[..., :3, 3]
    return np.einsum("vi,vij->vj", rig.weights, points)


def _rig_of(character: Character) -> Rig:
    assert character.rig is not None
    return character.rig


def test_vertices_that_seams_split_are_joined_and_the_map_says_how(tmp_path: Path) -> None:
    character = read_character(arm().write(tmp_path / "arm.glb"))
    vertices, faces = tube()
    assert character.topology.n_vertices == len(vertices)
    assert character.topology.n_faces == len(faces)
    assert character.topology.is_watertight
    assert np.array_equal(
        character.joined[np.arange(faces.size)].reshape(-1, 3), character.topology.faces
    )
    assert character.notes == (
        f"{faces.size - len(vertices)} vertices were joined with others at seams",
    )
    whole = read_character(arm(split=False).write(tmp_path / "whole.glb"))
    assert np.array_equal(whole.joined, np.arange(len(vertices)))
    assert np.array_equal(whole.topology.faces, faces)
    assert whole.notes == ()
    assert np.array_equal(
        whole.rest_vertices[faces], character.rest_vertices[character.topology.faces]
    )


def test_the_rig_poses_the_rest_pose_and_all_frames(tmp_path: Path) -> None:
    character = read_character(arm().write(tmp_path / "arm.glb"))
    rig = _rig_of(character)
    assert rig.joint_names == ("rig:LeftArm", "rig:LeftForeArm", "rig:LeftHand")
    assert rig.parents.tolist() == [-1, 0, 1]
    assert rig.nodes.tolist() == [1, 2, 3]
    assert np.abs(rig.weights.sum(axis=1) - 1.0).max() < 1e-12
    assert np.abs(_skinned(rig, rig.rest) - character.rest_vertices).max() < 1e-12
    frames = character.sample("wave", None)
    assert frames.transforms is not None
    assert frames.names == ("wave 0", "wave 1", "wave 2")
    assert np.allclose(frames.times, [0.0, 0.4, 1.0])
    for vertices, transforms in zip(frames.vertices, frames.transforms, strict=True):
        assert np.abs(_skinned(rig, transforms) - vertices).max() < 1e-12
    assert np.abs(frames.vertices[1] - character.rest_vertices).max() > 0.5


def test_the_rest_pose_is_where_the_nodes_are_stored(tmp_path: Path) -> None:
    """Unlike in the bind pose, the forearm is bent, and the whole character is moved."""
    character = read_character(arm(split=False).write(tmp_path / "arm.glb"))
    vertices, _ = tube()
    upper = vertices[:, 1] <= 0.5
    assert np.abs(character.rest_vertices[upper] - vertices[upper] - [0.5, 0.0, -1.0]).max() < 1e-6
    hand = vertices[:, 1] >= 2.5
    turned = (
        moved(0.5, 1.5, -1.0)
        @ np.block(
            [
                [
                    np.array(
                        [
                            [np.cos(0.3), -np.sin(0.3), 0.0],
                            [np.sin(0.3), np.cos(0.3), 0.0],
                            [0.0, 0.0, 1.0],
                        ]
                    ),
                    np.zeros((3, 1)),
                ],
                [np.zeros((1, 3)), np.ones((1, 1))],
            ]
        )
        @ moved(0.0, -1.5, 0.0)
    )
    expected = vertices[hand] @ turned[:3, :3].T + turned[:3, 3]
    assert np.abs(character.rest_vertices[hand] - expected).max() < 1e-6


def test_frames_a_second_are_those_asked_for(tmp_path: Path) -> None:
    character = read_character(arm().write(tmp_path / "arm.glb"))
    assert len(character.sample("wave", 60.0).vertices) == 61
    assert len(character.sample("wave", 0.5).vertices) == 1
    with pytest.raises(MeshFileError, match=r"arm\.glb .*fps must be a number above 0, got 0"):
        character.sample("wave", 0.0)
    with pytest.raises(MeshFileError, match="fewer frames a second"):
        character.sample("wave", 1e12)
    with pytest.raises(MeshFileError, match=r"no clip 'run', its clips are: 'wave'"):
        character.sample("run", None)


def test_keys_faster_than_thirty_a_second_are_thinned(tmp_path: Path) -> None:
    builder = arm()
    times = np.arange(121) / 120.0
    builder.animation(
        "fast",
        {"node": 1, "path": "rotation", "times": times, "values": [rotation(0, t) for t in times]},
    )
    frames = read_character(builder.write(tmp_path / "arm.glb")).sample("fast", None)
    assert np.allclose(frames.times, np.arange(31) / 30.0)


def test_what_the_file_says_of_axes_units_and_groups(tmp_path: Path) -> None:
    path = arm().write(tmp_path / "arm.vrm")
    character = read_character(path)
    assert character.name == "arm"
    assert character.source == path
    assert character.up.tolist() == [0.0, 1.0, 0.0]
    assert character.up_is_sure
    assert character.metres == 1.0
    assert character.clips == {"wave": pytest.approx(1.0)}
    assert [group.name for group in character.groups] == ["Body", "Skin"]
    assert all(len(group.faces) == character.topology.n_faces for group in character.groups)
    assert read_character(path, up="z").up.tolist() == [0.0, 0.0, 1.0]
    assert read_character(path, up=0).up.tolist() == [1.0, 0.0, 0.0]
    with pytest.raises(ShapeError, match="up must be"):
        read_character(path, up="up")


def test_parts_have_human_names(tmp_path: Path) -> None:
    character = read_character(arm(split=False).write(tmp_path / "arm.glb"))
    labels = joint_parts(character)
    heights = tube()[0][:, 1]
    assert set(labels[heights < 0.9]) == {"Left upper arm"}
    assert set(labels[(heights > 1.1) & (heights < 1.9)]) == {"Left forearm"}
    assert set(labels[heights > 2.1]) == {"Left hand"}


def test_a_mesh_that_hangs_on_a_joint_follows_it(tmp_path: Path) -> None:
    builder = arm()
    vertices, faces = tube(2, 4, 0.5)
    sword = builder.add(
        "meshes",
        name="Sword",
        primitives=[
            {
                "attributes": {"POSITION": builder.array(vertices)},
                "indices": builder.array(faces.reshape(-1), "u4"),
            }
        ],
    )
    builder.description["nodes"][3]["children"] = [builder.add("nodes", name="Grip", mesh=sword)]
    character = read_character(builder.write(tmp_path / "arm.glb"))
    rig = _rig_of(character)
    assert rig.joint_names == ("rig:LeftArm", "rig:LeftForeArm", "rig:LeftHand")
    frames = character.sample("wave", None)
    assert frames.transforms is not None
    for posed, transforms in zip(frames.vertices, frames.transforms, strict=True):
        assert np.abs(_skinned(rig, transforms) - posed).max() < 1e-12
    # A node that moves by itself is a joint.
    builder.animation(
        "draw",
        {"node": 5, "path": "translation", "times": [0.0, 1.0], "values": [[0, 0, 0], [0, 1, 0]]},
    )
    character = read_character(builder.write(tmp_path / "arm.glb"))
    rig = _rig_of(character)
    assert rig.joint_names[-1] == "Grip"
    frames = character.sample("draw", None)
    assert frames.transforms is not None
    assert np.abs(_skinned(rig, frames.transforms[1]) - frames.vertices[1]).max() < 1e-12


def test_a_character_without_joints_has_no_rig(tmp_path: Path) -> None:
    builder = arm()
    del builder.description["nodes"][4]["skin"]
    path = builder.write(tmp_path / "arm.glb")
    assert not open_scene(path).has_skin
    assert read_character(path).rig is None
    assert read_character(path).sample("wave", None).transforms is None
    assert open_scene(arm().write(path)).has_skin


def test_what_a_joint_scaled_to_nothing_moves_is_part_of_its_parent(tmp_path: Path) -> None:
    builder = arm()
    builder.description["nodes"][3]["scale"] = [0.0, 0.0, 0.0]
    character = read_character(builder.write(tmp_path / "arm.glb"))
    rig = _rig_of(character)
    assert rig.joint_names == ("rig:LeftArm", "rig:LeftForeArm")
    assert np.abs(_skinned(rig, rig.rest) - character.rest_vertices).max() < 1e-12
    frames = character.sample("wave", None)
    assert frames.transforms is not None
    assert np.abs(_skinned(rig, frames.transforms[1]) - frames.vertices[1]).max() < 1e-12


def test_a_root_scaled_to_nothing_leaves_no_rig_and_a_sentence(tmp_path: Path) -> None:
    builder = arm()
    builder.description["nodes"][1]["scale"] = [1.0, 0.0, 1.0]
    character = read_character(builder.write(tmp_path / "arm.glb"))
    assert character.rig is None
    assert "joint rig:LeftArm has zero scale in its rest pose" in character.notes
    with pytest.raises(
        LCollisionError, match="be posed by its rig: joint rig:LeftArm has zero scale"
    ):
        RigPoseSpace(character)
    assert np.isfinite(character.sample("wave", None).vertices).all()


@pytest.mark.parametrize("is_first", [True, False])
def test_the_bones_of_an_avatar_are_what_its_description_says(
    is_first: bool, tmp_path: Path
) -> None:
    builder = arm()
    for number, name in ((1, "Bone"), (2, "Bone.001"), (3, "Knochen")):
        builder.description["nodes"][number]["name"] = name
    bones = {"leftUpperArm": 1, "leftLowerArm": 2, "leftHand": 3}
    if is_first:
        listed = [{"bone": bone, "node": node} for bone, node in bones.items()]
        extension = {"VRM": {"humanoid": {"humanBones": [*listed, {"node": "x"}, 7]}}}
    else:
        named = {bone: {"node": node} for bone, node in bones.items()} | {"jaw": None}
        extension = {"VRMC_vrm": {"humanoid": {"humanBones": named}}}
    builder.description["extensions"] = extension
    character = read_character(builder.write(tmp_path / "avatar.vrm"))
    rig = character.rig
    assert rig is not None
    assert rig.joint_names == tuple(bones)
    assert joint_roles(rig) == (Role.UPPER_ARM, Role.FOREARM, Role.HAND)
    assert set(joint_parts(character)) == {"Left upper arm", "Left forearm", "Left hand"}
    for damaged in ({"VRM": 3}, {"VRM": {"humanoid": []}}, {"VRMC_vrm": {"humanoid": {}}}):
        builder.description["extensions"] = damaged
        character = read_character(builder.write(tmp_path / "avatar.vrm"))
        assert character.rig is not None
        assert character.rig.joint_names == ("Bone", "Bone.001", "Knochen")
