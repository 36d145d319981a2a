"""Pose sets from characters with clips and from point caches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lcollision_core.errors import CancelledError, LCollisionError, MeshFileError
from lcollision_core.files import (
    read_character,
    read_mesh,
    read_pose_set,
    write_mesh,
    write_pose_set,
)
from lcollision_core.files.motion.caches import write_point_cache
from lcollision_core.jobs import Job
from lcollision_core.meshes import Topology
from tests.core.gltf_builder import GltfBuilder, arm, rotation, tube


def _two_clips(path: Path) -> Path:
    builder = arm()
    builder.animation(
        "turn",
        {"node": 1, "path": "rotation", "times": [0.0, 1.0], "values": [rotation(0, 0.0)] * 2},
    )
    return builder.write(path)


def test_the_poses_of_a_character_are_its_rest_pose_and_the_frames_of_its_clips(
    tmp_path: Path,
) -> None:
    path = _two_clips(tmp_path / "arm.glb")
    poses = read_pose_set(path)
    character = read_character(path)
    assert poses.names == ("rest", "wave 0", "wave 1", "wave 2", "turn 0", "turn 1")
    assert np.array_equal(poses.vertices[0], character.rest_vertices)
    assert np.array_equal(poses.vertices[1:4], character.sample("wave", None).vertices)
    assert poses.topology == character.topology
    assert poses.up_axis == 1
    assert poses.vertex_labels is not None
    assert set(poses.vertex_labels) == {"Left upper arm", "Left forearm", "Left hand"}
    assert np.array_equal(read_mesh(path).vertices, poses.vertices[0])
    few = read_pose_set(path, clip="turn", fps=4.0)
    assert few.names == ("rest", *(f"turn {frame}" for frame in range(5)))


def test_a_pose_set_of_a_character_is_stored_whole(tmp_path: Path) -> None:
    poses = read_pose_set(arm().write(tmp_path / "arm.glb"))
    write_pose_set(tmp_path / "arm.npz", poses)
    again = read_pose_set(tmp_path / "arm.npz")
    assert np.array_equal(again.vertices, poses.vertices)
    assert again.up_axis == 1
    assert again.vertex_labels is not None
    assert np.array_equal(again.vertex_labels, poses.vertex_labels)
    assert [group.name for group in again.groups] == ["Body", "Skin"]


def test_names_of_groups_are_made_printable(tmp_path: Path) -> None:
    builder = arm()
    (shown,) = (node for node in builder.description["nodes"] if "mesh" in node)
    shown["name"] = "Arm\n" + "x" * 5000
    builder.description["materials"][0]["name"] = "\x00"
    (group,) = read_pose_set(builder.write(tmp_path / "arm.glb")).groups
    assert group.name.startswith("Armxxx")


def test_a_scene_without_clips_is_no_pose_set(tmp_path: Path) -> None:
    builder = arm()
    del builder.description["animations"]
    with pytest.raises(MeshFileError, match=r"arm\.glb .*it contains no animation"):
        read_pose_set(builder.write(tmp_path / "arm.glb"))


def test_clips_that_are_not_there_or_too_long_get_a_sentence(tmp_path: Path) -> None:
    path = _two_clips(tmp_path / "arm.glb")
    with pytest.raises(MeshFileError, match="no clip 'run', its clips are: 'wave', 'turn'"):
        read_pose_set(path, clip="run")
    with pytest.raises(MeshFileError, match="clip 'wave' of 1 s has more than 1000000 frames"):
        read_pose_set(path, fps=2e6)
    builder = GltfBuilder()
    vertices, faces = tube(120, 100)
    primitive = {
        "attributes": {"POSITION": builder.array(vertices)},
        "indices": builder.array(faces.reshape(-1), "u4"),
    }
    builder.add("nodes", mesh=builder.add("meshes", primitives=[primitive]))
    values = [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    builder.animation(
        "slide", {"node": 0, "path": "translation", "times": [0.0, 1.0], "values": values}
    )
    large = builder.write(tmp_path / "large.glb")
    with pytest.raises(MeshFileError, match="has 8001 frames of 36006 numbers, more than"):
        read_pose_set(large, fps=8000.0)


def test_reading_frames_is_cancelled(tmp_path: Path) -> None:
    path = _two_clips(tmp_path / "arm.glb")
    job = Job()
    done: list[tuple[int, int]] = []

    def report(*progress: int) -> None:
        done.append(progress)
        if len(done) == 2:
            job.cancel()

    with pytest.raises(CancelledError):
        read_pose_set(path, job.part(report))
    assert len(done) == 2


@pytest.mark.parametrize("cache", [".pc2", ".MDD"])
@pytest.mark.parametrize("suffix", [".obj", ".ply", ".off", ".glb"])
def test_a_point_cache_finds_its_mesh(tmp_path: Path, cache: str, suffix: str) -> None:
    vertices, faces = tube()
    write_mesh(tmp_path / f"tube{suffix}", vertices, faces)
    frames = np.stack([vertices * [1.0, 1.0 + 0.01 * n, 1.0] for n in range(4)])
    path = tmp_path / f"tube{cache}"
    write_point_cache(path, frames)
    poses = read_pose_set(path)
    assert poses.names == ("rest", "frame 0", "frame 1", "frame 2", "frame 3")
    assert np.array_equal(poses.vertices[0].astype(np.float32), vertices)
    assert np.array_equal(poses.vertices[1:], frames.astype(np.float32))
    assert np.array_equal(poses.faces, faces)
    assert poses.up_axis == (1 if suffix == ".glb" else None)
    assert f"tube{suffix} is its mesh and rest pose" in poses.notes


def test_a_point_cache_of_a_character_has_its_files_vertices(tmp_path: Path) -> None:
    character = read_character(arm().write(tmp_path / "arm.glb"))
    frames = character.sample("wave", None).vertices
    write_point_cache(tmp_path / "arm.pc2", frames[:, character.joined])
    poses = read_pose_set(tmp_path / "arm.pc2")
    assert poses.topology == character.topology
    assert np.array_equal(poses.vertices[0], character.rest_vertices)
    assert np.array_equal(poses.vertices[1:], frames.astype(np.float32))


def test_a_point_cache_without_its_mesh_gets_a_sentence(tmp_path: Path) -> None:
    vertices, faces = tube(20, 24)
    path = tmp_path / "tube.pc2"
    write_point_cache(path, vertices[None])
    with pytest.raises(MeshFileError, match=r"tube\.pc2 .*put it there as tube\.obj"):
        read_pose_set(path)
    known = read_pose_set(path, topology=Topology(faces, len(vertices)))
    np.testing.assert_allclose(known.vertices, [vertices, vertices], atol=1e-6)
    with pytest.raises(MeshFileError, match="its mesh is not beside it"):
        read_pose_set(path, topology=Topology(tube(5)[1], 32))
    write_mesh(tmp_path / "tube.obj", *tube(5))
    with pytest.raises(
        MeshFileError, match=r"holds 482 vertices per frame, its mesh tube\.obj has 32"
    ):
        read_pose_set(path)
    write_mesh(tmp_path / "tube.obj", 0.01 * vertices, faces)
    with pytest.raises(MeshFileError, match="its edges are 100 times as long"):
        read_pose_set(path)
    order = np.random.default_rng(0).permutation(len(vertices))
    write_mesh(tmp_path / "tube.obj", vertices[order], faces)
    with pytest.raises(MeshFileError, match=r"has a different vertex order from tube\.obj"):
        read_pose_set(path)
    write_mesh(tmp_path / "tube.obj", vertices, faces)
    with pytest.raises(MeshFileError, match="which has no clips"):
        read_pose_set(path, clip="wave")
    assert len(read_pose_set(path)) == 2


def test_a_point_cache_alone_is_no_mesh(tmp_path: Path) -> None:
    write_point_cache(tmp_path / "tube.pc2", tube()[0][None])
    with pytest.raises(LCollisionError, match="not a known mesh format"):
        read_mesh(tmp_path / "tube.pc2")
