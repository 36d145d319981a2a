"""House rules that no tool checks."""

from __future__ import annotations

import ast
import warnings
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

_SENTENCES = {
    "say": slice(1),
    "say_number": slice(1, 3),
    "counted": slice(1, 3),
    "marked": slice(1),
}
_MARKED = {"ALL_LOCKED", "FEET_MOVED", "self.reason"}


def _warn(kind: type[Warning], module: str) -> None:
    warnings.warn_explicit("it changes", kind, f"{module}.py", 1, module)


@pytest.mark.parametrize("kind", [DeprecationWarning, FutureWarning, UserWarning])
def test_warnings_of_our_code_are_errors_and_those_of_others_are_not(kind: type[Warning]) -> None:
    for module in ("app.window.main_window", "lcollision_core.meshes", "tests.conftest", __name__):
        with pytest.raises(kind):
            _warn(kind, module)
    with warnings.catch_warnings(record=True) as caught:
        _warn(kind, "numpy._core")
        _warn(kind, "application")
    assert [warning.category for warning in caught] == [kind, kind]


def test_numbers_that_go_wrong_are_errors_wherever_they_do() -> None:
    with pytest.raises(RuntimeWarning):
        _warn(RuntimeWarning, "scipy.linalg")


def test_no_source_file_is_over_1000_lines() -> None:
    lengths = {
        str(path.relative_to(ROOT)): len(path.read_text().splitlines())
        for folder in ("app", "lcollision_core")
        for path in (ROOT / folder).rglob("*.py")
    }
    assert len(lengths) > 10
    assert {name: length for name, length in lengths.items() if length > 1000} == {}


def test_the_app_asks_a_body_what_it_can_do_and_never_its_class() -> None:
    kinds = {"Body", "RigBody", "LearnedBody", "MeshBody", "PoseModel"}
    asked = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in (ROOT / "app").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call)
        and getattr(node.func, "id", "") in ("isinstance", "issubclass", "type")
        and kinds & {name.id for name in ast.walk(node) if isinstance(name, ast.Name)}
    ]
    assert asked == []


def test_a_catalogue_can_hold_every_sentence_that_is_said() -> None:
    """`xgettext` sees literals only: those of `say` itself, or of constants that are marked."""
    said = [
        (f"{path.relative_to(ROOT)}:{node.lineno}", sentence)
        for room in ("app", "lcollision_core")
        for path in (ROOT / room).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in _SENTENCES
        for sentence in node.args[_SENTENCES[getattr(node.func, "id", "")]]
    ]
    assert len(said) > 100
    assert [
        place
        for place, sentence in said
        if not isinstance(sentence, ast.Constant) and ast.unparse(sentence) not in _MARKED
    ] == []
