"""``lcollision check``: verdict, JSON, exit status and sentences."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lcollision_core.bodies import NamedPose, open_body, write_poses
from lcollision_core.bodies.remembered import remember_file
from lcollision_core.files import read_own_file, write_mesh
from lcollision_core.files.scene_files import open_scene
from lcollision_core.meshes import ContactRules
from tests.app.support import STABBED, Lcollision
from tests.core.character_file import described, figure
from tests.core.gltf_builder import GltfBuilder
from tests.rigged_shapes import head_in_torso, write_gltf


def test_collision_is_reported_with_its_energy(lcollision: Lcollision, stabbed: Path) -> None:
    result = lcollision("check", "--json", stabbed)
    assert result.exit_code == 1
    (report,) = json.loads(result.stdout)
    assert report.pop("seconds") > 0
    assert report.pop("energy") == pytest.approx(0.1**2)
    assert report.pop("deepest") == [{"faces": [0, 1], "depth": pytest.approx(0.1)}]
    assert report == {
        "file": str(stabbed),
        "vertices": 6,
        "faces": 2,
        "watertight": False,
        "pairs": 1,
        "near_pairs": 0,
        "excluded_pairs": {
            "near": 0,
            "rest": 0,
            "ignored": 0,
            "tolerated": 0,
            "joint": 0,
            "touching": 0,
            "shape": 0,
        },
        "rules": ContactRules().to_json(),
        "rules_of": None,
        "coincident_pairs": 0,
        "clearance": 0.0,
        "least_distance": None,
        "least_at": None,
        "colliding": True,
    }


def test_energy_is_in_squared_heights_of_the_mesh(
    lcollision: Lcollision, stabbed: Path, tmp_path: Path
) -> None:
    larger = tmp_path / "larger.obj"
    scaled = [
        " ".join(["v", *(str(100 * float(x)) for x in line.split()[1:])])
        if line.startswith("v")
        else line
        for line in STABBED.splitlines()
    ]
    larger.write_text("\n".join(scaled))
    reports = json.loads(lcollision("check", "--json", stabbed, larger).stdout)
    assert reports[0]["energy"] == pytest.approx(reports[1]["energy"], rel=1e-12)


def test_free_mesh_exits_with_zero(lcollision: Lcollision, apart: Path) -> None:
    result = lcollision("check", apart)
    assert result.exit_code == 0
    assert "no collisions (" in result.stdout
    assert "(6 vertices, 2 faces, " in result.stdout


def test_one_face_is_no_faces(lcollision: Lcollision, tmp_path: Path) -> None:
    (tmp_path / "one.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert "(3 vertices, 1 face, " in lcollision("check", tmp_path / "one.obj").stdout


def test_a_folder_stands_for_its_meshes(
    lcollision: Lcollision, apart: Path, stabbed: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    assert lcollision("check", folder, apart).exit_code == 2
    (folder / "a10.obj").write_text(stabbed.read_text())
    (folder / "a9.obj").write_text(apart.read_text())
    result = lcollision("check", "--json", apart, folder)
    assert result.exit_code == 1
    assert [(report["file"], report["colliding"]) for report in json.loads(result.stdout)] == [
        (str(apart), False),
        (str(folder / "a9.obj"), False),
        (str(folder / "a10.obj"), True),
    ]
    assert lcollision("check", apart, folder).stdout.endswith("\n1 of 3 meshes collide\n")


def test_several_files_come_in_order(lcollision: Lcollision, apart: Path, stabbed: Path) -> None:
    result = lcollision("check", "--json", apart, stabbed, apart)
    assert result.exit_code == 1
    assert [report["colliding"] for report in json.loads(result.stdout)] == [False, True, False]


def test_open_mesh_is_checked_with_a_warning(lcollision: Lcollision, apart: Path) -> None:
    result = lcollision("check", "--json", apart)
    assert "open" in result.stderr
    assert str(apart) in result.stderr
    assert len(json.loads(result.stdout)) == 1


def test_near_pairs_are_counted_apart(lcollision: Lcollision, tmp_path: Path) -> None:
    strip = tmp_path / "strip.obj"
    # Faces 0 and 3 of a folded strip of four share no vertex; one edge joins them.
    strip.write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nv 0.2 0.2 0.5\nv 0.3 0.2 -0.1\n"
        "f 1 2 3\nf 2 4 3\nf 3 4 5\nf 4 6 5\n"
    )
    counted = json.loads(lcollision("check", "--json", strip).stdout)[0]
    apart = lcollision("check", "--json", "--near-exclusion", 1, strip)
    assert counted["pairs"] > 0
    excluded = json.loads(apart.stdout)[0]
    assert (excluded["pairs"], excluded["near_pairs"]) == (0, counted["pairs"])
    assert apart.exit_code == 0


def test_surfaces_that_coincide_are_free_with_a_warning(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    twice = tmp_path / "twice.off"
    twice.write_text("OFF\n6 2 0\n" + "0 0 0\n1 0 0\n0 1 0\n" * 2 + "3 0 1 2\n3 3 4 5\n")
    result = lcollision("check", "--json", twice)
    assert result.exit_code == 0
    assert f"{twice}: 1 pair of faces coincides" in result.stderr
    (report,) = json.loads(result.stdout)
    assert (report["coincident_pairs"], report["pairs"], report["deepest"]) == (1, 0, [])


def test_the_deepest_of_many_pairs_are_listed(lcollision: Lcollision, tmp_path: Path) -> None:
    path = tmp_path / "many.ply"
    corners = np.random.default_rng(1).random((360, 3))
    write_mesh(path, corners, np.arange(360).reshape(-1, 3))
    (report,) = json.loads(lcollision("check", "--json", path).stdout)
    depths = [pair["depth"] for pair in report["deepest"]]
    assert report["pairs"] > len(depths) == 100
    assert depths == sorted(depths, reverse=True)
    assert sum(depth**2 for depth in depths) < report["energy"]


BAD_FILES = {
    "empty.obj": (b"", "it is empty"),
    "garbage.obj": (bytes(range(256)) * 20, "garbage.obj"),
    "garbage.ply": (bytes(range(256)) * 20, "garbage.ply"),
    "nan.obj": (STABBED.replace("0.3", "nan").encode(), "vertex 5"),
    "index.obj": (STABBED.replace("f 4 5 6", "f 4 5 7").encode(), "expected 0 to 5"),
    "truncated.ply": (b"ply\nformat ascii 1.0\nelement vertex 3\n", "truncated.ply"),
    "huge.ply": (
        b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\n"
        b"property float y\nproperty float z\nelement face 50000000\n"
        b"property list uchar int vertex_indices\nend_header\n",
        "50000000",
    ),
    "pose.docx": (b"PK", ".obj"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_file_gets_one_sentence_and_exit_status_2(
    lcollision: Lcollision, tmp_path: Path, name: str
) -> None:
    content, expected = BAD_FILES[name]
    path = tmp_path / name
    path.write_bytes(content)
    result = lcollision("check", path)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert len(result.stderr.splitlines()) == 1
    assert name in result.stderr
    assert expected in result.stderr


def test_missing_file_gets_one_sentence(lcollision: Lcollision, tmp_path: Path) -> None:
    result = lcollision("check", tmp_path / "nowhere.obj")
    assert result.exit_code == 2
    assert len(result.stderr.splitlines()) == 1
    assert "nowhere.obj" in result.stderr


def test_good_files_are_reported_beside_a_bad_one(
    lcollision: Lcollision, apart: Path, tmp_path: Path
) -> None:
    result = lcollision("check", "--json", tmp_path / "nowhere.obj", apart)
    assert result.exit_code == 2
    assert [report["file"] for report in json.loads(result.stdout)] == [str(apart)]


UNCHECKABLE = {
    "point.obj": ("v 3 2 1\n" * 3, "all vertices are at one point"),
    "vast.obj": ("v -1.7e308 0 0\nv 1.7e308 0 0\nv 0 1 0\n", "scale it"),
    "far.obj": ("v 1e12 0 0\nv 1e12 1 0\nv 1e12 0 1\n", "vertex 0 is more than"),
}


@pytest.mark.parametrize("name", UNCHECKABLE)
def test_mesh_that_cannot_be_checked_is_named(
    lcollision: Lcollision, tmp_path: Path, name: str
) -> None:
    vertices, expected = UNCHECKABLE[name]
    path = tmp_path / name
    path.write_text(vertices + "f 1 2 3\n")
    result = lcollision("check", path)
    assert result.exit_code == 2
    assert result.stdout == ""
    sentence = result.stderr.splitlines()[-1]
    assert sentence.startswith(f"lcollision: {path} cannot be checked: ")
    assert expected in sentence


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root reads all")
def test_file_without_permission_does_not_keep_the_others_from_being_checked(
    lcollision: Lcollision, apart: Path, tmp_path: Path
) -> None:
    locked = tmp_path / "locked.obj"
    locked.write_text("")
    locked.chmod(0)
    result = lcollision("check", "--json", locked, apart)
    assert result.exit_code == 2
    assert f"{locked} cannot be read: permission is denied" in result.stderr
    assert len(json.loads(result.stdout)) == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_full_disk_is_no_bug(apart: Path) -> None:
    with Path("/dev/full").open("w") as full:
        result = subprocess.run(
            [sys.executable, "-m", "app", "check", apart],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert result.returncode == 2
    assert result.stderr.splitlines()[-1] == (
        "lcollision: can't write the output: the disk is full"
    )


@pytest.mark.slow
def test_reader_that_leaves_is_no_answer(apart: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "app", "check", apart],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    process.stdout.close()
    assert process.stderr is not None
    with process.stderr as stderr:
        said = stderr.read()
    assert process.wait() == 130
    assert "Traceback" not in said
    assert "BrokenPipe" not in said


def test_a_bug_does_not_look_like_an_answer() -> None:
    code = (
        "from app.cli.main import main\n"
        "from lcollision_core import files\n"
        "files.read_mesh = lambda *_, **__: 1 / 0\n"
        "main()\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, "check", "any.obj"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 3
    assert "ZeroDivisionError" in result.stderr
    assert "bug" in result.stderr


@pytest.fixture
def exported(lcollision: Lcollision, tmp_path: Path) -> Callable[..., Path]:
    """Write a pose of a character whose shins penetrate its feet, which its rules ignore."""
    hero = write_gltf(head_in_torso(), tmp_path / "hero.glb")
    model = open_body(hero)
    write_poses(tmp_path / "poses.json", model, [NamedPose("bow", np.full(model.latent_size, 0.1))])
    ignored = ("--ignore", "Left shin:Left foot", "--ignore", "Right shin:Right foot")
    assert lcollision("contacts", hero, *ignored).exit_code == 0

    def export(name: str, *options: str) -> Path:
        out = tmp_path / name
        done = lcollision("decode", hero, tmp_path / "poses.json", "-o", out, *options)
        assert done.exit_code == 0, done.output
        return out

    return export


@pytest.mark.variants(2)
@pytest.mark.parametrize("form", ["joints", "mesh", "morph", "clip"])
def test_a_character_s_file_written_here_is_checked_by_its_rules_anywhere(
    lcollision: Lcollision,
    exported: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    form: str,
) -> None:
    out = exported("posed.glb", "--form", form)
    # Another machine has neither the character nor its chosen rules.
    (tmp_path / "hero.glb").unlink()
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "elsewhere"))
    result = lcollision("check", out)
    assert result.exit_code == 0, result.output
    assert "posed.glb: no collisions; " in result.stdout
    assert ", by the contact rules of hero (--no-rules counts all pairs) (" in result.stdout
    (report,) = json.loads(lcollision("check", "--json", out).stdout)
    assert report["rules_of"] == "hero"
    assert report["rules"]["ignored"][0] == ["Left shin", "Left foot"]
    n_left_out = sum(report["excluded_pairs"].values())
    strict = lcollision("check", "--json", "--no-rules", out)
    (report,) = json.loads(strict.stdout)
    assert strict.exit_code == 1
    assert (report["pairs"], report["rules_of"]) == (n_left_out, None)
    assert report["rules"] == ContactRules().to_json()


@pytest.mark.variants
@pytest.mark.parametrize("name", ["posed.obj", "posed.ply", "hero.glb"])
def test_a_mesh_of_a_character_that_was_opened_is_checked_by_its_rules(
    lcollision: Lcollision,
    exported: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    name: str,
) -> None:
    out = tmp_path / name
    if name != "hero.glb":
        exported(name, "--axes", "unreal")
    result = lcollision("check", "--json", out)
    (report,) = json.loads(result.stdout)
    assert (report["colliding"], report["rules_of"]) == (False, "hero")
    assert f"{out}: its contact rules are those that you chose for it" in result.stderr
    # Its energies are in its own unit, whatever the file's unit.
    depth = lcollision("check", "--json", out, "--tolerated-depth", 0.5)
    assert json.loads(depth.stdout)[0]["rules"]["tolerated_depth"] == 0.5
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "elsewhere"))
    result = lcollision("check", "--json", out)
    assert result.exit_code == 1
    assert json.loads(result.stdout)[0]["rules_of"] is None


def test_opening_a_character_does_not_change_what_is_found_in_its_file(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    hero = write_gltf(head_in_torso(), tmp_path / "hero.glb")
    reports = []
    for _ in range(2):
        (report,) = json.loads(lcollision("check", "--json", hero).stdout)
        reports.append(report | {"seconds": 0.0})
        remember_file(open_body(hero), hero)
    assert reports[0] == reports[1]
    assert reports[0]["colliding"]


def _edited(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    builder = GltfBuilder()
    builder.description, builder.blob = described(path)
    change(builder.description)
    builder.write(path)


@pytest.mark.variants(3)
@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda held: held["nodes"][0].update(name="x"), "another program has changed it since"),
        (
            lambda held: held["asset"]["extras"]["lcollision"].update(format_version=2),
            "its version must be 1, got 2; update LCollision",
        ),
        (
            lambda held: held["asset"]["extras"]["lcollision"].update(shown_by=[[1]]),
            "what it says of its source is damaged",
        ),
        (
            lambda held: held["asset"]["extras"]["lcollision"].update(shown_by=[]),
            "its vertices are not those of its source",
        ),
        (
            lambda held: held["asset"]["extras"]["lcollision"]["rules"].update(near_exclusion=-1),
            "the near exclusion must be 0 or more",
        ),
        (
            lambda held: held["asset"]["extras"]["lcollision"]["source"].update(nodes=7),
            "nodes must be a list of objects, got 7",
        ),
    ],
    ids=["changed", "later", "damaged", "other parts", "impossible rules", "impossible source"],
)
def test_what_a_file_says_of_itself_is_not_trusted(
    lcollision: Lcollision,
    exported: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    change: Callable[[dict[str, Any]], None],
    sentence: str,
) -> None:
    out = exported("posed.glb", "--form", "joints")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "elsewhere"))
    _edited(out, change)
    result = lcollision("check", "--json", out)
    assert result.exit_code == 1, result.output
    assert json.loads(result.stdout)[0]["rules_of"] is None
    (told,) = [line for line in result.stderr.splitlines() if "all pairs are counted" in line]
    assert sentence in told


def test_parts_in_another_order_and_scenery_do_not_confuse_what_is_checked(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    builder = figure()
    nodes = builder.description["nodes"]
    # Two nodes show one mesh, which becomes two in a pose; and there is a floor.
    nodes.append({"name": "Twin", "mesh": nodes[4]["mesh"], "skin": 0, "translation": [9, 0, 0]})
    floor = builder.array(np.array([[0, -9, 0], [9, -9, 0], [0, -9, 9]]))
    primitive = {"attributes": {"POSITION": floor}, "indices": builder.array(np.arange(3), "u2")}
    nodes.append({"name": "Floor", "mesh": builder.add("meshes", primitives=[primitive])})
    own, out = builder.write(tmp_path / "figure.glb"), tmp_path / "posed.glb"
    model = open_body(own)
    latent = np.full(model.latent_size, 0.3)
    write_poses(tmp_path / "poses.json", model, [NamedPose("bow", latent)])
    for form in ("joints", "mesh", "morph"):
        words = ("decode", own, tmp_path / "poses.json", "-o", out, "--form", form)
        assert lcollision(*words).exit_code == 0
        found = read_own_file(open_scene(out))
        assert found is not None
        assert found.rules == model.rules
        assert found.character.topology == model.topology
        assert np.abs(found.character.rest_vertices - model.reference).max() < 1e-9
        assert np.abs(found.vertices - model.decode(latent)).max() < 1e-5
