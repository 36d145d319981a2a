"""Event filters: the window's shortcuts in fields, its painting, dropped files, mnemonics."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import QCoreApplication, QEvent, QObject, Qt, QTimer, Signal, Slot
from PySide6.QtGui import QAction, QDragEnterEvent, QDropEvent, QKeyEvent, QKeySequence
from PySide6.QtWidgets import (
    QAbstractButton,
    QAbstractSpinBox,
    QApplication,
    QDialog,
    QLabel,
    QLineEdit,
    QWidget,
)

from app.work.threads import single_shot

if TYPE_CHECKING:
    from app.editing.live_pose import PoseMotion


class FileDrops(QObject):
    """Accept files dropped on a widget.

    Signals
    -------
    dropped : list of Path, at least one; emitted once the source program no longer waits
    """

    dropped = Signal(object)

    def __init__(self, widget: QWidget) -> None:
        super().__init__(widget)
        widget.setAcceptDrops(True)
        widget.installEventFilter(self)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:  # noqa: N802 - Qt's name
        """Accept files."""
        if isinstance(event, QDragEnterEvent | QDropEvent):
            urls = event.mimeData().urls()
            paths = [Path(url.toLocalFile()) for url in urls if url.isLocalFile()]
            if paths:
                event.acceptProposedAction()
            if paths and event.type() is QEvent.Type.Drop:
                QTimer.singleShot(0, self, lambda: self.dropped.emit(paths))
            return True
        return super().eventFilter(watched, event)


_MARK = re.compile("&(?!&)(.)|&&")


class Mnemonics(QObject):
    """Give the visible buttons and labels of a dialog unique mnemonics, updated with its layout.

    A mnemonic in a text is kept unless an earlier item has it too. Other items get the first free
    letter that begins a word, or else any free letter.

    Parameters
    ----------
    dialog : whose buttons and labels with a buddy are marked
    """

    def __init__(self, dialog: QDialog) -> None:
        super().__init__(dialog)
        self._dialog = dialog
        dialog.installEventFilter(self)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:  # noqa: N802 - Qt's name
        """Mark new items before they are drawn."""
        if event.type() in (QEvent.Type.Show, QEvent.Type.LayoutRequest):
            self._mark()
        return super().eventFilter(watched, event)

    def _mark(self) -> None:
        labels = [label for label in self._dialog.findChildren(QLabel) if label.buddy() is not None]
        # The text of a button that a label names is a value, such as a colour.
        named = {label.buddy() for label in labels}
        buttons = [button for button in self._dialog.findChildren(QAbstractButton) if button.text()]
        items: list[QAbstractButton | QLabel] = [
            button for button in buttons if button not in named
        ]
        items += labels
        letters = set[str]()
        new: list[QAbstractButton | QLabel] = []
        for item in (item for item in items if item.isVisibleTo(self._dialog)):
            letter = mnemonic(item.text())
            if letter and letter not in letters:
                letters.add(letter)
            else:
                new.append(item)
        for item in new:
            text = _MARK.sub(lambda mark: mark[1] or "&&", item.text())
            marked = _with_mark(text, letters)
            letters.add(mnemonic(marked))
            if marked != item.text():
                item.setText(marked)


def mnemonic(text: str) -> str:
    """Return the mnemonic of a text in lower case, "" for none."""
    return next((mark[1].casefold() for mark in _MARK.finditer(text) if mark[1]), "")


def _with_mark(text: str, taken: set[str]) -> str:
    """Mark the best free letter of a text; return the text unchanged if none is free."""
    starts = [match.start() for match in re.finditer(r"\b\w", text)]
    for place in (*starts, *range(len(text))):
        if text[place].isalnum() and text[place].casefold() not in taken:
            return f"{text[:place]}&{text[place:]}"
    return text


_Key = QKeySequence.StandardKey
_EDITING = (_Key.Undo, _Key.Redo, _Key.Copy, _Key.Cut, _Key.Paste, _Key.SelectAll, _Key.Delete)
_KEPT = (
    *(_Key.DeleteStartOfWord, _Key.DeleteEndOfWord),
    *(_Key.MoveToStartOfDocument, _Key.MoveToEndOfDocument),
)
"""Editing keys of a field that Qt would pass to a shortcut."""
_KEPT_OF_WORDS = (_Key.DeleteEndOfLine, _Key.DeleteCompleteLine)
"""Ctrl+K and Ctrl+U on X11: in a number box, the window's shortcuts take priority."""
_Held = Qt.KeyboardModifier
_COMMANDS = _Held.ControlModifier | _Held.AltModifier | _Held.MetaModifier


class WindowShortcuts(QObject):
    """Give a window's shortcuts priority over rare editing keys of its fields, as Ctrl+E on X11.

    Copying, pasting, deleting words and the like stay with the field.

    Parameters
    ----------
    window : whose actions have the shortcuts
    """

    def __init__(self, window: QWidget) -> None:
        super().__init__(window)
        self._window = window
        application = QApplication.instance()
        assert isinstance(application, QApplication)
        application.focusChanged.connect(self._on_focus)

    @Slot(QWidget, QWidget)
    def _on_focus(self, _: QWidget | None, now: QWidget | None) -> None:
        if isinstance(now, QLineEdit | QAbstractSpinBox) and not isinstance(now.window(), QDialog):
            now.installEventFilter(self)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:  # noqa: N802 - Qt's name
        """Reserve the window's shortcuts; see Qt's ShortcutOverride."""
        if event.type() is not QEvent.Type.ShortcutOverride or not isinstance(event, QKeyEvent):
            return False
        if any(event.matches(key) for key in _EDITING):
            return False
        is_number = isinstance(watched, QAbstractSpinBox)
        if any(event.matches(key) for key in (*_KEPT, *(() if is_number else _KEPT_OF_WORDS))):
            event.accept()
            return True
        if event.text().isprintable() and event.text() and not event.modifiers() & _COMMANDS:
            # A printable character is being typed.
            return False
        keys = QKeySequence(event.keyCombination())
        if any(keys in action.shortcuts() for action in self._window.findChildren(QAction)):
            event.ignore()
            return True
        return False


_PATIENCE_MILLISECONDS = 16
"""Longest time that painting waits for a frame: one refresh of a 60 Hz screen."""


class PaintGate(QObject):
    """Defer painting a window while a quick frame of the pose is expected.

    Painting the window twice would cost more than all else. Nothing blocks meanwhile.

    Parameters
    ----------
    window : top-level
    motion : the source of the frames
    """

    def __init__(self, window: QWidget, motion: PoseMotion) -> None:
        super().__init__(window)
        self._window, self._motion = window, motion
        self._is_held = False
        self._patience = single_shot(self, _PATIENCE_MILLISECONDS, self._on_late)
        self._patience.setTimerType(Qt.TimerType.PreciseTimer)
        window.installEventFilter(self)
        motion.frame_changed.connect(self._open)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:  # noqa: N802 - Qt's name
        """Hold back the window's update request while a frame is expected."""
        if event.type() is not QEvent.Type.UpdateRequest or not self._motion.expects_frame:
            return super().eventFilter(watched, event)
        self._is_held = True
        if not self._patience.isActive():
            self._patience.start(_PATIENCE_MILLISECONDS)
        return True

    def close(self) -> None:
        """Stop deferring."""
        self._window.removeEventFilter(self)
        self._motion.frame_changed.disconnect(self._open)
        self._patience.stop()

    @Slot()
    def _on_late(self) -> None:
        self._motion.stop_expecting()
        self._open()

    @Slot()
    def _open(self) -> None:
        if self._is_held and not self._motion.expects_frame:
            self._is_held = False
            self._patience.stop()
            update = QEvent(QEvent.Type.UpdateRequest)
            QCoreApplication.postEvent(
                self._window, update, Qt.EventPriority.LowEventPriority.value
            )
