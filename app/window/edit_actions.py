"""The actions of the menus Edit and Pose, and when each is enabled."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, Qt, Slot
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QWidget

from app.window.actions import ACTIONS, NO_BODY, allow_action
from app.window.dialogs.body_parts import BodyPartsDialog
from app.window.dialogs.forms import resolve_form
from app.wording import menu_text

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.editing.settings import Settings
    from app.view.pictures import Pictures
    from app.window.panels.randomise import RandomiseCard
    from app.window.panels.sliders import SlidersPanel


class EditActions(QObject):
    """Changes the pose and the body parts of its model.

    Parameters
    ----------
    window : that dialogs belong to
    document : changed
    settings : how Resolve works
    sliders, randomise : where the user finds a slider, and chooses a random pose
    pictures : cancelled with the document's work
    actions : by key; their texts and whether they can be chosen follow the document

    Attributes
    ----------
    acts : callables by the actions' keys; each may raise `LCollisionError`
    """

    def __init__(
        self,
        window: QWidget,
        document: PoseDocument,
        settings: Settings,
        sliders: SlidersPanel,
        randomise: RandomiseCard,
        pictures: Pictures,
        actions: Mapping[str, QAction],
    ) -> None:
        super().__init__(window)
        self._window, self._document, self._settings = window, document, settings
        self._pictures, self._actions = pictures, actions
        self.acts: dict[str, Callable[[], object]] = {
            "undo": document.history.undo,
            "redo": document.history.redo,
            "reset": document.motion.reset_all,
            "randomise": randomise.draw,
            "mirror": document.tasks.mirror,
            "filter": sliders.find_slider,
            "unlock": self._unlock,
            "parts": self.edit_parts,
            "resolve": self._resolve,
            "cancel": self._cancel,
            "resolve_options": self._choose_resolve_options,
        }
        for changed in (
            document.model_changed,
            document.motion.locks_changed,
            document.tasks.solve_started,
            document.tasks.solve_finished,
            document.tasks.busy_changed,
            pictures.busy_changed,
            document.history.undo_stack.indexChanged,
        ):
            changed.connect(self._update_actions)
        self._update_actions()

    def edit_parts(self, domain: int | None = None, what: str = "") -> None:
        """Show the dialog of the body parts.

        Parameters
        ----------
        domain : the one to begin with, None for the first
        what : "name" or "colour" of it to change at once, "" for neither
        """
        from lcollision_core.model import is_bundled

        document = self._document
        dialog = BodyPartsDialog(
            document.model, is_bundled(document.history.model_file), self._window
        )
        dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        dialog.edited.connect(document.tasks.edit_parts)
        # Another model has other parts.
        document.model_changed.connect(dialog.reject)
        dialog.open()
        if domain is not None:
            dialog.choose(domain)
        if what == "name":
            dialog.edit_name()
        elif what == "colour":
            dialog.choose_colour()

    def _choose_resolve_options(self) -> None:
        form = resolve_form(self._settings, self._window, self._document.model.has_predictor)
        form.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        form.open()

    def _unlock(self) -> None:
        for domain in self._document.motion.locked_domains:
            self._document.motion.set_locked(domain, False)

    def _resolve(self) -> None:
        from lcollision_core.resolve import ResolveOptions

        settings = self._settings
        self._document.tasks.resolve(
            ResolveOptions(
                metric=settings["resolve_metric"],
                threshold=settings["resolve_threshold"],
                time_budget=settings["resolve_time_budget"],
            )
        )

    def _cancel(self) -> None:
        self._document.tasks.cancel_all()
        self._pictures.cancel()

    @Slot()
    def _update_actions(self) -> None:
        document, stack = self._document, self._document.history.undo_stack
        model = document.model if document.has_model else None
        can_resolve = model is not None and model.can_resolve
        unable = "" if can_resolve else "This model has no predictor to resolve with"
        waits = "Wait for Resolve to finish" if document.tasks.solving else ""
        if document.tasks.incoming:
            waits = f"{document.tasks.incoming}, which will replace this pose"
        is_busy = document.tasks.busy or self._pictures.busy
        why_not = {
            "undo": "" if stack.canUndo() else "There is nothing to undo",
            "redo": "" if stack.canRedo() else "There is nothing to redo",
            "mirror": model.why_not_mirrored if model else "",
            "unlock": "" if document.motion.locked_domains else "No body part is locked",
            "parts": "Wait for the model to be changed" if document.tasks.changing_model else "",
            "resolve": unable or waits,
            "resolve_options": unable,
            "cancel": "" if is_busy else "Nothing is being computed",
        }
        for key in self.acts:
            reason = why_not.get(key, "") if document.has_model else NO_BODY
            allow_action(self._actions[key], ACTIONS[key].tip, reason)
        for dialog in self._window.findChildren(BodyPartsDialog):
            dialog.save.setEnabled(not document.tasks.changing_model)
        for key, step in (("undo", stack.undoText()), ("redo", stack.redoText())):
            text = f"{ACTIONS[key].text} {menu_text(step[:1].lower() + step[1:])}"
            self._actions[key].setText(text.rstrip())
