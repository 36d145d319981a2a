"""Writing models into files that others may have changed meanwhile."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from lcollision_core.bodies.pose_model import PoseModel
from lcollision_core.errors import ModelFileError
from lcollision_core.files import FileStamp, file_stamp, locked, unused_name
from lcollision_core.meshes import ContactRules
from lcollision_core.meshes.face_groups import ignored_faces_digest


def change_model(
    path: str | os.PathLike[str], change: Callable[[PoseModel], PoseModel]
) -> PoseModel:
    """Read a model, change it and write it back; no other command's change is lost.

    Parameters
    ----------
    path : its file
    change : gets the model that the file holds now, and returns the one to write

    Raises
    ------
    ModelFileError : as for `PoseModel.load` and `PoseModel.save`, and whatever `change` raises.
    MeshFileError : another command holds it, see `locked`.
    """
    with locked(path):
        model = change(PoseModel.load(path))
        model.save(path)
    return model


def save_trained(
    destination: Path,
    before: FileStamp | None,
    model: PoseModel,
    add: Callable[[PoseModel], PoseModel] | None = None,
) -> Path:
    """Write what was trained, and keep what others have written there since it began.

    Parameters
    ----------
    destination : the file to write
    before : its stamp when the training began
    model : what to write
    add : what the training adds to a model. Where the file has changed since, and what it holds
        now is of the same body and latent space, this is added to that, and its names stay.

    Returns
    -------
    path : where the model went: beside `destination`, where that has changed to something else

    Raises
    ------
    ModelFileError : the file cannot be written.
    MeshFileError : another command holds it, see `locked`.
    """
    with locked(destination):
        path, base = destination, model
        stamp = file_stamp(destination)
        if stamp not in (None, before):
            now = _of_same_space(destination, model) if add is not None else None
            path, base = (destination, now) if now is not None else (unused_name(path), model)
        (base if add is None else add(base)).save(path)
    return path


def _of_same_space(path: Path, model: PoseModel) -> PoseModel | None:
    """Return the model that a file holds now, if what was trained for `model` fits it."""
    try:
        now = PoseModel.load(path)
    except ModelFileError:
        return None

    def space(of: PoseModel) -> tuple[str, ContactRules, str, float]:
        return of.fingerprint, of.rules, ignored_faces_digest(of.rules, of.groups), of.body_size

    return now if space(now) == space(model) else None
