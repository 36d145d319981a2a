"""Short forms: size of a picture, length of a turntable video, options of Resolve."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from PySide6.QtCore import Qt, Slot
from PySide6.QtGui import QColor
from PySide6.QtWidgets import (
    QCheckBox,
    QColorDialog,
    QComboBox,
    QDialog,
    QDialogButtonBox,
    QFormLayout,
    QLabel,
    QPushButton,
    QWidget,
)

from app.editing.settings import SETTINGS, Settings
from app.view.theme import NORMAL, WIDE
from app.window.widgets import Mnemonics, NumberBox, dialog_vbox, labelled, swatch

_WIDTH, _BORDER = 400, WIDE + 4


class ColourButton(QPushButton):
    """Shows a colour, and asks for another when it is pressed.

    Parameters
    ----------
    colour : "#rrggbb"; anything else is white
    title : of the dialog that asks
    """

    def __init__(self, colour: str, title: str) -> None:
        super().__init__()
        self._title = title
        # A dialog's button that takes Enter would be pressed by it.
        self.setAutoDefault(False)
        self.setStyleSheet("text-align: left;")
        self._show(QColor(colour) if QColor(colour).isValid() else QColor("#ffffff"))
        self.clicked.connect(self._ask)

    @Slot()
    def _ask(self) -> None:
        chosen = QColorDialog.getColor(QColor(self.text()), self, self._title)
        if chosen.isValid():
            self._show(chosen)

    def _show(self, colour: QColor) -> None:
        self.setIcon(swatch(colour.name(), self.iconSize().height(), self.devicePixelRatioF()))
        self.setText(colour.name())


class Form(QDialog):
    """Fields that show settings and write them back when they are accepted.

    Parameters
    ----------
    title : of the dialog
    action : text of the button that accepts
    settings : read and written
    parent : the window that it belongs to
    """

    def __init__(self, title: str, action: str, settings: Settings, parent: QWidget) -> None:
        super().__init__(parent)
        self.setWindowTitle(title)
        Mnemonics(self)
        self.setFixedWidth(_WIDTH)
        self._settings = settings
        self._refused = False
        self._fields: dict[str, QWidget] = {}
        self._readers: dict[str, Callable[[], Any]] = {}
        self._form = QFormLayout(horizontalSpacing=WIDE, verticalSpacing=NORMAL)
        buttons = QDialogButtonBox(QDialogButtonBox.StandardButton.Cancel)
        accept = buttons.addButton(action, QDialogButtonBox.ButtonRole.AcceptRole)
        self._refusal = labelled("", "refusal", wraps=True)
        self._refusal.hide()
        self.setLayout(dialog_vbox(self._form, self._refusal, buttons))
        buttons.accepted.connect(self.accept)
        buttons.rejected.connect(self.reject)
        # Only now that it is the dialog's: or else Enter would cancel.
        accept.setDefault(True)

    def accept(self) -> None:
        """Store the fields and close, unless a value has just been refused."""
        for field in self._fields.values():
            if isinstance(field, NumberBox):
                field.interpretText()
        if self._refused:
            self._refused = False
            return
        for key, read in self._readers.items():
            self._settings[key] = read()
        super().accept()

    def add_number(
        self,
        key: str,
        label: str,
        suffix: str = "",
        step: float = 1.0,
        tip: str = "",
        decimals: int = 0,
        trims: bool = False,
    ) -> NumberBox:
        """Add a field for a number, by default a whole one; see `NumberBox`."""
        setting = SETTINGS[key]
        field = NumberBox(decimals, setting.low or 0.0, setting.high or 0.0, trims=trims)
        field.setSingleStep(step)
        field.setSuffix(suffix)
        field.setValue(self._settings[key])
        field.refused.connect(lambda sentence: self._on_refused(label, sentence))
        field.lineEdit().textEdited.connect(self._on_edited)
        self._add(key, label, field, field.value, tip)
        return field

    def add_choice(self, key: str, label: str, names: dict[str, str], tip: str) -> QComboBox:
        """Add a field for one of several values, by their names."""
        field = QComboBox()
        for value, name in names.items():
            field.addItem(name, value)
        # What was remembered may not be offered now.
        field.setCurrentIndex(max(0, field.findData(self._settings[key])))
        self._add(key, label, field, field.currentData, tip)
        return field

    def add_check(self, key: str, label: str, tip: str = "") -> QCheckBox:
        """Add a box to tick."""
        field = QCheckBox(label)
        field.setChecked(self._settings[key])
        self._add(key, "", field, field.isChecked, tip)
        return field

    def add_colour(self, key: str, label: str) -> ColourButton:
        """Add a button that shows a colour and asks for another."""
        field = ColourButton(self._settings[key], label)
        self._add(key, label, field, field.text)
        return field

    def add_widget(self, label: str, widget: QWidget) -> None:
        """Add what no setting remembers."""
        self._form.addRow(label, widget)

    def add_note(self, text: str) -> QLabel:
        """Add some lines of explanation."""
        note = labelled("", "caption", wraps=True)
        self._form.addRow(note)
        self.explain(note, text)
        return note

    def explain(self, note: QLabel, text: str) -> None:
        """Put another text into a note, and leave space for it."""
        note.setText(text)
        # A form asks for one line of it, however narrow.
        note.setFixedHeight(max(0, note.heightForWidth(_WIDTH - 2 * _BORDER)))
        self.adjustSize()

    def _add(
        self, key: str, label: str, field: QWidget, read: Callable[[], Any], tip: str = ""
    ) -> None:
        field.setToolTip(tip)
        self._fields[key], self._readers[key] = field, read
        self._form.addRow(label, field)

    def _on_refused(self, label: str, sentence: str) -> None:
        self._refused = True
        self._refusal.setText(f"{label}: {sentence}")
        self._refusal.show()

    @Slot()
    def _on_edited(self) -> None:
        self._refused = False
        self._refusal.hide()


def screenshot_form(settings: Settings, parent: QWidget) -> Form:
    """Ask how large a screenshot is to be."""
    form = Form("Screenshot", "Choose file…", settings, parent)
    form.add_number("screenshot_width", "Width", " px")
    form.add_number("screenshot_height", "Height", " px")
    form.add_check("screenshot_transparent", "Transparent background")
    return form


def video_form(settings: Settings, parent: QWidget, of_motion: bool = False) -> Form:
    """Ask for length, size, background and format of a turntable, or of a motion's video.

    That lasts as long as the motion.
    """
    from app.view.offscreen import FASTEST_GIF

    title = "Video of the motion" if of_motion else "Turntable"
    form = Form(title, "Choose file…", settings, parent)
    formats = {"gif": "GIF", "webp": "WebP", "png": "PNG sequence"}
    kind = form.add_choice("turntable_format", "Format", formats, "What is written")
    if not of_motion:
        form.add_number("turntable_seconds", "Duration", " s", 0.5, decimals=1)
    rate = form.add_number("turntable_rate", "Frames per second")
    form.add_number("turntable_width", "Width", " px")
    form.add_number("turntable_height", "Height", " px")
    backgrounds = {"shown": "As shown", "plain": "One colour", "transparent": "Transparent"}
    behind = form.add_choice(
        "turntable_background", "Background", backgrounds, "What is shown behind the body"
    )
    colour = form.add_colour("turntable_colour", "Colour")
    note = form.add_note("")
    most = rate.maximum()
    meanings = {
        "gif": f"256 colours, at most {FASTEST_GIF} frames per second, never transparent.",
        "webp": "All colours, smaller than a GIF.",
        "png": "A new folder of numbered pictures, for example to make an MP4.",
    }

    def follow() -> None:
        is_gif = kind.currentData() == "gif"
        rate.setMaximum(FASTEST_GIF if is_gif else most)
        index = list(backgrounds).index("transparent")
        behind.setItemData(index, 0 if is_gif else None, Qt.ItemDataRole.UserRole - 1)
        if is_gif and behind.currentIndex() == index:
            behind.setCurrentIndex(0)
        what = "From in to out point" if of_motion else "One full turn"
        form.explain(note, f"{what}, current shading. {meanings[kind.currentData()]}")

    def show_colour() -> None:
        colour.setEnabled(behind.currentData() == "plain")

    follow()
    show_colour()
    kind.currentIndexChanged.connect(follow)
    behind.currentIndexChanged.connect(show_colour)
    return form


def resolve_form(settings: Settings, parent: QWidget, has_predictor: bool = True) -> Form:
    """Ask for the options of Resolve; those of a search only where a predictor leads it."""
    form = Form("Resolve options", "OK", settings, parent)
    metrics = {"vertices": "the look of the pose", "latent": "the slider values"}
    tip = "What Resolve tries to change as little as possible"
    form.add_choice("resolve_metric", "Keep close to", metrics, tip)
    if has_predictor:
        tip = (
            "Below this probability the estimate calls a pose clear; lower is safer but moves "
            "the pose more"
        )
        label = "Decision threshold"
        form.add_number("resolve_threshold", label, "", 0.05, tip, decimals=2)
    tip = (
        "The most that any point may move, in per cent of the body size; if no collision-free pose "
        "is that near, Resolve settles for the least overlap"
    )
    largest = form.add_number("resolve_largest_change", "Largest change", " %", 0.5, tip, 2, True)
    largest.setSpecialValueText("any")
    tip = "After this time Resolve falls back to a known pose without collisions"
    form.add_number("resolve_time_budget", "Time limit", " s", 1.0, tip, decimals=1)
    form.add_note("The exact check decides in any case.")
    return form
