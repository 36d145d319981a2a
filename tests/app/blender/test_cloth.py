"""Motions prepared for cloth in real Blender, judged by ipctk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.app.blender.running import in_blender
from tests.core.motion.swings import CLIP, swinging_body
from tests.foreign_cloth import by_ipctk
from tests.rigged_shapes import write_gltf

pytestmark = pytest.mark.slow

SCRIPT = "inside_cloth.py"


@pytest.fixture(scope="module")
def body(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_gltf(swinging_body(), tmp_path_factory.mktemp("body") / "body.glb")


@pytest.mark.parametrize("output", ["ACTION", "CACHE"])
def test_a_motion_is_fit_for_cloth_by_a_foreign_check(
    body: Path, tmp_path: Path, output: str
) -> None:
    told = in_blender(tmp_path, "prepare", body, CLIP, output, 0.003, 1, tmp_path, script=SCRIPT)
    ((done,), (level, said)) = told["said"]
    assert (done, level) == ("FINISHED", "INFO")
    assert told["verdict"].startswith("Fit for cloth: 48 frames, 1 pose between two")
    assert "none does now" in said
    assert told["frames"] == []
    assert told["text"].startswith("Fit for cloth")
    assert told["action"].endswith(".free")
    is_cache = output == "CACHE"
    assert (told["modifiers"][0][-1] == "MESH_CACHE") == is_cache
    assert [name.endswith(".pc2") for name in told["files"]] == [True] * is_cache
    with np.load(tmp_path / "frames.npz") as file:
        faces = file["faces"].astype(np.int32)
        before, after = (file[name].astype(np.float64) for name in ("before", "after"))
    assert len(after) == 95
    owner = np.array([name.startswith("LeftArm") for name in told["groups"]])
    of_arm = owner[faces].all(axis=1)
    # Only the arm and the trunk: linked tubes all cross at their joints.
    trunk = np.array([name in ("Hips", "Spine") for name in told["groups"]])[faces].all(axis=1)
    chosen = faces[of_arm | trunk]
    assert by_ipctk(before, chosen)[0]
    assert by_ipctk(after, chosen) == ([], [])


def test_what_cannot_be_done_is_said_and_nothing_is_changed(body: Path, tmp_path: Path) -> None:
    told = in_blender(tmp_path, "refused", body, CLIP, tmp_path, script=SCRIPT)
    assert told["unsaved"] == [
        ["CANCELLED"],
        ["ERROR", "Save the file first, or choose a folder for the mesh caches"],
    ]
    assert told["unwritable"][0] == ["CANCELLED"]
    assert "choose another folder" in told["unwritable"][1][1]
    ((done,), (level, said)) = told["locked"]
    assert (done, level) == ("FINISHED", "WARNING")
    assert said.endswith("see the text Cloth Report")
    assert len(told["frames"]) > 5
    assert {why for _, why in told["frames"]} == {"no joint moves them apart"}
    number = told["frames"][0][0]
    assert f"\nFrame {number}, here: " in told["text"]
    assert told["action"] == CLIP
    assert all("MESH_CACHE" not in kinds for kinds in told["modifiers"])
