"""The scripts of docs/examples, run as users do."""

from __future__ import annotations

import csv
import runpy
import shutil
import sys
from pathlib import Path

import pytest

import lcollision_core
from lcollision_core.bodies import LearnedBody
from lcollision_core.files import read_mesh

ROOT = Path(__file__).parents[2]
POSES = ROOT / "resources" / "poses"


def _run(monkeypatch: pytest.MonkeyPatch, name: str, *arguments: object) -> None:
    path = ROOT / "docs" / "examples" / name
    assert len(path.read_text().splitlines()) <= 50
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    runpy.run_path(str(path), run_name="__main__")


def test_meshes_are_checked_and_resolved(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    meshes = [POSES / "windmill.obj", POSES / "rest.obj"]
    _run(monkeypatch, "check_and_resolve.py", "body", *meshes, "-o", tmp_path / "free")
    said = capsys.readouterr().out.splitlines()
    assert "50 pairs of faces collided, 0 do now" in said[0]
    assert said[1].endswith("rest.obj: no collisions")
    (written,) = (tmp_path / "free").iterdir()
    assert not LearnedBody.load("body").detector.detect(read_mesh(written).vertices).n_pairs


@pytest.mark.slow
def test_the_collision_loss_keeps_generated_poses_free(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shares = []
    for weight in (0.1, 0):
        _run(monkeypatch, "collision_loss.py", "body", "--steps", 50, "--weight", weight)
        last = capsys.readouterr().out.splitlines()[-1]
        shares.append(int(last.split(" % collide")[0].split()[-1]))
    assert shares[0] <= 10
    assert shares[1] >= shares[0] + 20


def test_a_folder_is_screened(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for mesh in POSES.glob("*.obj"):
        shutil.copy(mesh, tmp_path)
    _run(monkeypatch, "screen_folder.py", tmp_path, "-o", tmp_path / "report.csv")
    assert "1 of 2 collide" in capsys.readouterr().out
    with (tmp_path / "report.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["file"], row["pairs"]) for row in rows] == [
        ("windmill.obj", "50"),
        ("rest.obj", "0"),
    ]
    assert float(rows[0]["deepest, % of the body size"]) > 0.1
    assert rows[1]["x"] is None


def test_the_paper_s_pairs_change_no_verdict_as_the_page_says(
    capsys: pytest.CaptureFixture[str],
) -> None:
    page = (ROOT / "docs" / "reproducing.md").read_text()
    code = page.split("```python\n")[1].split("```")[0]
    exec(compile(code, "reproducing.md", "exec"), {})
    assert capsys.readouterr().out.strip() == code.rsplit("# ", 1)[1].strip()


def test_the_package_says_its_version_and_that_it_is_typed() -> None:
    from importlib.metadata import version

    assert lcollision_core.__version__ == version("lcollision")
    assert (Path(lcollision_core.__file__).parent / "py.typed").is_file()


@pytest.mark.slow
def test_the_api_reference_is_made_from_the_docstrings(tmp_path: Path) -> None:
    import pdoc

    pdoc.render.configure(docformat="numpy")
    pages = pdoc.pdoc("lcollision_core.predictor.pose_module", output_directory=tmp_path)
    assert pages is None
    page = (tmp_path / "lcollision_core" / "predictor" / "pose_module.html").read_text()
    assert "A learned model, differentiable by its latent codes" in page
