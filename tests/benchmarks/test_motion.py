"""The benchmark of motions, on a small character."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.app.support import Lcollision
from tests.core.motion.swings import CLIP, N_FRAMES, OTHER, swinging_body
from tests.rigged_shapes import write_gltf

pytestmark = pytest.mark.slow


def test_the_command_compares_both_methods(lcollision: Lcollision, tmp_path: Path) -> None:
    path = write_gltf(swinging_body(), tmp_path / "swing.glb")
    result = lcollision("benchmark", "motion", "--model", path, "--json")
    assert result.exit_code == 0, result.output
    rows = json.loads(result.stdout)
    assert [(row["motion"], row["method"]) for row in rows] == [
        (clip, method) for clip in (CLIP, OTHER) for method in ("spans", "frame by frame")
    ]
    spans, single = rows[:2]
    assert spans["free_before"] < spans["free_after"] == spans["frames"] == N_FRAMES
    assert spans["half_steps"] == 0
    assert spans["confirmed"] == "10 of 10"
    assert spans["acceleration_ratio"] < 1.1 < single["acceleration_ratio"]
    assert rows[2]["mean_change"] == 0.0
