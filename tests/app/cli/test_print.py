"""``lcollision print``: figures for a 3D printer."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh

from lcollision_core.bodies import LearnedBody, NamedPose, open_body, write_poses
from lcollision_core.files import read_mesh
from lcollision_core.resolve import PoseResolver
from tests.app.support import Lcollision, refusal
from tests.core.gltf_builder import arm

CORE = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"


@pytest.fixture(scope="module")
def windmill() -> Path:
    """Return a pose of the built-in body that collides."""
    return Path("resources/poses/windmill.obj")


@pytest.fixture(scope="module")
def one_pose(tmp_path_factory: pytest.TempPathFactory) -> Path:
    body = LearnedBody.load("body")
    path = tmp_path_factory.mktemp("poses") / "one.json"
    write_poses(path, body, [NamedPose("one", body.known_poses[1])])
    return path


def test_a_pose_is_resolved_and_printed_as_stl(
    lcollision: Lcollision, windmill: Path, tmp_path: Path
) -> None:
    path = tmp_path / "figure.stl"
    done = lcollision("print", "body", windmill, "-o", path, "--height", 60, "--json")
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert (told["output"], told["height"]) == (str(path), 60.0)
    assert told["pairs_before"] > 0 == told["pairs_after"]
    assert (told["closed"], told["capped"], told["thickened"]) == (1, 0, 0)
    assert 0.0 < told["thinnest"] <= told["wall"] == 1.0
    mesh = trimesh.load_mesh(path)
    assert mesh.is_volume
    assert len(mesh.faces) == told["n_faces"]
    assert mesh.volume == pytest.approx(told["volume"], rel=1e-5)
    assert mesh.extents[2] == pytest.approx(60.0, abs=1e-4)
    assert mesh.bounds[0] == pytest.approx(0.0, abs=1e-4)
    # It bends down as in its own file, not in the pose of the encoded body.
    shape = np.ptp(read_mesh(windmill).vertices, axis=0)
    assert mesh.extents == pytest.approx(shape * 60.0 / shape[2], rel=0.03)
    checked = lcollision("check", path, "--no-rules", "--json")
    assert json.loads(checked.stdout)[0]["pairs"] == 0


def test_a_3mf_says_its_unit_and_holds_the_same_solid(
    lcollision: Lcollision, one_pose: Path, tmp_path: Path
) -> None:
    paths = [tmp_path / "figure.3mf", tmp_path / "figure.stl"]
    for path in paths:
        done = lcollision("print", "body", one_pose, "-o", path, "--base", 3)
        assert done.exit_code == 0, done.output
        assert "one closed volume" in done.stdout
    with zipfile.ZipFile(paths[0]) as package:
        assert package.namelist()[0] == "[Content_Types].xml"
        model = ElementTree.fromstring(package.read("3D/3dmodel.model"))
    assert model.get("unit") == "millimeter"
    vertices = [[float(v.get(k)) for k in "xyz"] for v in model.iter(f"{CORE}vertex")]
    faces = [[int(t.get(f"v{n}")) for n in (1, 2, 3)] for t in model.iter(f"{CORE}triangle")]
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_volume
    # The figure stands half a wall thickness deep in its base.
    assert mesh.extents[2] == pytest.approx(100.0 + 3.0 - 0.5, abs=1e-4)
    assert mesh.volume == pytest.approx(trimesh.load_mesh(paths[1]).volume, rel=1e-5)
    bottom = mesh.vertices[mesh.vertices[:, 2] == 0.0]
    assert np.ptp(bottom[:, 0]) == pytest.approx(np.ptp(bottom[:, 1]), rel=1e-2)


def test_the_front_of_a_character_is_towards_the_viewer_of_a_printer(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    character, poses = arm().write(tmp_path / "arm.glb"), tmp_path / "rest.json"
    body = open_body(str(character))
    write_poses(poses, body, [NamedPose("rest", np.zeros(body.latent_size))])
    path = tmp_path / "arm.stl"
    done = lcollision("print", character, poses, "-o", path, "--open-layers", "thicken")
    assert done.exit_code == 0, done.output
    rest = body.decode(np.zeros(body.latent_size)) * (100.0 / np.ptp(body.reference[:, 1]))
    turned = rest @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]).T
    found = trimesh.load_mesh(path).bounds
    assert np.ptp(found, axis=0) == pytest.approx(np.ptp(turned, axis=0), abs=2.5)


def test_a_pose_that_is_not_freed_is_printed_with_exit_status_1(
    lcollision: Lcollision, windmill: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # No small body is known that Resolve cannot free, so make it fail.
    monkeypatch.setattr(
        PoseResolver, "resolve", lambda _, latent, *__: SimpleNamespace(latent=latent)
    )
    command = ("print", "body", windmill, "-o", tmp_path / "figure.stl")
    done = lcollision(*command)
    assert done.exit_code == 1, done.output
    assert "still collided and grew together" in done.stdout
    assert (tmp_path / "figure.stl").is_file()
    assert lcollision(*command, "--no-resolve").exit_code == 0


def test_what_cannot_be_printed_is_one_sentence_and_no_file(
    lcollision: Lcollision, windmill: Path, one_pose: Path, tmp_path: Path
) -> None:
    path = tmp_path / "figure.stl"
    for arguments, sentence in (
        (("body", one_pose, "-o", tmp_path / "figure.obj"), "must be a .stl or .3mf file"),
        (("body", one_pose, "-o", path, "--height", 0), "--height"),
        (("body", one_pose, "-o", path, "--pose", "two"), "has no pose named 'two'; name one by"),
        (("body", one_pose, "-o", path, "--without", "component 1"), "leaves nothing to print"),
        (("body", one_pose, "-o", path, "--without", "hat"), "hat"),
        (("body", windmill.with_name("none.obj"), "-o", path), "none.obj"),
    ):
        assert sentence in refusal(lcollision, "print", *arguments)
    assert not list(tmp_path.iterdir())
