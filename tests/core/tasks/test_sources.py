"""Poses of one body from several sources."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import open_body
from lcollision_core.errors import LCollisionError, MeshFileError, PoseSetError
from lcollision_core.files import PoseSet, read_character, read_pose_set, write_mesh, write_pose_set
from lcollision_core.files.motion.caches import write_point_cache
from lcollision_core.jobs import Job
from lcollision_core.tasks.sources import ENOUGH_POSES, gather_poses
from tests.core.gltf_builder import arm
from tests.rigged_shapes import rigged_body, rigged_tube, write_gltf


@pytest.fixture
def still(tmp_path: Path) -> Path:
    """Return a rigged file without animation."""
    return write_gltf(rigged_body(), tmp_path / "still.gltf")


@pytest.fixture
def moving(tmp_path: Path) -> Path:
    """Return the same character with 12 frames, equal in pairs."""
    return write_gltf(rigged_body(n_frames=12), tmp_path / "moving.gltf")


def test_a_rigged_file_without_animation_is_posed_by_its_rig(still: Path) -> None:
    with pytest.raises(MeshFileError, match="contains no animation"):
        gather_poses([still], by_rig=0)
    said: list[tuple[int, int]] = []
    poses = gather_poses([still], by_rig=9, seed=3, job=Job(lambda *counts: said.append(counts)))
    assert poses.names == ("rest", *(f"rig {number}" for number in range(1, 10)))
    assert said[-1][0] == said[-1][1]
    (rest, made) = poses.provenance["sources"]
    assert rest == {"file": "still.gltf", "poses": 1}
    assert (made["poses"], made["by_rig"]["seed"], made["by_rig"]["drawn"]) == (9, 3, 9)
    again = gather_poses([still], by_rig=9, seed=3)
    np.testing.assert_array_equal(poses.vertices, again.vertices)
    assert poses.up_axis == 1
    assert gather_poses([still], by_rig=2, up=2).up_axis == 2


def test_little_animation_is_topped_up(still: Path, moving: Path) -> None:
    for file in (still, moving):
        poses = gather_poses([file])
        assert len(poses) == ENOUGH_POSES
        assert poses.names[-1].startswith("rig ")
    assert any(name.startswith("moves ") for name in poses.names)
    read = read_pose_set(moving)
    assert len(gather_poses([moving], by_rig=0, thin=False)) == len(read)
    np.testing.assert_array_equal(poses.vertices[0], read.vertices[0])
    assert (poses.up_axis, poses.source) == (read.up_axis, moving)
    # The rig's rules, so that a learned model and its character agree.
    assert poses.rules == open_body(moving).rules
    assert {group.name for group in poses.groups} >= {group.name for group in read.groups}


def test_the_rest_pose_of_the_rig_is_first_wherever_its_file_is_named(
    still: Path, moving: Path, tmp_path: Path
) -> None:
    frames = read_pose_set(moving)
    cache = tmp_path / "cache"
    cache.mkdir()
    write_mesh(cache / "frames.obj", frames.vertices[3], frames.faces)
    write_point_cache(cache / "frames.mdd", frames.vertices[4:7])
    write_pose_set(tmp_path / "set.npz", replace(frames, vertices=frames.vertices + 0.1))
    rest = read_character(still).rest_vertices
    files = [cache / "frames.mdd", tmp_path / "set.npz", still]
    poses = gather_poses(files, by_rig=0)
    np.testing.assert_array_equal(poses.vertices[0], rest)
    assert poses.names[0] == "still rest"
    assert poses.source == still
    # The set contains the cache's poses and the rest pose, at another position.
    all_names = gather_poses(files, by_rig=0, thin=False).names
    assert len(all_names) == 1 + 4 + 13
    assert "set rest" in all_names
    assert "set rest" not in poses.names
    assert any("left out" in note for note in poses.notes)
    # Each name is prefixed by its file's name, once.
    topped_up = gather_poses(files, by_rig=3)
    assert topped_up.names[-3:] == ("still rig 1", "still rig 2", "still rig 3")
    assert topped_up.names[:-3] == poses.names
    assert [part["poses"] for part in topped_up.provenance["sources"]][-1] == 3


def test_a_character_and_its_animation_may_be_two_files(still: Path, moving: Path) -> None:
    for files in ((still, moving), (moving, still)):
        poses = gather_poses(files, by_rig=0, clip="moves", thin=False)
        assert len(poses) == 13
        assert poses.names[0] == f"{files[0].stem} rest"
        assert "moving moves 11" in poses.names
    with pytest.raises(MeshFileError, match="contains no animation"):
        gather_poses([still], by_rig=3, clip="moves")


def test_what_has_no_rig_is_read_as_it_is(moving: Path, tmp_path: Path) -> None:
    frames = read_pose_set(moving)
    write_pose_set(tmp_path / "set.npz", frames)
    poses: PoseSet = gather_poses([tmp_path / "set.npz"])
    assert set(poses.names) <= set(frames.names)
    assert poses.provenance == {}
    with pytest.raises(LCollisionError, match=r"set\.npz has no joints to pose it by"):
        gather_poses([tmp_path / "set.npz"], by_rig=4)


def test_a_rig_that_cannot_pose_is_refused_before_anything_is_read(tmp_path: Path) -> None:
    builder = arm()
    builder.description["nodes"][1]["scale"] = [1.0, 0.0, 1.0]
    path = builder.write(tmp_path / "arm.glb")
    said: list[tuple[int, int]] = []
    with pytest.raises(LCollisionError, match=r"arm\.glb cannot be posed by its rig: joint rig"):
        gather_poses([path], by_rig=5, job=Job(lambda *counts: said.append(counts)))
    assert not said
    assert gather_poses([path], by_rig=0).names == gather_poses([path]).names


def test_what_cannot_be_gathered_gets_a_sentence(moving: Path, tmp_path: Path) -> None:
    with pytest.raises(LCollisionError, match="nothing to read"):
        gather_poses([])
    for by_rig in (None, 5):
        with pytest.raises(MeshFileError, match=r"none\.glb does not exist"):
            gather_poses([tmp_path / "none.glb"], by_rig=by_rig)
    with pytest.raises(MeshFileError, match="no clip 'run'"):
        gather_poses([moving], clip="run")
    other = write_gltf(rigged_tube(frames=True), tmp_path / "other.gltf")
    with pytest.raises(PoseSetError, match="vertices than the set"):
        gather_poses([moving, other])
