"""A posed character in its own file: moved parts, and nothing else changed."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lcollision_core.bodies.rig_space import RigPoseSpace
from lcollision_core.errors import MeshFileError, ShapeError
from lcollision_core.files import (
    Character,
    CharacterForm,
    PosedFile,
    read_character,
    read_own_file,
    write_character,
)
from lcollision_core.files.character_writing import NewClip, write_character_clips
from lcollision_core.files.scene_files import open_scene
from lcollision_core.meshes.topology import FloatArray
from tests.core.character_file import PNG, described, figure, vectors
from tests.core.gltf_builder import GltfBuilder, rotation, split_corners, tube

SIZE = 3.0
FORMS = list(CharacterForm)


@pytest.fixture
def character(tmp_path: Path) -> Character:
    return read_character(figure().write(tmp_path / "figure.glb"))


def _space(character: Character) -> RigPoseSpace:
    return RigPoseSpace(character)


def _pose(character: Character) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and transforms of a pose in which all joints and the body turn."""
    space = _space(character)
    codes = np.random.default_rng(1).uniform(-0.4, 0.4, len(space.low))
    codes[space.are_shapes] = 0.0
    vertices = space.decode(codes[None])[0] * space.body_size
    return vertices.astype(np.float32), space.transforms(codes)


def _written(character: Character, form: CharacterForm, path: Path) -> tuple[np.ndarray, PosedFile]:
    vertices, transforms = _pose(character)
    return vertices, write_character(path, character, vertices, form, transforms)


def _vtk_vertices(path: Path) -> np.ndarray:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOGeometry import vtkGLTFReader

    reader = vtkGLTFReader()
    reader.SetFileName(str(path))
    reader.Update()
    iterator = reader.GetOutput().NewIterator()
    found = []
    while not iterator.IsDoneWithTraversal():
        points = iterator.GetCurrentDataObject().GetPoints()
        found.append(vtk_to_numpy(points.GetData()).astype(float))
        iterator.GoToNextItem()
    return np.concatenate(found)


def _distance_to_nearest(points: np.ndarray, others: np.ndarray) -> float:
    return float(np.linalg.norm(points[:, None] - others[None], axis=2).min(axis=1).max())


def test_clips_that_are_kept_play_as_they_did_beside_the_pose(
    character: Character, tmp_path: Path
) -> None:
    path = tmp_path / "posed.glb"
    vertices, transforms = _pose(character)
    posed = write_character(path, character, vertices, "joints", transforms, keep_clips=True)
    assert not any("left out" in note and "clip" in note for note in posed.notes)
    again = read_character(path)
    size = float(np.ptp(character.rest_vertices, axis=0).max())
    assert np.abs(again.rest_vertices - vertices).max() < 1e-5 * size
    assert list(again.clips.items()) == list(character.clips.items())
    assert character.file is not None
    # The camera's clip shows the pose.
    for name in ("wave", "walk"):
        before, after = (one.sample(name, None) for one in (character, again))
        np.testing.assert_array_equal(after.times, before.times)
        assert np.abs(after.vertices - before.vertices).max() < 1e-6 * size
    # Every key of the source is unchanged.
    old, new = (described(file)[0]["animations"] for file in (character.source, path))
    for was, now in zip(old, new, strict=True):
        assert now["channels"][: len(was["channels"])] == was["channels"]
        assert now["samplers"][: len(was["samplers"])] == was["samplers"]
    # The file is recognised, with its rules and clips.
    own = read_own_file(open_scene(path))
    assert own is not None
    np.testing.assert_allclose(own.vertices, again.rest_vertices, atol=1e-9)


def test_only_joints_keep_clips(character: Character, tmp_path: Path) -> None:
    vertices, _ = _pose(character)
    with pytest.raises(ShapeError, match="a pose with clips must be of the form joints, got mesh"):
        write_character(tmp_path / "posed.glb", character, vertices, "mesh", keep_clips=True)


def test_poses_as_a_clip_come_before_those_that_are_kept(
    character: Character, tmp_path: Path
) -> None:
    vertices, transforms = _pose(character)
    path = tmp_path / "clips.glb"
    clip = NewClip("poses", 30.0, transforms[None], [vertices])
    write_character_clips(path, character, [clip], lambda *_: None, keep_clips=True)
    again = read_character(path)
    assert list(again.clips) == ["poses", *character.clips]
    size = float(np.ptp(character.rest_vertices, axis=0).max())
    held = again.sample("poses", None).vertices[0]
    assert np.abs(held - vertices).max() < 1e-5 * size
    before, after = (one.sample("wave", None).vertices for one in (character, again))
    assert np.abs(after - before).max() < 1e-6 * size


def test_a_clip_that_stands_still_is_as_long_as_its_frames(
    character: Character, tmp_path: Path
) -> None:
    assert character.rig is not None
    path, still = tmp_path / "still.glb", np.tile(character.rig.rest, (4, 1, 1, 1))
    clip = NewClip("still", 10.0, still, [character.rest_vertices] * 4)
    write_character_clips(path, character, [clip], lambda *_: None)
    assert read_character(path).clips["still"] == pytest.approx(0.3)


@pytest.mark.parametrize("form", FORMS)
def test_readers_get_the_vertices_that_were_asked_for(
    form: CharacterForm, character: Character, tmp_path: Path
) -> None:
    path = tmp_path / "posed.glb"
    vertices, posed = _written(character, form, path)
    assert np.abs(vertices - character.rest_vertices).max() > 0.5
    assert np.abs(posed.vertices - vertices).max() < 1e-6 * SIZE
    again = read_character(path)
    assert len(again.joined) == len(character.joined)
    in_file = again.rest_vertices[again.joined]
    assert np.abs(in_file - posed.vertices[character.joined]).max() < 1e-12
    # VTK's reader has its own order of nodes.
    seen = _vtk_vertices(path)
    assert seen.shape == in_file.shape
    assert _distance_to_nearest(seen, in_file) < 1e-5 * SIZE
    assert _distance_to_nearest(in_file, seen) < 1e-5 * SIZE


def test_a_static_mesh_holds_what_was_checked_bit_for_bit(
    character: Character, tmp_path: Path
) -> None:
    path = tmp_path / "posed.glb"
    vertices, posed = _written(character, CharacterForm.MESH, path)
    assert np.array_equal(posed.vertices, vertices)
    description, _ = described(path)
    meshes = [node["mesh"] for node in description["nodes"] if "mesh" in node]
    stored = [
        vectors(path, primitive["attributes"]["POSITION"])
        for mesh in sorted(meshes)
        for primitive in description["meshes"][mesh]["primitives"]
    ]
    assert np.array_equal(np.concatenate(stored), vertices[character.joined])
    assert "skins" not in description
    assert not any("skin" in node for node in description["nodes"])
    assert set(description["meshes"][0]["primitives"][0]["attributes"]) == {
        "POSITION",
        "NORMAL",
        "TEXCOORD_0",
    }


@pytest.mark.parametrize("form", FORMS)
def test_what_makes_no_shape_stays(
    form: CharacterForm, character: Character, tmp_path: Path
) -> None:
    path = tmp_path / "posed.glb"
    _written(character, form, path)
    (before, data), (after, new_data) = described(Path(character.source)), described(path)
    assert new_data.startswith(data.rstrip(b"\0"))
    for name in ("materials", "textures", "images", "cameras", "extensionsUsed", "extensions"):
        assert after[name] == before[name]
    assert after["accessors"][: len(before["accessors"])] == before["accessors"]
    assert after["bufferViews"][: len(before["bufferViews"])] == before["bufferViews"]
    assert [mesh["name"] for mesh in after["meshes"]] == ["Body", "Core", "Hat"]
    assert [node["name"] for node in after["nodes"]][:8] == [n["name"] for n in before["nodes"]]
    assert after["nodes"][2]["extras"] == {"kept": True}
    assert after["nodes"][4]["extras"] == {"a": 1}
    for old, new in zip(before["meshes"], after["meshes"], strict=True):
        for one, other in zip(old["primitives"], new["primitives"], strict=True):
            assert other["indices"] == one["indices"]
            assert other.get("material") == one.get("material")
            kept = ("TEXCOORD_0",) if form is CharacterForm.MESH else tuple(one["attributes"])
            for name in kept:
                assert other["attributes"].get(name) == one["attributes"].get(name)


@pytest.mark.parametrize("form", FORMS)
def test_clips_that_would_hide_the_pose_are_left_out(
    form: CharacterForm, character: Character, tmp_path: Path
) -> None:
    path = tmp_path / "posed.glb"
    _, posed = _written(character, form, path)
    description, _ = described(path)
    assert [animation["name"] for animation in description["animations"]] == ["orbit"]
    assert posed.notes == ("clips left out, as they would hide the pose: wave, walk",)


@pytest.mark.parametrize("form", FORMS)
def test_an_untouched_frame_is_the_source(
    form: CharacterForm, character: Character, tmp_path: Path
) -> None:
    assert character.rig is not None
    path = tmp_path / "posed.glb"
    rest = character.rest_vertices
    posed = write_character(path, character, rest, form, character.rig.rest)
    assert np.abs(posed.vertices - rest).max() < 1e-6
    before, after = described(Path(character.source))[0], described(path)[0]
    if form is CharacterForm.JOINTS:
        assert after["nodes"] == before["nodes"]
    for old, new in zip(before["meshes"], after["meshes"], strict=True):
        for one, other in zip(old["primitives"], new["primitives"], strict=True):
            for name in ("POSITION", "NORMAL"):
                written = vectors(path, other["attributes"][name])
                stored = vectors(Path(character.source), one["attributes"][name])
                assert np.abs(written - stored).max() < 1e-6
    # An unmoved child of a joint is not changed.
    assert after["nodes"][6] == before["nodes"][6]


def test_joints_only_turn(character: Character, tmp_path: Path) -> None:
    space = _space(character)
    codes = np.where(space.joint_of_code == 2, 0.3, 0.0)
    vertices = space.decode(codes[None])[0] * space.body_size
    path = tmp_path / "posed.glb"
    write_character(path, character, vertices, "joints", space.transforms(codes))
    before, after = described(Path(character.source))[0], described(path)[0]
    joint = space.joint_of_code[np.flatnonzero(codes)[0]]
    changed = [i for i in range(len(before["nodes"])) if before["nodes"][i] != after["nodes"][i]]
    assert character.rig is not None
    assert changed == [int(character.rig.nodes[joint])]
    old, new = before["nodes"][changed[0]], after["nodes"][changed[0]]
    assert {name for name in new if new[name] != old.get(name)} == {"rotation"}


def test_a_morph_target_of_weight_0_is_the_source(character: Character, tmp_path: Path) -> None:
    path, back = tmp_path / "posed.glb", tmp_path / "back.glb"
    _written(character, CharacterForm.MORPH, path)
    description, binary = described(path)
    for mesh in description["meshes"]:
        assert mesh.pop("weights") == [1.0]
        assert mesh.pop("extras") == {"targetNames": ["pose"]}
    builder = GltfBuilder()
    builder.description, builder.blob = description, binary
    again = read_character(builder.write(back))
    in_file = again.rest_vertices[again.joined]
    assert np.abs(in_file - character.rest_vertices[character.joined]).max() < 1e-9


def test_a_morph_target_joins_those_that_are_there(tmp_path: Path) -> None:
    builder = figure()
    mesh = builder.description["meshes"][1]
    for primitive in mesh["primitives"]:
        n = builder.description["accessors"][primitive["attributes"]["POSITION"]]["count"]
        primitive["targets"] = [{"POSITION": builder.array(np.full((n, 3), 0.1))}]
    mesh["weights"], mesh["extras"] = [0.25], {"targetNames": ["smile"]}
    builder.description["nodes"][5]["weights"] = [0.5]
    character = read_character(builder.write(tmp_path / "figure.glb"))
    path = tmp_path / "posed.glb"
    _, posed = _written(character, CharacterForm.MORPH, path)
    again = read_character(path)
    in_file = again.rest_vertices[again.joined]
    assert np.abs(in_file - posed.vertices[character.joined]).max() < 1e-12
    description, _ = described(path)
    assert description["meshes"][1]["weights"] == [0.25, 1.0]
    assert description["nodes"][5]["weights"] == [0.5, 1.0]
    assert description["meshes"][1]["extras"] == {"targetNames": ["smile", "pose"]}
    # One of the mesh's primitives may have no targets.
    del mesh["primitives"][0]["targets"]
    character = read_character(builder.write(tmp_path / "figure.glb"))
    _, posed = _written(character, CharacterForm.MORPH, path)
    again = read_character(path)
    in_file = again.rest_vertices[again.joined]
    assert np.abs(in_file - posed.vertices[character.joined]).max() < 1e-12


def test_a_static_mesh_says_that_it_loses_its_morph_targets(tmp_path: Path) -> None:
    builder = figure()
    mesh, hat = builder.description["meshes"][1:3]
    for primitive in (*mesh["primitives"], *hat["primitives"]):
        n = builder.description["accessors"][primitive["attributes"]["POSITION"]]["count"]
        primitive["targets"] = [{"POSITION": builder.array(np.full((n, 3), 0.1))}]
    mesh["extras"] = {"targetNames": ["smile"], "kept": 1}
    # A hat that no joint moves keeps its own morph target.
    builder.add("nodes", name="Stand", mesh=2, translation=[3.0, 0.0, 0.0])
    builder.description["nodes"][6].pop("mesh")
    group = {"name": "joy", "binds": [{"mesh": 1, "index": 0}, {"mesh": 2, "index": 0}]}
    smile = {"morphTargetBinds": [{"node": 5, "index": 0}, {"node": 8, "index": 0}]}
    builder.description["extensions"] = {
        "VRM": {"blendShapeMaster": {"blendShapeGroups": [group]}},
        "VRMC_vrm": {"expressions": {"preset": {"happy": smile}}},
    }
    character = read_character(builder.write(tmp_path / "figure.vrm"))
    path = tmp_path / "posed.vrm"
    posed = write_character(path, character, character.rest_vertices, "mesh")
    assert "its morph targets are left out of the static mesh" in posed.notes
    description, _ = described(path)
    assert description["meshes"][1]["extras"] == {"kept": 1}
    extensions = description["extensions"]
    (group,) = extensions["VRM"]["blendShapeMaster"]["blendShapeGroups"]
    assert group == {"name": "joy", "binds": [{"mesh": 2, "index": 0}]}
    happy = extensions["VRMC_vrm"]["expressions"]["preset"]["happy"]
    assert happy == {"morphTargetBinds": [{"node": 8, "index": 0}]}
    _, posed = _written(character, CharacterForm.JOINTS, path)
    assert not any("morph" in note for note in posed.notes)
    assert described(path)[0]["extensions"] == builder.description["extensions"]


@pytest.mark.parametrize("form", FORMS)
def test_a_file_that_is_read_once_is_written_alike(
    form: CharacterForm, character: Character, tmp_path: Path
) -> None:
    path = tmp_path / "posed.glb"
    vertices, transforms = _pose(character)
    rest = _space(character).rig.rest
    write_character(path, character, character.rest_vertices, form, rest)
    again = write_character(path, character, vertices, form, transforms)
    data = path.read_bytes()
    alone = write_character(path, replace(character, file=None), vertices, form, transforms)
    assert path.read_bytes() == data
    assert again.notes == alone.notes


def test_a_mesh_that_two_nodes_show_becomes_two(tmp_path: Path) -> None:
    builder = figure()
    other = builder.add("nodes", name="Other hat", mesh=2, translation=[3.0, 0.0, 0.0])
    builder.description["nodes"][1]["children"].append(other)
    character = read_character(builder.write(tmp_path / "figure.glb"))
    path = tmp_path / "posed.glb"
    for form in (CharacterForm.MESH, CharacterForm.MORPH):
        _, posed = _written(character, form, path)
        again = read_character(path)
        assert len(again.joined) == len(character.joined)
        nearest = _distance_to_nearest(posed.vertices, again.rest_vertices)
        assert nearest < 1e-12


@pytest.mark.parametrize("form", [CharacterForm.MESH, CharacterForm.MORPH])
def test_normals_turn_with_the_pose_and_agree_at_seams(
    form: CharacterForm, character: Character, tmp_path: Path
) -> None:
    path = tmp_path / "posed.glb"
    vertices, _ = _written(character, form, path)
    description, _ = described(path)
    primitive = description["meshes"][0]["primitives"][0]
    normals = vectors(path, primitive["attributes"]["NORMAL"])
    if form is CharacterForm.MORPH:
        normals = normals + vectors(path, primitive["targets"][0]["NORMAL"])
    assert np.abs(np.linalg.norm(normals, axis=1) - 1.0).max() < 1e-6
    joined = character.joined[: len(normals)]
    for vertex in np.unique(joined):
        at_seam = normals[joined == vertex]
        assert np.abs(at_seam - at_seam[0]).max() < 1e-6
    # Normals of the sides still point away from the axis through the middle of each ring.
    vertices_in_file = vertices[joined]
    unposed = split_corners(*tube())[0]
    for height in np.unique(unposed[:, 1]):
        ring = (unposed[:, 1] == height) & (np.abs(unposed[:, [0, 2]]).max(axis=1) > 0.0)
        outwards = vertices_in_file[ring] - vertices_in_file[ring].mean(axis=0)
        assert (np.einsum("vi,vi->v", normals[ring], outwards) > 0.2).all()


def test_normals_of_a_body_that_turns_as_a_whole_turn_with_it(
    character: Character, tmp_path: Path
) -> None:
    path = tmp_path / "posed.glb"
    turn = Rotation.from_rotvec([0.4, -1.0, 0.2]).as_matrix()
    write_character(path, character, character.rest_vertices @ turn.T, "mesh")
    before, after = described(Path(character.source))[0], described(path)[0]
    for mesh in range(2):
        numbers = (one["meshes"][mesh]["primitives"][0]["attributes"] for one in (before, after))
        old, new = (number["NORMAL"] for number in numbers)
        stored = vectors(Path(character.source), old)
        assert np.abs(vectors(path, new) - stored @ turn.T).max() < 1e-6


def test_gltf_with_its_data_beside_it_becomes_one_file(tmp_path: Path) -> None:
    builder = figure()
    path = builder.write(tmp_path / "figure.gltf")
    description = json.loads(path.read_text())
    description["buffers"][0]["uri"] = "figure.bin"
    del description["images"][0]["bufferView"]
    del description["images"][0]["mimeType"]
    description["images"][0]["uri"] = "skin.png"
    description["images"].append({"uri": "missing.png"})
    path.write_text(json.dumps(description))
    (tmp_path / "figure.bin").write_bytes(builder.blob)
    (tmp_path / "skin.png").write_bytes(PNG)
    character = read_character(path)
    target = tmp_path / "elsewhere"
    target.mkdir()
    _, posed = _written(character, CharacterForm.MESH, target / "posed.glb")
    again = read_character(target / "posed.glb")
    in_file = again.rest_vertices[again.joined]
    assert np.array_equal(in_file, posed.vertices[character.joined])
    after, binary = described(target / "posed.glb")
    assert "uri" not in after["buffers"][0]
    image = after["images"][0]
    view = after["bufferViews"][image["bufferView"]]
    assert image["mimeType"] == "image/png"
    assert binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]] == PNG
    assert after["images"][1] == {"uri": "missing.png"}
    (note,) = [note for note in posed.notes if "texture" in note]
    assert note.startswith("texture 'missing.png' was not embedded")


def test_vrm_stays_vrm(tmp_path: Path) -> None:
    character = read_character(figure().write(tmp_path / "figure.vrm"))
    _, posed = _written(character, CharacterForm.JOINTS, tmp_path / "posed.vrm")
    again = read_character(tmp_path / "posed.vrm")
    assert np.abs(again.rest_vertices - posed.vertices).max() < 1e-12


def test_what_cannot_be_written_is_said_in_one_sentence(
    character: Character, tmp_path: Path
) -> None:
    vertices, transforms = _pose(character)
    path = tmp_path / "posed.glb"
    with pytest.raises(MeshFileError, match=r"posed\.fbx cannot be written: .*written as \.glb"):
        write_character(tmp_path / "posed.fbx", character, vertices, "mesh")
    with pytest.raises(ShapeError, match="with transforms"):
        write_character(path, character, vertices, "joints")
    with pytest.raises(ShapeError, match="vertices of figure"):
        write_character(path, character, vertices[1:], "mesh")
    assert not path.exists()
    detailed = vertices + np.random.default_rng(2).normal(0.0, 0.01, vertices.shape)
    posed = write_character(path, character, detailed, "joints", transforms)
    assert "written as a static mesh" in posed.notes[0]
    assert np.abs(posed.vertices - detailed).max() < 1e-6
    path.unlink()
    figure().write(Path(character.source)).write_bytes(b"glTF")
    with pytest.raises(MeshFileError, match=r"figure\.glb cannot be read"):
        write_character(path, character, vertices, "mesh")
    assert not path.exists()


def test_a_source_that_changed_is_refused(character: Character, tmp_path: Path) -> None:
    vertices, _ = _pose(character)
    other = figure()
    other.description["meshes"][2]["primitives"][0]["attributes"]["POSITION"] = other.array(
        tube(n_rings=2, height=0.3)[0][:-1]
    )
    other.description["meshes"][2]["primitives"][0]["indices"] = other.array(np.arange(3), "u2")
    other.write(Path(character.source))
    with pytest.raises(MeshFileError, match="is not the file that the character was read from"):
        write_character(tmp_path / "posed.glb", character, vertices, "mesh")
    # It is also refused if only its vertices have moved.
    other = figure()
    other.description["nodes"][1]["translation"] = [0.0, 1.0, -50.0]
    other.write(Path(character.source))
    with pytest.raises(MeshFileError, match=r"is not the file .*; open it again"):
        write_character(tmp_path / "posed.glb", character, vertices, "mesh")


@pytest.mark.parametrize(
    ("places", "value", "sentence"),
    [
        (("nodes", 7, "children"), "", "children of nodes 7 must be a list of whole numbers, got"),
        (
            ("animations", 2, "channels", 0, "target"),
            None,
            "animation 2 has channels without target",
        ),
        (("bufferViews", 0, "buffer"), 7, "the buffer of buffer view 0 must be a whole number"),
    ],
)
def test_damage_that_reading_passes_over_is_one_sentence(
    tmp_path: Path, places: tuple[str | int, ...], value: object, sentence: str
) -> None:
    builder = figure()
    character = read_character(builder.write(tmp_path / "figure.glb"))
    held: Any = builder.description
    for place in places[:-1]:
        held = held[place]
    held[places[-1]] = value
    builder.write(tmp_path / "figure.glb")
    for form in (CharacterForm.MESH, CharacterForm.MORPH):
        with pytest.raises(MeshFileError, match=r"figure\.glb cannot be read: ") as caught:
            write_character(tmp_path / "posed.glb", character, character.rest_vertices, form)
        assert sentence in str(caught.value)
    assert not (tmp_path / "posed.glb").exists()


def _shaped(**transforms: Any) -> GltfBuilder:
    """Build the figure with some nodes scaled, or placed by a matrix, in the rest pose."""
    builder = figure()
    nodes = builder.description["nodes"]
    for number in (1, 2, 3):
        # Not along the parent's axes.
        nodes[number]["rotation"] = rotation(number % 3, 0.7)
    for node in nodes:
        node |= transforms.get(node["name"], {})
        if "matrix" in node:
            for name in ("translation", "rotation", "scale"):
                node.pop(name, None)
    return builder


UNEVEN = [1.05, 1.0, 1.0]
MATRIX = np.diag([2.0, 1.0, 0.5, 1.0])
MATRIX[:3, 3] = [0.0, 0.0, -100.0]
SCALED: dict[str, dict[str, Any]] = {
    "root": {"LeftArm": {"scale": UNEVEN}},
    "middle": {"LeftForeArm": {"scale": UNEVEN}},
    "leaf": {"LeftHand": {"scale": UNEVEN}},
    "above the root": {"Armature": {"scale": [0.01, 0.02, 0.01]}},
    "several": {"LeftArm": {"scale": [1.3, 1.0, 0.8]}, "LeftForeArm": {"scale": [0.5, 1.5, 1.0]}},
    "reflected": {"LeftArm": {"scale": [1.0, -1.4, 1.0]}, "LeftForeArm": {"scale": [1, 1, -0.7]}},
    "by a matrix": {"LeftForeArm": {"matrix": MATRIX.T.reshape(-1).tolist()}},
}


@pytest.mark.parametrize("scaled", SCALED.values(), ids=SCALED)
def test_joints_of_a_rig_that_is_scaled_unevenly_hold_its_poses(
    scaled: dict[str, Any], tmp_path: Path
) -> None:
    character = read_character(_shaped(**scaled).write(tmp_path / "figure.glb"))
    path = tmp_path / "posed.glb"
    vertices, posed = _written(character, CharacterForm.JOINTS, path)
    size = float(np.ptp(character.rest_vertices, axis=0).max())
    assert np.abs(vertices - character.rest_vertices).max() > 0.05 * size
    assert not any("static mesh" in note for note in posed.notes)
    assert np.abs(posed.vertices - vertices).max() < 1e-5 * size
    again = read_character(path)
    assert np.abs(again.rest_vertices - posed.vertices).max() < 1e-12 * size
    seen, in_file = _vtk_vertices(path), again.rest_vertices[again.joined]
    assert _distance_to_nearest(seen, in_file) < 1e-5 * size
    assert _distance_to_nearest(in_file, seen) < 1e-5 * size
    before, after = described(Path(character.source))[0], described(path)[0]
    for old, new in zip(before["nodes"], after["nodes"], strict=True):
        assert new.get("scale") == old.get("scale") or "matrix" in old


def test_the_last_row_of_a_matrix_is_that_of_any_transform(tmp_path: Path) -> None:
    matrix = [0.01, 0.0, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.0, 0.01, 0.0, 5.0, 0.0, 0.0, 0.0]
    builder = _shaped(Armature={"matrix": matrix})
    character = read_character(builder.write(tmp_path / "figure.glb"))
    path = tmp_path / "posed.glb"
    vertices, posed = _written(character, CharacterForm.JOINTS, path)
    assert not any("static mesh" in note for note in posed.notes)
    size = float(np.ptp(character.rest_vertices, axis=0).max())
    assert np.abs(read_character(path).rest_vertices - vertices).max() < 1e-5 * size


def test_a_clip_of_a_rig_that_is_scaled_unevenly_is_held_by_its_joints(tmp_path: Path) -> None:
    character = read_character(_shaped(**SCALED["several"]).write(tmp_path / "figure.glb"))
    space, path = _space(character), tmp_path / "clip.glb"
    codes = np.random.default_rng(3).uniform(-0.5, 0.5, (3, len(space.low)))
    vertices = space.decode(codes) * space.body_size
    transforms = np.stack([space.transforms(one) for one in codes])
    clip = NewClip("poses", 10.0, transforms, vertices)
    frames: list[FloatArray] = []
    write_character_clips(path, character, [clip], lambda _, frame: frames.append(frame))
    reread = read_character(path)
    assert reread.rate("poses") == 10.0
    again = reread.sample("poses", None).vertices
    for wanted, frame, held in zip(vertices, frames, again, strict=True):
        assert np.abs(frame - wanted).max() < 1e-5 * space.body_size
        assert np.abs(held - frame).max() < 1e-6 * space.body_size


def test_what_joints_cannot_hold_is_written_as_a_mesh_and_said(tmp_path: Path) -> None:
    sheared = np.eye(4)
    sheared[0, 1], sheared[2, 3] = 0.5, -100.0
    builder = _shaped(LeftForeArm={"matrix": sheared.T.reshape(-1).tolist()})
    character = read_character(builder.write(tmp_path / "figure.glb"))
    path = tmp_path / "posed.glb"
    vertices, posed = _written(character, CharacterForm.JOINTS, path)
    assert "its joints cannot reproduce this pose (vertices would be off by 0." in posed.notes[0]
    assert posed.notes[0].endswith("of the body size), so it is written as a static mesh")
    assert np.array_equal(posed.vertices, vertices)
    again = read_character(path)
    assert again.rig is None
    in_file = again.rest_vertices[again.joined]
    assert np.abs(in_file - vertices[character.joined]).max() < 1e-6
    # A joint above it can be turned.
    space = _space(character)
    codes = np.where(space.joint_of_code == 0, 0.3, 0.0)
    turned = space.decode(codes[None])[0] * space.body_size
    posed = write_character(path, character, turned, "joints", space.transforms(codes))
    assert read_character(path).rig is not None
    assert np.abs(posed.vertices - turned).max() < 1e-5 * space.body_size
    # A clip has no other form.
    transforms = np.stack([_pose(character)[1]] * 2)
    sentence = r"figure\.glb cannot be written with these poses: its joints .*; write a point cache"
    clip = NewClip("poses", 30.0, transforms, [vertices] * 2)
    with pytest.raises(MeshFileError, match=sentence):
        write_character_clips(path, character, [clip], lambda *_: None)
