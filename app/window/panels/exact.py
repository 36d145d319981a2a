"""The exact check of the pose, live, or where it takes long as soon as the pose rests."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from PySide6.QtCore import Signal, Slot
from PySide6.QtWidgets import QPushButton

from app.window.panels.resolve import millimetres_of
from app.window.widgets import (
    Card,
    ElidedLabel,
    Sign,
    hbox,
    labelled,
    plain_tip,
    show_verdict,
    title_row,
)
from app.wording import counted, length_text, overlap_text, with_capital

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from lcollision_core.contact import SelfCollisions

_SIGNS = {"free": "check", "colliding": "warning"}
_SIGN_SIZE = 20
_SOURCE = "on the mesh"
_BEFORE = "previous pose"
_AS_READ = "as it was read"
_HELD = "Stopped by contact"
_NO_DEEPER = "Solid stops it from getting deeper; Resolve removes it"


class ExactCard(Card):
    """The headline of the right panel: the exact result, with pairs and depth.

    While a changed pose waits for its check, the previous result stays, greyed and
    marked as such: nothing flickers, and no line comes or goes.

    Parameters
    ----------
    document : followed

    Attributes
    ----------
    nearest : says how near the pose comes to itself; pressed, it shows where

    Signals
    -------
    faces_named : faces by number that are to be seen in the view, or None
    places_named : (2, 3) array, two places that are to be looked at
    """

    faces_named = Signal(object)
    places_named = Signal(object)

    def __init__(self, document: PoseDocument) -> None:
        super().__init__("exact")
        self._document = document
        self._sign = Sign(_SIGN_SIZE)
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
        """Whether the result shown is of a pose that has changed since."""
        return self._kind == "waiting" and self._sign.name != "wait"

    def _on_model(self) -> None:
        """Clear the result of another model's pose."""
        has_model = self._document.has_model
        self._sign.show_icon("wait", "waiting")
        self.verdict.setText("Checking…" if has_model else "No pose yet")
        self.details.setText("Updates when the pose stops moving")
        if has_model:
            # What does not count is reported on a separate line.
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
        shown = motion.frame, motion.exact
        if any(new is not old for new, old in zip(shown, self._shown, strict=True)):
            self._show()

    def _show(self) -> None:
        """Show the verdict of the pose, or that it is not known yet."""
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
        """Say how near the pose comes to itself, once it rests."""
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
            self.places_named.emit(nearest.points)

    @Slot(bool)
    def _on_shown(self, shown: bool) -> None:
        """Tint the two faces and those around them; they are small."""
        nearest = self._document.motion.nearest
        if not shown or nearest is None:
            self.faces_named.emit(None)
            return
        faces = self._document.model.faces
        around = np.isin(faces, faces[nearest.faces]).any(axis=1)
        self.faces_named.emit(np.flatnonzero(around))

    def _say(self, verdict: SelfCollisions) -> None:
        document = self._document
        frame, excluded = document.motion.frame, verdict.excluded
        left_out = verdict.counted_only or excluded.total > 0
        is_held = frame is not None and len(frame.contacts) > 0
        headline = "Colliding (checked)" if verdict.colliding else "No collisions (checked)"
        said, tips = [], []
        if verdict.colliding:
            pairs = counted(len(verdict.pairs), "pair")
            said.append(f"{pairs} of triangles, overlap {overlap_text(verdict.energy)}")
            tips.append(
                "Overlap: how deep all crossing triangles penetrate each other, combined, in per "
                "cent of the body size"
            )
        elif is_held:
            said.append(_HELD)
        else:
            said.append(f"No {'other ' if left_out else ''}triangles cross")
        rules = document.model.rules
        if rules.left_out:
            said.append(with_capital(rules.left_out_in_words()))
        if left_out:
            if verdict.counted_only:
                what, sentence = rules.in_short(), f"{rules.described()} are not counted"
            else:
                what, sentence = excluded.described(), rules.sentence(excluded)
            said.append(f"Pairs not counted: {what}")
            tips.insert(0, f"{headline}; {sentence}: see Edit > Contacts")
        if is_held and verdict.colliding:
            # Why a drag goes no further.
            said.append(_NO_DEEPER)
        self.verdict.setText(headline)
        self.details.setText("\n".join(said))
        for label in (self.verdict, self.details):
            label.setToolTip(plain_tip("\n".join(tips)) if tips else "")
