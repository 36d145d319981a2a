"""The Edit menu: history, the clipboard, whole poses, sliders, body parts and contact rules."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QMimeData, QPoint, Qt
from PySide6.QtGui import QGuiApplication

from app.editing.live_pose import part_name
from app.view.shading import Shading
from app.window.command import EditorWindow, Menu, at_each_step, called, greyed, unless
from app.window.dialogs.body_parts import BodyPartsDialog
from app.window.dialogs.contact_rules import ContactsDialog
from lcollision_core.errors import LCollisionError
from lcollision_core.json_values import from_json, parse_json
from lcollision_core.tasks.words import menu_text

if TYPE_CHECKING:
    from app.editing.document import PoseDocument


_KIND = "application/x-lcollision-pose+json"


@dataclass(frozen=True)
class CopiedPose:
    """A pose on the clipboard.

    Attributes
    ----------
    fingerprint : of the pose's model
    name : of the model
    what : description of the copied part, for messages
    latent : all D codes of the pose
    codes : indices of the copied codes
    """

    fingerprint: str
    name: str
    what: str
    latent: tuple[float, ...]
    codes: tuple[int, ...]


def copy_pose(document: PoseDocument, vertex: int | None = None) -> None:
    """Put the working pose on the clipboard.

    Parameters
    ----------
    vertex : if given, copy only its limb
    """
    model, latent = document.model, document.history.latent
    copied_codes = _codes_of(document, vertex)
    what = "the pose" if vertex is None else f"the limb of {part_name(model, vertex)}"
    copied = CopiedPose(
        model.fingerprint,
        model.name,
        what,
        tuple(latent.tolist()),
        tuple(np.flatnonzero(copied_codes).tolist()),
    )
    data = QMimeData()
    data.setData(_KIND, json.dumps(asdict(copied)).encode())
    QGuiApplication.clipboard().setMimeData(data)
    document.message.emit(f"Copied {what}")


def paste_pose(document: PoseDocument, vertex: int | None = None) -> None:
    """Paste the copied codes as one undo step; locked body parts stay unchanged.

    Parameters
    ----------
    vertex : if given, paste only into its limb

    Raises
    ------
    LCollisionError : the clipboard holds no pose, or one of another body.
    """
    model, copied = document.model, _on_clipboard()
    if copied.fingerprint != model.fingerprint or len(copied.latent) != model.latent_size:
        raise LCollisionError(
            f"the copied pose is one of “{copied.name}”, not of “{model.name}”",
            "copy a pose of this body",
        )
    pasted_codes = np.zeros(model.latent_size, dtype=np.bool_)
    pasted_codes[list(copied.codes)] = True
    pasted_codes &= _codes_of(document, vertex)
    if not pasted_codes.any():
        raise LCollisionError(
            f"the copied pose ({copied.what}) has no values for this limb", "copy the whole pose"
        )
    what = "pose" if vertex is None and pasted_codes.all() else "limb"
    document.motion.paste(f"Paste {what}", np.array(copied.latent), pasted_codes)


def _codes_of(document: PoseDocument, vertex: int | None) -> npt.NDArray[np.bool_]:
    """Return a (D,) mask of the codes of a vertex's limb, or of all codes for None."""
    model = document.model
    if vertex is None:
        return np.ones(model.latent_size, dtype=np.bool_)
    limbs = model.space.limbs
    return limbs.codes_beside(int(limbs.leads[vertex]))


def _on_clipboard() -> CopiedPose:
    data = bytes(QGuiApplication.clipboard().mimeData().data(_KIND).data())
    try:
        copied = from_json(CopiedPose, parse_json(data), "the copied pose")
        size = len(copied.latent)
        if not (
            np.isfinite(copied.latent).all() and all(0 <= code < size for code in copied.codes)
        ):
            raise ValueError("the clipboard holds invalid values")
    except ValueError as error:
        raise LCollisionError(
            "there is no pose on the clipboard", "copy one first, by Edit > Copy pose"
        ) from error
    return copied


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
@at_each_step
@called(lambda w: _with_step("&Undo", w.document.history.undo_stack.undoText()))
def _undo(window: EditorWindow) -> None:
    window.document.history.undo()


@EDIT.command("redo", "&Redo", "Ctrl+Shift+Z, Ctrl+Y", "Redo the change that was undone", "redo")
@unless(lambda w: w.document.history.undo_stack.canRedo(), "There is nothing to redo")
@at_each_step
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
