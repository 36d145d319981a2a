"""``lcollision dataset check`` and ``dataset make``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.files import PoseSet, read_pose_set, write_mesh, write_pose_set
from lcollision_core.files.motion.caches import write_point_cache
from lcollision_core.meshes import ContactRules, Topology
from tests.app.support import Lcollision
from tests.core.gltf_builder import arm, rotation, tube
from tests.rigged_shapes import rigged_body, write_gltf

TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])


@pytest.fixture
def two_tetrahedra() -> PoseSet:
    """Two watertight bodies: apart in pose 0, one penetrating the other by 0.1 in pose 1."""
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
        "rules": ContactRules().to_json(),
        "proposed_ignored": [],
        "excluded_at_rest": {
            "near": 0,
            "rest": 0,
            "ignored": 0,
            "tolerated": 0,
            "joint": 0,
            "touching": 0,
            "shape": 0,
        },
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


def test_the_frames_of_characters_become_a_pose_set(lcollision: Lcollision, tmp_path: Path) -> None:
    output = tmp_path / "arm.npz"
    files = [arm().write(tmp_path / name) for name in ("one.glb", "two.vrm")]
    result = lcollision("dataset", "make", *files, "-o", output, "--clip", "wave", "--fps", 4)
    assert result.exit_code == 0
    assert result.stderr.splitlines()[-1].endswith(f"wrote 11 poses of 44 vertices to {output}")
    poses = read_pose_set(output)
    # The rest pose of the second is that of the first.
    assert poses.names[:3] == ("one rest", "one wave 0", "one wave 1")
    assert poses.names[6] == "two wave 0"
    assert poses.up_axis == 1
    assert poses.vertex_labels is not None
    report = json.loads(lcollision("dataset", "check", files[0], "--json").stdout)
    assert report["poses"] == 4
    assert report["up_axis"] == "y"
    assert report["up_is_sure"]
    lcollision("dataset", "make", files[0], "-o", output, "--up", "z")
    assert read_pose_set(output).up_axis == 2


def test_a_set_whose_up_axis_is_not_sure_asks_for_it(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    vertices, faces = tube()
    write_mesh(tmp_path / "tube.obj", vertices, faces)
    write_point_cache(tmp_path / "tube.mdd", vertices[None])
    output = tmp_path / "tube.npz"
    result = lcollision("dataset", "make", tmp_path / "tube.mdd", "-o", output)
    assert result.exit_code == 0
    assert "--up x|y|z overrides it" in result.stderr
    result = lcollision("dataset", "make", tmp_path / "tube.mdd", "-o", output, "--up", "y")
    assert "--up" not in result.stderr
    assert read_pose_set(output).up_axis == 1


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["body", "--clip", "wave"], "--clip applies to files, not to body"),
        (["body", "body-jump"], "body can't be combined with other sources, got body, body-jump"),
        (["body", "--by-rig", "5"], "--by-rig applies to files, not to body"),
        (["arm.glb", "--vertices", "600"], "--vertices applies only to the built-in body"),
        (
            ["arm.glb", "--seed", "1"],
            "--seed applies only to the built-in body and to poses by the rig",
        ),
        (["arm.glb", "--clip", "run"], "arm.glb cannot be read: it has no clip 'run'"),
        (["none.glb"], "none.glb does not exist"),
        (["arm.glb", "other.glb"], "has another number of vertices than the set"),
    ],
)
def test_options_and_files_that_do_not_fit_get_one_sentence(
    lcollision: Lcollision,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    sentence: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    arm().write(Path("arm.glb"))
    builder = arm()
    more = builder.array(np.eye(3))
    builder.description["nodes"][3]["mesh"] = builder.add(
        "meshes", primitives=[{"attributes": {"POSITION": more}}]
    )
    builder.animation(
        "wave 2",
        {"node": 2, "path": "rotation", "times": [0.0], "values": [rotation(0, 0.0)]},
    )
    builder.write(Path("other.glb"))
    result = lcollision("dataset", "make", *arguments, "-o", "out.npz")
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert not Path("out.npz").exists()


def test_a_rig_makes_the_poses_of_a_set(lcollision: Lcollision, tmp_path: Path) -> None:
    file = write_gltf(rigged_body(), tmp_path / "still.gltf")
    first, again, other = (tmp_path / name for name in ("one.npz", "two.npz", "three.npz"))
    result = lcollision("dataset", "make", file, "--by-rig", 6, "--seed", 2, "-o", first)
    assert result.exit_code == 0
    poses = read_pose_set(first)
    assert len(poses) == 7
    made = poses.provenance["sources"][1]["by_rig"]
    assert f"{made['free']} of 6 poses by the rig are free of collisions" in result.stderr
    assert f"wrote 7 poses of {poses.topology.n_vertices} vertices" in result.stderr
    lcollision("dataset", "make", file, "--by-rig", 6, "--seed", 2, "-o", again)
    assert again.read_bytes() == first.read_bytes()
    lcollision("dataset", "make", file, "--by-rig", 6, "-o", other)
    assert not np.array_equal(read_pose_set(other).vertices, poses.vertices)
    # A file without animation is not a pose set by itself.
    result = lcollision("dataset", "make", file, "-o", tmp_path / "none.npz")
    assert result.exit_code == 2
    assert "it contains no animation" in result.stderr
    result = lcollision("dataset", "make", first, "--by-rig", 6, "-o", tmp_path / "none.npz")
    assert result.exit_code == 2
    assert "one.npz has no joints to pose it by" in result.stderr
