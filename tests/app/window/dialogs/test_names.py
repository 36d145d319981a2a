"""Names with line breaks or of excessive length: shown in one line, refused in one sentence."""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path

import pytest
from PySide6.QtCore import QTimer
from PySide6.QtWidgets import QDialog, QFileDialog, QLabel
from pytestqt.qtbot import QtBot

from app.window.dialogs.questions import FailureDialog
from app.window.main_window import MainWindow
from app.work.threads import Failure
from lcollision_core.bodies import LearnedBody, NamedPose, write_poses
from lcollision_core.files import write_pose_set
from lcollision_core.tasks.words import one_line
from tests.app.support import STABBED, Lcollision, export_pose
from tests.app.windows import PATIENCE, accept_and_choose, answer
from tests.bending_tube import bending_tube

pytestmark = pytest.mark.one_window

LONG = "x" * 300
TWO_LINES = "two\nlines\u2028\x1b[31m"
SHOWN = r"two\nlines\u2028\x1b[31m"


@pytest.fixture(scope="module")
def model_file(editor_model: LearnedBody, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "tube.safetensors"
    editor_model.save(path)
    return path


@pytest.fixture
def work(
    editor_model: LearnedBody, model_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """Return the current folder, with a model, its poses, a pose set and a mesh."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    shutil.copy(model_file, "m.safetensors")
    write_poses("p.json", editor_model, [NamedPose(TWO_LINES, editor_model.free_latent[:1].sum(0))])
    write_pose_set("set.npz", bending_tube())
    Path("mesh.obj").write_text(STABBED)
    return tmp_path


MORE = (
    f"sample m.safetensors -n 1 -o {LONG}.json",
    f"encode m.safetensors mesh.obj -o {LONG}.json",
    f"decode m.safetensors p.json -o {LONG}.obj",
    f"decode m.safetensors {LONG}.json -o out",
    f"resolve m.safetensors p.json -o {LONG}.json",
    f"label m.safetensors -n 1 -o {LONG}",
    f"train embedding set.npz -o {LONG}",
    f"train embedding set.npz -o {LONG}.safetensors",
    f"train predictor m.safetensors store -o {'x' * 236}.safetensors",
    f"info {LONG}",
    f"dataset check {LONG}",
    f"dataset make body -o {LONG}.npz",
)
"""Commands of the same kinds."""


@pytest.mark.parametrize(
    "command",
    [
        f"decode m.safetensors p.json -o {LONG}",
        f"resolve m.safetensors {LONG} -o out",
        # The model's name would fit, but not that of its checkpoint.
        f"train embedding set.npz -o {'x' * 236}.safetensors",
        f"info m.safetensors --figure {LONG}.png",
        f"check {LONG}.obj",
        f"edit {LONG}.json",
        *(pytest.param(command, marks=pytest.mark.slow) for command in MORE),
    ],
)
def test_a_name_that_is_too_long_is_one_sentence(
    lcollision: Lcollision, work: Path, command: str
) -> None:
    before = sorted(work.iterdir())
    result = lcollision(*command.split())
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert "too long" in line
    assert [path for path in sorted(work.iterdir()) if path.name != "data"] == before


@pytest.mark.usefixtures("work")
def test_line_breaks_in_names_are_shown_escaped(lcollision: Lcollision) -> None:
    assert one_line(TWO_LINES) == SHOWN
    Path(f"{TWO_LINES}.obj").write_text(STABBED)
    (line,) = lcollision("check", f"{TWO_LINES}.obj").stdout.splitlines()
    assert line.startswith(f"{SHOWN}.obj: colliding, 1 pair of faces")
    result = lcollision("decode", "m.safetensors", f"{TWO_LINES}.json", "-o", "out")
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"lcollision: {SHOWN}.json cannot be read")
    result = lcollision("resolve", "m.safetensors", "p.json", "-o", TWO_LINES)
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith(f"p.json: {SHOWN}: ")
    assert result.stdout.count("\n") == 1
    assert f"wrote 1 pose to {SHOWN}\n" in result.stderr


def test_plain_names_are_shown_as_they_are() -> None:
    for name in ("hand on hip", "Größe \N{DANCER}", "a\\nb", "\u5de6\u624b", "e\u0301"):
        assert one_line(name) == name


def named(window: MainWindow, name: str) -> None:
    """Open a file of one pose in a window."""
    path = Path(window.settings["last_folder"]) / "poses.json"
    model = window.document.model
    write_poses(path, model, [NamedPose(name, model.known_poses[0])])
    window.document.tasks.open_poses(path)


def test_the_window_shows_names_in_one_line(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    window.settings["last_folder"] = str(tmp_path)
    named(window, TWO_LINES)
    qtbot.waitUntil(lambda: window.document.history.pose.name == TWO_LINES, timeout=PATIENCE)
    qtbot.waitUntil(lambda: window.windowTitle().startswith(SHOWN), timeout=PATIENCE)
    window.document.message.emit(f"Saved {TWO_LINES}")
    assert window.statusBar().currentMessage() == f"Saved {SHOWN}"
    dialog = FailureDialog(Failure(f"{TWO_LINES} is damaged", "copy it again"), window)
    assert f"{SHOWN} is damaged" in [label.text() for label in dialog.findChildren(QLabel)]


def test_a_proposed_file_name_is_one(window: MainWindow, tmp_path: Path) -> None:
    window.settings["last_folder"] = str(tmp_path)
    proposed = []

    def look(dialog: QDialog) -> None:
        assert isinstance(dialog, QFileDialog)
        proposed.extend(map(Path, dialog.selectedFiles()))
        dialog.reject()

    timer = answer(look)
    window.files.ask_save("Save", "../two\nlines", {"Poses": ".json"})
    assert not timer.isActive()
    assert proposed == [tmp_path / "_two_lines.json"]


def test_a_dot_in_a_name_ends_no_format(qtbot: QtBot, window: MainWindow, tmp_path: Path) -> None:
    timers: list[QTimer] = []
    timers.append(answer(accept_and_choose(tmp_path / "walk v0.9", timers)))
    window.actions_by_key["export"].trigger()
    qtbot.waitUntil((tmp_path / "walk v0.9.obj").is_file, timeout=PATIENCE)


@pytest.mark.variants
@pytest.mark.parametrize("suffix", [".json", ".obj", ".png"])
def test_the_window_tells_of_a_name_that_is_too_long(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, suffix: str
) -> None:
    path, document = tmp_path / f"{LONG}{suffix}", window.document
    write = {
        ".json": document.tasks.save,
        ".obj": partial(export_pose, document),
        ".png": lambda path: window.viewport.pictures.screenshot(path, 64, 64, False),
    }[suffix]
    window.attempt(lambda: write(path))
    qtbot.waitUntil(lambda: bool(window.findChildren(FailureDialog)), timeout=PATIENCE)
    (failure,) = window.findChildren(FailureDialog)
    assert "too long" in failure.what.text()
    failure.reject()
