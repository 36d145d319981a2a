"""Which model the editor starts with."""

from __future__ import annotations

from pathlib import Path

from app.window.start_up import DEFAULT_MODEL, last_model


def test_a_model_that_is_gone_gives_way_to_the_default(tmp_path: Path) -> None:
    file = tmp_path / "mine.safetensors"
    assert last_model(str(file)) == DEFAULT_MODEL
    file.touch()
    assert last_model(str(file)) == str(file)
    assert last_model("body-swing") == "body-swing"
    assert last_model("") == last_model("no such model") == DEFAULT_MODEL
