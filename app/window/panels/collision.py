"""The panel of collisions: the exact check, the estimate, Resolve and proposed contact rules."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from PySide6.QtCore import (
    QEvent,
    QPoint,
    QPointF,
    QRectF,
    QSignalBlocker,
    QSize,
    Qt,
    QTimer,
    Signal,
    Slot,
)
from PySide6.QtGui import QAction, QColor, QPainter, QPaintEvent, QPolygonF
from PySide6.QtWidgets import (
    QApplication,
    QFormLayout,
    QProgressBar,
    QPushButton,
    QSizePolicy,
    QStackedWidget,
    QToolButton,
    QWidget,
)

from app.editing.tasks import Work
from app.view.shading import FULL_PREDICTED
from app.view.theme import CLOSE, NORMAL, ROW_HEIGHT, TIGHT, current_theme, give_icon
from app.window.layout import Docking
from app.window.widgets import (
    NAME_SHARE,
    SWATCH,
    Card,
    ElidedLabel,
    HoverRow,
    NameLabel,
    NumberBox,
    ThemedIcon,
    bar_style,
    described,
    hbox,
    labelled,
    longest_name,
    plain_tip,
    push_button,
    scrolling,
    show_verdict,
    signals_blocked,
    title_row,
    unbroken,
    vbox,
    widget_of,
)
from lcollision_core.tasks.words import (
    counted,
    heading,
    height_text,
    length_text,
    overlap_text,
    say,
    say_number,
    seconds_text,
    with_capital,
)

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.work.frames import PoseFrame
    from lcollision_core.bodies import Body
    from lcollision_core.contact import SelfCollisions
    from lcollision_core.resolve import ResolveResult


EVEN_ODDS = 0.5
"""Probability above which a pose counts as predicted to collide."""

_BAR_WIDTH, _BAR_STEPS = 40, 1000
_TIP = "The model's instant estimate of how likely this pose collides with itself"
_MISSING = (
    "This model can't estimate collisions, so Resolve is off. Open another model, or train one "
    "with File > New model."
)
_BY_RIG = "No estimate: it is posed by its rig."


class ProbabilityMeter(QWidget):
    """A bar from 0 to 1 with a line at even odds and a mark at the pose's probability.

    Attributes
    ----------
    probability : that is shown, None for none
    """

    def __init__(self) -> None:
        super().__init__()
        self.probability: float | None = None
        self._is_aside = False
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)

    def show_probability(self, probability: float | None, is_aside: bool = False) -> None:
        """Move the mark, drawn in grey if `is_aside`."""
        if (probability, is_aside) != (self.probability, self._is_aside):
            self.probability, self._is_aside = probability, is_aside
            self.update()

    def sizeHint(self) -> QSize:  # noqa: N802
        """Ask for the bar and the scale beneath it."""
        return QSize(160, 22 + self.fontMetrics().height())

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: ARG002, N802
        """Draw both halves, the line between them, the mark and the scale."""
        theme = current_theme()
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.setPen(Qt.PenStyle.NoPen)
        bar = QRectF(1, 9, self.width() - 2, 8)
        painter.setBrush(QColor(theme.track))
        painter.drawRoundedRect(bar, 4, 4)
        middle = bar.left() + EVEN_ODDS * bar.width()
        if self.probability is not None:
            verdict = theme.colliding if self.probability > EVEN_ODDS else theme.free
            ink = QColor(theme.muted if self._is_aside else verdict)
            mark = bar.left() + self.probability * bar.width()
            filled = QColor(ink)
            filled.setAlpha(130)
            painter.setBrush(filled)
            painter.setClipRect(QRectF(bar.left(), 0, mark - bar.left(), self.height()))
            painter.drawRoundedRect(bar, 4, 4)
            painter.setClipping(False)
            painter.setBrush(ink)
            tip = min(max(mark, bar.left() + 4), bar.right() - 4)
            corners = ((tip - 5, 1), (tip + 5, 1), (tip, 8))
            painter.drawPolygon(QPolygonF([QPointF(x, y) for x, y in corners]))
            painter.drawRect(QRectF(tip - 1, 7, 2, 12))
        painter.setBrush(QColor(theme.text))
        painter.drawRect(QRectF(middle - 0.75, 6, 1.5, 14))
        painter.setPen(QColor(theme.muted))
        scale = QRectF(0, 20, self.width(), self.fontMetrics().height() + 2)
        for text, side in (
            ("clear", Qt.AlignmentFlag.AlignLeft),
            (f"{EVEN_ODDS:g}", Qt.AlignmentFlag.AlignHCenter),
            ("colliding", Qt.AlignmentFlag.AlignRight),
        ):
            painter.drawText(scale, side, text)


class DomainRow(HoverRow):
    """Swatch, name, predicted energy and lock of one domain.

    Parameters
    ----------
    document : whose lock is set
    domain : index from 0
    name_width : width that the name takes before the bar grows beyond its minimum
    """

    def __init__(self, document: PoseDocument, domain: int, name_width: int) -> None:
        colour = document.model.card.domain_colours[domain]
        super().__init__(domain, colour, TIGHT)
        self._name = heading(document.model.domain_names[domain])
        self.bar = QProgressBar(self, textVisible=False, maximum=_BAR_STEPS)
        self.bar.setMinimumWidth(_BAR_WIDTH)
        self.bar.setStyleSheet(bar_style(colour))
        self.lock = described(QToolButton(), "", f"Lock {self._name}")
        self.lock.setCheckable(True)
        self.lock.setFixedSize(24, 22)
        self.lock.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        label = NameLabel(self._name)
        margins = (TIGHT + SWATCH + CLOSE, 0, 0, 0)
        if document.model.has_predictor:
            label.setMaximumWidth(name_width)
            line = hbox(label, self.bar, self.lock, wide=self.bar, margins=margins)
            line.setStretchFactor(label, NAME_SHARE)
        else:
            line = hbox(label, self.lock, wide=label, margins=margins)
        self.setLayout(line)
        self.setFixedHeight(ROW_HEIGHT - 3)
        self.lock.toggled.connect(lambda locked: document.motion.set_locked(domain, locked))
        self.show_lock(False)

    def changeEvent(self, event: QEvent) -> None:  # noqa: N802
        """Restyle the bar's outline for the new theme."""
        super().changeEvent(event)
        if event.type() is QEvent.Type.StyleChange:
            self.bar.setStyleSheet(bar_style(self._colour))

    def show_lock(self, locked: bool) -> None:
        """Show whether the domain is locked."""
        with signals_blocked(self.lock):
            self.lock.setChecked(locked)
        give_icon(self.lock, "lock" if locked else "unlock", "text" if locked else "muted")
        self.lock.setToolTip(
            plain_tip(
                f"{self._name} is locked, in drags too: click to unlock it"
                if locked
                else f"Lock {self._name}: drags, Resolve, Randomise, Reset all and blending leave "
                "it unchanged"
            )
        )

    def show_energy(self, energy: float | None) -> None:
        """Show a predicted energy, in normalised length squared; None hides the bar."""
        self.bar.setVisible(energy is not None)
        if energy is not None:
            # The square root of an energy is a depth.
            fraction = math.sqrt(max(energy, 0.0)) / FULL_PREDICTED
            step = round(_BAR_STEPS * min(fraction, 1.0))
            if step != self.bar.value():
                # Otherwise Qt repaints the whole window at once for each bar.
                self.bar.setUpdatesEnabled(False)
                self.bar.setValue(step)
                self.bar.setUpdatesEnabled(True)
            self.setToolTip(plain_tip(f"{self._name}: predicted overlap {overlap_text(energy)}"))


class PoseCard(Card):
    """A card that shows each frame of the pose with its exact check once.

    Parameters
    ----------
    document : followed
    name : see `Card`
    """

    def __init__(self, document: PoseDocument, name: str = "card") -> None:
        super().__init__(name)
        self._document = document
        self._shown: tuple[PoseFrame | None, SelfCollisions | None] | None = None
        document.motion.frame_changed.connect(self._on_frame)
        document.motion.exact_changed.connect(self._on_exact)
        document.model_changed.connect(self._on_model)

    @Slot()
    def _on_exact(self) -> None:
        if not self._document.motion.expects_verdict:
            self._on_frame()

    @Slot()
    def _on_frame(self) -> None:
        now = self._document.motion.frame, self._document.motion.exact
        if self._shown is None or now[0] is not self._shown[0] or now[1] is not self._shown[1]:
            self._shown = now
            self._show(*now)

    @Slot()
    def _on_model(self) -> None:
        """Show the pose of another model."""
        self._shown = None
        self._on_frame()

    def _show(self, frame: PoseFrame | None, exact: SelfCollisions | None) -> None:
        """Show a frame of the pose and its exact check, each None while it is unknown."""


class PredictionCard(PoseCard):
    """The estimate, beneath the exact check; grey once the check's result is known.

    For a body without a predictor, only the body parts and their locks are shown.

    Signals
    -------
    domain_hovered : int or None, the domain of the row under the pointer
    menu_wanted : int, None and QPoint: the domain that a context menu is for, and its position on
        the screen

    Parameters
    ----------
    document : followed; its locks are changed here
    learn_action : learns a model from a character, which has no estimate
    """

    domain_hovered = Signal(object)
    menu_wanted = Signal(object, object, QPoint)

    def __init__(self, document: PoseDocument, learn_action: QAction) -> None:
        super().__init__(document)
        self.rows: list[DomainRow] = []
        self.learn = described(QToolButton(), learn_action.toolTip())
        self.learn.setText("Learn it…")
        self.learn.setObjectName("action")
        self.learn.clicked.connect(learn_action.trigger)
        why = labelled(_BY_RIG, "caption", wraps=True)
        self._by_rig = widget_of(hbox(why, self.learn, wide=why))
        self._by_rig.hide()
        self.verdict = ElidedLabel("")
        self.percent = described(labelled("", "aside"), _TIP)
        self.meter = described(ProbabilityMeter(), _TIP, "Probability of a collision")
        self._missing = labelled(_MISSING, "caption", wraps=True)
        self.title = labelled("Estimate", "title")
        head = title_row(self.title, self.verdict)
        self.verdict.setObjectName("aside")
        head.addWidget(self.percent)
        self._rows = vbox(spacing=0, margins=(0, TIGHT, 0, 0))
        self.add(vbox(head, self.meter, self._missing, self._by_rig, self._rows))
        document.motion.locks_changed.connect(self._on_locks)
        if document.has_model:
            self._on_model()
        else:
            self._missing.hide()

    def light_domain(self, domain: int | None) -> None:
        """Show which domain the viewport's pointer is on."""
        for row in self.rows:
            row.set_lit(row.domain == domain)

    def _on_model(self) -> None:
        for row in self.rows:
            self._rows.removeWidget(row)
            row.deleteLater()
        model = self._document.model
        width = longest_name(self, map(heading, model.domain_names))
        self.rows = [DomainRow(self._document, k, width) for k in range(len(model.domain_names))]
        for domain in model.domain_order:
            row = self.rows[domain]
            row.hovered.connect(self.domain_hovered)
            row.menu_wanted.connect(self.menu_wanted)
            self._rows.addWidget(row)
        order = [self.learn, *(self.rows[domain].lock for domain in model.domain_order)]
        for before, after in pairwise(order):
            QWidget.setTabOrder(before, after)
        predicts = self._document.model.has_predictor
        for widget in (self.meter, self.verdict, self.percent):
            widget.setVisible(predicts)
        self.title.setText("Estimate" if predicts else "Body parts")
        self._missing.setVisible(not (predicts or self._document.model.can_resolve))
        self._by_rig.setVisible(model.character is not None)
        super()._on_model()
        self._on_locks()

    def _show(self, frame: PoseFrame | None, exact: SelfCollisions | None) -> None:
        prediction = frame.prediction if frame is not None else None
        if prediction is None:
            self.meter.show_probability(None)
            self.verdict.setText("…")
            self.percent.setText("")
            show_verdict(self.verdict, "waiting")
            for row in self.rows:
                row.show_energy(0.0 if self._document.model.has_predictor else None)
            return
        probability = prediction.collision_probability
        collides = probability > EVEN_ODDS
        word = "colliding" if collides else "free"
        self.meter.show_probability(probability, is_aside=exact is not None)
        overruled = exact is not None and exact.colliding != collides
        verdict = "Probably colliding" if collides else "Probably clear"
        self.verdict.setText("Overruled by the check" if overruled else verdict)
        self.percent.setText(f"{100 * probability:.0f} %")
        for label in (self.verdict, self.percent):
            show_verdict(label, word if exact is None else "aside")
        for row, energy in zip(self.rows, prediction.domain_energy, strict=True):
            row.show_energy(float(energy))

    def _on_locks(self) -> None:
        for row in self.rows:
            row.show_lock(row.domain in self._document.motion.locked_domains)


_WAITED = 0.5
"""Shortest wait before the search that is reported, in seconds."""

_LARGEST_CLEARANCE = 0.1

_ICONS_OF_ANSWERS = {
    True: ("check", "free"),
    False: ("error", "colliding"),
    None: ("info", "muted"),
}
"""Icon and colour for yes, no and unknown."""

_ESTIMATED = {
    True: "Estimate: probably clear",
    False: "Estimate: probably colliding",
    None: "No estimate: this body has no predictor",
}
_OVERRULED = {
    True: "Estimate: probably clear, overruled",
    False: "Estimate: probably colliding, overruled",
}


class Fact(QWidget):
    """One of the three facts of an outcome, with an icon for yes, no or unknown.

    Parameters
    ----------
    tip : explains the fact
    is_aside : whether it is always small and grey

    Attributes
    ----------
    answer : True, False, or None for unknown
    sign : the icon of the answer
    """

    def __init__(self, tip: str, is_aside: bool = False) -> None:
        super().__init__()
        self._is_aside = is_aside
        self.answer: bool | None = None
        self.sign = ThemedIcon(18)
        self._text = labelled("", "aside" if is_aside else "", wraps=True)
        if is_aside:
            show_verdict(self._text, "aside")
        self.setToolTip(tip)
        self.setLayout(hbox(self.sign, self._text, wide=self._text))

    def say(self, sentence: str, answer: bool | None) -> None:
        """Show a sentence and the icon of its answer."""
        self.answer = answer
        self.sign.show_icon(*_ICONS_OF_ANSWERS[None if self._is_aside else answer])
        self._text.setText(unbroken(sentence))


class ResolveCard(Card):
    """The card with Resolve at the bottom of the panel, always visible.

    Parameters
    ----------
    document : whose pose is resolved
    resolve_action, options_action : triggered by the buttons

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
        self.button = push_button("Resolve", clicked=resolve_action.trigger)
        self.button.setObjectName("primary")
        give_icon(self.button, "resolve", "on_accent")
        tip = "Choose how Resolve works"
        self.options = push_button("Options…", tip, options_action.trigger)
        tip = "Stop Resolve and leave the pose as it is (Escape)"
        self.cancel = push_button("Cancel", tip, document.tasks.cancel_resolve)
        self.bar = QProgressBar(textVisible=False)
        progress = vbox(ElidedLabel("Searching for a pose…"), self.bar, spacing=TIGHT)
        self.working = widget_of(hbox(progress, self.cancel, spacing=NORMAL))
        self.resting = widget_of(hbox(self.button, self.options, wide=self.button))
        # Stack both rows, so that the layout does not jump.
        self.stack = QStackedWidget()
        self.stack.addWidget(self.resting)
        self.stack.addWidget(self.working)
        locked = "All body parts are locked: unlock one to resolve"
        self._locked = labelled(locked, "caption", wraps=True)
        self.stack.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)
        self.clearance = described(
            NumberBox(2, 0.0, 100.0 * _LARGEST_CLEARANCE, strip_zeros=True),
            "Distance that Resolve and Solid keep between body parts; parts near at rest may "
            "come to half their rest distance",
            "Clearance",
        )
        self._clearance_unit = 0.01
        clearance = hbox(labelled("Clearance"), None, self.clearance)
        self.add(self.stack, clearance, self._locked)
        resolve_action.changed.connect(self._on_action)
        document.tasks.solve_started.connect(self._on_started)
        document.tasks.progressed.connect(self._on_progressed)
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
        """Show the clearance in the body's unit."""
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
        # Keep the button enabled while Resolve runs: it is hidden, and gets the focus back later.
        self.button.setEnabled(self._action.isEnabled() or self._document.tasks.solving)
        self.button.setToolTip(self._action.toolTip())

    @Slot()
    def _on_started(self) -> None:
        self._go_to(self.working, self.cancel)
        self.bar.setValue(0)

    def _go_to(self, page: QWidget, button: QPushButton) -> None:
        """Show another page; if the old one has the keyboard focus, move it to `button`."""
        focused = QApplication.focusWidget()
        had_focus = focused is not None and self.stack.isAncestorOf(focused)
        self.stack.setCurrentWidget(page)
        if had_focus:
            button.setFocus()

    @Slot(object, int, int)
    def _on_progressed(self, work: object, done: int, total: int) -> None:
        if work is Work.RESOLVE and done > 0:
            self.bar.setRange(0, total)
            self.bar.setValue(done)

    @Slot(object)
    def _on_finished(self, result: object) -> None:  # noqa: ARG002
        self._go_to(self.resting, self.button)

    @Slot()
    def _on_locks(self) -> None:
        self._locked.setVisible(self._document.motion.all_locked)


class OutcomeCard(Card):
    """The result of Resolve; hidden without one, while it runs, and in a comparison.

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
        self.add(vbox(*facts, numbers, self._note, spacing=TIGHT))
        for changed in (
            document.tasks.solve_started,
            document.tasks.solve_finished,
            document.history.outcome_changed,
            document.timeline.options_changed,
        ):
            changed.connect(self._on_outcome)
        self._on_outcome()

    @Slot()
    def _on_outcome(self) -> None:
        document = self._document
        result = document.history.state.outcome if document.has_model else None
        is_hidden = document.tasks.solving or document.timeline.comparing
        self.setVisible(result is not None and not is_hidden)
        if result is not None:
            self._show(result)

    def _show(self, result: ResolveResult) -> None:
        from lcollision_core.resolve import ALL_LOCKED, Step

        ran = result.solver_status != "not run"
        exactly_free, predicted_free = result.exactly_free, result.predicted_free
        self.exactly_free.say(self._checked(result), exactly_free)
        # With a clearance, the energy measures how much pairs lack of it.
        self._measure.setText("Lacks clearance" if result.clearance > 0.0 else "Overlap")
        if ran and exactly_free:
            # Even if the search was cut short, a free pose is a success.
            search = "The search found a pose without collisions"
        elif ran:
            search = "The search finished" if result.converged else "The search stopped early"
        elif say(ALL_LOCKED) in (result.note or ""):
            search = "No search: all body parts are locked"
        elif result.step != Step.UNCHANGED:
            search = "No search: the time limit came first"
        else:
            search = "No search was needed"
        self.converged.say(search, bool(exactly_free or result.converged) if ran else None)
        estimate = _ESTIMATED[predicted_free]
        if None not in (exactly_free, predicted_free) and exactly_free != predicted_free:
            estimate = _OVERRULED[bool(predicted_free)]
        self.predicted_free.say(estimate, predicted_free)
        self.predicted_free.setVisible(self._document.model.has_predictor)
        if result.energy_before is None or result.energy_after is None:
            self._energy.setText("not measured")
        else:
            before, after = overlap_text(result.energy_before), overlap_text(result.energy_after)
            self._energy.setText(
                f"{before}, as before" if before == after else f"{before} → {after}"
            )
        mean, largest = result.vertex_distance_mean, result.vertex_distance_max
        moved = f"{height_text(mean)} of the body size, at most {height_text(largest)}"
        self._moved.setText("not at all" if result.latent_distance == 0.0 else unbroken(moved))
        self._moved.setToolTip("Mean and maximum over the mesh")
        self._took.setText(_times(result.seconds, self._document.history.state.outcome_seconds))
        self._note.setText(with_capital(result.note or ""))
        self._note.setVisible(bool(result.note))

    def _checked(self, result: ResolveResult) -> str:
        """Word what the exact check says of the pose that Resolve found."""
        from lcollision_core.resolve import Step

        if result.exactly_free is None:
            return "Not checked"
        millimetres = millimetres_of(self._document.model)
        least, has_clearance = result.least_distance, result.clearance > 0.0
        if result.exactly_free:
            if not has_clearance or least is None:
                return "No collisions (checked)"
            distance = length_text(least, millimetres)
            return say("No collisions (checked), least distance {distance}", distance=distance)
        verdict = "Still colliding"
        if has_clearance and least is not None and least >= 0.0:
            clearance = length_text(result.clearance, millimetres)
            verdict = say("Nearer than {clearance}", clearance=clearance)
        if result.step != Step.SOFT:
            return verdict
        return say(
            "{verdict}: {pairs}, by up to {depth}",
            verdict=verdict,
            pairs=counted(result.pairs_after or 0, "pair", "pairs"),
            depth=length_text(result.deepest_after or 0.0, millimetres),
        )


def millimetres_of(model: Body) -> float | None:
    """Return the body size in millimetres, None if the body's unit is unknown."""
    metres = model.known_metres
    return None if metres is None else 1000.0 * metres * model.body_size


def _times(searched: float, in_all: float) -> str:
    """Return how long the search took, and the preparation if that took noticeably long."""
    waited = in_all - searched
    took = seconds_text(searched)
    return f"{took}, after {seconds_text(waited)} of preparation" if waited > _WAITED else took


_SIGNS = {"free": "check", "colliding": "warning"}
_SIGN_SIZE = 20
_SOURCE = "on the mesh"
_BEFORE = "previous pose"
_AS_READ = "as it was read"
_HELD = "Stopped by contact"
_NO_DEEPER = "Solid stops it from getting deeper; Resolve removes it"


class ExactCard(PoseCard):
    """The headline of the panel: the verdict of the exact check, with pairs and overlap.

    While a changed pose waits for its check, the previous result stays, greyed and
    marked as such, so that nothing flickers and no line appears or disappears.

    Parameters
    ----------
    document : followed

    Attributes
    ----------
    nearest : button with the least distance of the pose; while pressed, it shows where

    Signals
    -------
    faces_selected : indices of faces to tint in the view, or None
    points_selected : (2, 3) array, two points to bring into view
    """

    faces_selected = Signal(object)
    points_selected = Signal(object)

    def __init__(self, document: PoseDocument) -> None:
        super().__init__(document, "exact")
        self._sign = ThemedIcon(_SIGN_SIZE)
        self.verdict = labelled("", "headline", wraps=True)
        self.details = labelled("", "caption", wraps=True)
        self.source = ElidedLabel(_SOURCE)
        self.nearest = push_button("Least distance", clicked=self._bring_nearest)
        self.nearest.setObjectName("compact")
        self.nearest.setCheckable(True)
        self.nearest.toggled.connect(self._on_shown)
        headline = hbox(self._sign, self.verdict, wide=self.verdict)
        self.add(title_row("Exact check", self.source), headline, self.details, self.nearest)
        document.motion.nearest_changed.connect(self._say_nearest)
        document.timeline.resolving.changed.connect(self._on_resolve)
        self._on_model()

    @property
    def is_of_the_pose_before(self) -> bool:
        """Whether the result shown is that of the previous pose."""
        return self._kind == "waiting" and self._sign.name != "wait"

    def _on_model(self) -> None:
        """Clear the result of the previous model's pose."""
        has_model = self._document.has_model
        self._sign.show_icon("wait", "waiting")
        self.verdict.setText("Checking…" if has_model else "No pose yet")
        self.details.setText("Updates when the pose stops moving")
        if has_model:
            # Pairs that do not count take separate lines.
            lines = 1 if self._document.model.rules.exclude_nothing else 3
            self.details.setMinimumHeight(lines * self.details.fontMetrics().lineSpacing())
        super()._on_model()

    def _show(self, frame: PoseFrame | None, exact: SelfCollisions | None) -> None:  # noqa: ARG002
        """Show the verdict of the pose, or that it is still unknown."""
        self._kind = "waiting"
        if exact is not None:
            self._kind = "colliding" if exact.colliding else "free"
            self._say(exact)
        source = _AS_READ if self._document.motion.shows_another else _SOURCE
        self.source.setText(_BEFORE if self.is_of_the_pose_before else source)
        self._say_nearest()
        show_verdict(self.verdict, self._kind)
        show_verdict(self, self._kind)
        self._sign.show_icon(_SIGNS.get(self._kind, self._sign.name), self._kind)

    @Slot()
    def _say_nearest(self) -> None:
        """Show the least distance, or the deepest overlap, once it is known."""
        motion = self._document.motion
        nearest = motion.nearest if self._document.has_model else None
        if nearest is None:
            self.nearest.setChecked(False)
        self.nearest.setEnabled(nearest is not None)
        if nearest is not None:
            millimetres = millimetres_of(self._document.model)
            what = "Least distance" if nearest.distance >= 0.0 else "Deepest overlap"
            self.nearest.setText(f"{what} {length_text(abs(nearest.distance), millimetres)}")
            self.nearest.setToolTip("Show where body parts come nearest to each other")
        elif motion.is_measured:
            self.nearest.setText(f"Least distance above {self._bound()}")
            self.nearest.setToolTip("No body parts are nearer to each other")
        if nearest is not None and self.nearest.isChecked():
            self._on_shown(True)

    def _bound(self) -> str:
        from lcollision_core.contact import DISTANCE_BOUND

        return length_text(DISTANCE_BOUND, millimetres_of(self._document.model))

    @Slot()
    def _bring_nearest(self) -> None:
        nearest = self._document.motion.nearest
        if self.nearest.isChecked() and nearest is not None:
            self.points_selected.emit(nearest.points)

    @Slot(bool)
    def _on_shown(self, shown: bool) -> None:
        """Tint the two nearest faces and their neighbours: single faces are too small to see."""
        nearest = self._document.motion.nearest
        if not shown or nearest is None:
            self.faces_selected.emit(None)
            return
        faces = self._document.model.faces
        around = np.isin(faces, faces[nearest.faces]).any(axis=1)
        self.faces_selected.emit(np.flatnonzero(around))

    @Slot()
    def _on_resolve(self) -> None:
        """Say why Resolve left the frame shown, which it has not changed."""
        exact = self._document.motion.exact if self._document.has_model else None
        if exact is not None and self._document.timeline.resolving.progress is None:
            self._say(exact)

    def _say(self, verdict: SelfCollisions) -> None:
        document = self._document
        frame, excluded = document.motion.frame, verdict.excluded
        left_out = verdict.counted_only or excluded.total > 0
        is_held = frame is not None and len(frame.contacts) > 0
        headline = "Colliding (checked)" if verdict.colliding else "No collisions (checked)"
        sentences, tips = [], []
        if verdict.colliding:
            pairs = counted(len(verdict.pairs), "pair", "pairs")
            sentences.append(f"{pairs} of triangles, overlap {overlap_text(verdict.energy)}")
            tips.append(
                "Overlap: how deep all crossing triangles penetrate each other, combined, in per "
                "cent of the body size"
            )
        elif is_held:
            sentences.append(_HELD)
        else:
            sentences.append("No other triangles cross" if left_out else "No triangles cross")
        sentences += document.timeline.kept_sentences(document.timeline.frame)
        rules = document.model.rules
        if rules.left_out:
            sentences.append(with_capital(rules.left_out_in_words()))
        if left_out:
            if verdict.counted_only:
                what, sentence = rules.summary(), f"{rules.described()} are not counted"
            else:
                what, sentence = excluded.described(), rules.sentence(excluded)
            sentences.append(f"Pairs not counted: {what}")
            tips.insert(0, f"{headline}; {sentence}: see Edit > Contacts")
        if is_held and verdict.colliding:
            # Explain why the drag goes no further.
            sentences.append(_NO_DEEPER)
        self.verdict.setText(headline)
        self.details.setText(unbroken("\n".join(sentences)))
        for label in (self.verdict, self.details):
            label.setToolTip(plain_tip("\n".join(tips)) if tips else "")


_LISTED = 12
"""Largest number of pairs of names listed."""


class ProposalCard(Card):
    """Offer to ignore places that touch in nearly every pose; hidden if there are none.

    The places are listed, and tinted in the view, until there is an answer, which is remembered
    for the character.

    Parameters
    ----------
    document : its proposed rules are shown, and applied by a click

    Attributes
    ----------
    text, listed : labels with the effect of the rules, and with the places
    ignore, dismiss : buttons

    Signals
    -------
    faces_selected : indices of faces to tint in the view, or None
    """

    faces_selected = Signal(object)

    def __init__(self, document: PoseDocument) -> None:
        super().__init__()
        self._document = document
        self.text, self.listed = (labelled("", "caption", wraps=True) for _ in range(2))
        tip = "Don't count crossings at the tinted places; all others still count"
        self.ignore = push_button("Ignore them", tip, self._apply)
        tip = "Count them, and don't ask again; Edit > Contacts has them too"
        self.dismiss = push_button("Not now", tip, self._decline)
        title = labelled("Places that always touch", "title")
        self.add(title, self.text, self.listed, hbox(self.ignore, self.dismiss, None))
        for changed in (document.tasks.rules_proposed, document.model_changed):
            changed.connect(self._show_proposed)
        document.tasks.busy_changed.connect(
            lambda: self.ignore.setEnabled(not document.tasks.changing_model)
        )
        self._show_proposed()

    @Slot()
    def _show_proposed(self) -> None:
        """List the places and tint them, until there is an answer."""
        from lcollision_core.meshes.contact_rules import pair_in_words

        proposed = self._document.tasks.proposed_rules
        if proposed is None or not self._document.tasks.offers_rules:
            self._end()
            return
        then, places = (
            proposed.n_colliding_then,
            counted(len(proposed.new), "such place", "such places"),
        )
        remaining = say("With {places} ignored, no pose collides.", places=places)
        if then:
            remaining = say_number(
                then,
                "With {places} ignored, {n} of them still collides elsewhere.",
                "With {places} ignored, {n} of them still collide elsewhere.",
                places=places,
            )
        now = say_number(
            proposed.n_colliding,
            "{n} of {poses} collides, and the same parts touch in nearly all of them.",
            "{n} of {poses} collide, and the same parts touch in nearly all of them.",
            poses=counted(proposed.n_poses, "sampled pose", "sampled poses"),
        )
        self.text.setText(f"{now} {remaining}")
        lines = [
            f"{pair_in_words(pair)}: {counted(n, 'place', 'places')}"
            for pair, n in proposed.places.items()
        ]
        more = [say("and {n} more", n=len(lines) - _LISTED)] if len(lines) > _LISTED else []
        self.listed.setText("\n".join([*lines[:_LISTED], *more]))
        self.show()
        self.faces_selected.emit(proposed.faces)

    @Slot()
    def _end(self) -> None:
        self.hide()
        self.faces_selected.emit(None)

    @Slot()
    def _decline(self) -> None:
        self._end()
        self._document.tasks.decline_offer()

    @Slot()
    def _apply(self) -> None:
        proposed = self._document.tasks.proposed_rules
        if proposed is not None:
            self._end()
            self._document.tasks.set_rules(proposed.rules)


_MIN_WIDTH, _BESIDE_TEXT = 250, 45
"""Width that shows every card beside a scroll bar, and margins beside the longest button."""


class CollisionPanel(QWidget):
    """A column of cards; the headline at the top and Resolve at the bottom are always visible.

    Parameters
    ----------
    document : followed and changed
    actions : of commands, by key; triggered by the buttons

    Attributes
    ----------
    exact, proposal, prediction, resolve, outcome : the cards
    """

    docking = Docking(
        "collision",
        "&Collisions",
        "Ctrl+Alt+2",
        "Show or hide the check, the estimate and Resolve",
        Qt.DockWidgetArea.RightDockWidgetArea,
        (0.22, 312, 380),
    )

    def __init__(self, document: PoseDocument, actions: Mapping[str, QAction]) -> None:
        super().__init__()
        self._document = document
        longest = longest_name(self, ["Least distance above 13.58 mm"])
        self.setMinimumWidth(max(_MIN_WIDTH, longest + _BESIDE_TEXT))
        self.exact = ExactCard(document)
        self.proposal = ProposalCard(document)
        self.prediction = PredictionCard(document, actions["learn_character"])
        self.resolve = ResolveCard(document, actions["resolve"], actions["resolve_options"])
        self.outcome = OutcomeCard(document)
        page = QWidget()
        margins = (CLOSE, 0, CLOSE, 0)
        page.setLayout(vbox(self.proposal, self.prediction, self.outcome, None, margins=margins))
        self._area = scrolling(page)
        # In a low window it shrinks in favour of the cards that are always visible.
        self._area.setMinimumHeight(ROW_HEIGHT - TIGHT)
        headline = vbox(self.exact, margins=(CLOSE, TIGHT, CLOSE, 0))
        remedy = vbox(self.resolve, margins=(CLOSE, 0, CLOSE, TIGHT))
        self.setLayout(vbox(headline, self._area, remedy))
        document.history.outcome_changed.connect(self._on_outcome)

    @Slot()
    def _on_outcome(self) -> None:
        if self._document.history.state.outcome is not None:
            # Wait until the card has been laid out.
            QTimer.singleShot(0, self, self._scroll_to_outcome)

    @Slot()
    def _scroll_to_outcome(self) -> None:
        """Scroll to the result of Resolve, or to its beginning if it does not fit."""
        self._area.ensureWidgetVisible(self.outcome, 0, CLOSE)
        self._area.ensureWidgetVisible(self.outcome.exactly_free, 0, CLOSE)
