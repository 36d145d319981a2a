"""An FBX character as an equivalent rigged GLB."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lcollision_core.files import Character, ClipFrames, GltfCharacter, as_gltf, read_character
from lcollision_core.files.changed_clips import changed_gltf
from lcollision_core.files.gltf.schema import GltfDocument
from tests.core.fbx_builder import arm_fbx, character_fbx, ufbx_frames
from tests.core.motion.swings import CLIP, N_FRAMES, OTHER, swinging_body
from tests.core.vtk_gltf import vtk_corners

pytest.importorskip("ufbx")


def _written(made: GltfCharacter, path: Path) -> Character:
    """Write a character with all its clips unchanged, and read it again."""
    path.write_bytes(changed_gltf(made.character, []))
    return read_character(path)


def _document(character: Character) -> GltfDocument:
    assert character.file is not None
    return character.file.document


def test_each_frame_of_each_clip_is_where_ufbx_has_it(tmp_path: Path) -> None:
    path = character_fbx(swinging_body(), tmp_path / "swing.fbx")
    character = read_character(path)
    made = as_gltf(character)
    again = _written(made, tmp_path / "swing.glb")
    assert (again.metres, again.up.tolist()) == (1.0, [0.0, 1.0, 0.0])
    assert list(again.clips) == [CLIP, OTHER]
    size = float(np.ptp(again.rest_vertices, axis=0).max())
    rows = made.to_read[character.joined]
    for number, clip in enumerate(again.clips):
        frames = again.sample(clip, again.rate(clip))
        assert len(frames.times) == N_FRAMES
        expected = ufbx_frames(path, number, (np.arange(N_FRAMES) / 30.0).tolist())
        # From z up, in centimetres.
        expected = 0.01 * expected[..., [0, 2, 1]] * [1.0, 1.0, -1.0]
        assert np.ptp(expected, axis=0).max() > 0.01 * size
        assert np.abs(frames.vertices[:, rows] - expected).max() < 1e-6 * size


def test_its_skeleton_keeps_names_parents_and_order(tmp_path: Path) -> None:
    character = read_character(character_fbx(swinging_body(), tmp_path / "swing.fbx"))
    again = _written(as_gltf(character), tmp_path / "swing.glb")
    before, after = character.rig, again.rig
    assert before is not None
    assert after is not None
    assert after.joint_names == before.joint_names
    np.testing.assert_array_equal(after.parents, before.parents)
    used = before.weights.shape[1]
    assert not after.weights[:, used:].any()
    np.testing.assert_array_equal(after.joint_of[:, :used], before.joint_of)
    np.testing.assert_allclose(after.weights[:, :used], before.weights, atol=1e-7)
    np.testing.assert_array_equal(again.topology.faces, character.topology.faces)


def test_vtk_s_reader_sees_the_same_rest_pose(tmp_path: Path) -> None:
    character = read_character(character_fbx(swinging_body(), tmp_path / "swing.fbx"))
    made = as_gltf(character)
    _written(made, tmp_path / "swing.glb")
    seen = vtk_corners(tmp_path / "swing.glb")
    faces = character.topology.faces
    expected = made.frame.apply(character.rest_vertices)[faces.reshape(-1)]
    assert np.abs(seen.reshape(-1, 3) - expected).max() < 1e-6 * np.ptp(expected)


def test_its_colours_texture_coordinates_and_normals_come_along(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 255, (4, 4, 3), dtype=np.uint8)
    Image.fromarray(picture).save(tmp_path / "paint.png")
    body = swinging_body()
    character = read_character(character_fbx(body, tmp_path / "swing.fbx", texture="paint.png"))
    again = _written(as_gltf(character), tmp_path / "swing.glb")
    document, (mesh,) = _document(again), _document(again).objects("meshes")
    red, painted = document.objects("materials")
    assert (red["name"], painted["name"]) == ("Red", "Painted")
    assert red["pbrMetallicRoughness"]["baseColorFactor"] == [1.0, 0.0, 0.0, 1.0]
    assert painted["pbrMetallicRoughness"]["baseColorTexture"] == {"index": 0}
    (image,) = document.objects("images")
    assert document.image(image, "image 0") == (tmp_path / "paint.png").read_bytes()
    half = len(body.topology.faces) // 2
    counts = [
        len(document.array(one["indices"], "indices", ("SCALAR",))) for one in mesh["primitives"]
    ]
    assert counts == [3 * half, 3 * (len(body.topology.faces) - half)]
    before, after = character.look(), again.look()
    assert before is not None
    assert after is not None
    # Without a texture, coordinates do not matter.
    in_file, read = (look.uv[look.faces][half:] for look in (after, before))
    np.testing.assert_array_equal(in_file, read)
    np.testing.assert_array_equal(after.colours[after.faces], before.colours[before.faces])
    # Each face has its own normal, rotated upright with it.
    attributes = mesh["primitives"][0]["attributes"]
    normals = document.array(attributes["NORMAL"], "normals", ("VEC3",))
    faces = document.array(mesh["primitives"][0]["indices"], "indices", ("SCALAR",)).reshape(-1, 3)
    a, b, c = np.moveaxis(body.rest_vertices[body.topology.faces[:half]], 1, 0)
    expected = np.cross(b - a, c - a)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(normals[faces[:, 0]], expected, atol=1e-6)


def test_a_texture_of_another_format_becomes_png(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 255, (4, 4, 3), dtype=np.uint8)
    Image.fromarray(picture).save(tmp_path / "paint.tga")
    path = character_fbx(swinging_body(), tmp_path / "swing.fbx", texture="paint.tga")
    document = _document(as_gltf(read_character(path)).character)
    (image,) = document.objects("images")
    assert image["mimeType"] == "image/png"
    (tmp_path / "held.png").write_bytes(document.image(image, "image 0"))
    held = np.asarray(Image.open(tmp_path / "held.png").convert("RGB"))
    np.testing.assert_array_equal(held, picture)


def test_a_texture_that_is_missing_is_said(tmp_path: Path) -> None:
    path = character_fbx(swinging_body(), tmp_path / "swing.fbx", texture="paint.png")
    made = as_gltf(read_character(path))
    assert any("paint.png" in note and "is not beside the file" in note for note in made.notes)
    assert made.notes[0].startswith("FBX can't be written, so swing.fbx comes back as GLB")


def test_joints_that_their_parent_does_not_stretch_move_as_they_did(tmp_path: Path) -> None:
    path = character_fbx(swinging_body(), tmp_path / "swing.fbx", stretched="Spine")
    character = read_character(path)
    made = as_gltf(character)
    (note,) = made.notes[1:]
    assert "moved to the root" in note
    assert note.endswith(": LeftArm")
    assert sorted(made.joints) == list(range(len(made.joints))) != made.joints.tolist()
    again = _written(made, tmp_path / "swing.glb")
    size = float(np.ptp(again.rest_vertices, axis=0).max())
    for clip in again.clips:
        before, after = (one.sample(clip, 30.0) for one in (character, again))
        off = after.vertices[:, made.to_read] - made.frame.apply(before.vertices)
        assert np.abs(off).max() < 1e-6 * size


def test_vertices_of_many_joints_keep_all_their_weights(tmp_path: Path) -> None:
    body, n_joints = swinging_body(), 6
    assert body.rig is not None
    n = len(body.rest_vertices)
    weights = np.random.default_rng(0).dirichlet(np.ones(n_joints), n)
    rig = replace(
        body.rig,
        joint_of=np.tile(np.arange(n_joints, dtype=np.int32), (n, 1)),
        weights=weights,
        points=np.repeat(body.rest_vertices[:, None], n_joints, axis=1),
    )
    character = read_character(character_fbx(replace(body, rig=rig), tmp_path / "many.fbx"))
    again = _written(as_gltf(character), tmp_path / "many.glb")
    (mesh,) = _document(again).objects("meshes")
    names = set(mesh["primitives"][0]["attributes"])
    assert {"JOINTS_0", "WEIGHTS_0", "JOINTS_1", "WEIGHTS_1"} <= names
    assert "JOINTS_2" not in names
    assert again.rig is not None
    held = np.sort(again.rig.weights)[:, -n_joints:]
    np.testing.assert_allclose(held, np.sort(weights), atol=1e-6)
    # Programs that read only four influences get the strongest.
    first = mesh["primitives"][0]["attributes"]["WEIGHTS_0"]
    stored = _document(again).array(first, "weights", ("VEC4",))
    assert stored.sum(axis=1).min() >= np.sort(weights)[:, -4:].sum(axis=1).min() - 1e-6


def test_blend_shapes_and_their_keys_come_along(tmp_path: Path) -> None:
    path = arm_fbx(tmp_path / "arm.fbx")
    character = read_character(path)
    again = _written(as_gltf(character), tmp_path / "arm.glb")
    assert _document(again).objects("meshes")[0]["weights"] == [0.5]
    size = float(np.ptp(again.rest_vertices, axis=0).max())
    expected = 0.01 * ufbx_frames(path, 0, [0.0, 0.5, 1.0])
    frames = again.sample("wave", 2.0).vertices[:, again.joined]
    assert np.abs(frames - expected).max() < 1e-6 * size


def test_a_clip_that_begins_before_0_begins_at_0(tmp_path: Path) -> None:
    body = swinging_body()

    def sample(clip: str, fps: float | None) -> ClipFrames:
        frames = body.sample(clip, fps)
        return replace(frames, times=frames.times - 0.5)

    character = read_character(character_fbx(replace(body, sample=sample), tmp_path / "early.fbx"))
    made = as_gltf(character)
    again = _written(made, tmp_path / "early.glb")
    assert made.delays == {CLIP: pytest.approx(0.5), OTHER: pytest.approx(0.5)}
    assert again.sample(CLIP, 30.0).times[0] == 0.0
    before, after = (one.sample(CLIP, 30.0).vertices for one in (character, again))
    off = after[:, made.to_read] - made.frame.apply(before)
    assert np.abs(off).max() < 1e-6 * np.ptp(after)


def test_dual_quaternions_are_said(tmp_path: Path) -> None:
    made = as_gltf(read_character(arm_fbx(tmp_path / "arm.fbx", skinning="DualQuaternion")))
    assert any("dual quaternions" in note for note in made.notes)


@pytest.mark.parametrize(
    "name", ["blender_279_sausage_7400_binary.fbx", "maya_advanced_skinned_pivot_7700_binary.fbx"]
)
def test_real_files_come_back(name: str, characters: Path, tmp_path: Path) -> None:
    character = read_character(characters / name)
    made = as_gltf(character)
    again = _written(made, tmp_path / "real.glb")
    size = float(np.ptp(again.rest_vertices, axis=0).max())
    expected = made.frame.apply(character.rest_vertices)
    assert np.abs(again.rest_vertices[made.to_read] - expected).max() < 1e-6 * size
    assert list(again.clips) == list(character.clips)
    for clip in character.clips:
        before, after = (one.sample(clip, character.rate(clip)) for one in (character, again))
        off = after.vertices[:, made.to_read] - made.frame.apply(before.vertices)
        assert np.abs(off).max() < 1e-6 * size
