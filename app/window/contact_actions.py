"""The dialog of the contact rules, beside the body on which what they leave out is tinted."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, QPoint, Qt
from PySide6.QtWidgets import QWidget

from app.view.shading import Shading
from app.window.dialogs.contact_rules import ContactsDialog

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.view.viewport import Viewport


class ContactActions(QObject):
    """Shows which pairs count.

    Parameters
    ----------
    window : that the dialog belongs to
    document : whose rules are shown and changed
    viewport : tinted while the dialog is open

    Attributes
    ----------
    acts : callables by the actions' keys
    """

    def __init__(self, window: QWidget, document: PoseDocument, viewport: Viewport) -> None:
        super().__init__(window)
        self._window, self._document, self._viewport = window, document, viewport
        self.acts: dict[str, Callable[[], object]] = {"contacts": self._show}

    def _show(self) -> None:
        for held in self._window.findChildren(ContactsDialog):
            if held.isVisible():
                held.activateWindow()
                return
        dialog = ContactsDialog(self._document, self._window)
        dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        before = self._viewport.shading
        self._viewport.set_shading(Shading.EXACT)
        dialog.faces_named.connect(self._viewport.point_out)
        dialog.finished.connect(lambda _: self._end(before))
        dialog.show()
        # Over the sliders: beside it stay the body and what the check says of it.
        view, corner = (held.mapToGlobal(QPoint()) for held in (self._viewport, self._window))
        dialog.move(max(corner.x(), view.x() - dialog.width()), view.y())

    def _end(self, before: Shading) -> None:
        """Colour the body as before, unless the user has chosen another shading meanwhile."""
        self._viewport.point_out(None)
        if self._viewport.shading is Shading.EXACT:
            self._viewport.set_shading(before)
