"""What is known of the pose: the exact check, which follows when the hand rests."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PySide6.QtWidgets import QHBoxLayout, QLabel

from app.icons import pixmap
from app.panels.parts import Card, ElidedLabel, labelled, show_verdict, title_row
from app.theme import CLOSE, current_theme
from app.wording import counted, overlap_text

if TYPE_CHECKING:
    from app.document import PoseDocument

_ICONS = {"free": "check", "colliding": "warning", "waiting": "wait"}


class ExactCard(Card):
    """The exact verdict: pairs and energy, or that the pose is free.

    Parameters
    ----------
    document : followed
    """

    def __init__(self, document: PoseDocument) -> None:
        super().__init__("", "truth")
        self._document = document
        self._kind = "waiting"
        self._sign = QLabel()
        self._sign.setFixedSize(22, 22)
        self.verdict = labelled("", "verdict")
        self.verdict.setWordWrap(True)
        self.details = labelled("", "caption")
        self.details.setWordWrap(True)
        line = QHBoxLayout()
        line.setSpacing(CLOSE)
        line.addWidget(self._sign)
        line.addWidget(self.verdict, 1)
        self.column.addLayout(title_row("Exact check", ElidedLabel("computed on the mesh")))
        self.column.addLayout(line)
        self.column.addWidget(self.details)
        document.exact_changed.connect(self._on_exact)
        document.model_changed.connect(self._on_exact)
        self._on_exact()

    def refresh_icons(self) -> None:
        """Draw the sign in the theme that has come."""
        ink = getattr(current_theme(), self._kind)
        self._sign.setPixmap(pixmap(_ICONS[self._kind], ink, 22, self.devicePixelRatioF()))

    def _on_exact(self) -> None:
        verdict = self._document.exact if self._document.has_model else None
        if verdict is None:
            self._kind = "waiting"
            self.verdict.setText("Checking…" if self._document.has_model else "No pose yet")
            self.details.setText("Follows a moment after the pose rests")
        else:
            self._kind = "colliding" if verdict.colliding else "free"
            folds = ""
            if verdict.n_near_pairs:
                folds = f"; {counted(verdict.n_near_pairs, 'skin fold')} not counted"
            if verdict.colliding:
                self.verdict.setText(f"{counted(len(verdict.pairs), 'pair')} of triangles collide")
                self.details.setText(f"Overlap {overlap_text(verdict.energy)} of the height{folds}")
            else:
                self.verdict.setText("Exactly collision-free")
                self.details.setText(f"No triangle crosses another{folds}")
            self.details.setToolTip(
                "How deep all crossing triangles lie in each other, taken together"
                if verdict.colliding
                else ""
            )
        show_verdict(self.verdict, self._kind)
        show_verdict(self, self._kind)
        self.refresh_icons()
