"""Actions in real Blender, without a window: no user data is lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.app.blender.running import in_blender
from tests.app.blender.test_addon import crossing_the_arm
from tests.core.motion.swings import swinging_body
from tests.rigged_shapes import write_gltf

pytestmark = pytest.mark.slow

SCRIPT = "inside_actions.py"


@pytest.fixture(scope="module")
def body(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_gltf(swinging_body(), tmp_path_factory.mktemp("body") / "body.glb")


def test_outside_of_the_spans_nothing_changes_and_the_old_action_is_kept(
    body: Path, tmp_path: Path
) -> None:
    told = in_blender(tmp_path, "sparse_action", body, tmp_path, script=SCRIPT)
    assert told["verdict"] == "No collisions in 60 frames (checked)"
    assert [at for at in range(60) if crossing_the_arm(told, told["after"][at])] == []
    before, after = np.array(told["before"]), np.array(told["after"])
    inside = np.zeros(60, dtype=bool)
    for start, stop in told["spans"]:
        inside[start:stop] = True
    assert 10 < inside.sum() < 50
    assert (before != after)[inside].any()
    assert np.array_equal(before[~inside], after[~inside])
    # Curves of unturned bones are unchanged; those of turned bones are keyed where needed.
    assert told["others"]
    added = {name: len(times) - 3 for name, times in told["keys"].items() if "rotation" in name}
    assert added
    assert max(added.values()) < 15
    assert set(told["old_keys"].values()) == {3}
    # The user's action stays in the file, although nothing uses it.
    old, new = told["actions"]
    (done, (level, said)) = told["said"]
    assert (done, level) == (["FINISHED"], "INFO")
    assert f"{old} is kept" in said
    assert {old, new} <= set(told["reopened"])


def test_frames_outside_of_spans_keep_every_bit_for_all_kinds_of_keys(tmp_path: Path) -> None:
    told = in_blender(tmp_path, "rekeyed", 40, script=SCRIPT)
    assert len(told) == 40
    assert [one["outside"] for one in told] == [0] * 40
    assert max(one["inside"] for one in told) < 1.001e-2
    assert min(one["added"] for one in told) < 5


def test_what_is_no_verdict_on_the_pose_or_cannot_be_written_is_said_before(
    body: Path, tmp_path: Path
) -> None:
    told = in_blender(tmp_path, "refusals", body, script=SCRIPT)
    assert told.pop("changed") == []
    said = {}
    for name, reports in told.items():
        ((level, said[name]),) = reports
        assert level == "ERROR", name
    for name in ("edit ARMATURE", "edit MESH"):
        assert "is in Edit Mode, which hides the pose" in said[name]
    assert "is shown in its rest position" in said["rest"]
    assert "its Armature modifier is off" in said["modifier"]
    assert "is scaled to 0" in said["scale 0.0"]
    assert "is scaled to 0" in said["scale 1.0"]
    for name, text in said.items():
        if name.startswith("engine"):
            assert "engine.json does not say where LCollision is installed" in text
    assert "shows a blend of its action with NLA strips (Add" in said["blended"]
    assert "is in the NLA's tweak mode" in said["tweaked"]


@pytest.mark.parametrize("constrained", [False, True])
def test_linked_characters_are_refused_and_overrides_are_resolved_for_good(
    body: Path, tmp_path: Path, constrained: bool
) -> None:
    told = in_blender(tmp_path, "library", body, tmp_path, constrained, script=SCRIPT)
    for name in ("pose", "action"):
        (done, (level, said)) = told[name]
        assert (done, level) == (["CANCELLED"], "ERROR")
        assert "is linked from library.blend, and changes to it are lost" in said
    assert not told["stray"]
    (done, (level, said)) = told["overridden"]
    assert (done, level) == (["FINISHED"], "INFO")
    assert "none does now" in said
    name, action, _ = told["shown"]
    assert action.endswith(".free")
    assert name.endswith(".free") == constrained
    assert told["reopened"] == [action, 0]
    # Pairs that do not count may follow.
    level, said = told["checked"]
    assert level == "INFO"
    assert said.startswith("No collisions in 11 frames (checked)")


def test_bones_whose_curves_take_no_keys_stay(body: Path, tmp_path: Path) -> None:
    told = in_blender(tmp_path, "unkeyable", body, script=SCRIPT)
    assert told["why"] == {
        "Spine": "locked curves",
        "Neck": "muted curves",
        "RightArm": "curves with the modifier Noise",
    }
    assert {"Spine", "Neck", "RightArm"} <= set(told["same"])
    assert "LeftArm" not in told["same"]
    assert told["verdict"] == "No collisions in 11 frames (checked)"


def test_an_action_goes_on_from_what_blender_shows_until_that_is_free(
    body: Path, tmp_path: Path
) -> None:
    told = in_blender(tmp_path, "mirrored", body, script=SCRIPT)
    assert told["verdict"] == "No collisions in 11 frames (checked)"
    assert told["said"][0] == ["FINISHED"]
    assert told["steps"] > 1
    # The modifier's side is not keyed, and bones in its plane stay.
    assert "LeftArm" in told["keyed"]
    assert not {"Hips", "Spine", "Neck", "Head", "RightArm"} & set(told["keyed"])


def test_where_nothing_can_turn_nothing_is_written(body: Path, tmp_path: Path) -> None:
    told = in_blender(tmp_path, "nothing_turns", body, script=SCRIPT)
    assert told["changed"] == []
    for name in ("action", "pose"):
        (done, (level, said)) = told[name]
        assert (done, level) == (["FINISHED"], "WARNING")
        why = {"action": "could not be freed", "pose": "no better pose was found"}[name]
        assert f"{why}, nothing was changed" in said


def test_what_is_worse_than_it_was_is_not_written(body: Path, tmp_path: Path) -> None:
    told = in_blender(tmp_path, "worse", body, script=SCRIPT)
    whole, shown = told["all"], told["shown"]
    # All frames were shown to be worse, and then restored.
    assert len(shown[0]) == 14
    assert all(shown[0])
    assert not any(shown[-1])
    (done, (level, said)) = whole["said"]
    assert (done, level) == (["FINISHED"], "WARNING")
    assert "could not be freed, nothing was changed" in said
    assert whole["changed"] == []
    assert whole["before"] == whole["after"]
    # One of two spans is free except for a worse frame, or for an arm that jumps back and forth: it
    # stays bit-identical, and the other one is written.
    for name in ("one", "jump"):
        one = told[name]
        (done, (level, said)) = one["said"]
        assert (done, level) == (["FINISHED"], "WARNING")
        (first, second) = one["spans"]
        before, after = np.array(one["before"]), np.array(one["after"])
        assert np.array_equal(before[first[0] : first[1]], after[first[0] : first[1]]), name
        assert not np.array_equal(before[second[0] : second[1]], after[second[0] : second[1]]), name
        frames = one["frames"]
        assert 8 in frames
        assert max(frames) < 20
        assert f"frames {frames[0]}-{frames[-1]} could not be freed" in said
    (done, (level, said)) = told["pose"]
    assert (done, level) == (["FINISHED"], "WARNING")
    assert "no better pose was found, nothing was changed" in said
    assert told["pose_is_kept"]
