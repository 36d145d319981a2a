"""The window's texts, in plain, standard words."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from PySide6.QtWidgets import QAbstractButton, QDialog, QLabel
from pytestqt.qtbot import QtBot

from app.view.shading import Shading
from app.window.dialogs.contact_rules import ContactsDialog
from app.window.dialogs.forms import MotionDialog, resolve_form
from app.window.main_window import MainWindow
from lcollision_core.bodies import sample_poses
from lcollision_core.errors import LCollisionError
from lcollision_core.files.motion.bvh import read_bvh
from tests.app.window.test_main_window import words_on_the_screen
from tests.app.windows import PATIENCE, rest

pytestmark = pytest.mark.one_window

OUR_OWN = re.compile(
    r"\b(mend\w*|upon|films?|filming|learnt|believes?|in truth|proved|truly|exactly free"
    r"|domains?|commoner|by chance|nobody|as the system|keep this pose"
    r"|looking for|so manieth|to the eye|moves it free|freed)\b",
    re.IGNORECASE,
)


def test_the_window_uses_standard_words(qtbot: QtBot, window: MainWindow) -> None:
    document = window.document
    form = resolve_form(window.settings, window)
    qtbot.addWidget(form)
    document.motion.blend_towards(sample_poses(document.model, 1, 0, colliding=True)[0], 1.0)
    rest(qtbot, window)
    said: set[str] = set()
    for shading in Shading:
        window.viewport.set_shading(shading)
        rest(qtbot, window)
        said |= set(words_on_the_screen(window))
    with qtbot.waitSignal(document.tasks.solve_finished, timeout=PATIENCE):
        window.actions_by_key["resolve"].trigger()
    rest(qtbot, window)
    for key in ("shortcuts", "about", "parts"):
        window.actions_by_key[key].trigger()
    said |= set(words_on_the_screen(window))
    assert [text for text in sorted(said) if OUR_OWN.search(text)] == []
    plain = {text.replace("&", "") for text in said}
    assert {
        "Match system",
        "Camera view",
        "Mirror pose",
        "Add to library…",
        "No collisions (checked)",
        "Resolve options…",
    } <= plain
    assert form.windowTitle() == "Resolve options"
    for dialog in window.findChildren(QDialog):
        dialog.close()


def words_of(dialog: QDialog) -> set[str]:
    return {
        held.text().replace("&", "")
        for kind in (QLabel, QAbstractButton)
        for held in dialog.findChildren(kind)
    }


def test_labels_are_sentences_that_people_say(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    model = window.document.model
    steps = [action.text() for action in window.commands.submenus["Onion skin &step"].actions()]
    assert steps[:2] == ["&Every frame", "Every &2 frames"]
    motion = MotionDialog(window.settings, window, model, rate=24.0)
    qtbot.addWidget(motion)
    said = words_of(motion)
    assert {"The clip's own rate is 24 frames per second.", "Format"} <= said
    window.actions_by_key["contacts"].trigger()
    (contacts,) = window.findChildren(ContactsDialog)
    assert {"or count only deeper than", "Set"} <= words_of(contacts)
    contacts.close()
    path = tmp_path / "no.bvh"
    path.write_text("MOTION")
    with pytest.raises(LCollisionError, match="it has no HIERARCHY and MOTION sections"):
        read_bvh(path)


def test_what_is_not_supported_is_said_so(window: MainWindow, tmp_path: Path) -> None:
    path = tmp_path / "dancer.dae"
    path.write_bytes(b"<COLLADA>")
    with pytest.raises(LCollisionError, match=r"DAE isn't supported.* a motion \(\.bvh, \.vrma\)"):
        window.files.open_path(path)
    with pytest.raises(LCollisionError, match=r"Couldn't open .*: there is no such file"):
        window.files.open_path(path.with_suffix(".json"))
