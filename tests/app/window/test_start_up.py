"""How the editor starts: with which model, and what it loads before there is a window."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from app.window.start_up import DEFAULT_MODEL, last_model


def test_a_model_that_is_gone_gives_way_to_the_default(tmp_path: Path) -> None:
    file = tmp_path / "mine.safetensors"
    assert last_model(str(file)) == DEFAULT_MODEL
    file.touch()
    assert last_model(str(file)) == str(file)
    assert last_model("body-swing") == "body-swing"
    assert last_model("") == last_model("no such model") == DEFAULT_MODEL


def test_nothing_that_is_compiled_is_loaded_before_there_is_a_window() -> None:
    code = (
        "import sys; import app.window.editor, app.window.main_window, app.editing.document; "
        "print({'numba', 'torch', 'vtkmodules', 'lcollision_core.motion'} & set(sys.modules))"
    )
    told = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert told.stdout.strip() == "set()"
