"""What the tests of the command line and of the editor share."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PySide6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.view.theme import LIGHT, apply_theme
from app.view.viewport import Viewport
from app.window.main_window import MainWindow
from app.work.jobs import prepare, warm_up
from lcollision_core.bodies import LearnedBody, find_model, sample_poses
from lcollision_core.jobs import Job
from tests.app.editor_model import trained_tube
from tests.app.support import STABBED
from tests.app.views import SIDE, dispose, rest
from tests.app.windows import PATIENCE, close_window, is_open, open_window, settings_in
from tests.small_models import SWING


class PatientBot(QtBot):
    """Waits for what never comes in a failure only: as long as a busy machine may take.

    What should not come is waited for no longer than a test says.
    """

    def waitUntil(self, callback: Any, *, timeout: int = PATIENCE) -> None:  # noqa: N802
        super().waitUntil(callback, timeout=max(timeout, PATIENCE))

    def waitSignal(self, signal: Any, *, timeout: int = PATIENCE, **rest: Any) -> Any:  # noqa: N802
        if rest.get("raising", True):
            timeout = max(timeout, PATIENCE)
        return super().waitSignal(signal, timeout=timeout, **rest)


@pytest.fixture
def qtbot(request: pytest.FixtureRequest) -> QtBot:
    """Return pytest-qt's robot, of more patience."""
    request.getfixturevalue("qapp")
    return PatientBot(request)


@pytest.fixture(autouse=True)
def _own_data(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep models and pose libraries of a test in a folder of its own, never the user's."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path_factory.mktemp("data")))


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
def editor_model() -> LearnedBody:
    """Return a small model with a predictor, and nothing left to compile for its frames."""
    model = trained_tube()
    warm_up(model)
    return model


@pytest.fixture(scope="session")
def colliding(editor_model: LearnedBody) -> npt.NDArray[np.float64]:
    """Return a latent pose of the small model that collides, (D,) and read-only."""
    pose = sample_poses(editor_model, 1, 0, colliding=True)[0]
    pose.flags.writeable = False
    return pose


@pytest.fixture(scope="session")
def swing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of a character whose arm swings through its trunk; only read it."""
    return Path(shutil.copy(SWING, tmp_path_factory.mktemp("swing")))


@pytest.fixture(scope="session")
def compiled_body() -> None:
    """Compile what a window with the bundled body needs: the first time that takes a minute."""
    model = LearnedBody.load(find_model("body"))
    warm_up(model)
    prepare(model, Job())
    model.require_predictor().logit_and_gradient(model.known_poses[:1])


@pytest.fixture
def document(qtbot: QtBot, editor_model: LearnedBody) -> Iterator[PoseDocument]:
    """Return a document, its pose all zeros, predicted and checked; its threads end with it."""
    held = PoseDocument()
    # Poses are then what the tests set, at once.
    held.motion.set_solid(False)
    held.set_model(editor_model)
    held.motion.reset_all()
    held.history.undo_stack.clear()
    held.history.mark_saved()

    def settle() -> None:
        # The frame with the prediction comes after one without; either is checked.
        motion = held.motion
        frame, exact = motion.frame, motion.exact
        assert frame is not None, "no frame has come"
        assert frame.prediction is not None, "the predictor has not been loaded"
        assert exact is not None, "no verdict has come"
        assert motion.unchecked is None, "the newest frame has not been checked"

    qtbot.waitUntil(settle, timeout=20_000)
    yield held
    assert held.close()
    held.deleteLater()


@pytest.fixture
def window(qtbot: QtBot, document: PoseDocument, tmp_path: Path) -> Iterator[MainWindow]:
    """Return a window of the document that has drawn its pose; it closes with the test."""
    held = open_window(qtbot, document, settings_in(tmp_path))
    yield held
    if is_open(held):
        close_window(held)


@pytest.fixture(scope="session")
def body(compiled_body: None) -> LearnedBody:  # noqa: ARG001
    """Return the bundled body."""
    return LearnedBody.load("body")


@pytest.fixture
def body_window(qtbot: QtBot, body: LearnedBody, tmp_path: Path) -> Iterator[MainWindow]:
    """Return a window with the bundled body and a document of its own."""
    document = PoseDocument(body, library_folder=tmp_path / "library")
    held = open_window(qtbot, document, settings_in(tmp_path), (1280, 860))
    yield held
    if is_open(held):
        close_window(held)
    assert document.close()
    document.deleteLater()


@pytest.fixture
def viewport(qtbot: QtBot, document: PoseDocument) -> Iterator[Viewport]:
    """Return a viewport of the document that has drawn its pose, in the light theme."""
    apply_theme(QApplication.instance(), LIGHT)
    shown = Viewport(document)
    shown.resize(SIDE, SIDE)
    shown.show()
    rest(qtbot, shown)
    yield shown
    dispose(shown)
