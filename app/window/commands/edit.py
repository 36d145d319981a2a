"""The Edit menu: history, whole poses, sliders, body parts and contact rules."""

from __future__ import annotations

from PySide6.QtCore import QPoint, Qt

from app.view.shading import Shading
from app.window.clipboard import copy_pose, paste_pose
from app.window.command import EditorWindow, Menu, called, greyed, unless
from app.window.dialogs.body_parts import BodyPartsDialog
from app.window.dialogs.contact_rules import ContactsDialog
from lcollision_core.tasks.words import menu_text

EDIT = Menu("&Edit")


def edit_parts(window: EditorWindow, domain: int | None = None, what: str = "") -> None:
    """Show the dialog of the body parts.

    Parameters
    ----------
    window : parent of the dialog
    domain : selected at first, None for the first in the list
    what : "name" or "colour" to edit it at once, "" for neither
    """
    from lcollision_core.bodies import is_bundled

    document = window.document
    dialog = BodyPartsDialog(document.model, is_bundled(document.history.model_file), window)
    dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
    dialog.edited.connect(document.tasks.edit_parts)
    # Another model has other body parts.
    document.model_changed.connect(dialog.reject)
    dialog.open()
    if domain is not None:
        dialog.choose(domain)
    if what == "name":
        dialog.edit_name()
    elif what == "colour":
        dialog.choose_colour()


def _with_step(text: str, step: str) -> str:
    return f"{text} {menu_text(step[:1].lower() + step[1:])}".rstrip()


@EDIT.command("undo", "&Undo", "Ctrl+Z", "Undo the last change", "undo")
@unless(lambda w: w.document.history.undo_stack.canUndo(), "There is nothing to undo")
@called(lambda w: _with_step("&Undo", w.document.history.undo_stack.undoText()))
def _undo(window: EditorWindow) -> None:
    window.document.history.undo()


@EDIT.command("redo", "&Redo", "Ctrl+Shift+Z, Ctrl+Y", "Redo the change that was undone", "redo")
@unless(lambda w: w.document.history.undo_stack.canRedo(), "There is nothing to redo")
@called(lambda w: _with_step("&Redo", w.document.history.undo_stack.redoText()))
def _redo(window: EditorWindow) -> None:
    window.document.history.redo()


EDIT.line()


@EDIT.command("copy", "&Copy pose", "Ctrl+C", "Copy the pose, to paste it elsewhere")
def _copy(window: EditorWindow) -> None:
    copy_pose(window.document)


@EDIT.command("paste", "Pas&te", "Ctrl+V", "Paste the copied pose or limb; locked body parts stay")
def _paste(window: EditorWindow) -> None:
    paste_pose(window.document)


EDIT.line()


@EDIT.command(
    "reset",
    "Reset &all",
    "Ctrl+Backspace",
    "Set all sliders to zero and remove the pins; locked body parts stay as they are",
    "reset",
)
def _reset(window: EditorWindow) -> None:
    window.document.motion.reset_all()


@EDIT.command("randomise", "Ra&ndomise", "Ctrl+D", "Move towards a random pose", "random")
def _randomise(window: EditorWindow) -> None:
    window.randomise.draw()


@EDIT.command(
    "mirror", "&Mirror pose", "Ctrl+M", "Swap left and right, including locked body parts", "mirror"
)
@greyed(lambda window: window.document.model.why_not_mirrored)
def _mirror(window: EditorWindow) -> None:
    window.document.tasks.mirror()


EDIT.line()


@EDIT.command("filter", "&Find a slider", "Ctrl+F", "Type part of a slider's name", "search")
def _filter(window: EditorWindow) -> None:
    window.sliders.find_slider()


@EDIT.command("unlock", "Un&lock all", "Ctrl+L", "Unlock all body parts")
@unless(lambda w: w.document.motion.locked_domains, "No body part is locked")
def _unlock(window: EditorWindow) -> None:
    for domain in window.document.motion.locked_domains:
        window.document.motion.set_locked(domain, False)


@EDIT.command("parts", "Body &parts…", "Ctrl+Alt+B", "Rename, recolour and reorder the body parts")
@unless(lambda w: not w.document.tasks.changing_model, "Wait for the model to be changed")
def _parts(window: EditorWindow) -> None:
    edit_parts(window)


@EDIT.command(
    "contacts",
    "C&ontacts…",
    "Ctrl+Alt+C",
    "Choose which crossing triangles don't count as collisions",
)
def _show_contacts(window: EditorWindow) -> None:
    """Show the contact rules beside the body, with excluded pairs tinted."""
    viewport = window.viewport
    for open_dialog in window.findChildren(ContactsDialog):
        if open_dialog.isVisible():
            open_dialog.activateWindow()
            return
    dialog = ContactsDialog(window.document, window)
    dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
    before = viewport.shading
    viewport.set_shading(Shading.EXACT)

    def end() -> None:
        viewport.tint_faces(None)
        # Restore the shading unless the user has changed it meanwhile.
        if viewport.shading is Shading.EXACT:
            viewport.set_shading(before)

    dialog.faces_selected.connect(viewport.tint_faces)
    dialog.finished.connect(end)
    dialog.show()
    # Place the dialog over the sliders, so that the body and the verdict stay visible.
    view, corner = (widget.mapToGlobal(QPoint()) for widget in (viewport, window))
    dialog.move(max(corner.x(), view.x() - dialog.width()), view.y())
