"""The single table of file extensions."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import lcollision_core
from lcollision_core.files.formats import FILES, Holds, function_of, suffixes_of

CORE = Path(lcollision_core.__file__).parent


@pytest.mark.parametrize("suffix", FILES)
def test_readers_and_writers_of_the_table_are_there(suffix: str) -> None:
    kind = FILES[suffix]
    # Print formats need no reader.
    assert kind.holds is Holds.PRINT or callable(function_of(kind.reader))
    assert not kind.writer or callable(function_of(kind.writer))


def test_the_table_lists_what_can_be_opened_in_one_order() -> None:
    assert suffixes_of(Holds.MESH, written=True) == (".obj", ".ply", ".off", ".stl", ".glb")
    assert suffixes_of(Holds.SCENE) == (".glb", ".gltf", ".vrm", ".fbx")
    assert suffixes_of(Holds.POINTS | Holds.SKELETON) == (".pc2", ".mdd", ".bvh", ".vrma")


def test_no_other_file_lists_extensions() -> None:
    texts = {
        path: path.read_text()
        for folder in (CORE, CORE.parent / "app")
        for path in folder.rglob("*.py")
    }
    lists = [
        f"{path.relative_to(CORE.parent)}:{node.lineno}"
        for path, text in texts.items()
        # Parsing all files takes seconds.
        if sum(f'"{suffix}"' in text for suffix in FILES) > 2
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Tuple | ast.List | ast.Set) and _suffixes(node) > 2
    ]
    assert lists == []


def _suffixes(node: ast.Tuple | ast.List | ast.Set) -> int:
    return sum(isinstance(item, ast.Constant) and item.value in FILES for item in node.elts)


def test_the_table_loads_no_reader() -> None:
    code = "import lcollision_core.files.formats, sys; print(*sys.modules)"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert not {"numpy", "scipy", "trimesh"} & set(printed.stdout.split())
