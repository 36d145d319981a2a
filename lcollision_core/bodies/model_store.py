"""Where models are stored: bundled with the program, or in the user's own folder."""

from __future__ import annotations

import os
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

from lcollision_core.bundled import bundled_folder
from lcollision_core.errors import ModelFileError
from lcollision_core.files import has_known_suffix

MODEL_SUFFIX = ".safetensors"

WORK_SUFFIX = ".work"
"""What the folder of an unfinished model adds to its file's name."""


@dataclass(frozen=True)
class ListedModel:
    """A model that can be called by name.

    Attributes
    ----------
    name : what it is called, its file's name without the extension
    path : its file
    bundled : whether it came with the program
    """

    name: str
    path: Path
    bundled: bool


def user_models_folder() -> Path:
    """Return the folder of the user's own models, which may not exist yet."""
    from platformdirs import user_data_path

    return user_data_path("lcollision", appauthor=False) / "models"


def list_models() -> tuple[ListedModel, ...]:
    """List the user's models and the bundled ones that no user's model hides, by name."""
    found: dict[str, ListedModel] = {}
    for folder, bundled in ((bundled_folder("models"), True), (user_models_folder(), False)):
        for path in folder.glob(f"*{MODEL_SUFFIX}"):
            if not path.name.startswith("."):
                found[path.stem] = ListedModel(path.stem, path, bundled)
    return tuple(found[name] for name in sorted(found))


def is_bundled(file: str | os.PathLike[str]) -> bool:
    """Whether a model came with the program, or is in no file, so that it is changed in a copy."""
    path = Path(file)
    return not path.is_file() or path.absolute().parent == bundled_folder("models")


def find_model(name_or_path: str | os.PathLike[str]) -> Path:
    """Return the file of a model.

    Parameters
    ----------
    name_or_path : a file, or, where there is no such file, the name of a bundled or user model

    Raises
    ------
    ModelFileError : it is neither, or its training has not come to its end; the sentence says
        how to go on, or lists the names that there are.
    """
    path = Path(name_or_path)
    if path.is_file():
        return path
    destination = path
    if len(path.parts) == 1:
        listed = list_models()
        for model in listed:
            if model.name == path.name:
                return model.path
        if not has_known_suffix(path):
            destination = user_models_folder() / f"{path}{MODEL_SUFFIX}"
    beside = (checkpoint_path, work_path) if destination.name else ()
    for unfinished in (of(destination) for of in beside):
        if unfinished.exists():
            raise ModelFileError(
                "is not finished",
                f"run its command again, which goes on from {unfinished}",
                where=f"the training of {str(path)!r}",
            )
    if len(path.parts) == 1:
        names = ", ".join(model.name for model in listed) or "none yet"
        close = get_close_matches(path.name, [model.name for model in listed], 1)
        meant = f" (did you mean {close[0]}?)" if close else ""
        raise ModelFileError(
            f"there is no model or file {path.name!r}{meant}", f"the models are: {names}"
        )
    return path


def checkpoint_path(destination: Path) -> Path:
    """Return the file that a training to a destination goes on from."""
    return destination.with_name(destination.name + ".checkpoint")


def work_path(destination: Path) -> Path:
    """Return the folder in which a model is learned from files: see `learning.WorkFolder`."""
    return destination.with_name(destination.name + WORK_SUFFIX)


def model_destination(name_or_path: str | os.PathLike[str]) -> Path:
    """Return the file that a new model goes to.

    Parameters
    ----------
    name_or_path : a file ending in .safetensors; or a name without folder or extension ("v0.9"
        ends in none), which
        goes to the user's own models, whose folder is made

    Raises
    ------
    ModelFileError : another extension, or the user's folder cannot be made.
    """
    path = Path(name_or_path)
    if len(path.parts) == 1 and not has_known_suffix(path):
        folder = user_models_folder()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ModelFileError.because(
                folder, "cannot be made", error, "name a file elsewhere"
            ) from error
        return folder / f"{path}{MODEL_SUFFIX}"
    if path.suffix != MODEL_SUFFIX:
        raise ModelFileError.unwritable(
            path,
            f"a model is a {MODEL_SUFFIX} file",
            "rename it, or give a name alone to store it with your models",
        )
    return path
