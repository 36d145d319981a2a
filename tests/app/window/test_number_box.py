"""Typed numbers are accepted and marked, or refused in a sentence."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from PySide6.QtCore import QPoint, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QDialogButtonBox, QLabel, QToolTip, QWidget
from pytestqt.qtbot import QtBot

from app.editing.settings import SETTINGS, Settings
from app.view.theme import current_theme
from app.window.dialogs.forms import Form, resolve_form, screenshot_form, video_form
from app.window.dialogs.new_model import PosesPage
from app.window.main_window import MainWindow
from app.window.widgets import NumberBox
from tests.app.windows import settings_in, settle_layout

pytestmark = pytest.mark.one_window

LEFT = Qt.MouseButton.LeftButton


def type_in(field: NumberBox, text: str) -> None:
    field.setFocus()
    field.selectAll()
    QTest.keyClicks(field, text)
    QTest.keyClick(field, Qt.Key.Key_Return)


def test_a_number_outside_the_trained_range_is_kept_and_marked(window: MainWindow) -> None:
    document, row = window.document, window.sliders.row_of(1)
    space = document.model.latent_space
    low, high = float(space.low[1]), float(space.high[1])
    for wanted in (high + 0.4 * (high - low), low - 0.4 * (high - low)):
        type_in(row.field, f"{wanted:.3f}")
        assert document.history.latent[1] == pytest.approx(wanted, abs=1e-3)
        assert row.field.property("verdict") == "outside"
        assert "outside the trained range" in row.field.toolTip()
        ink = row.field.palette().color(row.field.foregroundRole()).name()
        assert ink == current_theme().colliding
    for wanted in (high, low, 0.5 * high, 0.0):
        type_in(row.field, f"{wanted:.3f}")
        assert row.field.property("verdict") != "outside"
        assert "outside" not in row.field.toolTip()
    assert window.statusBar().currentMessage() == ""


@pytest.mark.variants
@pytest.mark.parametrize("text", ["9999", "-9999", "123456789"])
def test_a_number_that_is_too_far_is_refused_in_a_sentence(window: MainWindow, text: str) -> None:
    document, row = window.document, window.sliders.row_of(1)
    document.motion.set_code(1, 0.125)
    before = document.history.latent
    type_in(row.field, text)
    assert document.history.latent is before
    assert row.field.value() == 0.125
    told = window.statusBar().currentMessage()
    assert f"{text} is out of range: type a number from" in told
    assert told.startswith(row.slider.accessibleName())
    assert QToolTip.text() in told
    # Also by leaving the field.
    window.statusBar().clearMessage()
    row.field.setFocus()
    row.field.selectAll()
    QTest.keyClicks(row.field, text)
    window.sliders.filter.setFocus()
    assert document.history.latent is before
    assert text in window.statusBar().currentMessage()


def test_the_seed_is_not_cut_to_another(window: MainWindow) -> None:
    seed = window.randomise.seed
    type_in(seed, "123")
    assert seed.value() == 123
    assert window.statusBar().currentMessage() == ""
    type_in(seed, "12345678")
    assert seed.value() == 123
    assert "12345678" in window.statusBar().currentMessage()
    assert "999999" in window.statusBar().currentMessage()


@pytest.mark.variants(2)
@pytest.mark.parametrize("make", [screenshot_form, video_form, resolve_form])
@pytest.mark.parametrize("how", ["enter", "click"])
def test_a_form_refuses_a_number_visibly_and_stays(
    qtbot: QtBot,
    window: MainWindow,
    tmp_path: Path,
    make: Callable[[Settings, QWidget], Form],
    how: str,
) -> None:
    settings = settings_in(tmp_path)
    form = make(settings, window)
    qtbot.addWidget(form)
    form.show()
    boxes = form.findChild(QDialogButtonBox)
    accept = next(b for b in boxes.buttons() if b.isDefault())
    fields = {key: field for key, field in form._fields.items() if isinstance(field, NumberBox)}
    assert fields
    for field in fields.values():
        before = field.value()
        field.setFocus()
        field.selectAll()
        QTest.keyClicks(field, "99999")
        if how == "enter":
            QTest.keyClick(field, Qt.Key.Key_Return)
        else:
            QTest.mouseClick(accept, LEFT, pos=QPoint(5, 5))
        assert form.isVisible()
        assert field.value() == before
        told = [label.text() for label in form.findChildren(QLabel) if label.isVisible()]
        assert any("99999 is out of range" in text for text in told)
    QApplication.processEvents()
    QTest.mouseClick(accept, LEFT)
    if form.isVisible():
        QTest.mouseClick(accept, LEFT)
    assert not form.isVisible()
    for key in fields:
        assert settings[key] == SETTINGS[key].default


def test_the_arrows_of_a_field_are_seen_and_step(qtbot: QtBot, window: MainWindow) -> None:
    row = window.sliders.row_of(1)
    # A narrow panel has no space for them.
    window.resize(1580, 800)
    settle_layout(qtbot, window)
    for theme in ("light", "dark"):
        window.set_theme(theme)
        for field in (row.field, window.collision.resolve.clearance):
            picture = field.grab().toImage()
            ratio = picture.devicePixelRatio()
            middle = field.height() // 2
            for top, bottom in ((2, middle), (middle, field.height() - 2)):
                inks = {
                    picture.pixelColor(int((field.width() - x) * ratio), int(y * ratio)).lightness()
                    for x in range(5, 16)
                    for y in range(top, bottom)
                }
                assert max(inks) - min(inks) > 60, (theme, field.accessibleName())
    before = window.document.history.latent[1]
    QTest.mouseClick(row.field, LEFT, pos=QPoint(row.field.width() - 8, 6))
    assert window.document.history.latent[1] > before
    QTest.mouseClick(row.field, LEFT, pos=QPoint(row.field.width() - 8, row.field.height() - 6))
    assert window.document.history.latent[1] == pytest.approx(before, abs=1e-3)


def test_a_frame_rate_has_three_decimals_and_no_needless_zeros(qtbot: QtBot) -> None:
    page = PosesPage()
    qtbot.addWidget(page)
    field = page.rate
    for text, shown in (("29.97", "29.97"), ("23.9760", "23.976"), ("100", "100")):
        type_in(field, text)
        assert field.text() == shown
        assert field.value() == float(shown)
    field.setValue(0.0)
    assert field.text() == "as in the file"
