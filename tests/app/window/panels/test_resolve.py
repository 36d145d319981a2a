"""The Resolve card: its text when nothing could be done, and the elapsed time."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from PySide6.QtWidgets import QLabel, QWidget
from pytestqt.qtbot import QtBot

from app.editing import tasks
from app.window.dialogs.forms import resolve_form
from app.window.main_window import MainWindow
from app.window.panels import collision as panel
from app.window.widgets import NumberBox
from lcollision_core.bodies import NamedPose
from lcollision_core.resolve import ResolveResult, Step
from lcollision_core.tasks.words import seconds_text
from tests.app.windows import PATIENCE, rest, take_picture

pytestmark = pytest.mark.one_window

LOCKED = "No search: all body parts are locked"


def resolve(qtbot: QtBot, window: MainWindow) -> ResolveResult:
    with qtbot.waitSignal(window.document.tasks.solve_finished, timeout=PATIENCE):
        window.actions_by_key["resolve"].trigger()
    rest(qtbot, window)
    assert window.document.history.state.outcome is not None
    return window.document.history.state.outcome


def texts(widget: QWidget) -> list[str]:
    return [label.text() for label in widget.findChildren(QLabel) if label.isVisible()]


def test_that_all_body_parts_are_locked_is_said_before_and_after_resolve(
    qtbot: QtBot, window: MainWindow, colliding: npt.NDArray[np.float64]
) -> None:
    document, card = window.document, window.collision.resolve
    outcome = window.collision.outcome
    document.motion.blend_towards(colliding, 1.0)
    for domain in (0, 1):
        assert "All body parts are locked: unlock one to resolve" not in texts(card)
        document.motion.set_locked(domain, True)
    assert "All body parts are locked: unlock one to resolve" in texts(card)
    for key in ("reset", "randomise"):
        window.actions_by_key[key].trigger()
        assert "All body parts are locked" in window.statusBar().currentMessage()
        window.statusBar().clearMessage()
    assert document.history.latent.tobytes() == colliding.tobytes()
    assert not resolve(qtbot, window).exactly_free
    assert LOCKED in texts(outcome)
    assert [text for text in texts(outcome) if text.endswith(" %, as before")]
    assert "No search was needed" not in texts(outcome)
    assert outcome.converged.sign.name == "info"
    # A free pose needs no Resolve, locked or not.
    document.motion.load_pose(NamedPose("mean", np.zeros_like(colliding)))
    assert resolve(qtbot, window).exactly_free
    assert "No search was needed" in texts(outcome)
    assert LOCKED not in texts(outcome)
    document.motion.set_locked(0, False)
    assert "All body parts are locked: unlock one to resolve" not in texts(card)


def test_the_largest_change_is_kept_and_what_is_left_is_said(
    qtbot: QtBot, window: MainWindow, colliding: npt.NDArray[np.float64]
) -> None:
    document, card = window.document, window.collision.outcome
    document.motion.set_clearance(0.0)
    document.motion.blend_towards(colliding, 1.0)
    form = resolve_form(window.settings, window)
    (field,) = (box for box in form.findChildren(NumberBox) if box.suffix() == " %")
    assert (field.value(), field.text()) == (25.0, "25 %")
    field.setValue(0.3)
    form.accept()
    form.deleteLater()
    outcome = resolve(qtbot, window)
    assert outcome.largest_change == 0.003
    assert outcome.vertex_distance_max <= 0.003
    assert not outcome.exactly_free
    said = [text for text in texts(card) if text.startswith("Still colliding: ")]
    assert said[0].startswith(f"Still colliding: {outcome.pairs_after} pairs, by up to ")
    assert "No free pose was found within 0.3 % of the body size" in texts(card)
    take_picture(window, "soft")
    window.settings["resolve_largest_change"] = 0.0
    document.history.undo()
    assert resolve(qtbot, window).exactly_free


@pytest.mark.slow
def test_a_search_that_had_no_time_is_not_called_needless(
    qtbot: QtBot, window: MainWindow, colliding: npt.NDArray[np.float64]
) -> None:
    document, card = window.document, window.collision.outcome
    document.motion.blend_towards(colliding, 1.0)
    outcome = resolve(qtbot, window)
    for free in (True, False):
        rushed = replace(
            outcome, solver_status="not run", step=Step.FALL_BACK, exactly_free=free, note=None
        )
        document.history.amend(replace(document.history.state, outcome=rushed))
        assert "No search: the time limit came first" in texts(card)


@pytest.mark.slow
def test_the_time_told_is_what_was_waited_as_well(
    qtbot: QtBot,
    window: MainWindow,
    colliding: npt.NDArray[np.float64],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real = tasks.resolve_pose

    def slow(*arguments: object, **named: object) -> object:
        document.tasks._solve_began -= 0.8
        result, ghost = real(*arguments, **named)  # type: ignore[arg-type]
        return replace(result, seconds=0.194), ghost

    card, document = window.collision.outcome, window.document
    document.motion.blend_towards(colliding, 1.0)
    with monkeypatch.context() as soon:
        soon.setattr(panel, "_WAITED", math.inf)
        resolve(qtbot, window)
        assert not any("of preparation" in text for text in texts(card))
    document.history.undo()
    monkeypatch.setattr(tasks, "resolve_pose", slow)
    resolve(qtbot, window)
    (told,) = (text for text in texts(card) if "of preparation" in text)
    assert told.startswith("194 ms, after ")
    assert told.endswith(
        f" {seconds_text(document.history.state.outcome_seconds - 0.194)} of preparation"
    )
    assert document.history.state.outcome_seconds >= 0.8
    # Undo and redo restore the same times.
    document.history.undo()
    document.history.redo()
    assert told in texts(card)
