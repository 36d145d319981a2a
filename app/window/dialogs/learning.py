"""The dialog of the progress and the result of learning a model."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import QSize, Qt, Signal, Slot
from PySide6.QtGui import QImage, QPixmap
from PySide6.QtWidgets import QComboBox, QGridLayout, QLabel, QProgressBar, QPushButton, QWidget

from app.view.theme import CLOSE, NORMAL, TIGHT, WIDE
from app.window.dialogs.questions import Dialog, ask_to_discard
from app.window.widgets import (
    SWATCH,
    Card,
    ThemedIcon,
    described,
    dialog_vbox,
    hbox,
    labelled,
    push_button,
    restyle,
    screen_of,
    swatch_icon,
    vbox,
)
from app.work import learning_runs
from app.work.learning_runs import LearningRun, LearningRuns
from lcollision_core.learning_state import RunState, Stage
from lcollision_core.tasks.words import (
    counted,
    duration_text,
    grouped,
    height_text,
    one_line,
    say,
    spent_text,
    with_capital,
)

if TYPE_CHECKING:
    from app.work.threads import Failure, LongWork
    from lcollision_core.bodies import LearnedBody
    from lcollision_core.tasks.learning import LearnedCard

STAGE_WORDS: dict[str, str] = {
    Stage.POSES: "reading the poses",
    Stage.LATENT_SPACE: "learning the latent space",
    Stage.LABELS: "checking poses",
    Stage.PREDICTOR: "training the estimate",
}
"""Description of each stage, in order."""

_ENDED = (RunState.STOPPED, RunState.FAILED, RunState.KILLED)
_WIDTH, _SIGN, _STAGE_SIGN, _BOLD_WIDTH = 560, 32, 18, 92
_PICTURE, _VALUE_WIDTH = QSize(300, 236), 200
_GOES_ON = (
    "Learning runs on with low priority while you pose, after you close this dialog, and after "
    "you close the editor. File > Learning shows this dialog again."
)


class LearningDialog(Dialog):
    """Show one of the runs, with buttons to control it.

    Signals
    -------
    open_wanted : Path, the working folder of a run whose model is to be opened
    closed : Path, the run shown when the user closed the dialog

    Parameters
    ----------
    runs : followed, stopped and continued
    work : reads models
    parent : window of the dialog
    attempt : calls a function and shows an error that the user can fix

    Attributes
    ----------
    which : lists the runs if there are several
    headline, state, bar : state and progress of the run
    stop, resume, discard, open_model, dismiss : buttons
    """

    open_wanted = Signal(object)
    closed = Signal(object)

    def __init__(
        self,
        runs: LearningRuns,
        work: LongWork,
        parent: QWidget,
        attempt: Callable[[Callable[[], object]], object],
    ) -> None:
        super().__init__("Learning", parent)
        self._runs, self._work, self._attempt = runs, work, attempt
        self.path: Path | None = None
        self._shown: tuple[Path, RunState, bool] | None = None
        self._card_of: Path | None = None
        self._read_for: Path | None = None
        self.which = described(QComboBox(), "", "Model being learned")
        self._sign = ThemedIcon(_SIGN)
        self.headline = labelled("", "headline", wraps=True)
        self.state = labelled("", wraps=True)
        self.bar = QProgressBar(textVisible=False, maximum=1000)
        self._stages = _StageRows()
        self._note = labelled(_GOES_ON, "caption", wraps=True)
        self.card = LearnedCardView()
        self._lay_out()
        self.which.activated.connect(lambda _: self.show_run(Path(self.which.currentData())))
        runs.changed.connect(self._on_runs)

    def show_run(self, path: Path) -> None:
        """Show another run."""
        self.path = path
        self._on_runs()

    def done(self, result: int) -> None:
        """Cancel reading a model, and close."""
        if self.path is not None:
            self.closed.emit(self.path)
        self._work.cancel(self)
        self.path = self._read_for = None
        super().done(result)

    def _lay_out(self) -> None:
        self.stop = push_button("Stop", clicked=partial(self._attempt_on_run, self._runs.stop))
        self.resume = push_button(
            "Continue", clicked=partial(self._attempt_on_run, self._runs.resume)
        )
        self.discard = push_button("Discard…", clicked=self._discard)
        self.open_model = QPushButton("Open")
        self.open_model.clicked.connect(lambda: self.open_wanted.emit(self._require_path()))
        tip = "Keep the model for later: it is under File > Models"
        self.dismiss = push_button("Dismiss", tip, self._dismiss)
        self._close = push_button("Close", clicked=self.reject)
        for button in (self.resume, self.open_model):
            # Qt's size hint is too small for the bold text.
            button.setMinimumWidth(_BOLD_WIDTH)
        words = vbox(self.headline, self.state, spacing=TIGHT)
        head = hbox(self._sign, words, spacing=NORMAL)
        head.setAlignment(self._sign, Qt.AlignmentFlag.AlignTop)
        head.setStretchFactor(words, 1)
        buttons = hbox(
            *(self.discard, None, self.stop, self.resume),
            *(self.dismiss, self._close, self.open_model),
        )
        self._column = dialog_vbox(
            self.which, head, self.bar, self._stages, self.card, self._note, buttons
        )
        self._column.setSpacing(NORMAL)
        self.setLayout(self._column)

    def _attempt_on_run(self, act: Callable[[Path], None]) -> None:
        self._attempt(partial(act, self._require_path()))

    def _require_path(self) -> Path:
        assert self.path is not None
        return self.path

    @Slot()
    def _on_runs(self) -> None:
        if not self.isVisible() and self.path is None:
            return
        run = self._runs.run_of(self.path)
        if run is None:
            # The run was discarded, here or elsewhere, or its model was opened.
            self.path = None
            self.reject()
            return
        self._list_runs()
        self._show(run)

    def _list_runs(self) -> None:
        names = [(run.name, str(run.path)) for run in self._runs.runs]
        rows = range(self.which.count())
        if names != [(self.which.itemText(row), self.which.itemData(row)) for row in rows]:
            self.which.clear()
            for name, path in names:
                self.which.addItem(name, path)
        self.which.setCurrentIndex(self.which.findData(str(self.path)))
        self.which.setVisible(len(names) > 1)

    def _show(self, run: LearningRun) -> None:
        state, name = run.state, one_line(run.name)
        is_done, has_ended = state == RunState.DONE, state in _ENDED
        headlines = {
            RunState.WAITING: say("“{name}” is queued", name=name),
            RunState.RUNNING: say("Learning “{name}”", name=name),
            RunState.STOPPING: say("Stopping “{name}”", name=name),
            RunState.STOPPED: say("“{name}” is paused", name=name),
            RunState.DONE: say("“{name}” is ready", name=name),
        }
        failure = say("Learning “{name}” failed", name=name)
        self.headline.setText(headlines.get(state, failure))
        self.state.setText(self._state(run))
        signs = {RunState.DONE: ("check", "free"), RunState.STOPPED: ("wait", "waiting")}
        failed = state in (RunState.FAILED, RunState.KILLED)
        sign = ("warning", "colliding") if failed else signs.get(state, ("wait", "accent"))
        self._sign.show_icon(*sign)
        self.bar.setValue(round(1000 * run.status.done))
        self._stages.follow(run)
        collides = has_ended and run.status.mostly_collides
        can_open = is_done or (collides and bool(run.status.model))
        shown: dict[QWidget, bool] = {
            **dict.fromkeys((self.bar, self._stages, self.discard), not is_done),
            self.card: is_done and self._card_of == run.path,
            self.stop: state in (RunState.RUNNING, RunState.WAITING),
            self.resume: has_ended,
            self.open_model: can_open,
            self.dismiss: is_done,
            self._note: run.is_active and state != RunState.WAITING,
        }
        for widget, is_shown in shown.items():
            widget.setVisible(is_shown)
        self.discard.setEnabled(state != RunState.STOPPING)
        if is_done and run.path not in (self._card_of, self._read_for):
            self._work.cancel(self)
            self._read_for = run.path
            read = partial(learning_runs.read_card, run.status.model)
            done = partial(self._on_card, run.path)
            self._work.start("Reading the model", read, done, self._on_no_card, self)
        if self._shown != (run.path, state, collides):
            self._shown = run.path, state, collides
            self.resume.setText("Train anyway" if collides else "Continue")
            self.open_model.setText("Open character" if collides else "Open")
            self.open_model.setToolTip(
                "Pose the character by its joints" if collides else "Open the model in the editor"
            )
            self.open_model.setDefault(can_open)
            self.resume.setDefault(has_ended and not can_open)
            (self.open_model if can_open else self.resume if has_ended else self._close).setFocus()
            self._fit()

    def _state(self, run: LearningRun) -> str:
        status, state = run.status, run.state
        if state in (RunState.FAILED, RunState.KILLED):
            return f"{with_capital(one_line(run.status.sentence))}."
        if state == RunState.DONE:
            seconds = sum(status.seconds.values())
            spent = spent_text(seconds)
            return say("Added to your models. Training took {spent}.", spent=spent)
        if state == RunState.WAITING:
            others = [run.name for run in self._runs.runs if run.state == RunState.RUNNING]
            if others:
                return say(
                    "It starts after “{other}”, while the editor is open.",
                    other=one_line(others[0]),
                )
            return say("It starts in a moment, while the editor is open.")
        share = 100 * status.done
        if state == RunState.STOPPED:
            return say("{share:.0f} % is done: Continue resumes from there.", share=share)
        text = say("{share:.0f} %", share=share)
        if state == RunState.RUNNING and status.seconds_left is not None and status.done > 0.0:
            left = duration_text(status.seconds_left)
            text = say("{share:.0f} %, {left} left", share=share, left=left)
        return ", ".join((text, *(status.facts if run.is_active else ())))

    def _fit(self) -> None:
        """Grow to fit the content, and stay on the screen."""
        self.setMinimumWidth(_WIDTH)
        self._column.activate()
        width = max(_WIDTH, self.sizeHint().width())
        height = max(self.sizeHint().height(), self._column.totalHeightForWidth(width))
        before = self.size() if self.isVisible() else QSize()
        self.resize(before.expandedTo(QSize(width, height)))
        screen, frame = screen_of(self), self.frameGeometry()
        left = min(frame.x(), screen.right() + 1 - frame.width())
        top = min(frame.y(), screen.bottom() + 1 - frame.height())
        if self.isVisible() and (left, top) != (frame.x(), frame.y()):
            self.move(max(left, screen.x()), max(top, screen.y()))

    @Slot()
    def _discard(self) -> None:
        path = self._require_path()
        run = self._runs.run_of(path)
        if run is not None and ask_to_discard(self, run.name):
            self._attempt(lambda: self._runs.stop(path, discard=True))

    @Slot()
    def _dismiss(self) -> None:
        """Remove the working folder of a finished run; its model stays."""
        run = self._runs.run_of(self._require_path())
        if run is not None:
            run.work.remove()
        self._runs.poll()

    def _on_card(self, path: Path, read: tuple[LearnedBody, LearnedCard]) -> None:
        from app.view.figures import parts_image

        model, card = read
        ratio = self.devicePixelRatioF()
        width, height = round(ratio * _PICTURE.width()), round(ratio * _PICTURE.height())
        drawn = parts_image(model, width, height)
        pixels = QImage(drawn.tobytes(), *drawn.size, 4 * width, QImage.Format.Format_RGBA8888)
        pixels.setDevicePixelRatio(ratio)
        self.card.show_model(model, card, QPixmap.fromImage(pixels))
        self._card_of = path
        self._on_runs()
        self._fit()

    def _on_no_card(self, failure: Failure) -> None:
        if self.path == self._read_for:
            self.state.setText(f"{with_capital(one_line(failure.headline))}.")


class _StageRows(Card):
    """The stages, each with a sign, its name and the time spent on it."""

    def __init__(self) -> None:
        super().__init__()
        self._rows: dict[str, tuple[ThemedIcon, QLabel, QLabel]] = {}
        for stage, words in STAGE_WORDS.items():
            sign, name = ThemedIcon(_STAGE_SIGN), labelled(with_capital(words))
            spent = labelled("", "caption")
            self._rows[stage] = sign, name, spent
            self.add(hbox(sign, name, None, spent))

    def follow(self, run: LearningRun) -> None:
        """Show the progress of a run."""
        stages = list(self._rows)
        now = stages.index(run.status.stage) if run.status.stage in stages else 0
        for index, (stage, (sign, name, spent)) in enumerate(self._rows.items()):
            is_done = index < now or run.state == RunState.DONE
            is_now = index == now and run.state in (RunState.RUNNING, RunState.STOPPING)
            icon = ("check", "free") if is_done else ("right", "accent" if is_now else "track")
            sign.show_icon(*icon)
            name.setObjectName("title" if is_now else "" if is_done else "caption")
            restyle(name)
            seconds = run.status.seconds.get(stage, 0.0)
            text = spent_text(seconds) if seconds >= 1.0 else ""
            if is_now and run.status.stage_done > 0.0:
                text = f"{100 * run.status.stage_done:.0f} %   {text}"
            spent.setText(text)


class LearnedCardView(QWidget):
    """The figures of a learned model, and its body parts."""

    def __init__(self) -> None:
        super().__init__()
        self.facts, self._parts = _grid(WIDE, TIGHT + 2), _grid(NORMAL, 2)
        name = "The body parts that were found, from the front and back"
        self.picture = described(QLabel(), "", name)
        self.picture.setFixedSize(_PICTURE)
        card = Card()
        card.add(self.facts, None)
        column = vbox(self.picture, self._parts, spacing=CLOSE)
        self.setLayout(hbox(card, column, wide=card, spacing=WIDE))

    def show_model(self, model: LearnedBody, card: LearnedCard, picture: QPixmap) -> None:
        """Show another model."""
        for grid in (self.facts, self._parts):
            while (item := grid.takeAt(0)) is not None and (widget := item.widget()) is not None:
                widget.deleteLater()
        for row, (name, value) in enumerate(_figures(card)):
            words = labelled(value, wraps=True)
            words.setMinimumWidth(_VALUE_WIDTH)
            self.facts.addWidget(labelled(name, "caption"), row, 0, Qt.AlignmentFlag.AlignTop)
            self.facts.addWidget(words, row, 1)
        for index, (name, colour) in enumerate(
            zip(model.domain_names, model.card.domain_colours, strict=True)
        ):
            sign, text = QLabel(), labelled(with_capital(one_line(name)), "aside")
            sign.setPixmap(
                swatch_icon(colour, SWATCH, self.devicePixelRatioF()).pixmap(SWATCH, SWATCH)
            )
            row, column = divmod(index, 2)
            self._parts.addWidget(sign, row, 2 * column)
            self._parts.addWidget(text, row, 2 * column + 1)
        for column in (1, 3):
            self._parts.setColumnStretch(column, 1)
        self.picture.setPixmap(picture)


def _figures(card: LearnedCard) -> list[tuple[str, str]]:
    """Return the names and texts of a card's figures."""
    error = f"{100 * card.error_mean:.2f} % of the body size"
    figures = [
        ("Vertices", grouped(card.vertices)),
        ("Learned from", counted(card.poses, "pose", "poses")),
        ("Body parts", f"{card.parts}"),
        (
            "Error",
            f"{error}, at most {height_text(card.error_max)}",
        ),
        (
            "Estimate",
            f"correct for {_percent(card.accuracy)} of new poses "
            f"(majority baseline: {_percent(card.majority_rate)})",
        ),
        (
            "False positive rate",
            "unknown: no sample was free"
            if card.false_positive_rate is None
            else f"{_percent(card.false_positive_rate)} of the free poses",
        ),
        (
            "False negative rate",
            "unknown: no sample collided"
            if card.false_negative_rate is None
            else f"{_percent(card.false_negative_rate)} of the colliding poses",
        ),
        ("Collide", f"{_percent(card.colliding_share)} of random poses"),
        ("Checked", f"{grouped(card.samples)} poses"),
        ("Not counted", card.rules or "nothing: all contacts count"),
    ]
    for stage, words in STAGE_WORDS.items():
        figures.append((with_capital(words), spent_text(card.seconds.get(stage, 0.0))))
    return figures


def _grid(across: int, down: int) -> QGridLayout:
    """Return an empty grid with these spacings."""
    grid = QGridLayout()
    grid.setHorizontalSpacing(across)
    grid.setVerticalSpacing(down)
    return grid


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
