"""``lcollision decode --axes --scale``: meshes for other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody, NamedPose, write_poses
from lcollision_core.files import read_mesh
from tests.app.support import Lcollision


@pytest.fixture(scope="module")
def body() -> LearnedBody:
    return LearnedBody.load("body")


@pytest.fixture
def poses(body: LearnedBody, tmp_path: Path) -> Path:
    path = tmp_path / "poses.json"
    named = [NamedPose(f"pose {n}", body.known_poses[n]) for n in range(2)]
    write_poses(path, body, named)
    return path


def test_a_folder_is_written_for_maya(
    lcollision: Lcollision, body: LearnedBody, poses: Path, tmp_path: Path
) -> None:
    plain, maya = tmp_path / "plain", tmp_path / "maya"
    assert lcollision("decode", "body", poses, "-o", plain).exit_code == 0
    assert lcollision("decode", "body", poses, "-o", maya, "--axes", "maya").exit_code == 0
    for name in ("pose 0.obj", "pose 1.obj"):
        before = read_mesh(plain / name, topology=body.topology).vertices
        after = read_mesh(maya / name, topology=body.topology).vertices
        np.testing.assert_array_equal(after, 100.0 * before[:, [0, 2, 1]] * [1.0, 1.0, -1.0])


def test_a_scale_of_its_own_takes_the_place_of_the_program_s(
    lcollision: Lcollision, poses: Path, tmp_path: Path
) -> None:
    plain, scaled = tmp_path / "plain", tmp_path / "scaled"
    lcollision("decode", "body", poses, "-o", plain, "--format", "ply")
    written = lcollision(
        "decode", "body", poses, "-o", scaled, "--format", "ply", "--axes", "unreal", "--scale", 2
    )
    assert written.exit_code == 0, written.output
    before = read_mesh(plain / "pose 0.ply").vertices
    after = read_mesh(scaled / "pose 0.ply").vertices
    np.testing.assert_array_equal(after, 2.0 * before[:, [1, 0, 2]] * [-1.0, 1.0, 1.0])


@pytest.mark.parametrize("option", [("--axes", "maya"), ("--scale", 3)])
def test_codes_have_no_axes(
    lcollision: Lcollision, poses: Path, tmp_path: Path, option: tuple[object, ...]
) -> None:
    refused = lcollision("decode", "body", poses, "-o", tmp_path / "codes.json", *option)
    assert refused.exit_code == 2
    assert "--axes, --scale, --like, --form and --keep-clips apply only to meshes" in refused.stderr
    unknown = lcollision("decode", "body", poses, "-o", tmp_path / "m", "--axes", "houdini")
    assert unknown.exit_code == 2
    none = lcollision("decode", "body", poses, "-o", tmp_path / "m", "--scale", "nan")
    assert none.exit_code == 2
    assert not (tmp_path / "m").exists()
