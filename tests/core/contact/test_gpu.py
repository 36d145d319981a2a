"""Checks and predictions on a GPU that Numba simulates; nothing else needs CUDA."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from lcollision_core.devices import Device, choose_device
from lcollision_core.errors import MissingExtraError


def _run(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *words],
        env=os.environ | environment,
        cwd=Path(__file__).parents[3],
        capture_output=True,
        text=True,
    )


@pytest.mark.slow
@pytest.mark.parametrize("room", ["contact", "predictor"])
def test_a_gpu_finds_what_the_processor_finds(room: str) -> None:
    tests = Path(__file__).parents[1] / room / "simulated_gpu.py"
    done = _run("-m", "pytest", "-q", "-n", "0", str(tests), NUMBA_ENABLE_CUDASIM="1")
    assert done.returncode == 0, done.stdout
    assert "passed" in done.stdout
    assert "skipped" not in done.stdout
    assert "deselected" not in done.stdout


def test_checking_many_poses_imports_nothing_of_cuda() -> None:
    script = """
import sys
import numpy as np
from lcollision_core.contact import CollisionDetector
from lcollision_core.devices import Device, choose_device
from tests.core.shapes import torus
mesh = torus(1.0, 0.4)
choose_device(Device.AUTO)
CollisionDetector(mesh.topology, mesh.vertices).are_colliding(np.stack(20 * [mesh.vertices]))
print([name for name in sys.modules if "cuda" in name and name.startswith("numba")])
"""
    done = _run("-c", script)
    assert done.stdout == "[]\n", done.stderr


def test_cuda_is_refused_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lcollision_core.devices._has_extra", lambda: False)
    with pytest.raises(MissingExtraError, match=r"lcollision\[gpu\]"):
        choose_device(Device.CUDA)


def test_a_missing_extra_is_one_sentence_of_the_command_line() -> None:
    done = _run("-m", "app", "sample", "body", "-n", "1", "-o", "never.json", "--device", "cuda")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert "numba-cuda" in done.stderr or "CUDA device" in done.stderr
