"""Poses in the user's own file: forms, axes, and checks of the written mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import (
    EXPORT_FORMS,
    ExportRequest,
    RigBody,
    SourceFile,
    export_frame,
    offered_forms,
    open_body,
    sequence_files,
    source_for,
    write_pose,
    write_sequence,
)
from lcollision_core.errors import MeshFileError, PoseSetError
from lcollision_core.files import CharacterForm, read_character, read_mesh, write_mesh
from lcollision_core.files.motion.caches import read_point_cache
from lcollision_core.files.scene_files import read_scene
from lcollision_core.meshes import RigidTransform
from tests.core.background import peak_memory
from tests.core.character_file import array, described, figure
from tests.core.shapes import random_rotation
from tests.core.vtk_gltf import vtk_corners


@pytest.fixture
def model(tmp_path: Path) -> RigBody:
    return RigBody.of(read_character(figure().write(tmp_path / "figure.glb")))


@pytest.fixture
def latent(model: RigBody) -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.4, 0.4, model.latent_size)


def test_a_source_offers_what_it_can_hold() -> None:
    keys = {
        source: [form.key for form in offered_forms(source, has_rig=True)]
        for source in ("a.glb", "a.VRM", "a.gltf", "a.fbx", "a.obj", "a.stl", None)
    }
    assert keys["a.glb"] == keys["a.VRM"] == keys["a.gltf"] == keys["a.fbx"]
    assert keys["a.glb"] == ["joints", "mesh", "morph", "clip", "bvh", "vrma", "pc2", "mdd"]
    assert keys["a.obj"] == ["obj", "bvh", "vrma", "pc2", "mdd"]
    assert keys["a.stl"] == keys[None] == ["bvh", "vrma", "pc2", "mdd"]
    without = [form.key for form in offered_forms("a.glb")]
    assert without == ["mesh", "morph", "pc2", "mdd"]
    assert len({form.key for form in EXPORT_FORMS}) == len(EXPORT_FORMS)
    assert set(CharacterForm) <= {form.key for form in EXPORT_FORMS}


@pytest.mark.parametrize("key", list(CharacterForm))
@pytest.mark.parametrize("is_placed", [False, True])
def test_a_pose_of_the_rig_goes_back_into_its_file(
    model: RigBody, latent: np.ndarray, tmp_path: Path, key: CharacterForm, is_placed: bool
) -> None:
    placement = None
    if is_placed:
        placement = RigidTransform(
            random_rotation(np.random.default_rng(1)), np.array([1.0, -2.0, 0.5]), 1.5
        )
    source = source_for(".glb", model)
    path = tmp_path / "posed.glb"
    vertices = model.exported_vertices(latent, placement)
    written = write_pose(
        path, model, latent, vertices, placement, ExportRequest(form=key), source=source
    )
    assert np.abs(written.vertices - vertices).max() < 1e-5 * model.body_size
    again = read_character(path)
    in_file = again.rest_vertices[again.joined]
    assert np.abs(in_file - written.vertices[model.character.joined]).max() < 1e-9
    assert written.notes == ("clips left out, as they would hide the pose: wave, walk",)
    assert written.unit == (1.0 / 1.5 if is_placed else 1.0)


def test_what_is_checked_is_what_the_file_holds(model: RigBody, tmp_path: Path) -> None:
    folded = np.where(model.space.joint_of_code > 0, model.space.high, 0.0)
    counts = []
    for codes in (np.zeros(model.latent_size), folded):
        vertices = model.exported_vertices(codes)
        path = tmp_path / "posed.glb"
        written = write_pose(path, model, codes, vertices, source=source_for(".glb", model))
        held = read_character(path).rest_vertices
        counts.append(len(written.checked(model).pairs))
        assert counts[-1] == len(model.detector.detect(held).pairs)
    assert counts[0] == 0 < counts[1]


def test_a_file_of_the_same_body_has_no_joints_to_turn(
    model: RigBody, latent: np.ndarray, tmp_path: Path
) -> None:
    other = source_for(".glb", model, figure().write(tmp_path / "other.glb"))
    assert other is not None
    assert [form.key for form in other.forms] == ["mesh", "morph", "pc2", "mdd"]
    path = tmp_path / "posed.glb"
    vertices = model.exported_vertices(latent)
    with pytest.raises(MeshFileError, match=r"with the form joints; choose .* mesh \(\.glb\)"):
        write_pose(path, model, latent, vertices, None, ExportRequest(form="joints"), source=other)
    assert not path.exists()
    written = write_pose(path, model, latent, vertices, source=other)
    assert np.array_equal(written.vertices, vertices)


def test_a_character_s_own_file_is_the_source_where_it_can_be(
    model: RigBody, latent: np.ndarray, tmp_path: Path
) -> None:
    for suffix in (".glb", ".GLB", ".pc2", ".mdd"):
        source = source_for(suffix, model)
        assert source is not None
        assert source.path == model.character.source
    assert source_for(".stl", model) is None
    assert source_for(".vrm", model) is None
    written = write_pose(tmp_path / "a.stl", model, latent, model.exported_vertices(latent))
    np.testing.assert_array_equal(written.vertices, model.exported_vertices(latent))
    with pytest.raises(MeshFileError, match="the form morph applies only to a character's file"):
        write_pose(
            tmp_path / "a.obj", model, latent, model.reference, None, ExportRequest(form="morph")
        )


def test_vrm_is_written_as_vrm(tmp_path: Path) -> None:
    model = RigBody.of(read_character(figure().write(tmp_path / "figure.vrm")))
    source = SourceFile(tmp_path / "figure.vrm", model)
    assert source.require_form(tmp_path / "posed.vrm", None).key == "joints"
    assert source.require_form(tmp_path / "posed.glb", None).key == "joints"


def test_files_that_are_not_of_the_body_are_refused(model: RigBody, tmp_path: Path) -> None:
    builder = figure()
    builder.description["nodes"][0]["scale"] = [1.0] * 3
    big = builder.write(tmp_path / "big.glb")
    with pytest.raises(MeshFileError, match=r"big\.glb is 100 times as large as the body of 'fig"):
        SourceFile(big, model)
    write_mesh(tmp_path / "few.obj", np.eye(3), np.array([[0, 1, 2]]))
    with pytest.raises(PoseSetError, match="has 3 vertices"):
        SourceFile(tmp_path / "few.obj", model)
    write_mesh(tmp_path / "own.ply", model.reference, model.faces)
    with pytest.raises(
        MeshFileError, match=r"own\.ply has a format that cannot be written \(\.ply\)"
    ):
        SourceFile(tmp_path / "own.ply", model)


@pytest.mark.parametrize("axes", ["model", "maya", "unreal"])
def test_an_obj_file_keeps_its_form_in_any_axes(
    model: RigBody, latent: np.ndarray, tmp_path: Path, axes: str
) -> None:
    own, path = tmp_path / "own.obj", tmp_path / "posed.obj"
    write_mesh(own, model.reference, model.faces)
    own.write_bytes(b"mtllib own.mtl\r\n" + own.read_bytes().replace(b"\nf", b"\nusemtl a\nf", 1))
    source = SourceFile(own, model)
    frame = export_frame(model, axes, path, scale=100.0)
    assert source.require_form(path, None).has_axes
    vertices = model.exported_vertices(latent)
    written = write_pose(
        path, model, latent, vertices, request=ExportRequest(axes, 100.0), source=source
    )
    assert written.unit == 0.01
    np.testing.assert_array_equal(read_mesh(path).vertices, written.vertices)
    np.testing.assert_array_equal(written.vertices, frame.apply(vertices))
    assert path.read_bytes().startswith(b"mtllib own.mtl\r\nv ")
    assert b"usemtl a" in path.read_bytes()


@pytest.mark.parametrize("suffix", [".pc2", ".mdd"])
def test_a_sequence_is_one_cache_for_each_mesh_that_the_file_shows(
    model: RigBody, latent: np.ndarray, tmp_path: Path, suffix: str
) -> None:
    source = SourceFile(model.character.source, model)
    latents = [share * latent for share in (0.0, 0.5, 1.0)]
    poses = [model.exported_vertices(codes) for codes in latents]
    path = tmp_path / f"run{suffix}"
    wanted = sequence_files(path, model, source)
    assert not any(file.exists() for file in wanted)
    frame = export_frame(model, "unreal", path)
    files, written = write_sequence(
        path, model, latents, poses, ExportRequest("unreal", fps=24.0), source=source
    )
    stored = np.stack([pose.vertices for pose in written])
    assert {pose.unit for pose in written} == {0.01}
    assert files == list(wanted)
    assert [file.name for file in files] == [f"run {n}{suffix}" for n in ("Body", "Core", "Hat")]
    caches = [read_point_cache(file) for file in files]
    joined = np.concatenate(caches, axis=1)
    np.testing.assert_array_equal(joined, stored[:, model.character.joined])
    np.testing.assert_allclose(stored, [frame.apply(pose) for pose in poses], rtol=1e-6, atol=1e-5)
    # As many as in the file's own meshes.
    description, _ = described(model.character.source)
    counts = [
        sum(
            description["accessors"][primitive["attributes"]["POSITION"]]["count"]
            for primitive in mesh["primitives"]
        )
        for mesh in description["meshes"]
    ]
    assert [cache.shape[1] for cache in caches] == counts
    if suffix == ".mdd":
        assert np.frombuffer(files[0].read_bytes(), ">f4", 2, 8)[1] == np.float32(1 / 24)


def test_a_motion_of_the_rig_becomes_a_clip_of_its_file(
    model: RigBody, latent: np.ndarray, tmp_path: Path
) -> None:
    latents = [share * latent for share in (0.0, 0.5, 1.0)]
    poses = [model.exported_vertices(codes) for codes in latents]
    path = tmp_path / "run.glb"
    source = source_for(".glb", model)
    files, written = write_sequence(
        path, model, latents, poses, ExportRequest(fps=24.0), source=source
    )
    assert files == [path]
    again = read_character(path)
    assert list(again.clips) == ["poses", "orbit"]
    np.testing.assert_array_equal(again.rest_vertices, model.character.rest_vertices)
    frames = again.sample("poses", None)
    np.testing.assert_allclose(frames.times, [0.0, 1 / 24, 2 / 24], rtol=1e-6)
    for pose, stored, frame in zip(poses, written, frames.vertices, strict=True):
        assert np.abs(stored.vertices - pose).max() < 1e-5 * model.body_size
        assert np.abs(frame - stored.vertices).max() < 1e-6 * model.body_size
    other = source_for(".glb", model, figure().write(tmp_path / "other.glb"))
    with pytest.raises(MeshFileError, match="with the form clip"):
        write_sequence(path, model, latents, poses, source=other)


def test_a_model_s_own_order_needs_no_source(
    model: RigBody, latent: np.ndarray, tmp_path: Path
) -> None:
    vertices = model.exported_vertices(latent)
    files, (written,) = write_sequence(tmp_path / "run.pc2", model, [latent], [vertices])
    assert files == [tmp_path / "run.pc2"]
    np.testing.assert_array_equal(read_point_cache(files[0])[0], vertices)
    np.testing.assert_array_equal(written.vertices, vertices)
    with pytest.raises(MeshFileError, match="is not a point cache; use one of"):
        write_sequence(tmp_path / "run.glb", model, [latent], [model.reference])
    with pytest.raises(MeshFileError, match=r"\.pc2 rounds coordinates"):
        write_sequence(tmp_path / "far.pc2", model, [latent], [model.reference + 1e6])
    assert not (tmp_path / "far.pc2").exists()


@pytest.mark.parametrize("name", ["mannequin-moves.glb", "xbot-moves.glb"])
def test_characters_of_artists_come_back_as_vtk_reads_them(
    characters: Path, tmp_path: Path, name: str
) -> None:
    own, path = characters / name, tmp_path / "posed.glb"
    model = open_body(own)
    assert isinstance(model, RigBody)
    latent = np.random.default_rng(0).uniform(model.space.low, model.space.high)
    parts = read_scene(own).parts
    ends = np.cumsum([0] + [len(part.points) for part in parts])
    corners = np.concatenate(
        [end + part.faces.reshape(-1) for end, part in zip(ends, parts, strict=False)]
    )
    for form in CharacterForm:
        for codes in (np.zeros_like(latent), latent):
            vertices = model.exported_vertices(codes)
            source = source_for(".glb", model)
            write_pose(path, model, codes, vertices, None, ExportRequest(form=form), source=source)
            seen = vtk_corners(path)
            expected = vertices[model.character.joined][corners]
            assert np.abs(seen - expected).max() < 1e-6 * model.body_size
            assert _texture_coordinates(path) == _texture_coordinates(own)
    latents = [np.zeros_like(latent), latent]
    poses = [model.exported_vertices(codes) for codes in latents]
    write_sequence(
        path, model, latents, poses, ExportRequest(fps=10.0), source=source_for(".glb", model)
    )
    for frame, vertices in enumerate(poses):
        seen = vtk_corners(path, 0, 0.1 * frame)
        expected = vertices[model.character.joined][corners]
        assert np.abs(seen - expected).max() < 1e-5 * model.body_size


def _texture_coordinates(path: Path) -> list[bytes]:
    description, _ = described(path)
    return [
        array(path, primitive["attributes"]["TEXCOORD_0"])
        for mesh in description["meshes"]
        for primitive in mesh["primitives"]
    ]


@pytest.mark.slow
def test_of_a_long_point_cache_one_frame_is_in_memory(model: RigBody, tmp_path: Path) -> None:
    n_frames = 1000
    still = model.reference.astype(np.float32)
    latents = [np.zeros(model.latent_size)] * n_frames
    one = still.astype(np.float64).nbytes

    def write() -> None:
        _, written = write_sequence(
            tmp_path / "long.pc2", model, latents, (still.copy() for _ in latents)
        )
        assert all(np.array_equal(pose.vertices, still) for pose in written)

    assert peak_memory(write) < max(40 * one, 1 << 20) < n_frames * one
