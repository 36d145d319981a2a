"""FBX files, against ufbx's own evaluation."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies.anatomy import joint_parts
from lcollision_core.errors import CancelledError, MeshFileError, MissingExtraError
from lcollision_core.files import read_character, read_mesh, read_pose_set
from lcollision_core.files.motion.caches import write_point_cache
from lcollision_core.files.scene import fbx
from lcollision_core.files.scene_files import open_scene, read_scene
from lcollision_core.jobs import Job
from tests.core.fbx_builder import TICKS, arm_fbx, ufbx_frames
from tests.core.gltf_builder import tube

pytest.importorskip("ufbx")


@pytest.mark.variants(2)
@pytest.mark.parametrize("skinning", ["Linear", "Rigid", "DualQuaternion", "Blend"])
def test_frames_agree_with_ufbx(tmp_path: Path, skinning: str) -> None:
    path = arm_fbx(tmp_path / "arm.fbx", skinning=skinning)
    character = read_character(path)
    height = float(np.ptp(character.rest_vertices[:, 1]))
    rest = ufbx_frames(path, None, [0.0])[0]
    assert np.abs(character.rest_vertices[character.joined] - rest).max() < 1e-6 * height
    frames = character.sample("wave", 10.0)
    assert len(frames.times) == 11
    expected = ufbx_frames(path, 0, frames.times.tolist())
    assert np.abs(frames.vertices[:, character.joined] - expected).max() < 1e-6 * height
    assert np.abs(expected[-1] - expected[0]).max() > 0.3 * height


def test_dual_quaternions_are_not_linear_and_the_notes_say_what_the_rig_does(
    tmp_path: Path,
) -> None:
    linear, dual = (
        read_character(arm_fbx(tmp_path / "arm.fbx", skinning=skinning))
        for skinning in ("Linear", "DualQuaternion")
    )
    last = [character.sample("wave", 1.0).vertices[-1] for character in (linear, dual)]
    assert np.abs(last[0] - last[1]).max() > 0.05
    assert any("dual quaternions" in note for note in dual.notes)
    assert not any("dual quaternions" in note for note in linear.notes)
    assert dual.rig is not None
    at_rest = np.einsum("vi,vij->vj", dual.rig.weights, dual.rig.points)
    assert np.abs(at_rest - dual.rest_vertices).max() < 1e-12


def test_a_clip_without_a_span_is_as_long_as_its_curves(tmp_path: Path) -> None:
    frames = [
        read_character(arm_fbx(tmp_path / "arm.fbx", is_long=is_long)).sample("wave", None)
        for is_long in (False, True)
    ]
    assert np.array_equal(frames[0].times, frames[1].times)
    assert np.array_equal(frames[0].vertices, frames[1].vertices)


@pytest.mark.variants
@pytest.mark.parametrize(("mode", "rate"), [(9, 30), (13, 24), (17, 30), (18, 30)])
def test_clips_of_ntsc_rates_keep_their_last_frame(tmp_path: Path, mode: int, rate: int) -> None:
    path = arm_fbx(tmp_path / "arm.fbx")
    text = path.read_text().replace(
        '"TimeMode", "enum", "", "",6', f'"TimeMode", "enum", "", "",{mode}'
    )
    # A tick less than 1.001 s, as after rounding.
    path.write_text(text.replace(str(TICKS), str(TICKS * 1001 // 1000 - 1)))
    # Above 30 frames per second, every second frame is sampled.
    times = read_character(path).sample("wave", None).times
    assert len(times) == rate + 1
    assert times[-1] == pytest.approx(1.001, abs=1e-9)


@pytest.mark.variants
@pytest.mark.parametrize("rate", [23.98, 27.5, 59.94005714])
def test_frames_are_those_of_the_clip_where_a_rate_is_rounded(tmp_path: Path, rate: float) -> None:
    path = arm_fbx(tmp_path / "arm.fbx")
    text, usual = path.read_text(), 'P: "TimeMode", "enum", "", "",6'
    custom = usual.replace(",6", ",14") + f'\n\tP: "CustomFrameRate", "double", "Number", "",{rate}'
    assert usual in text
    end = round(TICKS * 600 / rate)
    path.write_text(text.replace(usual, custom).replace(str(TICKS), str(end)))
    character = read_character(path)
    times = character.sample("wave", character.rate("wave")).times
    assert np.allclose(times, np.arange(601) / rate, rtol=0.0, atol=1e-9)


def test_a_blend_shape_is_masked_by_its_weights(tmp_path: Path) -> None:
    path = arm_fbx(tmp_path / "arm.fbx")
    text, full = path.read_text(), "FullWeights: *1 { a: 100 }"
    # In files from other programs, several weights denote in-between shapes.
    text = text.replace("7400\n}", '7400\n    Creator: "Blender (stable FBX IO) - 5.0.1"\n}', 1)
    vertices, _ = tube()
    changed = np.flatnonzero(vertices[:, 1] > 1.2)
    mask = np.zeros(len(vertices))
    mask[changed] = np.linspace(0.0, 1.0, len(changed))

    def last_frame(weights: np.ndarray) -> np.ndarray:
        numbers = ",".join(map(repr, (100.0 * weights).tolist()))
        path.write_text(text.replace(full, f"FullWeights: *{len(weights)} {{ a: {numbers} }}"))
        character = read_character(path)
        return character.sample("wave", None).vertices[-1][character.joined]

    without, whole = last_frame(np.zeros(len(changed))), last_frame(np.ones(len(changed)))
    expected = without + mask[:, None] * (whole - without)
    assert np.abs(whole - without).max() > 0.1
    assert np.abs(last_frame(mask[changed]) - expected).max() < 1e-6


def test_a_geometry_cache_that_is_not_read_is_said(tmp_path: Path) -> None:
    path = arm_fbx(tmp_path / "arm.fbx")
    cache = 'Deformer: 420, "Deformer::Cloth", "VertexCacheDeformer" { }\n    Material: 300,'
    text = path.read_text().replace("Material: 300,", cache, 1)
    path.write_text(text.replace('C: "OO",100,200', 'C: "OO",100,200\n    C: "OO",420,100'))
    notes = read_character(path).notes
    assert [note for note in notes if "geometry cache" in note] == [
        "not animated, as their geometry cache is not read (export PC2 or MDD instead): Body"
    ]


@pytest.mark.parametrize(
    ("shown", "levels", "is_said"), [(2, 1, True), (1, 1, False), (3, 0, False)]
)
def test_a_subdivision_that_is_not_applied_is_said(
    tmp_path: Path, shown: int, levels: int, is_said: bool
) -> None:
    path = arm_fbx(tmp_path / "arm.fbx")
    values = f"Smoothness: {shown}\n        RenderDivisionLevels: {levels}\n"
    mark = "GeometryVersion: 124"
    path.write_text(path.read_text().replace(mark, f"{values}        {mark}", 1))
    notes = read_character(path).notes
    said = "not subdivided, as their levels are not read (apply them before the export): Body"
    assert [note for note in notes if "subdivided" in note] == [said] * is_said


def test_a_clip_of_too_many_frames_is_left_out_and_said(tmp_path: Path) -> None:
    path = arm_fbx(tmp_path / "arm.fbx")
    text = path.read_text()
    stack = text[text.index("    AnimationStack: 500") : text.index("    AnimationLayer: 501")]
    endless = stack.replace("500", "700").replace("wave", "endless")
    endless = endless.replace(f'"",{TICKS}', f'"",{100_000 * TICKS}')
    endless += 'AnimationLayer: 701, "AnimLayer::Base", "" { }\n'
    endless += 'AnimationCurveNode: 710, "AnimCurveNode::", "" { }\n'
    links = 'C: "OO",701,700\nC: "OO",710,701\nC: "OP",710,201, "Lcl Rotation"\n'
    text = text.replace(stack, endless + stack)
    path.write_text(text.replace("Connections:  {\n", "Connections:  {\n" + links))
    character = read_character(path)
    assert list(character.clips) == ["wave"]
    assert character.topology.n_vertices == len(tube()[0])
    (endless_clip,) = [clip for clip in read_scene(path).clips if clip.name == "endless"]
    with pytest.raises(MeshFileError, match="; export fewer frames of it"):
        endless_clip.times(None)
    (note,) = [note for note in character.notes if "endless" in note]
    assert note.startswith("its clip 'endless' is left out: ")
    assert "from 0 to 100000 s at 30 frames a second, must have 1 to 1000000 frames" in note


def test_reading_stops_when_it_is_cancelled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = arm_fbx(tmp_path / "arm.fbx")
    sleeper = tmp_path / "sleeper.py"
    sleeper.write_text("import sys, time\nsys.stdin.buffer.read()\ntime.sleep(60)\n")
    monkeypatch.setattr(fbx, "_WORKER", sleeper)
    job = Job()
    timer = threading.Timer(0.3, job.cancel)
    timer.start()
    with pytest.raises(CancelledError):
        read_pose_set(path, job.part())
    timer.join()
    monkeypatch.setattr(fbx, "_MOST_SECONDS", 0.2)
    with pytest.raises(MeshFileError, match=r"reading it took more than 0\.2 s"):
        read_pose_set(path)


def test_an_animation_without_a_mesh_is_said(tmp_path: Path) -> None:
    path = arm_fbx(tmp_path / "arm.fbx")
    # Its geometry is not connected to anything.
    path.write_text(path.read_text().replace('C: "OO",100,200', 'C: "OO",100,300'))
    with pytest.raises(MeshFileError, match="an animation, but no mesh; name or open the char"):
        read_character(path)


def test_a_point_cache_finds_the_fbx_that_is_its_mesh(tmp_path: Path) -> None:
    character = read_character(arm_fbx(tmp_path / "arm.fbx", up=2))
    frames = character.sample("wave", 10.0).vertices
    write_point_cache(tmp_path / "arm.mdd", frames)
    poses = read_pose_set(tmp_path / "arm.mdd")
    assert np.array_equal(poses.vertices[1:], frames.astype(np.float32))
    assert poses.up_axis == 2


def test_a_character_of_fbx_has_its_rig_parts_and_clips(tmp_path: Path) -> None:
    path = arm_fbx(tmp_path / "arm.fbx")
    character = read_character(path)
    vertices, faces = tube()
    assert np.array_equal(character.joined, np.arange(len(vertices)))
    assert np.array_equal(character.topology.faces, faces)
    assert [group.name for group in character.groups] == ["Body", "Skin"]
    assert character.clips == {"wave": pytest.approx(1.0)}
    rig = character.rig
    assert rig is not None
    # The bottom of the tube follows the mesh itself.
    assert rig.joint_names == ("Body", "Lower", "Upper")
    assert rig.parents.tolist() == [-1, -1, 1]
    assert set(joint_parts(character)) == {"Body", "Lower", "Upper"}
    # The clip's own frames are at the file's rate, 30 per second.
    frames = character.sample("wave", None)
    assert frames.transforms is not None
    assert np.allclose(frames.times, np.arange(31) / 30.0)
    turns = frames.transforms[0] @ np.linalg.inv(rig.rest)
    assert np.abs(turns[1] - np.eye(4)).max() > 0.1
    assert open_scene(path).has_skin


def test_the_poses_of_fbx_know_their_axis(tmp_path: Path) -> None:
    for up in (0, 1, 2):
        path = arm_fbx(tmp_path / f"arm{up}.fbx", up=up, metres=1.0)
        poses = read_pose_set(path, fps=5.0)
        assert poses.up_axis == up
        assert poses.names[:2] == ("rest", "wave 0")
        character = read_character(path)
        assert character.up.tolist() == np.eye(3)[up].tolist()
        assert character.metres == pytest.approx(1.0)
    assert read_character(arm_fbx(tmp_path / "arm.fbx")).metres == pytest.approx(0.01)
    assert np.array_equal(read_mesh(path).vertices, poses.vertices[0])


@pytest.mark.parametrize(
    "name", ["blender_279_sausage_7400_binary.fbx", "maya_advanced_skinned_pivot_7700_binary.fbx"]
)
def test_frames_of_real_files_agree_with_ufbx(name: str, characters: Path) -> None:
    path = characters / name
    character = read_character(path)
    size = float(np.ptp(character.rest_vertices, axis=0).max())
    rest = ufbx_frames(path, None, [0.0])[0]
    assert np.abs(character.rest_vertices[character.joined] - rest).max() < 1e-6 * size
    for number, clip in enumerate(character.clips):
        frames = character.sample(clip, None)
        expected = ufbx_frames(path, number, frames.times.tolist())
        assert np.abs(frames.vertices[:, character.joined] - expected).max() < 1e-6 * size


def test_what_is_no_fbx_gets_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "m.fbx"
    for data, message in (
        (b"x", "damaged or unsupported FBX"),
        (b"Kaydara FBX Binary  \0\x1a\0\xe8\x1c\0\0" + b"\xff" * 100, "damaged or unsupported FBX"),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "damaged or unsupported FBX|0 meshes"),
    ):
        path.write_bytes(data)
        with pytest.raises(MeshFileError, match=message) as caught:
            read_mesh(path)
        assert "\n" not in str(caught.value)


def test_without_ufbx_a_sentence_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = arm_fbx(tmp_path / "arm.fbx")
    monkeypatch.setitem(sys.modules, "ufbx", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'lcollision\[fbx\]'"):
        read_mesh(path)
    with pytest.raises(MissingExtraError, match=r"pip install 'lcollision\[fbx\]'"):
        read_pose_set(path)


def test_hidden_meshes_lower_levels_of_detail_and_scenery_are_left_out(tmp_path: Path) -> None:
    scene = read_scene(arm_fbx(tmp_path / "a.fbx", others=["Floor", "hidden floor"]))
    assert [part.mesh for part in scene.parts] == ["Body"]
    why = "left out, as its file hides it or shows a finer level of detail"
    assert scene.notes == (f"{why}: hidden floor", "left out, as no joint carries it: Floor")
    path = arm_fbx(tmp_path / "levels.fbx", others=["level 0", "level 1", "level 2"])
    assert read_scene(path).notes == (
        f"{why}: level 1, level 2",
        "left out, as no joint carries it: level 0",
    )
