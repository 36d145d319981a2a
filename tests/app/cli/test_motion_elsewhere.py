"""Resolved clips in third-party programs: VTK, trimesh, pygltflib and Blender.

Blender's test runs where `bpy` can be imported, by default in this Python; the environment variable
LCOLLISION_BPY names another one that has it.
"""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
import trimesh
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOGeometry import vtkGLTFReader

from lcollision_core.bodies import open_body
from lcollision_core.bodies.motions import read_motions
from lcollision_core.files.character_reading import character_of_gltf
from lcollision_core.files.motion.bvh import read_bvh
from tests.app.blender.running import python_with_bpy
from tests.app.support import Lcollision
from tests.core.bodies.test_retargeting import IN_CM, of_rig
from tests.core.motion.swings import CLIP, N_FRAMES, OTHER, swinging_body
from tests.rigged_shapes import FloatArray, write_gltf

RATE = 30.0


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_gltf(swinging_body(begin=0.3), tmp_path_factory.mktemp("clips") / "source.glb")


@pytest.fixture(scope="module")
def free(lcollision: Lcollision, source: Path) -> Path:
    path = source.with_name("free.glb")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_DATA_HOME", str(source.parent))
        result = lcollision("resolve", source, "--motion", "--clip", CLIP, "-o", path)
    assert result.exit_code == 0, result.output
    return path


def proved(path: Path, clip: str) -> FloatArray:
    """Return the (T, P, 3) points of the file's mesh in a clip's frames, as checked free."""
    body = open_body(path)
    (motion,) = read_motions(body, path, clip)
    frames = list(character_of_gltf(path.read_bytes(), path).sample(clip, motion.times).vertices)
    check = body.exact_check()
    assert all(check.is_free_mesh(vertices.astype(np.float32)) for vertices in frames)
    return np.array(frames)[:, body.character.joined]  # type: ignore[attr-defined]


def test_vtk_plays_the_frames_that_were_proved(free: Path) -> None:
    reader = vtkGLTFReader()
    reader.SetFileName(str(free))
    reader.ApplyDeformationsToGeometryOn()
    reader.UpdateInformation()
    assert reader.GetNumberOfAnimations() == 2
    names = [reader.GetAnimationName(number) for number in range(2)]
    assert names == [CLIP, OTHER]
    reader.EnableAnimation(0)
    reader.DisableAnimation(1)
    reader.SetFrameRate(int(RATE))
    reader.UpdateInformation()
    for frame, points in enumerate(proved(free, CLIP)):
        reader.UpdateTimeStep(frame / RATE)
        leaves = leaves_of(reader.GetOutput())
        assert len(leaves) == 1
        shown = vtk_to_numpy(leaves[0].GetPoints().GetData())
        assert np.abs(shown - points).max() < 1e-5 * np.ptp(points, axis=0).max()


def leaves_of(node: Any) -> list[Any]:
    """Return the meshes of VTK's tree of blocks."""
    if not hasattr(node, "GetNumberOfBlocks"):
        return [node]
    blocks = [node.GetBlock(number) for number in range(node.GetNumberOfBlocks())]
    return [leaf for block in blocks if block is not None for leaf in leaves_of(block)]


def test_others_find_the_same_file_with_new_keys_in_one_clip(source: Path, free: Path) -> None:
    old, new = (trimesh.load(path, process=False) for path in (source, free))
    assert list(new.geometry) == list(old.geometry)
    for name, mesh in new.geometry.items():
        np.testing.assert_array_equal(mesh.vertices, old.geometry[name].vertices)
        np.testing.assert_array_equal(mesh.faces, old.geometry[name].faces)
    before, after = (pygltflib.GLTF2().load(str(path)) for path in (source, free))
    for kind in ("nodes", "meshes", "skins", "scenes", "animations"):
        assert len(getattr(after, kind)) == len(getattr(before, kind))
    assert after.skins[0].joints == before.skins[0].joints
    changed, kept = ([accessors_of(one, clip) for one in (before, after)] for clip in (CLIP, OTHER))
    assert changed[0] != changed[1]
    assert kept[0] == kept[1]
    assert len(kept[0]) > 0
    # The specification requires ascending times and rotations of length 1.
    for sampler in after.animations[0].samplers:
        times = np.frombuffer(bytes_of(after, sampler.input), np.float32)
        assert (np.diff(times) > 0.0).all()
        bounds = after.accessors[sampler.input]
        assert (bounds.min, bounds.max) == ([times.min()], [times.max()])
    for channel in after.animations[0].channels:
        if channel.target.path == "rotation":
            output = after.animations[0].samplers[channel.sampler].output
            turns = np.frombuffer(bytes_of(after, output), np.float32).reshape(-1, 4)
            np.testing.assert_allclose(np.linalg.norm(turns, axis=1), 1.0, atol=1e-6)


def bytes_of(gltf: pygltflib.GLTF2, accessor: int) -> bytes:
    described = gltf.accessors[accessor]
    view = gltf.bufferViews[described.bufferView]
    start = (view.byteOffset or 0) + (described.byteOffset or 0)
    size = {"SCALAR": 4, "VEC3": 12, "VEC4": 16}[described.type] * described.count
    return bytes(gltf.binary_blob()[start : start + size])


def accessors_of(gltf: pygltflib.GLTF2, clip: str) -> list[tuple[Any, ...]]:
    """Return what a clip's channels drive, and the bytes of their keys."""
    (animation,) = (one for one in gltf.animations if one.name == clip)
    found = []
    for channel in animation.channels:
        sampler = animation.samplers[channel.sampler]
        keys = (bytes_of(gltf, sampler.input), bytes_of(gltf, sampler.output))
        found.append((channel.target.node, channel.target.path, sampler.interpolation, *keys))
    return found


_IN_BLENDER = """
import sys
import bpy
import numpy as np
path, clip, rate, n_frames, out = sys.argv[1:]
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
# Before the import, which counts keys in frames of the scene.
scene.render.fps, scene.render.fps_base = int(rate), 1.0
bpy.ops.import_scene.gltf(filepath=path)
for item in bpy.data.objects:
    if item.animation_data is not None:
        for track in item.animation_data.nla_tracks:
            track.mute = True
        action = bpy.data.actions[clip]
        slots = [one for one in action.slots if one.identifier == "OB" + item.name]
        item.animation_data.action = action
        item.animation_data.action_slot = slots[0]
frames = []
for frame in range(int(n_frames)):
    scene.frame_set(frame)
    graph = bpy.context.evaluated_depsgraph_get()
    points = []
    for item in bpy.data.objects:
        if item.type == "MESH" and any(one.type == "ARMATURE" for one in item.modifiers):
            shown = item.evaluated_get(graph)
            mesh = shown.to_mesh()
            own = np.empty(3 * len(mesh.vertices), np.float32)
            mesh.vertices.foreach_get("co", own)
            world = np.array(shown.matrix_world)
            points.append(own.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3])
            shown.to_mesh_clear()
    # Blender is z up, glTF y up.
    frames.append(np.concatenate(points)[:, [0, 2, 1]] * [1.0, 1.0, -1.0])
np.save(out, np.array(frames))
"""


_JOINTS_IN_BLENDER = """
import sys
import bpy
import numpy as np
path, n_frames, out = sys.argv[1:]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_anim.bvh(filepath=path, axis_forward="-Z", axis_up="Y")
(skeleton,) = (item for item in bpy.data.objects if item.type == "ARMATURE")
frames = []
for frame in range(int(n_frames)):
    bpy.context.scene.frame_set(1 + frame)
    bpy.context.view_layer.update()
    heads = {bone.name: skeleton.matrix_world @ bone.head for bone in skeleton.pose.bones}
    frames.append([[*heads[name]] for name in sorted(heads)])
np.save(out, np.array(frames)[:, :, [0, 2, 1]] * [1.0, 1.0, -1.0])
"""


def in_blender(path: Path, clip: str, rate: float, n_frames: int, out: Path) -> FloatArray:
    """Return the (T, P, 3) points that Blender's own importer and evaluation give a clip."""
    return run_in_blender(_IN_BLENDER, str(path), clip, str(int(rate)), str(n_frames), str(out))


def run_in_blender(script: str, *arguments: str) -> FloatArray:
    """Return the array that a script writes to its last argument; skip without Blender."""
    python = python_with_bpy()
    # The other Python must use its own packages.
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    process = subprocess.run(
        [python, "-c", script, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
    )
    assert process.returncode == 0, process.stdout + process.stderr
    return np.asarray(np.load(arguments[-1]), dtype=np.float64)


def test_blender_plays_the_frames_that_were_proved(free: Path, tmp_path: Path) -> None:
    points = proved(free, CLIP)
    shown = in_blender(free, CLIP, RATE, N_FRAMES, tmp_path / "frames.npy")
    assert np.abs(shown - points).max() < 1e-5 * np.ptp(points[0], axis=0).max()


def test_blender_plays_a_real_character_as_proved(
    lcollision: Lcollision, characters: Path, tmp_path: Path
) -> None:
    source, free = characters / "mannequin-moves.glb", tmp_path / "free.glb"
    # Skip without Blender before doing the work for it.
    in_blender(source, "moves", RATE, 1, tmp_path / "one.npy")
    result = lcollision("resolve", source, "--motion", "-o", free, "--json")
    assert result.exit_code == 0, result.output
    (row,) = json.loads(result.stdout)
    points = proved(free, row["clip"])
    shown = in_blender(free, row["clip"], RATE, row["frames"], tmp_path / "frames.npy")
    assert np.abs(shown - points).max() < 1e-5 * np.ptp(points[0], axis=0).max()


@pytest.mark.slow
def test_blender_shows_a_resolved_skeleton_in_its_place(
    lcollision: Lcollision, source: Path, tmp_path: Path
) -> None:
    body = open_body(source)
    (motion,) = read_motions(body, source, CLIP)
    skeleton, free = tmp_path / "swing.bvh", tmp_path / "free.bvh"
    skeleton.write_text(of_rig(body, motion.codes))
    result = lcollision("resolve", source, skeleton, "--motion", "-o", free)
    assert result.exit_code == 0, result.output
    heads = run_in_blender(
        _JOINTS_IN_BLENDER, str(free), str(len(motion)), str(tmp_path / "heads.npy")
    )
    bvh, (resolved,) = read_bvh(free), read_motions(body, free)
    space = body.space
    axes = np.stack([np.cross(space.up, space.front), space.up, space.front])
    joints = [space.rig.joint_names.index(name) for name in sorted(bvh.names)]
    expected = np.array([space.transforms(row)[joints, :3, 3] for row in resolved.codes]) @ axes.T
    assert np.abs(heads / IN_CM - expected).max() < 1e-5 * body.body_size
