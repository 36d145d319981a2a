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
    window = "app.window.editor, app.window.main_window, app.editing.document"
    assert not loaded_with(window, "numba", "torch", "vtkmodules", "lcollision_core.motion")


def test_a_body_is_opened_without_what_only_learning_and_statistics_need() -> None:
    assert not loaded_with("lcollision_core.model", "torch", "scipy.stats", "scipy.optimize")


def loaded_with(imported: str, *modules: str) -> set[str]:
    """Return which of some modules an import loads in a new process."""
    code = f"import sys; import {imported}; print(*sys.modules)"
    told = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return set(modules) & set(told.stdout.split())
