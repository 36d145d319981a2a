"""Resolve: start and cancel it, its progress and its result."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PySide6.QtCore import QSignalBlocker, Qt, Slot
from PySide6.QtGui import QAction
from PySide6.QtWidgets import (
    QApplication,
    QFormLayout,
    QProgressBar,
    QPushButton,
    QSizePolicy,
    QStackedWidget,
    QWidget,
)

from app.view.theme import CLOSE, NORMAL, TIGHT, give_icon
from app.window.number_box import NumberBox
from app.window.widgets import Card, ElidedLabel, Sign, hbox, labelled, show_verdict, vbox
from app.wording import counted, heading, height_text, length_text, overlap_text, seconds_text

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from lcollision_core.bodies import PosableBody
    from lcollision_core.resolve import ResolveResult

_WAITED = 0.5
"""Least seconds of waiting before the search that are reported."""

_LARGEST_CLEARANCE = 0.1

_SIGNS = {True: ("check", "free"), False: ("error", "colliding"), None: ("info", "muted")}
"""Icon and colour for yes, no and not known."""

_CHECKED = {True: "No collisions (checked)", False: "Still colliding", None: "Not checked"}
_ESTIMATED = {
    True: "Estimate: probably clear",
    False: "Estimate: probably colliding",
    None: "No estimate: this body has no predictor",
}


class Fact(QWidget):
    """One of the three facts of an outcome, with the sign of yes, no or not known.

    Parameters
    ----------
    tip : what the fact means
    is_aside : small and grey, whatever it says

    Attributes
    ----------
    answer : yes, no or not known
    sign : shows it
    """

    def __init__(self, tip: str, is_aside: bool = False) -> None:
        super().__init__()
        self._is_aside = is_aside
        self.answer: bool | None = None
        self.sign = Sign(18)
        self._text = labelled("", "aside" if is_aside else "", wraps=True)
        if is_aside:
            show_verdict(self._text, "aside")
        self.setToolTip(tip)
        self.setLayout(hbox(self.sign, self._text, wide=self._text))

    def say(self, sentence: str, answer: bool | None) -> None:
        """Show a sentence that says yes, no, or that it is not known."""
        self.answer = answer
        self.sign.show_icon(*_SIGNS[None if self._is_aside else answer])
        self._text.setText(sentence)


class ResolveCard(Card):
    """The lower end of the right panel, always in sight.

    Parameters
    ----------
    document : resolved and cancelled through it
    resolve_action, options_action : what the buttons trigger

    Attributes
    ----------
    clearance : in millimetres where the body's unit is known, else in per cent of its size
    """

    def __init__(
        self, document: PoseDocument, resolve_action: QAction, options_action: QAction
    ) -> None:
        super().__init__()
        self._document = document
        self._action = resolve_action
        self.button = QPushButton("Resolve")
        self.button.setObjectName("primary")
        give_icon(self.button, "resolve", "on_accent")
        self.options = QPushButton("Options…")
        self.options.setToolTip("Choose how Resolve works")
        self.cancel = QPushButton("Cancel")
        self.cancel.setToolTip("Stop Resolve and leave the pose as it is (Escape)")
        self.bar = QProgressBar(textVisible=False)
        self.working = QWidget()
        progress = vbox(ElidedLabel("Searching for a pose…"), self.bar, spacing=TIGHT)
        self.working.setLayout(hbox(progress, self.cancel, spacing=NORMAL))
        self.resting = QWidget()
        self.resting.setLayout(hbox(self.button, self.options, wide=self.button))
        # They swap in place, so that nothing jumps.
        self.stack = QStackedWidget()
        self.stack.addWidget(self.resting)
        self.stack.addWidget(self.working)
        locked = "All body parts are locked: unlock one to resolve"
        self._locked = labelled(locked, "caption", wraps=True)
        self.stack.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)
        self.clearance = NumberBox(2, 0.0, 100.0 * _LARGEST_CLEARANCE, trims=True)
        self.clearance.setToolTip(
            "Distance that Resolve and Solid keep between body parts; parts near at rest may "
            "come to half their rest distance"
        )
        self._clearance_unit = 0.01
        self.column.addWidget(self.stack)
        self.column.addLayout(hbox(labelled("Clearance"), None, self.clearance))
        self.column.addWidget(self._locked)
        self.button.clicked.connect(resolve_action.trigger)
        self.cancel.clicked.connect(document.tasks.cancel_resolve)
        self.options.clicked.connect(options_action.trigger)
        resolve_action.changed.connect(self._on_action)
        document.tasks.solve_started.connect(self._on_started)
        document.tasks.solve_progressed.connect(self._on_progressed)
        document.tasks.solve_finished.connect(self._on_finished)
        document.motion.locks_changed.connect(self._on_locks)
        self.clearance.valueChanged.connect(self._on_chosen)
        document.model_changed.connect(self._on_clearance)
        document.motion.clearance_changed.connect(self._on_clearance)
        self._on_action()
        self._on_locks()
        self._on_clearance()

    @Slot()
    def _on_clearance(self) -> None:
        """Show the clearance, in what the body is measured in."""
        document = self._document
        millimetres = millimetres_of(document.model) if document.has_model else None
        self._clearance_unit = 0.01 if millimetres is None else 1.0 / millimetres
        with QSignalBlocker(self.clearance):
            self.clearance.setSuffix(" %" if millimetres is None else " mm")
            self.clearance.setSingleStep(0.05 if millimetres is None else 0.5)
            self.clearance.setMaximum(_LARGEST_CLEARANCE / self._clearance_unit)
            self.clearance.setValue(document.motion.clearance / self._clearance_unit)

    @Slot(float)
    def _on_chosen(self, value: float) -> None:
        self._document.motion.set_clearance(min(value * self._clearance_unit, _LARGEST_CLEARANCE))

    @Slot()
    def _on_action(self) -> None:
        # Hidden while it works, it keeps ready to have the keyboard again.
        self.button.setEnabled(self._action.isEnabled() or self._document.tasks.solving)
        self.button.setToolTip(self._action.toolTip())

    @Slot()
    def _on_started(self) -> None:
        self._go_to(self.working, self.cancel)
        self.bar.setValue(0)

    def _go_to(self, page: QWidget, button: QPushButton) -> None:
        """Show another page; the keyboard follows from one to the other, or stays elsewhere."""
        focused = QApplication.focusWidget()
        had_focus = focused is not None and self.stack.isAncestorOf(focused)
        self.stack.setCurrentWidget(page)
        if had_focus:
            button.setFocus()

    @Slot(object)
    def _on_progressed(self, status: object) -> None:
        if isinstance(status, tuple) and len(status) == 2 and status[1] > 0 and status[0] > 0:
            done, total = status
            self.bar.setRange(0, int(total))
            self.bar.setValue(int(done))

    @Slot(object)
    def _on_finished(self, result: object) -> None:  # noqa: ARG002
        self._go_to(self.resting, self.button)

    @Slot()
    def _on_locks(self) -> None:
        self._locked.setVisible(self._document.motion.all_locked)


class OutcomeCard(Card):
    """What Resolve has found; hidden before, and while it works.

    Parameters
    ----------
    document : its outcome is shown
    """

    def __init__(self, document: PoseDocument) -> None:
        super().__init__()
        self._document = document
        self.converged = Fact(
            "Whether the search ended by itself; the exact check alone decides whether the pose "
            "collides"
        )
        self.predicted_free = Fact(
            "The model's instant estimate of the pose: where the exact check disagrees, the check "
            "is right",
            is_aside=True,
        )
        self.exactly_free = Fact(
            "The exact check of the mesh: this alone tells whether the pose collides"
        )
        self._energy, self._moved, self._took = (labelled("", wraps=True) for _ in range(3))
        self._took.setToolTip(
            "The search and, the first time, the wait while it is loaded and compiled"
        )
        self._note = labelled("", "caption", wraps=True)
        top = Qt.AlignmentFlag.AlignTop
        numbers = QFormLayout(horizontalSpacing=CLOSE, verticalSpacing=2, labelAlignment=top)
        numbers.setContentsMargins(0, TIGHT, 0, TIGHT)
        self._measure = labelled("Overlap", "caption")
        numbers.addRow(self._measure, self._energy)
        numbers.addRow(labelled("Moved", "caption"), self._moved)
        numbers.addRow(labelled("Took", "caption"), self._took)
        facts = (self.exactly_free, self.converged, self.predicted_free)
        self.column.addLayout(vbox(*facts, numbers, self._note, spacing=TIGHT))
        for changed in (
            document.tasks.solve_started,
            document.tasks.solve_finished,
            document.history.outcome_changed,
        ):
            changed.connect(self._on_outcome)
        self._on_outcome()

    @Slot()
    def _on_outcome(self) -> None:
        result = self._document.history.state.outcome if self._document.has_model else None
        self.setVisible(result is not None and not self._document.tasks.solving)
        if result is not None:
            self._show(result)

    def _show(self, result: ResolveResult) -> None:
        from lcollision_core.resolve import ALL_LOCKED, Step

        ran = result.solver_status != "not run"
        exactly_free, predicted_free = result.exactly_free, result.predicted_free
        checked = _CHECKED[exactly_free]
        least, clearance = result.least_distance, result.clearance
        millimetres = millimetres_of(self._document.model)
        if clearance > 0.0 and exactly_free is not None:
            if exactly_free and least is not None:
                checked += f", least distance {length_text(least, millimetres)}"
            elif not exactly_free and least is not None and least >= 0.0:
                checked = f"Nearer than {length_text(clearance, millimetres)}"
        if result.step == Step.SOFT and not exactly_free:
            deepest = length_text(result.deepest_after or 0.0, millimetres)
            checked += f": {counted(result.pairs_after or 0, 'pair')}, by up to {deepest}"
        self.exactly_free.say(checked, exactly_free)
        # With a clearance, it is what pairs lack of it.
        self._measure.setText("Lacks clearance" if clearance > 0.0 else "Overlap")
        if ran and exactly_free:
            # One that was cut short has done its work where its pose is free.
            search = "The search found a pose without collisions"
        elif ran:
            search = "The search finished" if result.converged else "The search stopped early"
        elif ALL_LOCKED in (result.note or ""):
            search = "No search: all body parts are locked"
        elif result.step != Step.UNCHANGED:
            search = "No search: the time limit came first"
        else:
            search = "No search was needed"
        self.converged.say(search, bool(exactly_free or result.converged) if ran else None)
        estimate = _ESTIMATED[predicted_free]
        overruled = None not in (exactly_free, predicted_free) and exactly_free != predicted_free
        self.predicted_free.say(estimate + ", overruled" * overruled, predicted_free)
        self.predicted_free.setVisible(self._document.model.has_predictor)
        if result.energy_before is None or result.energy_after is None:
            self._energy.setText("not measured")
        else:
            before, after = overlap_text(result.energy_before), overlap_text(result.energy_after)
            self._energy.setText(
                f"{before}, as before" if before == after else f"{before} → {after}"
            )
        mean, largest = result.vertex_distance_mean, result.vertex_distance_max
        moved = f"{height_text(mean)} of the body size,\nat most {height_text(largest)}"
        self._moved.setText("not at all" if result.latent_distance == 0.0 else moved)
        self._moved.setToolTip("Mean and maximum over the mesh")
        self._took.setText(_times(result.seconds, self._document.history.state.outcome_seconds))
        self._note.setText(heading(result.note or ""))
        self._note.setVisible(bool(result.note))


def millimetres_of(model: PosableBody) -> float | None:
    """Return the body size in millimetres, None where the body's unit is unknown."""
    metres = model.known_metres
    return None if metres is None else 1000.0 * metres * model.body_size


def _times(searched: float, in_all: float) -> str:
    """Say how long the search took, and how long it was waited for where that is longer."""
    waited = in_all - searched
    took = seconds_text(searched)
    return f"{took}, after {seconds_text(waited)} of preparation" if waited > _WAITED else took
