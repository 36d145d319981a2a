"""``lcollision dataset check`` and ``dataset make``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.meshes import (
    ContactRules,
    PoseSet,
    Topology,
    read_pose_set,
    write_mesh,
    write_pose_set,
)
from tests.app.support import Lcollision

TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])


@pytest.fixture
def two_tetrahedra() -> PoseSet:
    """Two watertight bodies: apart in pose 0, one poking 0.1 into the other in pose 1."""
    apart = np.concatenate([CORNERS, CORNERS + [3.0, 0, 0]])
    poked = np.concatenate([CORNERS, CORNERS + [0.2, 0.2, -0.9]])
    topology = Topology(np.concatenate([TETRAHEDRON, TETRAHEDRON + 4]), 8)
    return PoseSet(np.stack([apart, poked]), topology, ("apart", "poked"))


def test_report_of_a_good_set(
    lcollision: Lcollision, two_tetrahedra: PoseSet, tmp_path: Path
) -> None:
    path = tmp_path / "set.npz"
    write_pose_set(path, two_tetrahedra)
    result = lcollision("dataset", "check", path, "--json")
    assert result.exit_code == 0
    report = json.loads(result.stdout)
    (colliding,) = report.pop("colliding")
    assert colliding["pose"] == "poked"
    assert colliding["pairs"] == 3
    assert report.pop("up_axis") in "xyz"
    assert isinstance(report.pop("up_is_sure"), bool)
    assert report == {
        "poses": 2,
        "vertices": 8,
        "faces": 8,
        "same_topology": True,
        "watertight": True,
        "colliding_poses": 1,
        "problems": [],
        "near_exclusion": 0.0,
    }
    assert "1 pose intersects itself" in lcollision("dataset", "check", path).stdout


def test_near_exclusion_of_the_set_is_honoured(
    lcollision: Lcollision, two_tetrahedra: PoseSet, tmp_path: Path
) -> None:
    path = tmp_path / "set.npz"
    # A bridge of two faces makes the bodies one surface, so that a path joins them.
    faces = np.concatenate([two_tetrahedra.faces, [[3, 5, 6], [1, 2, 4]]])
    bridged = PoseSet(
        two_tetrahedra.vertices, Topology(faces, 8), two_tetrahedra.names, rules=ContactRules(0.99)
    )
    write_pose_set(path, bridged)
    stored = json.loads(lcollision("dataset", "check", path, "--json").stdout)
    none = json.loads(lcollision("dataset", "check", path, "--json", "--near-exclusion", 0).stdout)
    assert (stored["near_exclusion"], stored["colliding_poses"]) == (0.99, 0)
    assert (none["near_exclusion"], none["colliding_poses"]) == (0.0, 1)


def test_every_misfit_is_listed(
    lcollision: Lcollision, two_tetrahedra: PoseSet, tmp_path: Path
) -> None:
    for pose in (0, 1, 2):
        write_mesh(tmp_path / f"pose{pose}.obj", two_tetrahedra.vertices[0], two_tetrahedra.faces)
    write_mesh(tmp_path / "pose3.obj", CORNERS, TETRAHEDRON)
    (tmp_path / "pose4.obj").write_text("v 0 0 nan\n")
    result = lcollision("dataset", "check", tmp_path, "--json")
    assert result.exit_code == 1
    report = json.loads(result.stdout)
    assert report["poses"] == 5
    assert not report["same_topology"]
    assert len(report["problems"]) == 2
    assert "pose3.obj" in report["problems"][0]
    assert "pose4.obj" in report["problems"][1]


def test_what_was_done_on_reading_is_said(lcollision: Lcollision, tmp_path: Path) -> None:
    quad = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n"
    for pose in (0, 1):
        (tmp_path / f"pose{pose}.obj").write_text(quad)
    result = lcollision("dataset", "check", tmp_path, "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["faces"] == 2
    assert f"{tmp_path}: 1 quad was triangulated" in result.stderr


def test_set_that_cannot_be_checked_is_named(
    lcollision: Lcollision, two_tetrahedra: PoseSet, tmp_path: Path
) -> None:
    path = tmp_path / "set.npz"
    far = two_tetrahedra.vertices + np.array([0.0, 1e12])[:, None, None]
    write_pose_set(path, PoseSet(far, two_tetrahedra.topology, two_tetrahedra.names))
    result = lcollision("dataset", "check", path)
    assert result.exit_code == 2
    assert result.stderr.startswith(f"lcollision: {path} cannot be checked: vertex 0 of pose 1 ")


def test_path_without_poses_gets_one_sentence(lcollision: Lcollision, tmp_path: Path) -> None:
    for path in (tmp_path / "nowhere", tmp_path):
        result = lcollision("dataset", "check", path, "--json")
        assert result.exit_code == 2
        assert result.stdout == ""
        assert len(result.stderr.splitlines()) == 1
        assert str(path) in result.stderr


def test_make_refuses_a_bad_output_before_it_works(lcollision: Lcollision, tmp_path: Path) -> None:
    for output in (tmp_path / "body.obj", tmp_path / "nowhere" / "body.npz", tmp_path):
        result = lcollision("dataset", "make", "body", "-o", output)
        assert result.exit_code == 2
        assert str(output) in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_made_body_is_a_pose_set(lcollision: Lcollision, tmp_path: Path) -> None:
    output = tmp_path / "body.npz"
    result = lcollision("dataset", "make", "body", "-o", output)
    assert result.exit_code == 0
    poses = read_pose_set(output)
    assert poses.vertices.shape == (71, 2161, 3)
    assert poses.topology.is_watertight
    report = json.loads(lcollision("dataset", "check", output, "--json").stdout)
    assert report["problems"] == []
    assert report["colliding_poses"] <= 5
