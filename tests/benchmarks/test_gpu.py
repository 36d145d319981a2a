"""The GPU benchmark compares the results of both devices, here in Numba's simulator."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.core.shapes import torus

pytestmark = pytest.mark.slow


def test_a_row_for_each_comparison(tmp_path: Path) -> None:
    path, mesh = tmp_path / "poses.npz", torus(1.0, 0.4, 5, 4)
    noise = np.random.default_rng(0).normal(scale=0.2, size=(3, *mesh.vertices.shape))
    np.savez(path, vertices=mesh.vertices + noise, faces=mesh.faces)
    done = subprocess.run(
        [sys.executable, "-m", "app", "benchmark", "gpu", "--data", path, "-n", "5", "--json"],
        env=os.environ | {"NUMBA_ENABLE_CUDASIM": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)
    assert [row["what"] for row in rows] == ["all pairs", "any pair", "all pairs, on the GPU"]
    assert all(row["equal"] and row["difference"] < 1e-12 for row in rows)
    assert all(row["items"] == 5 for row in rows)
