"""FBX files that Blender writes, against its own vertices."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.files.character_reading import read_character
from tests.app.blender.running import in_blender
from tests.core.motion.swings import swinging_body
from tests.rigged_shapes import write_gltf

pytestmark = pytest.mark.slow

RATES = {
    "film": (24, 1.001, 1, 31),
    "ntsc": (30, 1.001, 0, 31),
    "double": (60, 1.001, 100, 300),
    "fourfold": (120, 1.001, 1, 31),
    "rounded": (2398, 100.0, 1, 31),
    "pal": (25, 1.0, 1, 26),
    "odd": (55, 2.0, 1, 20),
}
"""Frame rate and its divisor, the first frame, and the number of frames."""


def test_frames_and_vertices_are_those_of_blender_at_any_rate(tmp_path: Path) -> None:
    body = write_gltf(swinging_body(), tmp_path / "body.glb")
    told = in_blender(
        tmp_path, "exported", body, tmp_path, json.dumps(RATES), script="inside_fbx.py"
    )
    for name, (fps, base, _, count) in RATES.items():
        character = read_character(tmp_path / f"{name}.fbx")
        (clip,) = character.clips
        frames = character.sample(clip, character.rate(clip))
        assert len(frames.times) == count
        assert np.allclose(np.diff(frames.times), base / fps, rtol=1e-6)
        # In Blender, z is up and y points backwards.
        x, y, z = np.moveaxis(frames.vertices[:, character.joined] * character.metres, -1, 0)
        vertices, expected = np.stack([x, -z, y], axis=-1), np.array(told[name])
        assert np.ptp(expected, axis=0).max() > 0.1
        assert np.abs(vertices - expected).max() < 1e-5 * np.ptp(expected[0], axis=0).max()
