"""A wheel built from the checkout, installed elsewhere, run from another folder."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel and unpack it into a separate folder, without the network."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    wheel = ["wheel", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir"]
    subprocess.run([*pip, *wheel, str(folder), str(ROOT)], check=True)
    (built,) = folder.glob("lcollision-*.whl")
    target = folder / "site"
    install = ["install", "--no-compile", "--no-deps", "--no-index", "--target"]
    subprocess.run([*pip, *install, str(target), str(built)], check=True)
    return target


def _run(site: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(site)}
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


def test_it_finds_every_resource(site: Path, tmp_path: Path) -> None:
    shipped = sorted(
        str(path.relative_to(ROOT))
        for path in (ROOT / "resources").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    )
    code = (
        "from lcollision_core.bundled import bundled_file\n"
        f"for name in {shipped!r}:\n"
        "    print(bundled_file(*name.split('/')[1:]))\n"
    )
    result = _run(site, tmp_path, "-c", code)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines() == [str(site / name) for name in shipped]


def test_its_program_checks_a_bundled_pose(site: Path, tmp_path: Path) -> None:
    pose = site / "resources" / "poses" / "windmill.obj"
    result = _run(site, tmp_path, "-m", "app", "check", "--json", str(pose))
    assert result.returncode == 1, result.stderr
    (report,) = json.loads(result.stdout)
    assert report["colliding"]
    assert report["pairs"] > 0
