"""Blender without a window, in a separate Python with its own packages.

Its wheel needs NumPy below 2 and one version of Python: `python3.11 -m venv bpyenv`,
`bpyenv/bin/pip install bpy==5.0.1`; run this folder's tests with LCOLLISION_BPY=bpyenv/bin/python.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from app.blender_addon import addon_zip
from tests.core.serve.engines import ROOT

HOW = "needs Blender's bpy: set LCOLLISION_BPY to a Python that has it (pip install bpy==5.0.1)"


def python_with_bpy() -> str:
    """Return a Python that has `bpy`, or skip the test."""
    python = os.environ.get("LCOLLISION_BPY")
    if python is None and importlib.util.find_spec("bpy") is None:
        pytest.skip(HOW)
    return python or sys.executable


def in_blender(folder: Path, task: str, *arguments: object, script: str = "inside.py") -> Any:
    """Install the add-on in a separate Blender and run a function of a script there.

    Parameters
    ----------
    folder : for the user's files of that Blender

    Returns
    -------
    told : the function's result, as JSON
    """
    python = python_with_bpy()
    archive, answer = folder / "lcollision.zip", folder / "answer.json"
    archive.write_bytes(addon_zip())
    environment = os.environ | {
        "BLENDER_USER_RESOURCES": str(folder / "user"),
        # For the engine that the add-on starts, if it is checked out but not installed.
        "PYTHONPATH": str(ROOT),
    }
    path = Path(__file__).with_name(script)
    process = subprocess.run(
        [python, path, archive, answer, task, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
        timeout=500.0,
    )
    assert process.returncode == 0, process.stdout + process.stderr
    assert "Traceback" not in process.stderr + process.stdout, process.stdout + process.stderr
    return json.loads(answer.read_text())
