"""What the tests of the command line and of the editor share."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.view import canvas
from app.view.theme import LIGHT, apply_theme
from app.view.viewport import Viewport
from app.window import file_actions
from app.window.dialogs.questions import Choice
from app.window.main_window import MainWindow
from app.work.preparing import prepare, warm_up
from lcollision_core.bodies import LearnedBody, find_model, sample_poses
from lcollision_core.files import locked
from lcollision_core.jobs import Job
from tests.app.editor_model import trained_tube
from tests.app.support import STABBED
from tests.app.views import SIDE, dispose, rest
from tests.app.windows import (
    PATIENCE,
    begin_again,
    close_window,
    is_open,
    open_window,
    settings_in,
)
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
def _plain_edges(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw edges without samples: in software these take a third of the time of most tests."""
    monkeypatch.setattr(canvas, "_SMOOTH_SAMPLES", 0)


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


@pytest.fixture(autouse=True)
def _opens_instead(monkeypatch: pytest.MonkeyPatch) -> None:
    """Open what is dropped on a character in its place, as the dialog's default does."""
    monkeypatch.setattr(file_actions, "ask_to_join", lambda *_: Choice.DISCARD)


@pytest.fixture(autouse=True)
def _releases_its_buttons() -> Iterator[None]:
    """See that a test holds no mouse button at its end: the next one's pointer would drag."""
    yield
    assert QApplication.mouseButtons() == Qt.MouseButton.NoButton


@pytest.fixture(scope="session")
def editor_model(tmp_path_factory: pytest.TempPathFactory) -> LearnedBody:
    """Return a small model with a predictor, and nothing left to compile for its frames."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        # All workers take what the first of them has trained.
        folder = folder.parent
    path = folder / "editor" / "tube.safetensors"
    path.parent.mkdir(exist_ok=True)
    with locked(path, wait=PATIENCE / 1000):
        if not path.exists():
            trained_tube().save(path)
    model = LearnedBody.load(path)
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


def _begin(qtbot: QtBot, document: PoseDocument, model: LearnedBody) -> None:
    """Let a document begin with a model, its pose all zeros, predicted and checked."""
    # Poses are then what the tests set, at once.
    document.motion.set_solid(False)
    document.set_model(model)
    document.motion.reset_all()
    document.history.undo_stack.clear()
    document.history.mark_saved()

    def settle() -> None:
        # The frame with the prediction comes after one without; either is checked.
        motion = document.motion
        frame, exact = motion.frame, motion.exact
        assert frame is not None, "no frame has come"
        assert frame.prediction is not None, "the predictor has not been loaded"
        assert exact is not None, "no verdict has come"
        assert motion.unchecked is None, "the newest frame has not been checked"

    qtbot.waitUntil(settle, timeout=20_000)


def shares_window(request: pytest.FixtureRequest) -> bool:
    """Return whether a test takes the window of its module."""
    one, own = (request.node.get_closest_marker(name) for name in ("one_window", "own_window"))
    return one is not None and own is None


@pytest.fixture(scope="module")
def kept_windows() -> Iterator[list[MainWindow]]:
    """Return the window that the tests of a module marked `one_window` share, once one is open."""
    windows: list[MainWindow] = []
    yield windows
    for held in filter(is_open, windows):
        close_window(held)
        assert held.document.close()
        held.document.deleteLater()


@pytest.fixture
def document(
    request: pytest.FixtureRequest, qtbot: QtBot, editor_model: LearnedBody
) -> Iterator[PoseDocument]:
    """Return a document, its pose all zeros, predicted and checked; its threads end with it.

    In a module marked `one_window`, it is that of the window, which begins again.
    """
    kept: list[MainWindow] = []
    if shares_window(request) and "window" in request.fixturenames:
        kept = request.getfixturevalue("kept_windows")
    is_kept = bool(kept) and is_open(kept[0])
    if is_kept:
        begin_again(kept[0])
    held = kept[0].document if is_kept else PoseDocument()
    _begin(qtbot, held, editor_model)
    if is_kept:
        rest(qtbot, kept[0].viewport)
    yield held
    if not kept or not is_open(kept[0]):
        assert held.close()
        held.deleteLater()


@pytest.fixture
def window(
    request: pytest.FixtureRequest, qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> Iterator[MainWindow]:
    """Return a window of the document that has drawn its pose.

    It closes with the test, or in a module marked `one_window` after the last.
    """
    if shares_window(request):
        kept = request.getfixturevalue("kept_windows")
        if not kept or not is_open(kept[0]):
            kept[:] = [open_window(qtbot, document, settings_in(tmp_path))]
        yield kept[0]
        return
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
