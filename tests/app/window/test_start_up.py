"""Start of the editor: its model, and the modules loaded before the window is shown."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.window.main_window import MainWindow
from app.window.start_up import DEFAULT_MODEL, StartUp, last_model
from app.work.threads import Failure
from lcollision_core.bodies import LearnedBody
from tests.app.windows import settings_in


def test_a_model_that_is_gone_gives_way_to_the_default(tmp_path: Path) -> None:
    file = tmp_path / "mine.safetensors"
    assert last_model(str(file)) == DEFAULT_MODEL
    file.touch()
    assert last_model(str(file)) == str(file)
    assert last_model("body-swing") == "body-swing"
    assert last_model("") == last_model("no such model") == DEFAULT_MODEL


def test_nothing_that_is_compiled_is_loaded_before_there_is_a_window() -> None:
    window = "app.window.editor, app.window.main_window, app.editing.document"
    assert not loaded_with(window, "numba", "torch", "vtkmodules", "lcollision_core.motion")


def test_a_body_is_opened_without_what_only_learning_and_statistics_need() -> None:
    bodies = "lcollision_core.bodies.public"
    assert not loaded_with(bodies, "torch", "scipy.stats", "scipy.optimize")


def loaded_with(imported: str, *modules: str) -> set[str]:
    """Return the given modules that an import loads in a new process."""
    code = f"import sys; import {imported}; print(*sys.modules)"
    told = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return set(modules) & set(told.stdout.split())


def test_a_file_without_a_skeleton_is_refused_for_what_it_is(
    qtbot: QtBot, editor_model: LearnedBody, stabbed: Path, tmp_path: Path
) -> None:
    last = tmp_path / "yesterday.safetensors"
    editor_model.save(last)
    document, settings = PoseDocument(), settings_in(tmp_path)
    settings["model"] = str(last)
    window = MainWindow(document, settings)
    handlers = [(number, signal.getsignal(number)) for number in (signal.SIGINT, signal.SIGTERM)]
    failures: list[Failure] = []
    document.failed.connect(failures.append)
    try:
        window.show()
        StartUp(window, stabbed, None).begin()
        qtbot.waitUntil(lambda: bool(failures))
        qtbot.waitUntil(lambda: document.motion.exact is not None)
    finally:
        for number, handler in handlers:
            signal.signal(number, handler)
    said = "stabbed.obj has no skeleton to pose it by, and is no mesh of the body that is open"
    assert failures[0].headline == said
    assert "yesterday" not in f"{failures[0].headline} {failures[0].next_step}"
    failures.clear()
    # In a window whose body the user has chosen, it is compared with that.
    window.files.open_path(stabbed)
    qtbot.waitUntil(lambda: bool(failures))
    assert "the model 'yesterday'" in failures[0].headline
    assert "has no skeleton" not in failures[0].headline
