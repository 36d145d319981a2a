"""The window's shortcuts while a field has the keyboard focus."""

from __future__ import annotations

from PySide6.QtCore import QEvent, QObject, Qt, Slot
from PySide6.QtGui import QAction, QKeyEvent, QKeySequence
from PySide6.QtWidgets import QAbstractSpinBox, QApplication, QDialog, QLineEdit, QWidget

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
