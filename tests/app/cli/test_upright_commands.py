"""``lcollision upright``, and the commands' reports on the up axis."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody, find_model
from lcollision_core.files import PoseSet, write_pose_set
from tests.app.support import Lcollision
from tests.bending_tube import bending_tube
from tests.core.shapes import sphere


def test_a_model_is_turned_upright_in_its_file(
    lcollision: Lcollision, editor_model: LearnedBody, tmp_path: Path
) -> None:
    path = tmp_path / "tube.safetensors"
    editor_model.save(path)
    assert lcollision("upright", path).stdout == "tube: y is up\n"
    assert lcollision("upright", path, "--up", "z").stdout == "tube: z is up\n"
    assert LearnedBody.load(path).up_axis == 2
    assert lcollision("upright", path, "--up", "w").exit_code == 2


def test_a_bundled_model_stays_as_it_is(lcollision: Lcollision) -> None:
    before = find_model("body").read_bytes()
    result = lcollision("upright", "body", "--up", "x")
    assert result.exit_code == 2
    assert "copy" in result.stderr
    assert find_model("body").read_bytes() == before


def test_dataset_check_says_which_way_is_up(lcollision: Lcollision, tmp_path: Path) -> None:
    path = tmp_path / "balls.npz"
    ball = sphere()
    vertices = np.stack([ball.vertices, 1.01 * ball.vertices])
    write_pose_set(path, PoseSet(vertices, ball.topology, ("a", "b")))
    result = lcollision("dataset", "check", path)
    assert "is probably up: what it stands on doesn't show it" in result.stdout
    assert "--up x|y|z" in result.stderr
    report = json.loads(lcollision("dataset", "check", path, "--json").stdout)
    assert report["up_is_sure"] is False
    assert report["up_axis"] in "xyz"


@pytest.mark.variants
@pytest.mark.parametrize("up", ["x", "z"])
def test_training_takes_the_axis_that_it_is_told(
    lcollision: Lcollision, tmp_path: Path, up: str
) -> None:
    path, out = tmp_path / "tubes.npz", tmp_path / "tube.safetensors"
    write_pose_set(path, bending_tube(3))
    size = ["--domains", 2, "--domain-codes", 2]
    result = lcollision("train", "embedding", path, "-o", out, *size, "--up", up)
    assert result.exit_code == 0, result.stderr
    assert "xyz"[LearnedBody.load(out).up_axis] == up
