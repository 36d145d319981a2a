"""Rigify's human in real Blender: resolved poses are set by the rig's own controls."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.app.blender.running import in_blender
from tests.independent_check import crossing_pairs

pytestmark = pytest.mark.slow

FREE = "No collisions (checked)"


SCRIPT = "inside_rigify.py"


@pytest.fixture(scope="module")
def human(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return in_blender(tmp_path_factory.mktemp("rigify"), "pose", script=SCRIPT)


def crossing_the_arm(told: Any, points: Any) -> int:
    """Count, independently, the crossing faces of the left forearm with trunk and legs."""
    names = [name.removeprefix("DEF-") for name in told["groups"]]
    arm = np.array([name.startswith(("forearm.L", "hand.L")) for name in names])
    other = np.array([name.startswith(("spine", "thigh")) for name in names])
    faces = np.array(told["faces"])
    is_arm, is_other = arm[faces].all(axis=1), other[faces].all(axis=1)
    pairs = crossing_pairs(np.array(points, float), faces)
    return sum(bool((is_arm[a] and is_other[b]) or (is_arm[b] and is_other[a])) for a, b in pairs)


def test_a_pose_is_resolved_by_the_controls_of_rigifys_human(human: Any) -> None:
    told = human["pose"]
    said = "Writes to the controls if they can resolve it, else to a baked copy"
    assert f"label: {said}" in human["panel"]
    assert human["checked"]["verdict"].startswith("Colliding: ")
    assert crossing_the_arm(human, told["before"]["points"]) > 50
    # The rig itself, with all its constraints and drivers, is free now.
    assert told["verdict"] == told["again"] == FREE
    assert crossing_the_arm(human, told["after"]["points"]) == 0
    assert told["active"]
    for name in ("constraints", "drivers"):
        assert told["after"][name] == told["before"][name] > 0
    (done, (level, text)) = told["said"]
    assert (done, level) == (["FINISHED"], "INFO")
    assert "written to the controls" in text
    limbs = [name.replace("_parent", "") for name in told["after"]["by_fk"]]
    assert ("posed by FK now: " + ", ".join(limbs) in text) if limbs else "FK" not in text
    # Only controls are turned.
    assert told["changed"]
    assert not any(name.startswith(("DEF-", "ORG-", "MCH-")) for name in told["changed"])


def test_locks_of_controls_count_for_the_bones_that_they_turn(human: Any) -> None:
    assert human["locked"] == ["DEF-upper_arm.L", "DEF-forearm.L", "DEF-hand.L"]


def test_an_action_is_resolved_by_the_controls_of_rigifys_human(tmp_path: Path) -> None:
    told = in_blender(tmp_path, "action", script=SCRIPT)
    (done, (level, text)) = told["said"]
    assert (done, level) == (["FINISHED"], "INFO")
    assert "written to the controls" in text
    assert told["verdict"].startswith("No collisions in ")
    before, after = np.array(told["before"]), np.array(told["after"])
    inside = np.zeros(len(before), dtype=bool)
    for start, stop in told["spans"]:
        inside[start:stop] = True
    crossing = [[crossing_the_arm(told, one) > 0 for one in frames] for frames in (before, after)]
    assert any(crossing[0])
    assert not any(crossing[1])
    assert not inside.all()
    assert np.array_equal(before[~inside], after[~inside])
    assert told["old_is_untouched"]
    assert not told["is_copied"]
    first, last = told["constraints"]
    assert first == last > 0
    assert not any("DEF-" in path for path in told["keyed"])
