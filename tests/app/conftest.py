"""What the tests of the command line share."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.app.support import STABBED


@pytest.fixture
def stabbed(tmp_path: Path) -> Path:
    """Return the file of a mesh whose faces 0 and 1 collide."""
    path = tmp_path / "stabbed.obj"
    path.write_text(STABBED)
    return path


@pytest.fixture
def apart(tmp_path: Path) -> Path:
    """Return the file of the same mesh with its second face out of reach of the first."""
    path = tmp_path / "apart.obj"
    path.write_text(STABBED.replace("-0.1", "0.1"))
    return path
