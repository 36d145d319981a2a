"""The panel of collisions: the exact check, the estimate, Resolve and proposed contact rules."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from PySide6.QtCore import QSignalBlocker, Qt, QTimer, Signal, Slot
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

from app.view.theme import CLOSE, NORMAL, ROW_HEIGHT, TIGHT, give_icon
from app.window.panels.dock import Docking
from app.window.panels.prediction import PredictionCard
from app.window.widgets import (
    Card,
    ElidedLabel,
    NumberBox,
    ThemedIcon,
    hbox,
    labelled,
    plain_tip,
    scrolling,
    show_verdict,
    title_row,
    vbox,
)
from lcollision_core.tasks.words import (
    counted,
    heading,
    height_text,
    length_text,
    overlap_text,
    seconds_text,
    with_capital,
)

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from lcollision_core.bodies import Body
    from lcollision_core.contact import SelfCollisions
    from lcollision_core.resolve import ResolveResult


_WAITED = 0.5
"""Shortest wait before the search that is reported, in seconds."""

_LARGEST_CLEARANCE = 0.1

_ICONS_OF_ANSWERS = {
    True: ("check", "free"),
    False: ("error", "colliding"),
    None: ("info", "muted"),
}
"""Icon and colour for yes, no and unknown."""

_CHECKED = {True: "No collisions (checked)", False: "Still colliding", None: "Not checked"}
_ESTIMATED = {
    True: "Estimate: probably clear",
    False: "Estimate: probably colliding",
    None: "No estimate: this body has no predictor",
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
        self._text.setText(sentence)


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
        # Stack both rows, so that the layout does not jump.
        self.stack = QStackedWidget()
        self.stack.addWidget(self.resting)
        self.stack.addWidget(self.working)
        locked = "All body parts are locked: unlock one to resolve"
        self._locked = labelled(locked, "caption", wraps=True)
        self.stack.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)
        self.clearance = NumberBox(2, 0.0, 100.0 * _LARGEST_CLEARANCE, strip_zeros=True)
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
        self.column.addLayout(vbox(*facts, numbers, self._note, spacing=TIGHT))
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
        # With a clearance, the energy measures how much pairs lack of it.
        self._measure.setText("Lacks clearance" if clearance > 0.0 else "Overlap")
        if ran and exactly_free:
            # Even if the search was cut short, a free pose is a success.
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


class ExactCard(Card):
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
        super().__init__("exact")
        self._document = document
        self._sign = ThemedIcon(_SIGN_SIZE)
        self.verdict = labelled("", "headline", wraps=True)
        self.details = labelled("", "caption", wraps=True)
        self.source = ElidedLabel(_SOURCE)
        self.column.addLayout(title_row("Exact check", self.source))
        self.column.addLayout(hbox(self._sign, self.verdict, wide=self.verdict))
        self.column.addWidget(self.details)
        self.nearest = QPushButton("Least distance")
        self.nearest.setObjectName("compact")
        self.nearest.setCheckable(True)
        self.column.addWidget(self.nearest)
        self.nearest.toggled.connect(self._on_shown)
        self.nearest.clicked.connect(self._on_clicked)
        document.motion.exact_changed.connect(self._on_exact)
        document.motion.frame_changed.connect(self._on_frame)
        document.motion.nearest_changed.connect(self._say_nearest)
        document.model_changed.connect(self._on_model)
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
        self._show()

    @Slot()
    def _on_exact(self) -> None:
        if not self._document.motion.expects_verdict:
            self._on_frame()

    @Slot()
    def _on_frame(self) -> None:
        motion = self._document.motion
        frame_shown = motion.frame, motion.exact
        if any(new is not old for new, old in zip(frame_shown, self._shown, strict=True)):
            self._show()

    def _show(self) -> None:
        """Show the verdict of the pose, or that it is still unknown."""
        motion = self._document.motion
        self._shown = motion.frame, motion.exact
        verdict = motion.exact if self._document.has_model else None
        self._kind = "waiting"
        if verdict is not None:
            self._kind = "colliding" if verdict.colliding else "free"
            self._say(verdict)
        source = _AS_READ if motion.shows_another else _SOURCE
        self.source.setText(_BEFORE if self.is_of_the_pose_before else source)
        self._say_nearest()
        show_verdict(self.verdict, self._kind)
        show_verdict(self, self._kind)
        self._sign.show_icon(_SIGNS[self._kind] if verdict else self._sign.name, self._kind)

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

    @Slot(bool)
    def _on_clicked(self, shown: bool) -> None:
        nearest = self._document.motion.nearest
        if shown and nearest is not None:
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

    def _say(self, verdict: SelfCollisions) -> None:
        document = self._document
        frame, excluded = document.motion.frame, verdict.excluded
        left_out = verdict.counted_only or excluded.total > 0
        is_held = frame is not None and len(frame.contacts) > 0
        headline = "Colliding (checked)" if verdict.colliding else "No collisions (checked)"
        sentences, tips = [], []
        if verdict.colliding:
            pairs = counted(len(verdict.pairs), "pair")
            sentences.append(f"{pairs} of triangles, overlap {overlap_text(verdict.energy)}")
            tips.append(
                "Overlap: how deep all crossing triangles penetrate each other, combined, in per "
                "cent of the body size"
            )
        elif is_held:
            sentences.append(_HELD)
        else:
            sentences.append(f"No {'other ' if left_out else ''}triangles cross")
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
        # Keep the unit on the line of its number.
        self.details.setText("\n".join(sentences).replace(" %", "\N{NO-BREAK SPACE}%"))
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
        self.ignore, self.dismiss = QPushButton("Ignore them"), QPushButton("Not now")
        self.ignore.clicked.connect(self._apply)
        self.ignore.setToolTip("Don't count crossings at the tinted places; all others still count")
        self.dismiss.clicked.connect(self._decline)
        self.dismiss.setToolTip("Count them, and don't ask again; Edit > Contacts has them too")
        self.column.addWidget(labelled("Places that always touch", "title"))
        self.column.addWidget(self.text)
        self.column.addWidget(self.listed)
        self.column.addLayout(hbox(self.ignore, self.dismiss, None))
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
        then = proposed.n_colliding_then
        remaining = "no pose collides"
        if then:
            verb = "collides" if then == 1 else "collide"
            remaining = f"{counted(then, 'pose')} still {verb} elsewhere"
        self.text.setText(
            f"{proposed.n_colliding} of {counted(proposed.n_poses, 'pose')} collide, and the "
            f"same parts touch in nearly all of them. With "
            f"{counted(len(proposed.new), 'such place')} ignored, {remaining}."
        )
        lines = [
            f"{pair_in_words(pair)}: {counted(n, 'place')}" for pair, n in proposed.places.items()
        ]
        more = [f"and {len(lines) - _LISTED} more"] if len(lines) > _LISTED else []
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


_MIN_WIDTH = 250
"""Width that shows every card beside a scroll bar."""


class CollisionPanel(QWidget):
    """A column of cards; the headline at the top and Resolve at the bottom are always visible.

    Signals
    -------
    domain_hovered : int or None, the domain of the row under the pointer
    faces_selected : indices of faces to tint in the view, or None
    points_selected : (2, 3) array, two points to bring into view

    Parameters
    ----------
    document : followed and changed
    actions : of commands, by key; triggered by the buttons
    """

    domain_hovered = Signal(object)
    faces_selected = Signal(object)
    points_selected = Signal(object)

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
        self.setMinimumWidth(_MIN_WIDTH)
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
        remedy = vbox(self.resolve, margins=(CLOSE, 0, CLOSE, CLOSE))
        self.setLayout(vbox(headline, self._area, remedy))
        self.exact.points_selected.connect(self.points_selected)
        for card in (self.exact, self.proposal):
            card.faces_selected.connect(self.faces_selected)
        self.prediction.domain_hovered.connect(self.domain_hovered)
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
