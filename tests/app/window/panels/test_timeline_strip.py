"""The painted part of the timeline: the display of frames, clicks and drags."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from PySide6.QtCore import QEvent, QPoint, QPointF, Qt
from PySide6.QtGui import QColor, QHelpEvent, QImage, QMouseEvent, QWheelEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QToolTip
from pytestqt.qtbot import QtBot

from app.view.theme import DARK, LIGHT, Theme, apply_theme
from app.window.panels.timeline_strip import TimelineStrip, Track, by_column, known_runs, round_up
from tests.app.views import double_click

NONE, CTRL, SHIFT = (
    Qt.KeyboardModifier.NoModifier,
    Qt.KeyboardModifier.ControlModifier,
    Qt.KeyboardModifier.ShiftModifier,
)


@pytest.fixture(params=[LIGHT, DARK], ids=lambda theme: theme.name)
def theme(request: pytest.FixtureRequest) -> Iterator[Theme]:
    application = QApplication.instance()
    assert isinstance(application, QApplication)
    apply_theme(application, request.param)
    yield request.param
    apply_theme(application, LIGHT)


@pytest.fixture
def strip(qtbot: QtBot, theme: Theme) -> TimelineStrip:  # noqa: ARG001 - it is in this theme
    return shown(qtbot, 90)


def shown(qtbot: QtBot, n_frames: int, width: int = 900) -> TimelineStrip:
    """Show a motion without any checked frames."""
    strip = TimelineStrip()
    qtbot.addWidget(strip)
    strip.resize(width, strip.sizeHint().height())
    strip.set_motion(np.arange(n_frames) / 30.0)
    strip.show()
    qtbot.waitExposed(strip)
    return strip


def middle(strip: TimelineStrip, frame: int) -> int:
    return int(strip._track().x_of(frame + 0.5))


def seen(strip: TimelineStrip) -> tuple[float, float]:
    track = strip._track()
    return track.first, track.first + track.span


def exact_row(strip: TimelineStrip) -> range:
    row = strip._rows(strip._track())[1]
    return range(int(row.top()), int(row.bottom()))


def column(strip: TimelineStrip, image: QImage, frame: int) -> list[QColor]:
    """Return the exact check's pixels at a frame, beside the playhead's line."""
    return [image.pixelColor(middle(strip, frame), y) for y in exact_row(strip)]


def is_warm(colour: QColor) -> bool:
    """Return whether a colour is one for penetration, red to orange."""
    return colour.saturation() > 60 and (colour.hue() < 40 or colour.hue() > 340)


def is_green(colour: QColor) -> bool:
    return colour.saturation() > 60 and 130 < colour.hue() < 190


def wheel(strip: TimelineStrip, x: float, notches: QPoint, keys: Qt.KeyboardModifier) -> bool:
    """Turn the wheel; return whether the strip accepted it."""
    at = QPointF(x, 40.0)
    event = QWheelEvent(
        at,
        strip.mapToGlobal(at),
        QPoint(),
        120 * notches,
        Qt.MouseButton.NoButton,
        keys,
        Qt.ScrollPhase.NoScrollPhase,
        False,
    )
    event.ignore()
    QApplication.sendEvent(strip, event)
    return event.isAccepted()


def wanted(strip: TimelineStrip) -> list[int]:
    frames: list[int] = []
    strip.frame_wanted.connect(frames.append)
    return frames


def click(strip: TimelineStrip, x: float, y: int = 50) -> None:
    QTest.mouseClick(strip, Qt.MouseButton.LeftButton, pos=QPoint(round(x), y))


def drag(strip: TimelineStrip, start: QPoint, *ways: QPoint) -> None:
    QTest.mousePress(strip, Qt.MouseButton.LeftButton, pos=start)
    for place in ways:
        QTest.mouseMove(strip, place)
    QTest.mouseRelease(strip, Qt.MouseButton.LeftButton, pos=ways[-1])


def test_a_release_that_a_dialog_took_leaves_nothing_held(strip: TimelineStrip) -> None:
    frames = wanted(strip)
    start, none = QPoint(round(middle(strip, 10)), 50), Qt.MouseButton.NoButton
    QTest.mousePress(strip, Qt.MouseButton.LeftButton, pos=start)
    at = QPointF(middle(strip, 30), 50)
    moved = QMouseEvent(QEvent.Type.MouseMove, at, strip.mapToGlobal(at), none, none, NONE)
    QApplication.sendEvent(strip, moved)
    assert frames == [10]
    QTest.mouseRelease(strip, Qt.MouseButton.LeftButton, pos=start)


def test_a_click_asks_for_the_frame_under_the_pointer(strip: TimelineStrip) -> None:
    frames = wanted(strip)
    for frame in (0, 1, 44, 89):
        click(strip, middle(strip, frame))
    assert frames == [0, 1, 44, 89]
    for _ in range(6):
        wheel(strip, middle(strip, 44), QPoint(0, 1), CTRL)
    first, last = seen(strip)
    assert 0 < first < 40 < 48 < last < 89
    frames.clear()
    for frame in (41, 44, 47):
        click(strip, middle(strip, frame))
    assert frames == [41, 44, 47]


def test_nothing_moves_by_itself(strip: TimelineStrip) -> None:
    before = strip.grab().toImage()
    frames = wanted(strip)
    click(strip, middle(strip, 30))
    assert frames == [30]
    assert strip.grab().toImage() == before
    strip.set_frame(30)
    assert strip.grab().toImage() != before


def test_a_drag_asks_for_each_frame_that_it_comes_to_and_stops_at_the_ends(
    strip: TimelineStrip,
) -> None:
    frames = wanted(strip)
    strip.frame_wanted.connect(strip.set_frame)
    ways = [QPoint(middle(strip, frame), 60) for frame in (11, 11, 12)]
    drag(strip, QPoint(middle(strip, 10), 50), *ways, QPoint(strip.width() + 50, 60))
    assert frames == [10, 11, 12, 89]


def test_the_labels_and_other_buttons_ask_for_nothing(strip: TimelineStrip) -> None:
    frames = wanted(strip)
    click(strip, 20)
    QTest.mouseClick(strip, Qt.MouseButton.RightButton, pos=QPoint(middle(strip, 5), 50))
    assert frames == []


@pytest.mark.parametrize("frame", [0, 7_777, 12_345, 19_999])
def test_of_many_frames_in_a_pixel_a_click_goes_to_the_one_that_overlaps_deepest(
    qtbot: QtBot, frame: int
) -> None:
    strip = shown(qtbot, 20_000)
    depths = np.zeros(20_000)
    depths[frame] = 0.01
    strip.set_depths(depths)
    frames = wanted(strip)
    click(strip, middle(strip, frame))
    assert frames == [frame]


@pytest.mark.usefixtures("theme")
@pytest.mark.parametrize("frame", [0, 7_777, 12_345, 19_999])
def test_one_colliding_frame_of_20_000_is_seen(qtbot: QtBot, frame: int) -> None:
    strip = shown(qtbot, 20_000)
    strip.set_frame(10_000)
    depths = np.zeros(20_000)
    strip.set_depths(depths)
    assert not any(map(is_warm, column(strip, strip.grab().toImage(), frame)))
    depths[frame] = 0.001
    strip.set_depths(depths)
    image = strip.grab().toImage()
    assert any(map(is_warm, column(strip, image, frame)))
    assert is_warm(image.pixelColor(middle(strip, frame), exact_row(strip)[-1]))


def test_unknown_free_and_colliding_frames_differ_in_form_too(strip: TimelineStrip) -> None:
    depths = np.full(90, np.nan)
    depths[10], depths[20], depths[30] = 0.0, 0.002, 0.01
    strip.set_depths(depths)
    image = strip.grab().toImage()
    free = sum(map(is_green, column(strip, image, 10)))
    slight, deep = (sum(map(is_warm, column(strip, image, frame))) for frame in (20, 30))
    assert 0 < free < slight < deep == len(exact_row(strip))
    unknown = column(strip, image, 40)
    assert not any(is_green(colour) or is_warm(colour) for colour in unknown)
    assert len({colour.name() for colour in unknown}) > 1  # hatched


def test_a_frame_that_is_not_checked_is_not_hidden_by_free_ones_in_its_pixel(
    qtbot: QtBot,
) -> None:
    strip = shown(qtbot, 20_000)
    depths = np.zeros(20_000)
    depths[12_345] = np.nan
    strip.set_depths(depths)
    strip.set_frame(3)
    image = strip.grab().toImage()
    assert not any(map(is_green, column(strip, image, 12_345)))
    assert any(map(is_green, column(strip, image, 11_000)))


def test_resolved_spans_turn_free_and_lose_their_marks(strip: TimelineStrip) -> None:
    depths, between = np.zeros(90), np.zeros(90, dtype=bool)
    depths[20:40] = 0.01
    strip.set_depths(depths)
    strip.set_curve(depths, "")
    free = strip.grab().toImage()
    between[60] = True
    strip.set_between(between)
    image = strip.grab().toImage()
    assert image != free
    edge = int(strip._track().x_of(61))
    assert any(is_warm(image.pixelColor(edge, y)) for y in exact_row(strip))
    strip.set_resolved([range(15, 45), range(60, 62)])
    image = strip.grab().toImage()
    assert any(map(is_green, column(strip, image, 30)))
    assert not any(
        is_warm(image.pixelColor(x, y))
        for x in range(int(strip._gutter()), strip.width())
        for y in exact_row(strip)
    )


def test_the_estimate_has_a_strip_only_where_there_is_one(strip: TimelineStrip) -> None:
    curve = strip._rows(strip._track())[3]
    probability = np.full(90, np.nan)
    probability[10], probability[20] = 0.2, 0.9
    strip.set_estimate(probability)
    row = strip._rows(strip._track())[2]
    assert strip._rows(strip._track())[3].top() > curve.top()
    image = strip.grab().toImage()

    def bar(frame: int) -> list[QColor]:
        ys = range(int(row.top()), int(row.bottom()))
        return [image.pixelColor(middle(strip, frame), y) for y in ys]

    assert 0 < sum(map(is_green, bar(10))) < sum(map(is_warm, bar(20)))
    assert not any(is_green(colour) or is_warm(colour) for colour in bar(30))
    strip.set_estimate(None)
    assert strip._rows(strip._track())[3] == curve


def test_the_curve_is_as_high_as_the_overlap(strip: TimelineStrip) -> None:
    depths = np.full(90, np.nan)
    depths[10:13], depths[30:33], depths[50] = 0.01, 0.005, 0.0
    strip.set_curve(depths, "left arm")
    image = strip.grab().toImage()
    row = strip._rows(strip._track())[3]

    def height(frame: int) -> int:
        colours = (
            image.pixelColor(middle(strip, frame), y)
            for y in range(int(row.top()), int(row.bottom()) - 2)
        )
        return sum(colour.name() != strip_card.name() for colour in colours)

    strip_card = image.pixelColor(middle(strip, 70), int(row.center().y()))
    assert height(11) == pytest.approx(2 * height(31), abs=2)
    assert height(11) > 0.8 * row.height()
    assert height(50) == height(70) == 0


def test_the_handles_of_the_range_are_dragged(qtbot: QtBot, strip: TimelineStrip) -> None:
    ranges: list[tuple[int, int]] = []
    strip.range_wanted.connect(lambda *range_: ranges.append(range_))
    strip.range_wanted.connect(strip.set_range)
    frames = wanted(strip)
    strip.set_range(20, 60)
    track = strip._track()
    in_handle, out_handle = round(track.x_of(20)) - 5, round(track.x_of(61)) + 5
    QTest.mouseMove(strip, QPoint(in_handle, 12))
    qtbot.waitUntil(lambda: strip.cursor().shape() is Qt.CursorShape.SizeHorCursor)
    drag(strip, QPoint(in_handle, 12), QPoint(round(track.x_of(25)), 12))
    assert ranges == [(25, 60)]
    drag(strip, QPoint(out_handle, 12), QPoint(round(track.x_of(51)), 12))
    assert ranges == [(25, 60), (25, 50)]
    # Neither point passes the other, nor leaves the motion.
    drag(strip, QPoint(round(track.x_of(51)) + 5, 12), QPoint(round(track.x_of(3)), 12))
    assert ranges[-1] == (25, 25)
    drag(strip, QPoint(round(track.x_of(26)) + 5, 12), QPoint(strip.width() + 90, 12))
    assert ranges[-1] == (25, 89)
    drag(strip, QPoint(round(track.x_of(25)) - 5, 12), QPoint(-50, 12))
    assert ranges[-1] == (0, 89)
    assert frames == []
    QTest.mouseMove(strip, QPoint(middle(strip, 30), 50))
    qtbot.waitUntil(lambda: strip.cursor().shape() is Qt.CursorShape.ArrowCursor)
    click(strip, middle(strip, 30), y=12)
    assert frames == [30]


def test_what_is_outside_of_the_range_is_dimmed(strip: TimelineStrip) -> None:
    strip.set_depths(np.zeros(90))
    before = strip.grab().toImage()
    strip.set_range(20, 60)
    image = strip.grab().toImage()
    y = exact_row(strip)[-1]
    inside, outside = middle(strip, 40), middle(strip, 10)
    assert image.pixelColor(inside, y) == before.pixelColor(inside, y)
    assert image.pixelColor(outside, y).saturation() < before.pixelColor(outside, y).saturation()


def test_ctrl_and_the_wheel_zoom_about_the_pointer(strip: TimelineStrip) -> None:
    x = middle(strip, 30)
    place = strip._track().place_of(x)
    for _ in range(5):
        assert wheel(strip, x, QPoint(0, 1), CTRL)
        assert strip._track().place_of(x) == pytest.approx(place)
    first, last = seen(strip)
    assert last - first == pytest.approx(90 / 1.25**5)
    for _ in range(40):
        wheel(strip, x, QPoint(0, 1), CTRL)
    assert strip._track().span == 8
    for _ in range(60):
        wheel(strip, x, QPoint(0, -1), CTRL)
    assert seen(strip) == (0, 90)


def test_shift_and_a_sideways_wheel_scroll_and_a_plain_wheel_is_left_alone(
    strip: TimelineStrip,
) -> None:
    x = middle(strip, 45)
    assert not wheel(strip, x, QPoint(0, 1), NONE)
    assert seen(strip) == (0, 90)
    for _ in range(5):
        wheel(strip, x, QPoint(0, 1), CTRL)
    first, last = seen(strip)
    assert wheel(strip, x, QPoint(0, -1), SHIFT)
    assert seen(strip)[0] > first
    assert wheel(strip, x, QPoint(0, 1), SHIFT)
    assert seen(strip) == pytest.approx((first, last))
    assert wheel(strip, x, QPoint(-1, 0), NONE)
    assert seen(strip)[0] > first
    for _ in range(60):
        wheel(strip, x, QPoint(-1, 0), NONE)
    assert seen(strip)[1] == 90


def test_two_clicks_on_the_ruler_show_all_frames_and_elsewhere_they_are_clicks(
    strip: TimelineStrip,
) -> None:
    for _ in range(5):
        wheel(strip, middle(strip, 45), QPoint(0, 1), CTRL)
    frames = wanted(strip)
    double_click(strip, QPoint(middle(strip, 45), 60))
    assert seen(strip) != (0, 90)
    assert set(frames) == {45}
    double_click(strip, QPoint(middle(strip, 45), 12))
    assert seen(strip) == (0, 90)


def test_the_playhead_stays_in_sight(strip: TimelineStrip) -> None:
    for _ in range(10):
        wheel(strip, middle(strip, 10), QPoint(0, 1), CTRL)
    for frame in (10, 50, 89, 3, 0):
        strip.set_frame(frame)
        first, last = seen(strip)
        assert first <= frame
        assert frame + 1 <= last
    first, last = seen(strip)
    strip.set_frame(2)
    assert seen(strip) == (first, last)


def test_a_drag_beyond_what_is_seen_scrolls_frame_by_frame(strip: TimelineStrip) -> None:
    for _ in range(10):
        wheel(strip, middle(strip, 45), QPoint(0, 1), CTRL)
    strip.frame_wanted.connect(strip.set_frame)
    frames = wanted(strip)
    last = strip.frame_at(strip.width())
    beyond = [QPoint(strip.width() + 20 + k, 50) for k in range(3)]
    drag(strip, QPoint(middle(strip, 45), 50), *beyond)
    assert frames == [45, last + 1, last + 2, last + 3]


def test_it_says_in_words_what_it_shows(qtbot: QtBot) -> None:
    strip = shown(qtbot, 90)
    depths, between = np.zeros(90), np.zeros(90, dtype=bool)
    depths[30], depths[60] = 0.012, np.nan
    between[45] = True
    strip.set_depths(depths)
    strip.set_between(between)
    told = {}
    for frame in (15, 30, 45, 60):
        strip.set_frame(frame)
        told[frame] = strip.accessibleDescription()
    assert strip.accessibleName() == "Timeline"
    assert told == {
        15: "Frame 15, 0.50 s: free",
        30: "Frame 30, 1.00 s: overlaps by 1.2 % of the body size",
        45: "Frame 45, 1.50 s: free, but ◆ a pose between it and the next frame collides",
        60: "Frame 60, 2.00 s: not checked yet",
    }
    strip.set_estimate(np.full(90, 0.25))
    estimate = "estimated probability of a collision: 25 %"
    assert strip.accessibleDescription() == f"{told[60]}, {estimate}"
    strip.set_resolved([range(25, 50)])
    strip.set_frame(30)
    assert strip.accessibleDescription() == f"Frame 30, 1.00 s: free, {estimate}"


def test_the_tool_tip_is_about_the_frame_under_the_pointer(qtbot: QtBot) -> None:
    strip = shown(qtbot, 90)
    depths = np.zeros(90)
    depths[30] = 0.012
    strip.set_depths(depths)

    def told_at(x: int) -> str:
        at = QPoint(x, 50)
        QApplication.sendEvent(strip, QHelpEvent(QEvent.Type.ToolTip, at, strip.mapToGlobal(at)))
        return QToolTip.text()

    assert told_at(middle(strip, 15)) == "Frame 15, 0.50 s\nfree"
    at = QPointF(middle(strip, 30), 50)
    none = Qt.MouseButton.NoButton
    moved = QMouseEvent(QEvent.Type.MouseMove, at, strip.mapToGlobal(at), none, none, NONE)
    QApplication.sendEvent(strip, moved)
    assert QToolTip.text() == "Frame 30, 1.00 s\noverlaps by 1.2 % of the body size"
    between = depths > 0.0
    between[[30, 60]] = False, True
    strip.set_between(between)
    mark = int(strip._track().x_of(61))
    said = "◆ A pose between frames 60 and 61 collides, though both are free"
    assert told_at(mark - 3) == told_at(mark + 3) == said
    strip.set_curve(depths, "left <arm>")
    assert told_at(20) == "<span>Deepest overlap of left &lt;arm&gt;</span>"
    QToolTip.hideText()


@pytest.mark.parametrize("n_frames", [1, 2, 7])
def test_short_motions(qtbot: QtBot, n_frames: int) -> None:
    strip = shown(qtbot, n_frames)
    depths = np.zeros(n_frames)
    depths[-1] = 0.004
    strip.set_depths(depths)
    strip.set_curve(depths, "")
    strip.set_estimate(depths)
    strip.set_frame(n_frames - 1)
    frames = wanted(strip)
    for frame in range(n_frames):
        click(strip, middle(strip, frame) + 20)
    assert frames == list(range(n_frames))
    wheel(strip, middle(strip, 0), QPoint(0, 3), CTRL)
    assert seen(strip) == (0, n_frames)
    image = strip.grab().toImage()
    x = middle(strip, n_frames - 1) + 20
    assert any(is_warm(image.pixelColor(x, y)) for y in exact_row(strip))


def test_without_a_motion_it_is_empty_keeps_its_height_and_takes_no_click(
    strip: TimelineStrip,
) -> None:
    least = strip.minimumSizeHint()
    strip.set_frame(40)
    strip.set_motion(np.empty(0))
    assert strip.minimumSizeHint() == least
    image = strip.grab().toImage()
    blank = QImage(image.size(), image.format())
    blank.fill(image.pixelColor(0, 0))
    assert image == blank
    frames = wanted(strip)
    drag(strip, QPoint(300, 50), QPoint(400, 50))
    double_click(strip, QPoint(300, 12))
    assert not wheel(strip, 300, QPoint(0, 1), CTRL)
    assert frames == []
    assert strip.accessibleDescription() == "No motion"


def test_another_motion_starts_afresh(strip: TimelineStrip) -> None:
    new = strip.grab().toImage()
    strip.set_depths(np.full(90, 0.01))
    strip.set_curve(np.full(90, 0.01), "left arm")
    strip.set_estimate(np.full(90, 0.9))
    strip.set_range(10, 20)
    strip.set_frame(15)
    wheel(strip, middle(strip, 15), QPoint(0, 5), CTRL)
    strip.set_motion(np.arange(90) / 30.0)
    assert strip.grab().toImage() == new


def test_it_follows_the_theme(strip: TimelineStrip, theme: Theme) -> None:
    before = strip.grab().toImage()
    application = QApplication.instance()
    assert isinstance(application, QApplication)
    apply_theme(application, LIGHT if theme is DARK else DARK)
    assert strip.grab().toImage() != before
    apply_theme(application, theme)
    assert strip.grab().toImage() == before


def test_the_playhead_alone_does_not_draw_the_rest_again(strip: TimelineStrip) -> None:
    strip.grab()
    picture = strip._picture
    strip.set_frame(50)
    strip.grab()
    assert strip._picture is picture
    strip.set_depths(np.zeros(90))
    strip.grab()
    assert strip._picture is not picture


@pytest.mark.parametrize("n_frames", [1, 2, 90, 700, 20_000])
@pytest.mark.parametrize("zoom", [1.0, 0.37, 0.01])
@pytest.mark.parametrize("n_columns", [1, 640, 1333])
def test_each_frame_that_is_seen_is_in_a_column(n_frames: int, zoom: float, n_columns: int) -> None:
    span = min(max(zoom * n_frames, 8), n_frames)
    track = Track(100.0, 640.0, 0.4 * (n_frames - span), span, n_frames)
    starts = track.columns(n_columns)
    frames = np.arange(int(track.first), int(np.ceil(track.first + span)))
    reached = by_column(np.maximum, np.arange(n_frames), starts)
    assert len(reached) == n_columns
    assert reached[-1] == frames[-1]
    for frame in np.random.default_rng(0).choice(frames, 20):
        lone = np.zeros(n_frames)
        lone[frame] = 1.0
        assert by_column(np.fmax, lone, starts).max() == 1.0


def test_the_ticks_of_scales_are_1_2_and_5() -> None:
    values = (0.0049, 0.005, 0.012, 0.3, 1.0, 3.0, 10.0, 51.0)
    assert [round_up(value) for value in values] == pytest.approx(
        [0.005, 0.005, 0.02, 0.5, 1.0, 5.0, 10.0, 100.0]
    )


def test_runs_of_known_values() -> None:
    values = np.array([np.nan, 1.0, 2.0, np.nan, 3.0])
    assert list(known_runs(values)) == [slice(1, 3), slice(4, 5)]
    assert list(known_runs(np.full(3, np.nan))) == []
