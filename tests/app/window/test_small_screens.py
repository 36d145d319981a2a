"""From 800 x 600 up, everything can be reached, panels float beside, and tracks grow."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from PySide6.QtCore import QPoint, QRect, QSize, Qt
from PySide6.QtGui import QFontMetrics, QScreen
from PySide6.QtTest import QTest
from PySide6.QtWidgets import (
    QAbstractButton,
    QApplication,
    QDialog,
    QDockWidget,
    QLabel,
    QScrollArea,
    QToolBar,
    QToolButton,
    QWidget,
)
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.view.legend import LegendStrip
from app.view.shading import Shading
from app.window.dialogs.forms import resolve_form, screenshot_form, video_form
from app.window.dialogs.questions import FailureDialog
from app.window.layout import beside
from app.window.main_window import MainWindow
from app.window.widgets import screen_of
from app.work.threads import Failure
from lcollision_core.bodies import LearnedBody, sample_poses
from tests.app.windows import (
    PATIENCE,
    close_window,
    open_window,
    rest,
    settings_in,
    settle_layout,
    take_picture,
)

SMALL = QSize(800, 600)


@pytest.fixture
def small(qtbot: QtBot, document: PoseDocument, tmp_path: Path) -> MainWindow:
    held = open_window(qtbot, document, settings_in(tmp_path), (SMALL.width(), SMALL.height()))
    # Below a certain width the poses get the corner, which allows still narrower windows.
    held.resize(SMALL)
    settle_layout(qtbot, held)
    return held


def lies_in(widget: QWidget, around: QWidget) -> bool:
    return around.rect().contains(QRect(widget.mapTo(around, QPoint(0, 0)), widget.size()))


def test_everything_is_reached_at_800_by_600(qtbot: QtBot, small: MainWindow) -> None:
    assert small.size() == SMALL
    assert small.viewport.width() >= 160
    # The timeline comes with a motion.
    for dock in (held for held in small.docks.values() if held.isVisible()):
        assert lies_in(dock, small)
        for button in dock.findChildren(QToolButton):
            assert not button.isVisible() or lies_in(button, small) or _scrolls(button)
    for button in small.findChild(QToolBar).findChildren(QToolButton):
        assert not button.isVisible() or lies_in(button, small)
    # Contents that do not fit are in a scroll area.
    card = small.collision.resolve
    area = small.collision.findChild(QScrollArea)
    area.ensureWidgetVisible(card.button)
    assert lies_in(card.button, small)
    group = small.sliders.groups[-1]
    group.set_open(True)
    settle_layout(qtbot, small)
    for row in group.rows:
        area = _area_of(row)
        area.ensureWidgetVisible(row)
        assert lies_in(row.slider, area.viewport())
        assert lies_in(row.field, area.viewport())


def test_the_smallest_window_shows_the_whole_timeline(qtbot: QtBot, small: MainWindow) -> None:
    small.docks["timeline"].show()
    small.docks["timeline"].raise_()
    small.resize(1, 1)
    settle_layout(qtbot, small)
    assert lies_in(small.docks["timeline"], small)
    for widget in (small.timeline.resolve, small.timeline.strip):
        assert lies_in(widget, small.timeline)


@pytest.mark.variants
@pytest.mark.parametrize("shading", [Shading.DOMAINS, Shading.PREDICTED, Shading.EXACT])
def test_the_note_of_the_legend_is_read_whole(
    qtbot: QtBot, small: MainWindow, shading: Shading
) -> None:
    small.viewport.set_shading(shading)
    settle_layout(qtbot, small)
    rest(qtbot, small)
    take_picture(small, f"small, {shading.value}")
    legend = small.viewport.findChild(LegendStrip)
    (note,) = (one for one in legend.findChildren(QLabel) if one.text() == legend.legend.note)
    assert lies_in(note, legend)
    assert lies_in(legend, small.viewport)
    room = QRect(0, 0, note.width(), 1000)
    needed = note.fontMetrics().boundingRect(room, Qt.TextFlag.TextWordWrap, note.text())
    assert needed.width() <= note.width()
    assert needed.height() <= note.height()


def _area_of(widget: QWidget) -> QScrollArea:
    above = widget.parentWidget()
    while above is not None and not isinstance(above, QScrollArea):
        above = above.parentWidget()
    assert above is not None
    return above


def _scrolls(widget: QWidget) -> bool:
    try:
        return _area_of(widget).verticalScrollBar().maximum() > 0
    except AssertionError:
        return False


def test_what_a_narrow_tool_bar_leaves_out_is_behind_its_arrow(
    qtbot: QtBot, small: MainWindow
) -> None:
    bar = small.findChild(QToolBar)
    for dock in small.docks.values():
        dock.hide()
    more = bar.findChild(QToolButton, "qt_toolbar_ext_button")
    settle_layout(qtbot, small)
    small.resize(420, 600)
    qtbot.waitUntil(more.isVisible)
    for theme in ("light", "dark"):
        small.set_theme(theme)
        picture = more.grab().toImage()
        light = [
            picture.pixelColor(x, y).lightness()
            for x in range(picture.width())
            for y in range(picture.height())
        ]
        assert max(light) - min(light) > 120, theme
    assert more.toolTip()


@pytest.mark.variants(2)
@pytest.mark.parametrize("kind", ["resolve", "screenshot", "turntable", "shortcuts", "about", "no"])
def test_dialogs_fit_800_by_600(
    small: MainWindow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setattr(QScreen, "availableGeometry", lambda _: QRect(QPoint(), SMALL))
    settings = settings_in(tmp_path)
    dialog: QDialog
    if kind in ("shortcuts", "about"):
        small.actions_by_key[kind].trigger()
        dialog = next(d for d in small.findChildren(QDialog) if d.isVisible())
    elif kind == "no":
        dialog = FailureDialog(Failure("no such file", "look elsewhere " * 40, "x\n" * 99), small)
        dialog.show()
        dialog.unfold.click()
    else:
        forms = {
            "resolve": resolve_form,
            "screenshot": screenshot_form,
            "turntable": video_form,
        }
        dialog = forms[kind](settings, small)
    dialog.show()
    room = SMALL - QSize(0, 40)
    assert dialog.width() <= room.width()
    assert dialog.height() <= room.height()
    dialog.close()


def test_tracks_of_sliders_grow_with_their_panel(qtbot: QtBot, window: MainWindow) -> None:
    dock, row = window.docks["sliders"], window.sliders.row_of(1)
    widths = []
    for width in (330, 430, 530):
        window.resizeDocks([dock], [width], Qt.Orientation.Horizontal)
        settle_layout(qtbot, window)
        widths.append((dock.width(), row.slider.width(), window.randomise.amount.width()))
    for (before, *tracks), (after, *others) in pairwise(widths):
        assert after - before >= 90
        for track, other in zip(tracks, others, strict=True):
            assert other - track >= 0.9 * (after - before)


def test_a_window_of_1280_by_720_is_mostly_view_and_cuts_no_readout(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    held = open_window(qtbot, document, settings_in(tmp_path), (1280, 720))
    held.docks["timeline"].show()
    held.docks["timeline"].raise_()
    settle_layout(qtbot, held)
    assert held.viewport.width() >= 0.6 * held.width()
    timeline = held.timeline
    for readout in (timeline.speed, timeline.easing, timeline.strip, timeline.facts):
        assert readout.isVisible()
        assert lies_in(readout, timeline)
    nearest = held.collision.exact.nearest
    nearest.setText("Least distance above 13.58 mm")
    for button in (nearest, held.collision.resolve.button, held.collision.resolve.options):
        assert button.width() >= button.sizeHint().width(), button.text()
    # One line below the sliders, which get the height that it had.
    row = held.randomise
    assert row.height() < 1.5 * held.collision.resolve.button.height()
    row.seed.setValue(999_999)
    shown = row.seed.lineEdit()
    assert shown.width() >= shown.fontMetrics().horizontalAdvance("999999")
    take_picture(held, "1280x720")


def test_numbers_and_headlines_grow_with_the_system_font(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    own = QApplication.font()
    larger = QApplication.font()
    larger.setPixelSize(16)
    QApplication.setFont(larger)
    try:
        held = open_window(qtbot, document, settings_in(tmp_path), (1280, 720))
        fields = [held.sliders.row_of(0).field.lineEdit(), held.randomise.seed.lineEdit()]
        nearest, verdict = held.collision.exact.nearest, held.collision.exact.verdict
        for field, text in zip(fields, ("-100.0°", "999999"), strict=True):
            assert field.fontMetrics().height() > QFontMetrics(own).height()
            assert field.width() >= field.fontMetrics().horizontalAdvance(text)
        nearest.setText("Least distance above 13.58 mm")
        assert nearest.width() >= nearest.sizeHint().width()
        assert verdict.font().pixelSize() > nearest.font().pixelSize()
        close_window(held)
    finally:
        QApplication.setFont(own)


def test_a_wide_window_has_wider_panels(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    wide = open_window(qtbot, document, settings_in(tmp_path), (1580, 900))
    qtbot.waitUntil(lambda: wide.docks["sliders"].width() > 380)
    assert wide.docks["collision"].width() > 330


def test_a_panel_floats_beside_the_window(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    held = open_window(qtbot, document, settings_in(tmp_path), (900, 700))
    held.move(10, 40)
    for key in ("sliders", "collision"):
        dock = held.docks[key]
        button = dock.findChild(QAbstractButton, "qt_dockwidget_floatbutton")
        QTest.mouseClick(button, Qt.MouseButton.LeftButton)
        qtbot.waitUntil(dock.isFloating)
        qtbot.waitUntil(lambda dock=dock: not overlaps(dock, held))
        assert screen_of(held).contains(dock.frameGeometry())
        dock.setFloating(False)
        rest(qtbot, held)


def overlaps(dock: QDockWidget, window: MainWindow) -> bool:
    return dock.frameGeometry().intersects(window.frameGeometry())


def test_where_there_is_no_room_beside_a_panel_hides_no_body() -> None:
    room, panel = QRect(0, 0, 1000, 800), QRect(400, 100, 300, 500)
    body = QRect(300, 0, 300, 800)
    for window in (QRect(0, 0, 1000, 800), QRect(100, 0, 800, 800)):
        place = QRect(beside(panel, window, body, room), panel.size())
        assert room.contains(place)
        assert not place.intersects(body)
    # The window's screen need not start at 0.
    second = QRect(2000, 0, 1000, 800)
    place = QRect(beside(panel, QRect(2000, 0, 600, 800), body, second), panel.size())
    assert place.left() > 2600
    assert second.contains(place)
    # If it is larger than the screen, its title bar stays within reach.
    vast = QRect(0, 0, 1200, 900)
    corner = beside(vast, QRect(0, 0, 1000, 800), body, room)
    assert room.contains(corner)


def drag_line(qtbot: QtBot, window: MainWindow, dock: QDockWidget, by: int) -> None:
    """Drag the splitter at the right of a panel, as a user does."""
    start = QPoint(dock.geometry().right() + 3, dock.geometry().center().y())
    QTest.mousePress(window, Qt.MouseButton.LeftButton, pos=start)
    for step in range(1, 6):
        QTest.mouseMove(window, start + QPoint(by * step // 5, 0))
        qtbot.wait(20)
    QTest.mouseRelease(window, Qt.MouseButton.LeftButton, pos=start + QPoint(by, 0))
    settle_layout(qtbot, window)


def test_the_width_of_a_panel_is_the_users_and_remembered(
    qtbot: QtBot, document: PoseDocument, editor_model: LearnedBody, tmp_path: Path
) -> None:
    first = open_window(qtbot, document, settings_in(tmp_path), (1360, 840))
    settle_layout(qtbot, first)
    sliders, others = first.docks["sliders"], first.docks["collision"].width()
    before = sliders.width()
    drag_line(qtbot, first, sliders, 90)
    wanted = sliders.width()
    assert wanted == pytest.approx(before + 90, abs=3)
    # A narrow window reduces it only while it is narrow.
    for width in (800, 1360, 1580):
        first.resize(width, 800)
        settle_layout(qtbot, first)
        assert first.width() == width
        assert (sliders.width() == wanted) == (width > 800)
    close_window(first)
    again = PoseDocument(editor_model)
    second = open_window(qtbot, again, settings_in(tmp_path), (1500, 840))
    qtbot.waitUntil(lambda: second.docks["sliders"].width() == wanted)
    second.reset_layout()
    settle_layout(qtbot, second)
    assert second.docks["sliders"].width() != wanted
    assert second.docks["collision"].width() >= others


@pytest.mark.variants
@pytest.mark.parametrize("size", [(800, 600), (1360, 840)])
def test_resolve_is_in_sight_beside_long_lists_and_notes(
    qtbot: QtBot,
    document: PoseDocument,
    editor_model: LearnedBody,
    tmp_path: Path,
    size: tuple[int, int],
) -> None:
    window = open_window(qtbot, document, settings_in(tmp_path), (1360, 840))
    window.resize(*size)
    document.motion.blend_towards(sample_poses(editor_model, 1, 0, colliding=True)[0], 1.0)
    rest(qtbot, window)
    with qtbot.waitSignal(document.tasks.solve_finished, timeout=PATIENCE):
        window.actions_by_key["resolve"].trigger()
    panel = window.collision
    # As for a body with many parts, whose rules leave much out.
    for row in panel.prediction.rows:
        row.setFixedHeight(400)
    panel.proposal.show()
    panel.proposal.text.setText("The same parts touch in nearly all of the poses. " * 8)
    panel.exact.details.setText("54 pairs of triangles are not counted, as parts touch\n" * 3)
    rest(qtbot, window)
    settle_layout(qtbot, window)
    assert (window.width(), window.height()) == size
    for widget in (panel.resolve.button, panel.resolve.options, panel.exact.verdict):
        assert widget.isVisible()
        assert lies_in(widget, window)
        assert lies_in(widget, window.docks["collision"])
        assert widget.visibleRegion().boundingRect().size() == widget.size()
    assert panel.resolve.button.height() >= 30
