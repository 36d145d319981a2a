"""Helpers that open an editor's window for tests, wait for it, inspect it and dispose of it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import PySide6
from PySide6.QtCore import QEvent, QMimeData, QPoint, QPointF, QRect, QSettings, Qt, QTimer, QUrl
from PySide6.QtGui import QDragEnterEvent, QDropEvent, QGuiApplication, QMouseEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import (
    QApplication,
    QDialog,
    QDockWidget,
    QFileDialog,
    QLineEdit,
    QWidget,
)
from pytestqt.qtbot import QtBot
from shiboken6 import isValid

from app.editing.document import PoseDocument
from app.editing.settings import SETTINGS, Settings
from app.view.shading import Shading
from app.view.theme import apply_theme, wanted_theme
from app.window.main_window import MainWindow
from app.window.panels.sliders import CodeRow
from app.window.widgets import HANDLE

SHOTS = Path(__file__).parents[2] / "out" / "screenshots"
"""Folder of screenshots that tests leave for people to look at."""

SIZE = (1280, 800)
"""Size of a window, in pixels."""

PATIENCE = 300_000
"""Timeout on a busy machine, in milliseconds."""

SHARED: list[MainWindow] = []
"""The window that the tests of a module share; any other is closed after its test."""


def settings_in(folder: Path) -> Settings:
    """Return settings that nothing else reads."""
    settings = Settings(QSettings(str(folder / "editor.ini"), QSettings.Format.IniFormat))
    # Without Solid, poses are at once what the tests set.
    settings["solid"] = False
    return settings


def open_window(
    qtbot: QtBot, document: PoseDocument, settings: Settings, size: tuple[int, int] = SIZE
) -> MainWindow:
    """Show a window of a document that has a model, and wait until it has drawn the pose."""
    apply_theme(application(), wanted_theme(settings["theme"]))
    document.motion.set_solid(settings["solid"])
    window = MainWindow(document, settings)
    window.resize(*size)
    window.show()
    # Shortcuts reach only the active window.
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow, timeout=PATIENCE)
    rest(qtbot, window)
    return window


def begin_again(window: MainWindow) -> None:
    """Reset a window after a test: dialogs, panels' layout, choices, search texts."""
    for dialog in window.findChildren(QDialog):
        dialog.close()
        dialog.deleteLater()
    QApplication.sendPostedEvents(None, QEvent.Type.DeferredDelete)
    document, settings = window.document, window.settings
    document.motion.end_gesture()
    for key, setting in SETTINGS.items():
        settings[key] = setting.default
    settings["solid"] = False
    window.reset_layout()
    window.resize(*SIZE)
    for field in (window.sliders.filter, window.library.search):
        field.clear()
    window.library.training.click()
    document.motion.drag_strength = settings["drag_strength"]
    document.motion.standing = settings["standing"]
    document.motion.set_clearance(settings["clearance"])
    document.history.show_ghost(settings["show_ghost"])
    window.viewport.follows = settings["camera_follows"]
    window.viewport.set_shading(Shading.DOMAINS)
    window.viewport.setFocus()
    window.statusBar().clearMessage()
    window.activateWindow()


def application() -> QApplication:
    """Return the application that all tests share."""
    held = QApplication.instance()
    assert isinstance(held, QApplication)
    return held


def close_window(window: MainWindow) -> None:
    """Close a window, discarding changes, and check that nothing of it keeps running."""
    window.document.motion.end_gesture()
    window.document.history.mark_saved()
    assert window.close()
    dispose(window)


def close_opened() -> None:
    """Close the menus and windows that a test has left open, and delete their documents."""
    while (popup := QApplication.activePopupWidget()) is not None:
        popup.close()
    for window in QApplication.topLevelWidgets():
        if isinstance(window, MainWindow) and window.isVisible() and window not in SHARED:
            document = window.document
            close_window(window)
            document.deleteLater()


def dispose(window: MainWindow) -> None:
    """Delete a closed window, and check that it leaves neither thread nor timer."""
    assert not window.isVisible()
    running = [timer for timer in window.findChildren(QTimer) if timer.isActive()]
    assert running == []
    window.deleteLater()
    QApplication.sendPostedEvents(None, QEvent.Type.DeferredDelete)
    assert [t.name for t in threading.enumerate() if t.name == "import VTK"] == []


def rest(qtbot: QtBot, window: MainWindow) -> None:
    """Wait until the newest pose is on the screen, checked exactly."""
    document = window.document
    qtbot.waitUntil(
        lambda: document.motion.exact is not None and window.viewport.is_at_rest, timeout=PATIENCE
    )


def is_checked(window: MainWindow, n_frames: int) -> bool:
    """Return whether the strip shows the check of every frame of a motion.

    `Timeline.checks` may have a frame before the window is notified.
    """
    shown = window.timeline.strip._overlaps()
    return len(shown) == n_frames and not np.isnan(shown).any()


def settle_layout(qtbot: QtBot, window: MainWindow) -> None:
    """Wait until the window and its panels have the same geometry twice in a row."""
    looks: list[list[QRect]] = []

    def rests() -> bool:
        looks.append([held.geometry() for held in (window, *window.findChildren(QDockWidget))])
        return len(looks) > 1 and looks[-1] == looks[-2]

    qtbot.waitUntil(rests, timeout=PATIENCE)


def is_open(window: MainWindow) -> bool:
    """Return whether a window has not been closed and deleted."""
    return isValid(window) and window.isVisible()


def shown(window: MainWindow) -> npt.NDArray[np.float32]:
    """Return a copy of the vertices on the screen."""
    assert window.viewport.scene is not None
    return window.viewport.scene.surface.vertices.copy()


def colours(window: MainWindow) -> npt.NDArray[np.uint8]:
    """Return a copy of the vertex colours on the screen."""
    assert window.viewport.scene is not None
    return window.viewport.scene.surface.colours.copy()


def decoded(document: PoseDocument) -> npt.NDArray[np.float32]:
    """Return the vertices that should be on the screen."""
    return document.model.decode(document.history.latent).astype(np.float32)


def handle(row: CodeRow) -> QPoint:
    """Return the position of a row's handle in its slider."""
    slider = row.slider
    low, high = slider.value_range
    share = (slider.place - low) / (high - low)
    return QPoint(round(HANDLE + share * (slider.width() - 2 * HANDLE)), slider.height() // 2)


def drag(qtbot: QtBot, row: CodeRow, by: int, steps: int = 6) -> None:
    """Drag a row's handle with the left button, by some pixels."""
    start = handle(row)
    QTest.mousePress(row.slider, Qt.MouseButton.LeftButton, pos=start)
    for step in range(1, steps + 1):
        QTest.mouseMove(row.slider, start + QPoint(by * step // steps, 0))
        qtbot.wait(5)
    QTest.mouseRelease(row.slider, Qt.MouseButton.LeftButton, pos=start + QPoint(by, 0))


def move_held(widget: QWidget, place: QPoint, key: Qt.KeyboardModifier) -> None:
    """Move the pointer with the left button, and perhaps a key, held."""
    QApplication.sendEvent(
        widget,
        QMouseEvent(
            QEvent.Type.MouseMove,
            QPointF(place),
            QPointF(widget.mapToGlobal(place)),
            Qt.MouseButton.NoButton,
            Qt.MouseButton.LeftButton,
            key,
        ),
    )


def drop(window: QWidget, *paths: Path) -> None:
    """Drop files on a window, as from a file manager."""
    dropped = QMimeData()
    dropped.setUrls([QUrl.fromLocalFile(str(path)) for path in paths])
    buttons, keys = Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier
    place, action = QPoint(400, 300), Qt.DropAction.CopyAction
    # PySide 6.12 deprecates the former constructor.
    where = QPointF(place) if PySide6.__version_info__ >= (6, 12) else place
    entering = QDragEnterEvent(where, action, dropped, buttons, keys)
    QApplication.sendEvent(window, entering)
    assert entering.isAccepted()
    QApplication.sendEvent(window, QDropEvent(QPointF(place), action, dropped, buttons, keys))


def answer(act: Callable[[QDialog], None]) -> QTimer:
    """Answer the next modal dialog.

    The timer polls every few milliseconds, as long as the caller keeps it.
    """
    timer = QTimer()

    def look() -> None:
        dialog = QApplication.activeModalWidget()
        if isinstance(dialog, QDialog) and dialog.isVisible():
            timer.stop()
            act(dialog)

    timer.timeout.connect(look)
    timer.start(10)
    return timer


def name_field(dialog: QDialog) -> QLineEdit:
    """Return the name field of a file dialog."""
    assert isinstance(dialog, QFileDialog)
    field = dialog.findChild(QLineEdit, "fileNameEdit")
    assert isinstance(field, QLineEdit)
    return field


def choose_file(dialog: QDialog, path: Path) -> None:
    """Enter a file name in a file dialog, and accept."""
    name_field(dialog).setText(str(path))
    dialog.accept()


def accept_and_choose(path: Path, timers: list[QTimer]) -> Callable[[QDialog], None]:
    """Return a function that accepts a form and chooses a file in the dialog that follows."""

    def accept(dialog: QDialog) -> None:
        timers.append(answer(partial(choose_file, path=path)))
        dialog.accept()

    return accept


def take_picture(window: QWidget, name: str) -> None:
    """Save a screenshot of a window."""
    QApplication.processEvents()
    SHOTS.mkdir(parents=True, exist_ok=True)
    corner = window.mapToGlobal(QPoint(0, 0))
    area = QRect(corner, window.size())
    picture = QGuiApplication.primaryScreen().grabWindow(0, *area.getRect())
    assert not picture.isNull()
    # Compressing more takes several times as long.
    assert picture.save(str(SHOTS / f"{name}.png"), quality=85)
