"""The match between joints of a motion and of the body is shown, changed and remembered."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PySide6.QtWidgets import QScrollArea
from pytestqt.qtbot import QtBot

from app.window.dialogs.joints import JointsDialog
from app.window.main_window import MainWindow
from lcollision_core.bodies.partners import JointMatch
from tests.app.windows import PATIENCE, drop, rest
from tests.core.bodies.test_clips import changed, strip


def shown_dialogs(window: MainWindow) -> list[JointsDialog]:
    return [one for one in window.findChildren(JointsDialog) if one.isVisible()]


def renamed(source: Path, path: Path, names: dict[str, str]) -> Path:
    """Write only the clips of a character, with other joint names."""

    def change(held: dict) -> None:  # type: ignore[type-arg]
        strip(held)
        for node in held["nodes"]:
            node["name"] = names.get(node.get("name", ""), f"a {node.get('name', '')}")

    return changed(source, path, change)


def test_long_names_leave_room_for_all_columns(window: MainWindow) -> None:
    joints = tuple(f"mixamorig:{'a very long name of joint ' * 3}{k}" for k in range(3))
    match = JointMatch(
        joints,
        joints,
        ("neck", "left elbow", ""),
        dict(zip(joints, joints, strict=True)),
        frozenset(),
    )
    dialog = JointsDialog(match, "A dance, retimed for the second act, final v12 " * 3, "b", window)
    dialog.show()
    (area,) = dialog.findChildren(QScrollArea)
    assert area.widget().minimumSizeHint().width() <= area.viewport().width()
    dialog.close()


def asked_about(qtbot: QtBot, window: MainWindow, swing: Path, folder: Path) -> JointsDialog:
    """Drop the swing with two joints renamed, and return the page that asks about them."""
    path = renamed(swing, folder / "unsure.glb", {"LeftArm": "bone 7", "LeftForeArm": "bone 8"})
    with qtbot.waitSignal(window.document.timeline.joints_unsure, timeout=PATIENCE):
        drop(window, path)
    (dialog,) = shown_dialogs(window)
    return dialog


@pytest.mark.slow
def test_what_is_unsure_is_asked_once_and_remembered(
    qtbot: QtBot,
    window: MainWindow,
    swing: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    document, timeline = window.document, window.document.timeline
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        drop(window, swing)
    told = renamed(swing, tmp_path / "told.glb", {})
    with qtbot.waitSignal(timeline.arrived, timeout=PATIENCE):
        drop(window, told)
    assert timeline.joints is not None
    assert not timeline.joints.unsure
    assert not shown_dialogs(window)
    dialog = asked_about(qtbot, window, swing, tmp_path)
    assert timeline.joints.unsure == {"LeftArm", "LeftForeArm"}
    assert dialog.choices["LeftArm"].currentData() == "bone 7"
    assert list(dialog.choices)[:2] == ["LeftArm", "LeftForeArm"]
    rest(qtbot, window)
    before = timeline.motion
    assert before is not None
    dialog.choices["LeftForeArm"].setCurrentIndex(0)
    with qtbot.waitSignal(timeline.arrived, timeout=PATIENCE):
        dialog.use.click()
    assert not shown_dialogs(window)
    assert timeline.joints.followed["LeftForeArm"] is None
    assert not timeline.joints.unsure
    assert timeline.motion is not None
    assert not np.array_equal(timeline.motion.codes, before.codes)
    assert len(list((tmp_path / "data" / "lcollision" / "joints").glob("*.json"))) == 1
    window.actions_by_key["motion_joints"].trigger()
    (again,) = shown_dialogs(window)
    assert again.choices["LeftForeArm"].currentData() is None
    again.reject()


@pytest.mark.slow
def test_too_few_chosen_joints_are_asked_for_again(
    qtbot: QtBot,
    window: MainWindow,
    swing: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    document, timeline = window.document, window.document.timeline
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        drop(window, swing)
    dialog = asked_about(qtbot, window, swing, tmp_path)
    before, limbs = timeline.motion, ("LeftArm", "RightArm", "LeftLeg")
    for joint in limbs:
        dialog.choices[joint].setCurrentIndex(0)
    with qtbot.waitSignal(timeline.joints_unsure, timeout=PATIENCE):
        dialog.use.click()
    assert timeline.motion is before
    # Not a failure, from which nothing leads back to the choice.
    (again,) = shown_dialogs(window)
    assert timeline.joints is not None
    assert timeline.joints.unsure == set(limbs)
    assert {*list(again.choices)[:3]} == set(limbs)
    with qtbot.waitSignal(timeline.arrived, timeout=PATIENCE):
        again.choices["RightArm"].setCurrentText("a RightArm")
        again.use.click()
    assert not shown_dialogs(window)
    rest(qtbot, window)
