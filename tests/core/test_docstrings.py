"""The examples in docstrings run and print the stated output."""

from __future__ import annotations

import doctest
import importlib
import inspect
import pkgutil

import lcollision_core


def test_examples_in_docstrings() -> None:
    attempted = 0
    for module in pkgutil.walk_packages(lcollision_core.__path__, "lcollision_core."):
        imported = importlib.import_module(module.name)
        # For each object, doctest searches all modules that any test has imported.
        if ">>>" not in inspect.getsource(imported):
            continue
        result = doctest.testmod(imported)
        assert result.failed == 0, module.name
        attempted += result.attempted
    assert attempted > 0
