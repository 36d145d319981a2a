"""The rules that tools check: lint, format, types, and the direction of imports."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import sysconfig
import venv
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

ROOT = Path(__file__).parents[1]


TYPES = ROOT / "tests" / "types.txt"


@pytest.mark.parametrize(
    "command",
    [
        ("ruff", "check", "."),
        ("ruff", "format", "--check", "."),
        ("lint-imports",),
    ],
    ids=" ".join,
)
def test_tool_has_no_complaint(command: tuple[str, ...]) -> None:
    _require_no_complaint(*command)


def test_types_fit(python_with_fixed_types: Path) -> None:
    _require_no_complaint("mypy", "--python-executable", str(python_with_fixed_types))


def _require_no_complaint(name: str, *arguments: str) -> None:
    tool = Path(sysconfig.get_path("scripts")) / name
    result = subprocess.run(
        [tool, *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.fixture(scope="module")
def python_with_fixed_types() -> Path:
    """Return a Python that finds the packages of `TYPES` before the environment's own.

    It is made once, which needs the network, and kept inside the environment. On every Python they
    are those for 3.11, of which mypy reads the sources and stubs alone.
    """
    digest = hashlib.sha256(TYPES.read_bytes()).hexdigest()[:12]
    folder = Path(sys.prefix) / "lcollision-types" / digest
    if not folder.exists():
        folder.parent.mkdir(exist_ok=True)
        with TemporaryDirectory(dir=folder.parent) as unfinished:
            _make_types(Path(unfinished) / "python")
            (Path(unfinished) / "python").rename(folder)
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def _make_types(folder: Path) -> None:
    venv.create(folder, symlinks=os.name != "nt")
    (site,) = folder.rglob("site-packages")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--target", site, "-r", TYPES]
    only = ["--no-deps", "--only-binary=:all:", "--python-version", "3.11"]
    result = subprocess.run([*command, *only], capture_output=True, text=True, check=False)
    if result.returncode:
        pytest.fail(
            f"the packages of {TYPES}, whose types mypy judges by, cannot be installed, which "
            f"needs the network once: {result.stderr}"
        )
    for file in site.rglob("*"):
        if file.is_file() and file.suffix not in {".py", ".pyi", ".typed"}:
            file.unlink()
    (site / "environment.pth").write_text(sysconfig.get_path("purelib"))


def _warn(kind: type[Warning], module: str) -> None:
    warnings.warn_explicit("it changes", kind, f"{module}.py", 1, module)


@pytest.mark.parametrize("kind", [DeprecationWarning, FutureWarning, UserWarning])
def test_warnings_of_our_code_are_errors_and_those_of_others_are_not(kind: type[Warning]) -> None:
    for module in ("app.window.main_window", "lcollision_core.meshes", "tests.conftest", __name__):
        with pytest.raises(kind):
            _warn(kind, module)
    with warnings.catch_warnings(record=True) as caught:
        _warn(kind, "numpy._core")
        _warn(kind, "application")
    assert [warning.category for warning in caught] == [kind, kind]


def test_numbers_that_go_wrong_are_errors_wherever_they_do() -> None:
    with pytest.raises(RuntimeWarning):
        _warn(RuntimeWarning, "scipy.linalg")


def test_no_source_file_is_over_700_lines() -> None:
    lengths = {
        str(path.relative_to(ROOT)): len(path.read_text().splitlines())
        for folder in ("app", "lcollision_core")
        for path in (ROOT / folder).rglob("*.py")
    }
    assert len(lengths) > 10
    assert {name: length for name, length in lengths.items() if length > 700} == {}
