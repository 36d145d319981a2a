"""Public names of packages, loaded on first use."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any


def public_names(package: str) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package whose names are those of its module `public`.

    Importing one of the package's modules then loads only what that module needs.
    """

    def load(name: str) -> Any:
        if name.startswith("_") or find_spec(f"{package}.{name}"):
            raise AttributeError(name)  # A module is imported by itself.
        return getattr(import_module(f"{package}.public"), name)

    return load
