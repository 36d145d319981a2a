"""The right panel: enough space, and an estimate separate from the exact check."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PySide6.QtCore import QPoint, QRect, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QLabel, QScrollArea, QWidget
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.view.theme import current_theme
from app.window.main_window import MainWindow
from app.work.frames import FrameEvaluator, PosePrediction
from lcollision_core.resolve import ResolveResult
from tests.app.windows import PATIENCE, open_window, rest, settings_in, settle_layout

pytestmark = pytest.mark.one_window

FloatArray = npt.NDArray[np.float64]


def resolve(qtbot: QtBot, window: MainWindow) -> ResolveResult:
    with qtbot.waitSignal(window.document.tasks.solve_finished, timeout=PATIENCE) as told:
        window.actions_by_key["resolve"].trigger()
    rest(qtbot, window)
    assert told.args is not None
    result = told.args[0]
    assert isinstance(result, ResolveResult)
    return result


def scrolled(window: MainWindow) -> QScrollArea:
    (area,) = window.collision.findChildren(QScrollArea)
    return area


def is_seen_whole(window: MainWindow, widget: QWidget) -> bool:
    seen = scrolled(window).viewport()
    return widget.isVisible() and seen.rect().contains(
        QRect(widget.mapTo(seen, QPoint(0, 0)), widget.size())
    )


@pytest.mark.slow
def test_the_result_of_resolve_scrolls_into_sight(
    qtbot: QtBot, window: MainWindow, colliding: FloatArray
) -> None:
    window.resize(1280, 560)
    window.document.motion.blend_towards(colliding, 1.0)
    rest(qtbot, window)
    assert scrolled(window).verticalScrollBar().value() == 0
    resolve(qtbot, window)
    assert scrolled(window).verticalScrollBar().maximum() > 0
    qtbot.waitUntil(lambda: is_seen_whole(window, window.collision.outcome), timeout=PATIENCE)


@pytest.mark.slow
def test_the_panel_keeps_the_width_that_its_cards_need_also_where_settings_say_less(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = PosePrediction(np.zeros(2), 1.0)
    monkeypatch.setattr(FrameEvaluator, "_predict", lambda *_: told)
    settings = settings_in(tmp_path)
    settings["collision_width"] = 100
    after = open_window(qtbot, PoseDocument(document.model), settings)
    qtbot.waitUntil(lambda: not after.document.tasks.busy, timeout=PATIENCE)
    rest(qtbot, after)
    assert after.collision.prediction.percent.text() == "100 %"
    assert after.collision.prediction.verdict.text() == "Overruled by the check"
    assert has_room(after)
    for size in ((300, 300), (1280, 720)):
        after.resize(*size)
        settle_layout(qtbot, after)
        assert has_room(after)


def has_room(window: MainWindow) -> bool:
    """Whether nothing is cut off at the panel's right, even beside a scroll bar."""
    area = scrolled(window)
    bar = area.verticalScrollBar().sizeHint().width()
    return area.width() >= area.widget().minimumSizeHint().width() + bar


def texts(widget: QWidget) -> list[str]:
    return [label.text() for label in widget.findChildren(QLabel) if label.text()]


def ink(label: QLabel) -> str:
    return label.palette().color(label.foregroundRole()).name()


@pytest.mark.variants(2)
@pytest.mark.parametrize("collides", [False, True], ids=["free", "colliding"])
@pytest.mark.parametrize("right", [False, True], ids=["wrong", "right"])
def test_the_estimate_steps_back_once_the_check_has_spoken(
    qtbot: QtBot,
    window: MainWindow,
    colliding: FloatArray,
    monkeypatch: pytest.MonkeyPatch,
    collides: bool,
    right: bool,
) -> None:
    document, card, headline = window.document, window.collision.prediction, window.collision.exact
    monkeypatch.setattr("app.work.frames._QUICK_CHECK_SECONDS", 0.0)
    told = PosePrediction(np.zeros(2), 0.99 if collides == right else 0.01)
    monkeypatch.setattr(FrameEvaluator, "_predict", lambda *_: told)
    said = "Probably colliding" if collides == right else "Probably clear"
    alarm = getattr(current_theme(), "colliding" if collides == right else "free")
    document.motion.blend_towards(colliding if collides else np.zeros_like(colliding) + 1e-3, 1.0)
    qtbot.waitUntil(
        lambda: card.verdict.text() == said and ink(card.verdict) == alarm, timeout=PATIENCE
    )
    assert alarm in colours_of(card.meter)
    rest(qtbot, window)
    expected = "Colliding (checked)" if collides else "No collisions (checked)"
    assert headline.verdict.text() == expected
    assert ink(headline.verdict) == getattr(current_theme(), "colliding" if collides else "free")
    assert card.verdict.text() == (said if right else "Overruled by the check")
    assert ink(card.verdict) == ink(card.percent) == current_theme().muted
    assert alarm not in colours_of(card.meter)
    for label in (card.verdict, card.percent):
        assert label.fontInfo().pixelSize() < headline.details.fontInfo().pixelSize()
        assert label.fontInfo().pixelSize() < 0.8 * headline.verdict.fontInfo().pixelSize()
    assert headline.mapTo(window, QPoint(0, 0)).y() < card.mapTo(window, QPoint(0, 0)).y()


@pytest.mark.slow
def test_the_headline_stays_in_sight_below_which_the_panel_scrolls(
    qtbot: QtBot, window: MainWindow, colliding: FloatArray
) -> None:
    headline = window.collision.exact
    window.resize(1280, 560)
    window.document.motion.blend_towards(colliding, 1.0)
    rest(qtbot, window)
    resolve(qtbot, window)
    qtbot.waitUntil(lambda: scrolled(window).verticalScrollBar().value() > 0, timeout=PATIENCE)
    seen = QRect(headline.mapTo(window.collision, QPoint(0, 0)), headline.size())
    assert window.collision.rect().contains(seen)
    assert not headline.visibleRegion().isEmpty()
    assert headline.visibleRegion().boundingRect() == headline.rect()


@pytest.mark.slow
def test_the_headline_keeps_what_it_says_and_its_height_until_the_next_check(
    qtbot: QtBot, window: MainWindow, colliding: FloatArray
) -> None:
    document, card = window.document, window.collision.exact
    document.motion.blend_towards(colliding, 1.0)
    rest(qtbot, window)
    told, height = texts(card), card.height()
    places = [child.geometry() for child in card.findChildren(QLabel)]
    assert "on the mesh" in told
    document.motion.begin_gesture("Move a slider")
    for value in np.linspace(0.0, 1e-3, 20):
        document.motion.set_code(0, float(colliding[0] + value))
        qtbot.wait(5)
        # A quick frame brings picture and verdict together; until then, both stay.
        if document.motion.exact is None and not document.motion.expects_frame:
            before = [text.replace("on the mesh", "previous pose") for text in told]
            assert texts(card) == before != told
            assert card.is_of_the_pose_before
            assert ink(card.verdict) == current_theme().waiting
        assert card.height() == height
        assert [child.geometry() for child in card.findChildren(QLabel)] == places
    document.motion.end_gesture()
    rest(qtbot, window)
    assert not card.is_of_the_pose_before
    assert "previous pose" not in texts(card)
    # The layout does not move from one verdict to another either.
    document.motion.blend_towards(np.zeros_like(colliding), 1.0)
    rest(qtbot, window)
    assert card.verdict.text() == "No collisions (checked)"
    assert card.height() == height
    assert [child.geometry() for child in card.findChildren(QLabel)] == places
    # The verdict on another model's pose does not apply to this one.
    document.set_model(document.model)
    assert card.verdict.text() == "Checking…"
    assert not card.is_of_the_pose_before
    rest(qtbot, window)


def test_a_frame_that_comes_at_once_brings_its_verdict_along(
    qtbot: QtBot, window: MainWindow
) -> None:
    document, card = window.document, window.collision.exact
    document.motion.set_solid(False)
    rest(qtbot, window)
    assert document.motion.exact is not None
    assert not document.motion.exact.colliding
    seen: list[tuple[bool, str]] = []
    # Connected after the card, so called after it.
    document.motion.exact_changed.connect(
        lambda: seen.append((document.motion.expects_frame, card.verdict.property("verdict")))
    )
    for value in np.linspace(0.0, 1e-3, 10)[1:]:
        document.motion.set_code(0, float(value))
        rest(qtbot, window)
    assert (True, "free") in seen
    assert (True, "waiting") not in seen
    assert seen[-1] == (False, "free")


def colours_of(widget: QWidget) -> set[str]:
    picture = widget.grab().toImage()
    places = ((x, y) for x in range(picture.width()) for y in range(picture.height()))
    return {picture.pixelColor(x, y).name() for x, y in places}


def test_a_free_pose_reads_as_success_whatever_was_predicted(
    qtbot: QtBot, window: MainWindow, colliding: FloatArray
) -> None:
    document, card = window.document, window.collision.outcome
    facts = (card.exactly_free, card.converged, card.predicted_free)
    document.motion.blend_towards(colliding, 1.0)
    rest(qtbot, window)
    found = resolve(qtbot, window)
    for changes, signs, words in (
        (
            {"converged": False, "predicted_free": False},
            ["check", "check", "info"],
            [
                "No collisions (checked)",
                "The search found a pose without collisions",
                "Estimate: probably colliding, overruled",
            ],
        ),
        (
            {"exactly_free": False, "converged": False},
            ["error", "error", "info"],
            [
                "Still colliding",
                "The search stopped early",
                "Estimate: probably clear, overruled",
            ],
        ),
        (
            {"exactly_free": False, "predicted_free": False},
            ["error", "check", "info"],
            ["Still colliding", "The search finished", "Estimate: probably colliding"],
        ),
    ):
        known = {"solver_status": "known", "exactly_free": True, "converged": True}
        outcome = replace(found, **(known | {"predicted_free": True} | changes))
        document.history.amend(replace(document.history.state, outcome=outcome))
        assert [fact.sign.name for fact in facts] == signs
        assert [text for fact in facts for text in texts(fact)] == words
        assert facts[0].answer == outcome.exactly_free
        assert facts[2].answer == outcome.predicted_free
    assert len({fact.toolTip() for fact in facts} - {""}) == 3


def test_the_ghost_goes_and_comes_back_with_the_result_it_belongs_to(
    qtbot: QtBot, window: MainWindow, colliding: FloatArray
) -> None:
    document, card, scene = window.document, window.collision.outcome, window.viewport.scene
    assert scene is not None

    def seen() -> tuple[bool, bool]:
        rest(qtbot, window)
        return card.isVisible(), scene.ghost_shown

    document.motion.blend_towards(colliding, 1.0)
    rest(qtbot, window)
    resolve(qtbot, window)
    assert seen() == (True, True)
    window.actions_by_key["randomise"].trigger()
    assert seen() == (False, False)
    window.actions_by_key["undo"].trigger()
    assert seen() == (True, True)
    QTest.keyClick(window.sliders.row_of(0).slider, Qt.Key.Key_Right)
    assert seen() == (False, False)
    window.actions_by_key["undo"].trigger()
    assert seen() == (True, True)
    # A Resolve with nothing to do has no ghost, not even the previous one's.
    assert resolve(qtbot, window).latent_distance == 0.0
    assert seen() == (True, False)


def test_a_result_says_of_what_the_body_has_moved_its_shares(
    qtbot: QtBot, window: MainWindow, colliding: FloatArray
) -> None:
    window.document.motion.blend_towards(colliding, 1.0)
    rest(qtbot, window)
    resolve(qtbot, window)
    (moved,) = (text for text in texts(window.collision.outcome) if "at most" in text)
    assert re.fullmatch(r"[\d.]+\xa0% of the body size, at most [\d.]+\xa0%", moved)
    window.resizeDocks([window.docks["collision"]], [1], Qt.Orientation.Horizontal)
    settle_layout(qtbot, window)
    assert has_room(window)
