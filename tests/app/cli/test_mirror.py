"""``lcollision mirror``: output files, reports and exit status."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody, NamedPose, open_body, read_poses, write_poses
from lcollision_core.meshes import RigidTransform
from tests.app.support import Lcollision
from tests.core.gltf_builder import arm


@pytest.fixture(scope="module")
def body() -> LearnedBody:
    return LearnedBody.load("body")


@pytest.fixture
def poses(body: LearnedBody, tmp_path: Path) -> Path:
    """Return a file of a placed free pose, one that collides only mirrored, and a colliding one."""
    drawn = body.latent_space.sample(3, np.random.default_rng(0))
    placement = RigidTransform(np.eye(3), np.array([1.0, 0.0, 0.0]))
    path = tmp_path / "poses.json"
    named = [NamedPose(f"pose {n}", row) for n, row in enumerate(drawn)]
    named[0] = NamedPose("pose 0", drawn[0], placement)
    write_poses(path, body, named)
    return path


def test_a_file_is_mirrored_and_comes_back_to_the_bit(
    lcollision: Lcollision, body: LearnedBody, poses: Path, tmp_path: Path
) -> None:
    images, back = tmp_path / "images.json", tmp_path / "back.json"
    result = lcollision("mirror", "body", poses, "-o", images, "--json")
    assert result.exit_code == 0, result.output
    rows = json.loads(result.stdout)
    assert [row["source"] for row in rows] == [f"{poses}: pose {n}" for n in range(3)]
    free, resolved, colliding = rows
    assert not any(row["restored"] for row in rows)
    assert all(0.0 < row["fit_error_mean"] < row["fit_error_max"] < 0.05 for row in rows)
    assert free["pairs_before"] == free["pairs_mirrored"] == free["pairs_after"] == 0
    assert free["exactly_free"]
    assert not free["resolved"]
    assert resolved["pairs_before"] == 0 < resolved["pairs_mirrored"]
    assert resolved["pairs_after"] == 0
    assert resolved["resolved"]
    assert colliding["pairs_before"] > 0
    assert colliding["pairs_after"] > 0
    assert not colliding["exactly_free"]
    assert {row["output"] for row in rows} == {str(images)}

    written = read_poses(images, body)
    assert [pose.name for pose in written] == ["pose 0", "pose 1", "pose 2"]
    assert written[0].placement is not None
    assert written[0].placement.translation[0] == pytest.approx(-1.0)
    again = lcollision("mirror", "body", images, "-o", back)
    assert again.exit_code == 0, again.output
    assert again.stdout.count("restored to the unmirrored pose") == 3
    for pose, first in zip(read_poses(back, body), read_poses(poses, body), strict=True):
        assert pose.same_as(first)


def test_it_says_what_it_is_off_by_and_what_was_resolved(
    lcollision: Lcollision, poses: Path, tmp_path: Path
) -> None:
    result = lcollision("mirror", "body", poses, "-o", tmp_path / "images.json")
    free, resolved, colliding = result.stdout.splitlines()
    assert "pose 0: mirrored with a fit error of 0." in free
    assert free.endswith("free")
    assert "pairs of faces of the mirror image were resolved" in resolved
    assert "colliding as before: 134 pairs of faces (original: 150)" in colliding
    assert "wrote 3 poses to" in result.stderr


def test_a_free_pose_that_stays_colliding_is_told_with_an_offer(
    lcollision: Lcollision, body: LearnedBody, poses: Path, tmp_path: Path
) -> None:
    bare = tmp_path / "bare.safetensors"
    LearnedBody("bare", body.embedding, body.card).save(bare)
    images = tmp_path / "images.json"
    result = lcollision("mirror", bare, poses, "-o", images)
    assert result.exit_code == 1
    assert "pairs of faces that the original doesn't have" in result.stdout
    assert "1 free pose collides when mirrored" in result.stderr
    assert "train predictor" in result.stderr
    assert images.is_file()


def test_what_cannot_be_mirrored_is_one_sentence(
    lcollision: Lcollision, body: LearnedBody, poses: Path, tmp_path: Path
) -> None:
    images = tmp_path / "images.json"
    refused = lcollision("mirror", "body", poses, "-o", tmp_path / "images.obj")
    assert refused.exit_code == 2
    assert "must be a .json file" in refused.stderr
    empty = tmp_path / "empty.json"
    write_poses(empty, body, [])
    for command in ("mirror", "decode"):
        refused = lcollision(command, "body", empty, "-o", images)
        assert refused.exit_code == 2
        assert "contains no poses; name a file with poses" in refused.stderr
    one_arm = open_body(arm().write(tmp_path / "arm.glb"))
    write_poses(empty, one_arm, [NamedPose("first", one_arm.known_poses[0])])
    refused = lcollision("mirror", tmp_path / "arm.glb", empty, "-o", images)
    assert refused.exit_code == 2
    assert "its joint names do not say left and right" in refused.stderr
    assert not images.exists()


def test_a_body_that_is_not_symmetric_is_mirrored_as_nearly_as_it_can_be(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    """The dance starts in a pose that is not quite symmetric."""
    swing, given, images = LearnedBody.load("body-swing"), tmp_path / "a.json", tmp_path / "b.json"
    write_poses(given, swing, [NamedPose("first", swing.known_poses[30])])
    done = lcollision("mirror", "body-swing", given, "-o", images, "--json")
    assert done.exit_code == 0, done.output
    (report,) = json.loads(done.stdout)
    assert report["fit_error_mean"] < 0.01
    again = lcollision("mirror", "body-swing", images, "-o", tmp_path / "c.json", "--json")
    assert json.loads(again.stdout)[0]["restored"]
    (back,) = read_poses(tmp_path / "c.json", swing)
    np.testing.assert_array_equal(back.latent, swing.known_poses[30])
