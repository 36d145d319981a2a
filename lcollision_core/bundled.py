"""The files that ship with the program, wherever it is installed, and the user's folders."""

from __future__ import annotations

import tomllib
from importlib import resources
from pathlib import Path
from typing import TypeVar

import msgspec

T = TypeVar("T")


def bundled_file(*parts: str) -> Path:
    """Return the path of a file in ``resources/``.

    Parameters
    ----------
    parts : folders and file name below ``resources/``, such as "poses", "body.npz"
    """
    path = Path(str(resources.files("resources").joinpath(*parts)))
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing from the installation; reinstall lcollision")
    return path


def bundled_folder(name: str) -> Path:
    """Return the path of a folder in ``resources/``, such as "models"; it may not exist."""
    return Path(str(resources.files("resources").joinpath(name)))


def user_folder(name: str) -> Path:
    """Return a folder of the user's data, such as "models", which may not exist yet."""
    from platformdirs import user_data_path

    return user_data_path("lcollision", appauthor=False) / name


def bundled_table(name: str, kind: type[T]) -> T:
    """Read a TOML file in ``resources/`` into a typed object.

    Parameters
    ----------
    name : file name, such as "joints.toml"
    kind : type to convert its contents to
    """
    return msgspec.convert(tomllib.loads(bundled_file(name).read_text(encoding="utf-8")), kind)
