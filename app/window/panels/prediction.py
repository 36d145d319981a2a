"""The instant estimate, of the whole pose and of each body part."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from PySide6.QtCore import QEvent, QPoint, QPointF, QRectF, QSize, Qt, Signal, Slot
from PySide6.QtGui import QAction, QColor, QPainter, QPaintEvent, QPolygonF
from PySide6.QtWidgets import QProgressBar, QSizePolicy, QToolButton, QWidget

from app.view.shading import FULL_PREDICTED
from app.view.theme import CLOSE, ROW_HEIGHT, TIGHT, current_theme, give_icon
from app.window.widgets import (
    NAME_SHARE,
    SWATCH,
    Card,
    ElidedLabel,
    HoverRow,
    NameLabel,
    bar_style,
    hbox,
    labelled,
    longest_name,
    plain_tip,
    show_verdict,
    signals_blocked,
    title_row,
    vbox,
)
from lcollision_core.tasks.words import heading, overlap_text

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.work.frames import PoseFrame
    from lcollision_core.contact import SelfCollisions

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
        self.setAccessibleName("Probability of a collision")

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
        self.lock = QToolButton()
        self.lock.setCheckable(True)
        self.lock.setFixedSize(24, 22)
        self.lock.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.lock.setAccessibleName(f"Lock {self._name}")
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


class PredictionCard(Card):
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
        super().__init__()
        self._document = document
        self.rows: list[DomainRow] = []
        self._shown: tuple[PoseFrame | None, SelfCollisions | None] | None = None
        self.learn = QToolButton()
        self.learn.setObjectName("action")
        self.learn.setText("Learn it…")
        self.learn.setToolTip(learn_action.toolTip())
        self.learn.clicked.connect(learn_action.trigger)
        self._by_rig = QWidget()
        why = labelled(_BY_RIG, "caption", wraps=True)
        self._by_rig.setLayout(hbox(why, self.learn, wide=why))
        self._by_rig.hide()
        self.verdict = ElidedLabel("")
        self.percent = labelled("", "aside")
        self.meter = ProbabilityMeter()
        for widget in (self.percent, self.meter):
            widget.setToolTip(_TIP)
        self._missing = labelled(_MISSING, "caption", wraps=True)
        self.title = labelled("Estimate", "title")
        head = title_row(self.title, self.verdict)
        self.verdict.setObjectName("aside")
        head.addWidget(self.percent)
        self._rows = vbox(spacing=0, margins=(0, TIGHT, 0, 0))
        self.column.addLayout(vbox(head, self.meter, self._missing, self._by_rig, self._rows))
        document.model_changed.connect(self._on_model)
        document.motion.frame_changed.connect(self._on_frame)
        document.motion.exact_changed.connect(self._on_exact)
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
        predicts = self._document.model.has_predictor
        for widget in (self.meter, self.verdict, self.percent):
            widget.setVisible(predicts)
        self.title.setText("Estimate" if predicts else "Body parts")
        self._missing.setVisible(not (predicts or self._document.model.can_resolve))
        self._by_rig.setVisible(model.character is not None)
        self._shown = None
        self._on_frame()
        self._on_locks()

    @Slot()
    def _on_exact(self) -> None:
        if not self._document.motion.expects_verdict:
            self._on_frame()

    @Slot()
    def _on_frame(self) -> None:
        frame, exact = self._document.motion.frame, self._document.motion.exact
        if self._shown is not None and self._shown[0] is frame and self._shown[1] is exact:
            return
        self._shown = frame, exact
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
