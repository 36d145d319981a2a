"""The command line before any command runs: fast, light and complete."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.app.cli.commands_page import page
from tests.app.support import Lcollision
from tests.small_models import DATA


def _loaded_modules(code: str) -> set[str]:
    """Run code in a fresh interpreter and return the modules that it loaded."""
    report = "import sys; print(*sys.modules)"
    result = subprocess.run(
        [sys.executable, "-c", f"{code}\n{report}"], capture_output=True, text=True, check=True
    )
    return set(result.stdout.splitlines()[-1].split())


HEAVY = {"numpy", "scipy", "numba", "torch", "trimesh", "vtkmodules", "pyvista", "PySide6"}


def test_importing_the_command_line_loads_nothing_heavy() -> None:
    loaded = _loaded_modules("import app.cli.main")
    assert "typer" in loaded
    assert loaded & HEAVY == set()


def test_a_start_loads_the_file_of_its_command_alone() -> None:
    loaded = _loaded_modules(
        "from app.cli.main import app\napp(['check', '--help'], standalone_mode=False)"
    )
    files = {path.stem for path in (Path(__file__).parents[3] / "app" / "cli").glob("*.py")}
    commands = {"check", "resolve", "models", "benchmark", "train", "edit"}
    assert commands < files
    assert {name for name in commands if f"app.cli.{name}" in loaded} == {"check"}
    assert loaded & HEAVY == set()


def test_importing_the_core_loads_nothing_heavy() -> None:
    loaded = _loaded_modules("import lcollision_core")
    assert "lcollision_core" in loaded
    assert loaded & HEAVY == set()


def test_contact_and_meshes_load_neither_numba_nor_torch_nor_a_front_end() -> None:
    loaded = _loaded_modules("import lcollision_core.contact, lcollision_core.built_in_body")
    assert "scipy" in loaded
    assert loaded & {"numba", "torch", "anny", "vtkmodules", "pyvista", "PySide6"} == set()


def test_info_of_a_model_loads_neither_a_compiler_nor_a_part_of_scipy() -> None:
    loaded = _loaded_modules(
        "from app.cli.main import app\napp(['info', 'body'], standalone_mode=False)"
    )
    assert "lcollision_core.bodies" in loaded
    parts = {"scipy.sparse", "scipy.spatial", "scipy.linalg", "scipy.special"}
    assert loaded & (parts | HEAVY - {"numpy", "scipy"}) == set()
    others = {"bodies.rig_body", "posing.dragger", "contact.detector", "files.mesh_file", "motion"}
    assert loaded & {f"lcollision_core.{name}" for name in others} == set()


def test_info_of_a_character_loads_no_solver_and_no_network() -> None:
    words = ["info", str(DATA / "swing.glb")]
    loaded = _loaded_modules(f"from app.cli.main import app\napp({words!r}, standalone_mode=False)")
    assert "lcollision_core.bodies.rig_body" in loaded
    others = {"motion", "resolve", "predictor.predictor", "bodies.export", "posing.dragger"}
    assert loaded & {f"lcollision_core.{name}" for name in others} == set()
    assert "torch" not in loaded


def test_the_page_of_commands_is_what_help_says() -> None:
    """To regenerate the page: python -m tests.app.cli.commands_page > docs/commands.md."""
    root = Path(__file__).parents[3]
    assert (root / "docs" / "commands.md").read_text(encoding="utf-8") == page()
    assert "](docs/commands.md)" in (root / "README.md").read_text(encoding="utf-8")


def test_version_is_that_of_the_package() -> None:
    from importlib.metadata import version

    result = subprocess.run(
        [sys.executable, "-m", "app", "--version"], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == f"lcollision {version('lcollision')}"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["nonsense"], "No such command 'nonsense'; see lcollision --help"),
        (["chek"], "No such command 'chek'"),
        (["missing.obj"], "missing.obj is not there; name a file of poses, a character, a mesh"),
        (["edit", "missing.obj"], "missing.obj is not there; name a file of poses, a character"),
        (["--model"], "Option '--model' requires an argument"),
        (["--bogus"], "No such option: --bogus; see lcollision --help"),
        (["check"], "Missing argument 'MESH...'; see lcollision check --help"),
        (["dataset", "check", "--bogus"], "--bogus; see lcollision dataset check --help"),
    ],
)
def test_wrong_words_get_one_sentence(
    lcollision: Lcollision, words: list[str], sentence: str
) -> None:
    result = lcollision(*words)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert len(result.stderr.splitlines()) == 1
    assert result.stderr.startswith("lcollision: ")
    assert sentence in result.stderr


@pytest.mark.parametrize("command", [[], ["edit"]], ids=["alone", "edit"])
def test_the_editor_opens_what_it_is_given_with_its_command_or_without(
    lcollision: Lcollision, stabbed: Path, monkeypatch: pytest.MonkeyPatch, command: list[str]
) -> None:
    opened: list[tuple[Path | None, str | None]] = []

    def open_editor(path: Path | None, model_name: str | None) -> int:
        opened.append((path, model_name))
        return 0

    monkeypatch.setattr("app.window.editor.open_editor", open_editor)
    # A file needs no extension if its name is not a command's.
    monkeypatch.chdir(stabbed.parent)
    plain = Path(stabbed.stem)
    plain.write_bytes(stabbed.read_bytes())
    for words in (
        [],
        [stabbed],
        [plain],
        ["--model", "body"],
        ["--model=body", stabbed],
        [stabbed, "--model", "body"],
    ):
        assert lcollision(*command, *words).exit_code == 0
    assert opened == [
        (None, None),
        (stabbed, None),
        (plain, None),
        (None, "body"),
        (stabbed, "body"),
        (stabbed, "body"),
    ]


def test_a_group_alone_shows_its_commands(lcollision: Lcollision) -> None:
    result = lcollision("dataset")
    assert "\n  check" in result.stdout + result.stderr
