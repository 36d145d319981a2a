"""The examples in docstrings run and print what they say."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import lcollision_core


def test_examples_in_docstrings() -> None:
    attempted = 0
    for module in pkgutil.walk_packages(lcollision_core.__path__, "lcollision_core."):
        result = doctest.testmod(importlib.import_module(module.name))
        assert result.failed == 0, module.name
        attempted += result.attempted
    assert attempted > 0
