"""The architecture page matches the code."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "architecture.md").read_text()


def test_every_file_that_the_architecture_names_is_there() -> None:
    names = {name.rsplit("/", 1)[-1] for name in re.findall(r"`?([\w/]+\.py)\b", PAGE)}
    there = {
        path.name for room in ("app", "lcollision_core") for path in (ROOT / room).rglob("*.py")
    }
    assert len(names) > 15
    assert names <= there


def test_every_room_is_in_the_architecture() -> None:
    rooms = {
        f"  {path.name}/"
        for package in ("app", "lcollision_core")
        for path in (ROOT / package).iterdir()
        if (path / "__init__.py").is_file()
    }
    assert {room for room in rooms if f"\n{room} " not in PAGE} == set()
