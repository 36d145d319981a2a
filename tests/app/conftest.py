"""Fixtures of the command line's and the editor's tests."""

from __future__ import annotations

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
from app.view import viewport as viewport_module
from app.view.theme import LIGHT, apply_theme
from app.view.viewport import Viewport
from app.window import file_actions
from app.window.dialogs.questions import Choice
from app.window.main_window import MainWindow
from app.work.preparing import prepare, warm_up
from lcollision_core.bodies import LearnedBody, find_model, sample_poses
from lcollision_core.jobs import Job
from tests.app.editor_model import tube_with_predictor
from tests.app.support import STABBED
from tests.app.views import SIDE, dispose, rest
from tests.app.windows import (
    PATIENCE,
    SHARED,
    begin_again,
    close_opened,
    is_open,
    open_window,
    settings_in,
)
from tests.small_models import SWING


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown() -> Iterator[None]:
    """Close what a test, even a failing one, has left open, before its fixtures end."""
    try:
        if QApplication.instance() is not None:
            close_opened()
    finally:
        yield


class PatientBot(QtBot):
    """Waits as long as a busy machine may take; only a failing test waits that long.

    Checks that a signal does not come take no longer than the test asks for.
    """

    def waitUntil(self, callback: Any, *, timeout: int = PATIENCE) -> None:  # noqa: N802
        super().waitUntil(callback, timeout=max(timeout, PATIENCE))

    def waitSignal(self, signal: Any, *, timeout: int = PATIENCE, **rest: Any) -> Any:  # noqa: N802
        if rest.get("raising", True):
            timeout = max(timeout, PATIENCE)
        return super().waitSignal(signal, timeout=timeout, **rest)


@pytest.fixture
def qtbot(request: pytest.FixtureRequest) -> QtBot:
    """Return pytest-qt's robot with longer timeouts."""
    request.getfixturevalue("qapp")
    return PatientBot(request)


@pytest.fixture(autouse=True)
def _plain_edges(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw without multisampling, which takes long in software, and the final picture soon."""
    monkeypatch.setattr(canvas, "_SMOOTH_SAMPLES", 0)
    monkeypatch.setattr(canvas, "_REST_MILLISECONDS", 60)
    for duration in ("_TRANSITION_MILLISECONDS", "_TURN_MILLISECONDS"):
        monkeypatch.setattr(viewport_module, duration, 60)


@pytest.fixture(autouse=True)
def _own_data(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep a test's models and pose libraries in a separate folder, never the user's."""
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
    """Let a dropped character replace the open one, as the dialog's default does."""
    monkeypatch.setattr(file_actions, "ask_to_join", lambda *_: Choice.DISCARD)


@pytest.fixture(autouse=True)
def _releases_its_buttons() -> Iterator[None]:
    """Check that no mouse button is held after a test: the next test's pointer would drag."""
    yield
    assert QApplication.mouseButtons() == Qt.MouseButton.NoButton


@pytest.fixture(scope="session")
def editor_model() -> LearnedBody:
    """Return a small model with a predictor, warmed up so that its frames need no compiling."""
    model = tube_with_predictor()
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
    """Return the file of a character whose arm swings through its trunk; do not change it."""
    return Path(shutil.copy(SWING, tmp_path_factory.mktemp("swing")))


@pytest.fixture(scope="session")
def compiled_body() -> None:
    """Compile what a window with the bundled body needs; this takes a minute the first time."""
    model = LearnedBody.load(find_model("body"))
    warm_up(model)
    prepare(model, Job())
    model.require_predictor().logit_and_gradient(model.known_poses[:1])


def _begin(qtbot: QtBot, document: PoseDocument, model: LearnedBody) -> None:
    """Set a document's model, and wait until its all-zero pose is predicted and checked."""
    # Without Solid, poses are at once what the tests set.
    document.motion.set_solid(False)
    document.set_model(model)
    document.motion.reset_all()
    document.history.undo_stack.clear()
    document.history.mark_saved()

    def is_settled() -> bool:
        # The frame with the prediction follows one without; either may be checked.
        motion = document.motion
        return (
            motion.frame is not None
            and motion.frame.prediction is not None
            and motion.exact is not None
            and (motion.resting is None or motion.resting.is_checked)
        )

    qtbot.waitUntil(is_settled, timeout=20_000)


def shares_window(request: pytest.FixtureRequest) -> bool:
    """Return whether a test uses its module's shared window."""
    one, own = (request.node.get_closest_marker(name) for name in ("one_window", "own_window"))
    return one is not None and own is None


@pytest.fixture(scope="module")
def kept_windows() -> Iterator[list[MainWindow]]:
    """Return a list for the window that the tests of a module marked `one_window` share."""
    yield SHARED
    SHARED.clear()
    close_opened()


@pytest.fixture
def document(
    request: pytest.FixtureRequest, qtbot: QtBot, editor_model: LearnedBody
) -> Iterator[PoseDocument]:
    """Return a document with an all-zero pose, predicted and checked; its threads end with it.

    In a module marked `one_window`, it is the reset document of the shared window.
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
) -> MainWindow:
    """Return a window of the document that has drawn its pose.

    It closes after the test, or in a module marked `one_window` after the last test.
    """
    if shares_window(request):
        kept = request.getfixturevalue("kept_windows")
        if not kept or not is_open(kept[0]):
            kept[:] = [open_window(qtbot, document, settings_in(tmp_path))]
        return kept[0]
    return open_window(qtbot, document, settings_in(tmp_path))


@pytest.fixture(scope="session")
def body(compiled_body: None) -> LearnedBody:  # noqa: ARG001
    """Return the bundled body."""
    return LearnedBody.load("body")


@pytest.fixture
def body_window(qtbot: QtBot, body: LearnedBody, tmp_path: Path) -> MainWindow:
    """Return a window with the bundled body and a separate document."""
    document = PoseDocument(body, library_folder=tmp_path / "library")
    return open_window(qtbot, document, settings_in(tmp_path), (1280, 860))


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
