"""What the tests of the command line and of the editor share."""

from __future__ import annotations

import gc
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from pytestqt.qtbot import QtBot

from app.document import PoseDocument
from lcollision_core.model import PoseModel
from tests.app.editor_model import trained_tube
from tests.app.support import STABBED

_WINDOW_TESTS = {"test_viewport", "test_editor_window", "test_editor_use"}
_PREPARED_MODEL = "LCOLLISION_PREPARED_MODEL"
"""Names the model that the process which started this one has trained."""

if _PREPARED_MODEL in os.environ:
    # Collecting what a closed window leaves behind can crash in the driver too.
    gc.disable()


def pytest_runtest_protocol(item: pytest.Item) -> bool | None:
    """Give each test that opens real windows a process of its own, as the program has.

    Dozens of windows opened and closed in one process corrupt the heap inside the software OpenGL
    driver sooner or later.
    """
    if item.path.stem not in _WINDOW_TESTS or _PREPARED_MODEL in os.environ:
        return None
    folder = Path(item.config.cache.mkdir(f"window-tests-{os.getpid()}"))
    model = folder / "tube.safetensors"
    if not model.exists():
        trained_tube().save(model)
        item.config.add_cleanup(lambda: shutil.rmtree(folder))
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    ended = subprocess.run(
        [
            *(sys.executable, "-X", "faulthandler", "-m", "pytest"),
            *("-q", "-p", "no:hypothesispytest", item.nodeid),
        ],
        cwd=item.config.rootpath,
        env={**os.environ, _PREPARED_MODEL: str(model)},
        capture_output=True,
        text=True,
        check=False,
    )
    passed = ended.returncode == 0 and "1 passed" in ended.stdout
    report = pytest.TestReport(
        nodeid=item.nodeid,
        location=item.location,
        keywords={},
        outcome="passed" if passed else "failed",
        longrepr=None if passed else f"exit {ended.returncode}\n{ended.stdout}{ended.stderr}",
        when="call",
    )
    item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


@pytest.hookimpl(tryfirst=True)
def pytest_unconfigure(config: pytest.Config) -> None:
    """End a process of one test as it stands: the report is out, and only collecting is left."""
    if _PREPARED_MODEL in os.environ:
        failed = config.pluginmanager.get_plugin("terminalreporter").stats.get("failed", [])
        errors = config.pluginmanager.get_plugin("terminalreporter").stats.get("error", [])
        sys.stdout.flush()
        os._exit(1 if failed or errors else 0)


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


@pytest.fixture(scope="session")
def editor_model() -> PoseModel:
    """Return a small model with a predictor."""
    prepared = os.environ.get(_PREPARED_MODEL)
    return PoseModel.load(prepared) if prepared else trained_tube()


@pytest.fixture
def document(qtbot: QtBot, editor_model: PoseModel) -> Iterator[PoseDocument]:
    """Return a document whose first pose is computed and checked; its threads end with the test."""
    held = PoseDocument()
    with qtbot.waitSignal(held.exact_changed, check_params_cb=lambda: held.exact is not None):
        held.set_model(editor_model)
    yield held
    assert held.close()
    held.deleteLater()
