"""What the tests of the command line share."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from app.cli.main import app
from tests.app.support import STABBED, Lcollision


@pytest.fixture
def lcollision() -> Lcollision:
    """Run ``lcollision ARGUMENTS``; the result has exit_code, stdout and stderr."""

    def run(*arguments: object) -> Result:
        result = CliRunner().invoke(app, [str(argument) for argument in arguments])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result

    return run


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
