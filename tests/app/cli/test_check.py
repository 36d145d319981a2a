"""``lcollision check``: its verdict, its JSON, its exit status, its sentences."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.meshes import ContactRules, write_mesh
from tests.app.support import STABBED, Lcollision


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
        },
        "rules": ContactRules().to_json(),
        "coincident_pairs": 0,
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
    # The faces 0 and 3 of a folded strip of four share no vertex; one edge joins them.
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
    assert f"{twice}: 1 pair of faces lies exactly on each other" in result.stderr
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
    "point.obj": ("v 3 2 1\n" * 3, "one point"),
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
        "lcollision: the answer cannot be written: the disk is full"
    )


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
        "from lcollision_core import meshes\n"
        "meshes.read_mesh = lambda path: 1 / 0\n"
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
