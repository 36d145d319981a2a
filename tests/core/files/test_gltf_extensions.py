"""glTF extensions that are read, refused, or reported as ignored."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from lcollision_core.errors import MeshFileError
from lcollision_core.files import CharacterForm, read_character, read_mesh, write_character
from lcollision_core.files.gltf.schema import GltfDocument
from lcollision_core.files.scene.joined import join_parts
from lcollision_core.files.scene.scene import Scene
from lcollision_core.files.scene_files import read_scene
from tests.core.gltf_builder import GltfBuilder, arm, rotation, tube

HIDDEN = {"KHR_node_visibility": {"visible": False}}


def _tubes(**node: Any) -> GltfBuilder:
    """Build a tube shown by a node with the given fields, and mesh 1, a copy of its mesh."""
    builder = GltfBuilder()
    vertices, faces = tube()
    attributes = {"POSITION": builder.array(vertices)}
    primitive = {"attributes": attributes, "indices": builder.array(faces.reshape(-1), "u2")}
    for name in ("Tube", "Copy"):
        builder.add("meshes", name=name, primitives=[primitive])
    builder.add("nodes", **{"name": "First", "mesh": 0} | node)
    return builder


def _instanced(builder: GltfBuilder, node: int, **attributes: int) -> None:
    extension = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    builder.description["nodes"][node]["extensions"] = extension
    builder.description["extensionsUsed"] = ["EXT_mesh_gpu_instancing"]
    builder.description["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]


def _names(scene: Scene) -> list[str]:
    return [scene.node_names[part.node] for part in scene.parts]


def test_instances_are_as_many_shapes_and_follow_their_node(tmp_path: Path) -> None:
    builder = _tubes(translation=[0.0, 0.0, 2.0])
    places = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 5.0, 0.0]])
    turns = Rotation.from_rotvec(np.outer([0.0, 0.5, 1.0], [1.0, 0.0, 0.0]))
    # A mirrored instance has reversed winding.
    scales = np.array([[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0], [0.5, 0.5, 2.0]])
    turned = builder.array(np.round(turns.as_quat() * 32767.0), "i2", normalized=True)
    placed = builder.array(places)
    _instanced(builder, 0, TRANSLATION=placed, ROTATION=turned, SCALE=builder.array(scales))
    channel = {"node": 0, "path": "translation", "times": [0.0, 1.0]}
    builder.animation("up", channel | {"values": [[0.0, 0.0, 2.0], [0.0, 9.0, 2.0]]})
    path = builder.write(tmp_path / "m.glb")
    vertices, faces = tube()
    expected = [
        turn.apply(vertices * scale) + place + [0.0, 0.0, 2.0]
        for turn, scale, place in zip(turns, scales, places, strict=True)
    ]
    mesh = read_mesh(path)
    assert np.allclose(mesh.vertices, np.concatenate(expected), atol=1e-3)
    volumes = [
        trimesh.Trimesh(mesh.vertices, some, process=False).volume
        for some in np.split(mesh.faces, 3)
    ]
    whole = trimesh.Trimesh(vertices, faces, process=False).volume
    assert np.allclose(volumes, np.array([1.0, 1.0, 0.5]) * whole, rtol=1e-3)
    scene = read_scene(path)
    moved = join_parts(scene).posed(scene.clips[0].sample(np.array([1.0])))[0]
    assert np.allclose(moved - mesh.vertices, [0.0, 9.0, 0.0], atol=1e-9)


def test_instances_on_a_joint_are_posed_and_written_with_it(tmp_path: Path) -> None:
    builder = arm(split=False)
    vertices, faces = tube()
    primitive = {
        "attributes": {"POSITION": builder.array(vertices * 0.05)},
        "indices": builder.array(faces.reshape(-1), "u2"),
    }
    beads = builder.add("meshes", name="Bead", primitives=[primitive])
    node = builder.add("nodes", name="Beads", mesh=beads)
    builder.description["nodes"][3]["children"] = [node]
    _instanced(builder, node, TRANSLATION=builder.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]))
    character = read_character(builder.write(tmp_path / "m.glb"))
    assert len(character.rest_vertices) == 3 * len(vertices)
    assert character.rig is not None
    frames = character.sample("wave", None)
    assert frames.transforms is not None
    out = tmp_path / "posed.glb"
    write_character(out, character, frames.vertices[1], "joints", frames.transforms[1])
    assert np.allclose(read_character(out).rest_vertices, frames.vertices[1], atol=1e-5)
    with pytest.raises(MeshFileError, match=r"'?Beads'? shows a mesh 2 times, .*choose joints"):
        write_character(out, character, frames.vertices[1], CharacterForm.MORPH)


def test_instances_of_a_skinned_mesh_are_shown_once_and_said(tmp_path: Path) -> None:
    builder = arm(split=False)
    (primitive,) = builder.description["meshes"][0]["primitives"]
    normals = np.tile([0.0, 0.0, 1.0], (len(tube()[0]), 1))
    primitive["attributes"]["NORMAL"] = builder.array(normals)
    _instanced(builder, 4, TRANSLATION=builder.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]))
    character = read_character(builder.write(tmp_path / "m.glb"))
    assert len(character.rest_vertices) == len(tube()[0])
    note = "instances of skinned meshes (EXT_mesh_gpu_instancing) are shown once: Body"
    assert note in character.notes
    out = tmp_path / "posed.glb"
    write_character(out, character, character.rest_vertices, CharacterForm.MORPH)
    assert np.allclose(read_mesh(out).vertices, character.rest_vertices, atol=1e-5)


def test_custom_attributes_alone_say_how_many_instances_there_are(tmp_path: Path) -> None:
    builder = _tubes()
    _instanced(builder, 0, _FEATURE_ID=builder.array(np.arange(3.0)[:, None]))
    (part,) = read_scene(builder.write(tmp_path / "m.glb")).parts
    np.testing.assert_allclose(part.points, np.tile(tube()[0], (3, 1)), atol=1e-6)
    assert len(part.faces) == 3 * len(tube()[1])


def test_instances_of_another_number_are_refused(tmp_path: Path) -> None:
    builder = _tubes()
    _instanced(
        builder,
        0,
        TRANSLATION=builder.array(np.zeros((3, 3))),
        SCALE=builder.array(np.ones((2, 3))),
    )
    with pytest.raises(
        MeshFileError, match="the scales of the instances of node 0 have 2 values, 3"
    ):
        read_scene(builder.write(tmp_path / "m.glb"))


def test_hidden_nodes_and_all_below_them_are_left_out_and_said(tmp_path: Path) -> None:
    builder = _tubes()
    builder.add("nodes", name="Wardrobe", extensions=HIDDEN, children=[2, 3])
    builder.add("nodes", name="Hat", mesh=1)
    builder.add("nodes", name="Coat", mesh=1, extensions={"KHR_node_visibility": {"visible": True}})
    builder.description["extensionsRequired"] = ["KHR_node_visibility"]
    scene = read_scene(builder.write(tmp_path / "m.glb"))
    assert _names(scene) == ["First"]
    assert scene.notes == ("left out, as its file hides it: Hat, Coat",)
    builder.description["nodes"][0]["extensions"] = HIDDEN
    with pytest.raises(MeshFileError, match=r"it shows no triangles .*hides it: First"):
        read_scene(builder.write(tmp_path / "m.glb"))


def test_a_file_of_lines_says_so_beside_what_it_hides(tmp_path: Path) -> None:
    builder = arm()
    primitive = builder.description["meshes"][0]["primitives"][0]
    builder.add("nodes", name="Hidden", mesh=0, extensions=HIDDEN)
    primitive["mode"] = 2
    with pytest.raises(MeshFileError, match=r"hides it: Hidden; 1 part without triangles \(points"):
        read_scene(builder.write(tmp_path / "m.glb"))


def test_levels_of_detail_below_the_finest_are_left_out_and_said(tmp_path: Path) -> None:
    builder = _tubes(extensions={"MSFT_lod": {"ids": [1, 2]}})
    builder.add("nodes", name="Coarse", mesh=1)
    builder.add("nodes", name="Coarser", children=[3])
    builder.add("nodes", name="Box", mesh=1)
    scene = read_scene(builder.write(tmp_path / "m.glb"))
    assert _names(scene) == ["First"]
    assert scene.notes == ("left out, as a lower level of detail: Coarse, Box",)


@pytest.mark.parametrize(
    ("extension", "annotation"),
    [
        ("VRMC_vrm", {"node": 1, "type": "firstPersonOnly"}),
        ("VRM", {"mesh": 1, "firstPersonFlag": "FirstPersonOnly"}),
    ],
)
def test_what_only_its_wearer_sees_is_left_out_and_said(
    tmp_path: Path, extension: str, annotation: dict[str, Any]
) -> None:
    kind = "type" if extension == "VRMC_vrm" else "firstPersonFlag"
    others = [{"node": 0, "mesh": 0, kind: "thirdPersonOnly"}]
    builder = _tubes()
    builder.add("nodes", name="Headless", mesh=1)
    seen = {"firstPerson": {"meshAnnotations": [annotation, *others]}}
    builder.description["extensions"] = {extension: seen}
    scene = read_scene(builder.write(tmp_path / "m.vrm"))
    assert _names(scene) == ["First"]
    assert scene.notes == ("left out, as only the wearer of the avatar sees it: Headless",)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (
            "KHR_gaussian_splatting",
            "needs the extension 'KHR_gaussian_splatting', which may change",
        ),
        (
            "ACME_subdivision",
            "needs the extension 'ACME_subdivision', which may .*; export it without",
        ),
    ],
)
def test_a_required_extension_of_shapes_that_is_not_read_is_refused(
    tmp_path: Path, name: str, said: str
) -> None:
    builder = _tubes()
    builder.description["extensionsUsed"] = [name]
    builder.description["extensionsRequired"] = [name]
    with pytest.raises(MeshFileError, match=said):
        read_scene(builder.write(tmp_path / "m.glb"))


@pytest.mark.parametrize(
    "name",
    [
        *("KHR_materials_unlit", "KHR_texture_transform", "KHR_texture_basisu", "EXT_texture_webp"),
        *(
            "KHR_lights_punctual",
            "EXT_lights_image_based",
            "KHR_xmp_json_ld",
            "VRMC_materials_mtoon",
        ),
        *("EXT_structural_metadata", "KHR_mesh_quantization", "MSFT_packing_occlusionRoughness"),
        *("GODOT_single_root", "FB_ngon_encoding", "EXT_mesh_manifold"),
    ],
)
def test_a_required_extension_of_the_appearance_is_no_reason_to_refuse(
    tmp_path: Path, name: str
) -> None:
    builder = _tubes()
    builder.description["extensionsRequired"] = builder.description["extensionsUsed"] = [name]
    assert not read_scene(builder.write(tmp_path / "m.glb")).notes


def test_an_optional_extension_that_is_not_read_is_said(tmp_path: Path) -> None:
    builder = arm()
    used = ["KHR_materials_unlit", "ACME_subdivision", "VRMC_springBone", "VRMC_node_constraint"]
    builder.description["extensionsUsed"] = used
    roll = {"roll": {"source": 1, "rollAxis": "X", "weight": 0.5}}
    held = {"VRMC_node_constraint": {"specVersion": "1.0", "constraint": roll}}
    builder.description["nodes"][3]["extensions"] = held
    assert read_scene(builder.write(tmp_path / "m.glb")).notes == (
        "constraints of nodes (VRMC_node_constraint) are not followed: rig:LeftHand",
        "its extension 'ACME_subdivision', which may change its shape or pose, is not read",
        "its extension 'VRMC_springBone', which may change its shape or pose, is not read",
    )


def test_quantised_positions_are_read_as_their_numbers(tmp_path: Path) -> None:
    builder = _tubes(scale=[0.01, 0.01, 0.01])
    vertices, _ = tube()
    whole = builder.array(np.round(vertices * 100.0), "i2")
    builder.description["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = whole
    builder.description["extensionsRequired"] = ["KHR_mesh_quantization"]
    path = builder.write(tmp_path / "m.glb")
    assert np.abs(read_mesh(path).vertices - vertices).max() < 0.0051


def _optional_meshopt() -> GltfBuilder:
    builder = arm()
    used = {"buffer": 0, "byteLength": 16, "byteStride": 12, "count": 4, "mode": "ATTRIBUTES"}
    builder.description["bufferViews"][0]["extensions"] = {"EXT_meshopt_compression": used}
    draco = {"bufferView": 0, "attributes": {"POSITION": 0}}
    primitive = builder.description["meshes"][0]["primitives"][0]
    primitive["extensions"] = {"KHR_draco_mesh_compression": draco, "X_other": {}}
    names = ["EXT_meshopt_compression", "KHR_draco_mesh_compression"]
    builder.description["extensionsUsed"] = names
    return builder


def test_compressed_copies_of_plain_data_are_left_aside_and_not_written(tmp_path: Path) -> None:
    path = _optional_meshopt().write(tmp_path / "m.glb")
    plain = read_mesh(arm().write(tmp_path / "plain.glb"))
    assert np.array_equal(read_mesh(path).vertices, plain.vertices)
    character = read_character(path)
    vertices = character.rest_vertices + [0.0, 0.0, 1.0]
    write_character(tmp_path / "posed.glb", character, vertices, CharacterForm.MESH)
    # Readers that can decompress would show the compressed copy instead of the pose.
    written = GltfDocument((tmp_path / "posed.glb").read_bytes(), tmp_path).description
    assert "extensionsUsed" not in written
    assert not any("extensions" in view for view in written["bufferViews"])
    assert written["meshes"][0]["primitives"][0]["extensions"] == {"X_other": {}}


def test_compressed_data_without_a_plain_copy_is_what_is_read(tmp_path: Path) -> None:
    builder = _optional_meshopt()
    primitive = builder.description["meshes"][0]["primitives"][0]
    del builder.description["accessors"][primitive["attributes"]["POSITION"]]["bufferView"]
    with pytest.raises(MeshFileError, match=r"compressed data \(Draco\) are damaged"):
        read_scene(builder.write(tmp_path / "m.glb"))
    builder = _optional_meshopt()
    builder.description["bufferViews"][0]["buffer"] = 1
    path = builder.write(tmp_path / "m.gltf")
    described = json.loads(path.read_text())
    fallback = {"EXT_meshopt_compression": {"fallback": True}}
    described["buffers"].append(described["buffers"][0] | {"extensions": fallback})
    del described["buffers"][1]["uri"]
    path.write_text(json.dumps(described))
    with pytest.raises(MeshFileError, match=r"compressed data \(meshopt\) are damaged"):
        read_scene(path)


def test_pointers_to_transforms_are_followed_and_others_said(tmp_path: Path) -> None:
    builder = arm()
    values = [rotation(0, 0.0), rotation(0, 1.2), rotation(0, -0.5)]
    turn = {"node": 2, "path": "rotation", "times": [0.0, 0.4, 1.0], "values": values}
    builder.animation("same", turn, turn | {"node": 1}, turn | {"node": 0})
    for channel, pointer in zip(
        builder.description["animations"][1]["channels"],
        ("rotation", "extensions/KHR_node_visibility/visible", "weights/0"),
        strict=True,
    ):
        node = channel["target"].pop("node")
        named = {"pointer": f"/nodes/{node}/{pointer}"}
        channel["target"] |= {
            "path": "pointer",
            "extensions": {"KHR_animation_pointer": named},
        }
    builder.description["extensionsUsed"] = ["KHR_animation_pointer", "KHR_node_visibility"]
    scene = read_scene(builder.write(tmp_path / "m.glb"))
    assert scene.notes == (
        "its clips animate unsupported properties: visibility of rig:LeftArm, weights of Rig",
    )
    by_pointer = scene.clips[1].sample(np.array([0.4])).transforms[0, 2, :3, :3]
    by_node = scene.clips[0].sample(np.array([0.4])).transforms[0, 2, :3, :3]
    assert np.allclose(by_pointer, by_node)
