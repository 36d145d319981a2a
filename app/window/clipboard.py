"""Copy whole poses or limbs to the clipboard, and paste them into any frame or window."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QMimeData
from PySide6.QtGui import QGuiApplication

from app.editing.live_pose import part_name
from lcollision_core.errors import LCollisionError
from lcollision_core.json_values import from_json, parse_json

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
