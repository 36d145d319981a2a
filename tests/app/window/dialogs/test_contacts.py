"""The contact rules dialog: pairs excluded in the rest pose, shown and changed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot

from app.view.shading import Shading
from app.window.dialogs.body_parts import BodyPartsDialog
from app.window.dialogs.contact_rules import ContactsDialog
from app.window.main_window import MainWindow
from lcollision_core.bodies import LearnedBody, RigBody, open_body, typical_poses
from lcollision_core.contact import propose_by_kind
from lcollision_core.meshes import ContactRules
from lcollision_core.meshes.face_groups import FaceGroup, without_joints
from lcollision_core.tasks.changing import PartEdits
from tests.app.windows import PATIENCE, rest, take_picture
from tests.core.gltf_builder import arm
from tests.rigged_shapes import head_in_torso, rigged_body, sunk_arm

pytestmark = pytest.mark.one_window

LEFT = Qt.MouseButton.LeftButton


def dialog_of(qtbot: QtBot, window: MainWindow) -> ContactsDialog:
    window.actions_by_key["contacts"].trigger()
    qtbot.waitUntil(lambda: not window.document.tasks.busy, timeout=PATIENCE)
    (dialog,) = window.findChildren(ContactsDialog)
    return dialog


@pytest.fixture
def body(qtbot: QtBot, window: MainWindow) -> RigBody:
    """Open a body whose forearms cross at rest, which counts at first."""
    body = rigged_body()
    assert body.rig is not None
    moved = np.where(body.rest_vertices[:, :1] > 0.5, [-1.2, 0.0, -0.01], 0.0)
    rig = replace(body.rig, points=body.rig.points + moved[:, None])
    touching = replace(body, rest_vertices=body.rest_vertices + moved, rig=rig)
    model = RigBody.of(touching).with_rules(ContactRules())
    window.document.set_model(model)
    rest(qtbot, window)
    qtbot.waitUntil(lambda: not window.document.tasks.busy, timeout=PATIENCE)
    return model


def test_rules_are_applied_counted_and_tinted(
    qtbot: QtBot, window: MainWindow, body: RigBody
) -> None:
    document, viewport = window.document, window.viewport
    viewport.set_shading(Shading.DOMAINS)
    remembered = window.settings["shading"]
    dialog = dialog_of(qtbot, window)
    assert viewport.shading is Shading.EXACT
    # This is the dialog's shading, not the user's choice.
    assert window.settings["shading"] == remembered != "exact"
    pairs = len(body.detector.detect(body.reference).pairs)
    assert pairs > 0
    assert dialog.total.text().startswith(f"At rest 0 pairs not counted, {pairs} pairs counted.")
    assert not dialog.apply.isEnabled()
    document.motion.set_code(10, 0.2)
    latent = document.history.latent
    dialog.at_rest.setChecked(True)
    dialog.rest.setValue(5.0)
    QTest.mouseClick(dialog.apply, LEFT)
    qtbot.waitUntil(lambda: not document.tasks.busy, timeout=PATIENCE)
    rest(qtbot, window)
    assert document.model.rules == ContactRules(rest_exclusion=0.05)
    assert isinstance(document.model, RigBody)
    np.testing.assert_array_equal(document.history.latent, latent)
    assert document.history.undo_stack.canUndo()
    assert dialog.counts["rest"].text() == f"{pairs} pairs at rest"
    assert dialog.total.text() == f"At rest {pairs} pairs not counted, 0 pairs counted."
    exact, scene = document.motion.exact, viewport.scene
    assert exact is not None
    assert scene is not None
    assert exact.excluded.rest > 0
    assert scene.uncounted.n_faces == len(np.unique(exact.excluded_pairs)) > 0
    tip = window.collision.exact.verdict.toolTip()
    assert f"{exact.excluded.rest} pairs that touch at rest are not counted" in tip
    assert "not counted" in window.collision.exact.details.text()
    take_picture(window, "contacts")
    dialog.close()
    assert viewport.shading is Shading.DOMAINS


def test_pairs_of_groups_are_ignored_and_counted_again(
    qtbot: QtBot, window: MainWindow, body: RigBody
) -> None:
    document, dialog = window.document, dialog_of(qtbot, window)
    names = [dialog.first.itemText(row) for row in range(dialog.first.count())]
    assert names == list(dict.fromkeys(group.name for group in without_joints(body.groups)))
    dialog.second.setCurrentIndex(1)
    for _ in range(2):
        QTest.mouseClick(dialog.add, LEFT)
    assert dialog.rules().ignored == ((names[0], names[1]),)
    QTest.mouseClick(dialog.apply, LEFT)
    qtbot.waitUntil(lambda: not document.tasks.busy, timeout=PATIENCE)
    assert document.model.rules.ignored == ((names[0], names[1]),)
    (kind,) = dialog._kinds.values()
    assert kind.isExpanded()
    kind.child(0).setCheckState(0, Qt.CheckState.Unchecked)
    QTest.mouseClick(dialog.apply, LEFT)
    qtbot.waitUntil(lambda: not document.tasks.busy, timeout=PATIENCE)
    assert document.model.rules == ContactRules()
    dialog.close()


def test_a_pair_of_groups_is_tolerated_up_to_a_depth(
    qtbot: QtBot, window: MainWindow, body: RigBody
) -> None:
    document, dialog = window.document, dialog_of(qtbot, window)
    assert body.detector.detect(body.reference).colliding
    for box, name in ((dialog.first, "LeftArm"), (dialog.second, "RightArm")):
        box.setCurrentIndex(box.findText(name))
    for percent in (5.0, 10.0):
        dialog.own_depth.setValue(percent)
        QTest.mouseClick(dialog.tolerate, LEFT)
    pair = ("LeftArm", "RightArm", 0.1)
    assert dialog.rules().tolerated_pairs == (pair,)
    QTest.mouseClick(dialog.apply, LEFT)
    qtbot.waitUntil(lambda: not document.tasks.busy, timeout=PATIENCE)
    rest(qtbot, window)
    assert document.model.rules == ContactRules(tolerated_pairs=(pair,))
    assert document.motion.exact is not None
    assert document.motion.exact.excluded.tolerated > 0
    tip = window.collision.exact.verdict.toolTip()
    assert "not deeper than 0.1 between LeftArm and RightArm" in tip
    (item,) = dialog._tolerated.values()
    assert item.text(0) == "LeftArm and RightArm: up to 10 %"
    take_picture(dialog, "contacts_tolerated")
    item.setCheckState(0, Qt.CheckState.Unchecked)
    assert dialog.rules() == ContactRules()
    dialog.close()


def test_joints_count_by_a_tick_and_the_groups_that_are_chosen_are_tinted(
    qtbot: QtBot, window: MainWindow, body: RigBody
) -> None:
    document, dialog = window.document, dialog_of(qtbot, window)
    assert body.has_joints
    assert not dialog.at_joints.isChecked()
    assert not dialog.always.isEnabled()
    dialog.at_joints.setChecked(True)
    QTest.mouseClick(dialog.apply, LEFT)
    qtbot.waitUntil(lambda: not document.tasks.busy, timeout=PATIENCE)
    assert document.model.rules == ContactRules(joint_exclusion=True)
    assert dialog.counts["joint"].text().endswith("at rest")
    scene = window.viewport.scene
    assert scene is not None
    dialog.first.textActivated.emit(dialog.first.currentText())
    chosen = {dialog.first.currentText(), dialog.second.currentText()}
    groups = [g for groups in body.groups_by_kind.values() for g in groups if g.name in chosen]
    assert scene.selection.n_faces == len(np.unique(np.concatenate([g.faces for g in groups]))) > 0
    dialog.close()
    assert scene.selection.n_faces == 0


def test_a_part_is_left_out_by_its_tick(qtbot: QtBot, window: MainWindow, body: RigBody) -> None:
    dialog = dialog_of(qtbot, window)
    document = window.document
    top = [dialog.ignored.topLevelItem(row) for row in range(dialog.ignored.topLevelItemCount())]
    (parts,) = [item for item in top if item is not None and "Leave out meshes" in item.text(0)]
    names = [parts.child(row).text(0) for row in range(parts.childCount())]
    assert {group.name for group in body.groups_by_kind["meshes and materials"]} == set(names)
    # Several rows are visible, and more once the dialog is taller. Pending layouts come first.
    QApplication.processEvents()
    heights = [dialog.ignored.height()]
    dialog.resize(dialog.width(), dialog.height() + 100)
    heights.append(dialog.ignored.height())
    assert heights[0] >= 6 * dialog.ignored.visualItemRect(parts).height()
    assert heights[1] - heights[0] >= 90
    limb = parts.child(names.index("LeftArm"))
    with qtbot.waitSignal(dialog.faces_selected) as named:
        dialog.ignored.setCurrentItem(limb)
    assert named.args is not None
    (group,) = (group for group in body.character.groups if group.name == "LeftArm")
    assert np.array_equal(named.args[0], group.faces)
    limb.setCheckState(0, Qt.CheckState.Checked)
    QTest.mouseClick(dialog.apply, LEFT)
    qtbot.waitUntil(lambda: not document.tasks.busy, timeout=PATIENCE)
    rest(qtbot, window)
    assert document.model.rules == ContactRules(left_out=("LeftArm",))
    assert document.motion.exact is not None
    assert not document.motion.exact.colliding
    assert "Without LeftArm" in window.collision.exact.details.text()
    take_picture(window, "left-out")


@pytest.mark.slow
def test_meshes_and_materials_have_a_list_each_in_a_dialog_that_widens(
    qtbot: QtBot, window: MainWindow, body: RigBody
) -> None:
    faces = [group.faces for group in body.character.groups]
    groups = (
        FaceGroup("Axe", faces[0]),
        FaceGroup("Steel", np.union1d(faces[0], faces[1]), is_material=True),
        FaceGroup("Cape", faces[2]),
    )
    window.document.set_model(RigBody.of(replace(body.character, groups=groups)))
    rest(qtbot, window)
    dialog = dialog_of(qtbot, window)
    top = [dialog.ignored.topLevelItem(row) for row in range(dialog.ignored.topLevelItemCount())]
    listed = {
        item.text(0): [item.child(row).text(0) for row in range(item.childCount())] for item in top
    }
    assert listed["Leave out meshes (2)"] == ["Axe", "Cape"]
    assert listed["Leave out materials (1)"] == ["Steel"]
    # The choices also separate meshes from materials.
    names = [dialog.first.itemText(row) for row in range(dialog.first.count())]
    assert names[:2] + names[-2:] == ["Axe", "Cape", "", "Steel"]
    narrow, list_width = dialog.width(), dialog.ignored.width()
    note = dialog.total.height()
    dialog.resize(narrow + 300, dialog.height())
    qtbot.waitUntil(lambda: dialog.width() == narrow + 300)
    assert dialog.ignored.width() >= list_width + 290
    assert dialog.total.height() <= note
    take_picture(dialog, "contacts-wide")
    dialog.close()


def test_rules_that_a_predictor_was_trained_by_stay(qtbot: QtBot, window: MainWindow) -> None:
    dialog = dialog_of(qtbot, window)
    fields = (dialog.near, dialog.at_rest, dialog.rest, dialog.tolerated, dialog.add, dialog.apply)
    assert [field.isEnabled() for field in fields] == [False] * len(fields)
    assert dialog.kept.isVisible()
    assert window.document.model.name in dialog.kept.text()
    dialog.close()


def test_rules_of_a_model_without_predictor_are_kept_in_its_file(
    qtbot: QtBot, window: MainWindow, editor_model: LearnedBody, tmp_path: Path
) -> None:
    document, path = window.document, tmp_path / "bare.safetensors"
    LearnedBody("bare", editor_model.embedding, editor_model.card).save(path)
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        document.tasks.open_model(path)
    dialog = dialog_of(qtbot, window)
    dialog.tolerated.setValue(1.5)
    dialog.near.setValue(dialog.near.value())
    QTest.mouseClick(dialog.apply, LEFT)
    qtbot.waitUntil(lambda: not document.tasks.busy, timeout=PATIENCE)
    kept = LearnedBody.load(path).rules
    assert kept == document.model.rules
    assert (kept.tolerated_depth, kept.near_exclusion) == (0.015, editor_model.rules.near_exclusion)
    dialog.close()


def test_groups_that_always_touch_are_proposed_by_kind_and_ignored_in_one_click(
    qtbot: QtBot, window: MainWindow
) -> None:
    body = RigBody.of(head_in_torso(30)).with_rules(ContactRules())
    window.document.set_model(body)
    rest(qtbot, window)
    document, dialog = window.document, dialog_of(qtbot, window)
    with qtbot.waitSignal(document.tasks.pairs_proposed, timeout=PATIENCE) as proposed:
        QTest.mouseClick(dialog.propose, LEFT)
    expected = propose_by_kind(body.detector, typical_poses(body), body.groups_by_kind)
    assert proposed.args[0] == expected
    kinds = [dialog.ignored.topLevelItem(row) for row in range(dialog.ignored.topLevelItemCount())]
    kinds = [kind for kind in kinds if not kind.text(0).startswith("Leave out ")]
    shown = {kind.text(0): kind for kind in kinds}
    assert list(shown) == [
        f"{kind.capitalize()} ({len(pairs)}): in all of the poses"
        for kind, pairs in expected.items()
        if pairs
    ]
    texts = [kind.child(row).text(0) for kind in kinds for row in range(kind.childCount())]
    assert texts == [
        f"{pair.groups[0]} and {pair.groups[1]}: {100 * pair.share:.0f} % of the poses"
        for pairs in expected.values()
        for pair in pairs
    ]
    assert dialog.rules() == body.rules
    assert not any(kind.isExpanded() for kind in kinds)
    # The first one to try is suggested, and the groups of a row are tinted.
    size = {g.name: len(g.faces) for groups in body.groups_by_kind.values() for g in groups}
    left_out = {
        kind: sum(size[pair.groups[0]] * size[pair.groups[1]] for pair in pairs)
        for kind, pairs in expected.items()
        if pairs
    }
    assert dialog.total.text().startswith(f"Start with {min(left_out, key=left_out.__getitem__)}")
    scene = window.viewport.scene
    assert scene is not None
    item = kinds[0].child(0)
    dialog.ignored.setCurrentItem(item)
    named = next(iter(dialog._pairs))
    assert scene.selection.n_faces == sum(size[name] for name in named)
    dialog.ignored.setCurrentItem(None)
    assert scene.selection.n_faces == 0
    components = next(kind for text, kind in shown.items() if text.startswith("Components"))
    components.setCheckState(0, Qt.CheckState.Checked)
    ignored = tuple(pair.groups for pair in expected["components"])
    assert dialog.rules().ignored == ignored
    take_picture(dialog, "contacts_proposed")
    # Components are not groups of the file.
    QTest.mouseClick(dialog.apply, LEFT)
    qtbot.waitUntil(lambda: not document.tasks.busy, timeout=PATIENCE)
    assert document.model.rules.ignored == ignored
    model = document.model
    assert model.detector.detect(model.reference).excluded.ignored > 0
    dialog.close()


def test_rules_are_remembered_and_go_back_to_the_defaults(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    document, path = window.document, arm().write(tmp_path / "arm.glb")
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        document.tasks.open_model(path)
    own = document.model.rules
    dialog = dialog_of(qtbot, window)
    assert "remembered for this character" in dialog.kept.text()
    assert not dialog.restore.isEnabled()
    # A limb's size bounds the default length, but not one that is typed.
    begin = dialog.near.value()
    for value, at_limbs in ((begin - 1.0, ""), (begin, ", less at thin limbs")):
        dialog.near.setValue(value)
        assert dialog.folds.text() == f"Pairs this close along the surface{at_limbs}"
    dialog.tolerated.setValue(1.5)
    QTest.mouseClick(dialog.apply, LEFT)
    qtbot.waitUntil(lambda: not document.tasks.busy, timeout=PATIENCE)
    assert open_body(path).rules == document.model.rules != own
    told = []
    document.message.connect(told.append)
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        document.tasks.open_model(path)
    qtbot.waitUntil(lambda: not document.tasks.busy, timeout=PATIENCE)
    assert document.model.rules.tolerated_depth == 0.015
    (sentence,) = told
    assert sentence.endswith("; its contact rules are those that you chose for it")
    QTest.mouseClick(dialog.restore, LEFT)
    qtbot.waitUntil(lambda: not document.tasks.busy, timeout=PATIENCE)
    assert document.model.rules == own == open_body(path).rules
    assert (dialog.tolerated.value(), dialog.restore.isEnabled()) == (0.0, False)
    dialog.close()


@pytest.mark.slow
def test_parts_that_always_touch_are_offered_to_be_ignored(
    qtbot: QtBot, window: MainWindow
) -> None:
    document, card = window.document, window.collision.proposal
    assert card.isHidden()
    body = RigBody.of(head_in_torso(30))
    # As if these were its default rules.
    strict = ContactRules()
    body.own_card = replace(body.own_card, rules=strict)
    with qtbot.waitSignal(document.tasks.rules_proposed, timeout=PATIENCE):
        document.set_model(body.with_rules(strict))
    rest(qtbot, window)
    proposed = document.tasks.proposed_rules
    assert proposed is not None
    assert card.isVisible()
    assert card.text.text().startswith(
        f"{proposed.n_colliding} of {proposed.n_poses} sampled poses"
    )
    assert f"{len(proposed.new)} such places ignored" in card.text.text()
    # The places are listed and tinted at once.
    scene = window.viewport.scene
    assert scene is not None
    assert scene.selection.n_faces == len(proposed.faces) > 0
    ((first, second), n), *_ = proposed.places.items()
    assert f"{first} and {second}: {n} place" in card.listed.text()
    assert card.ignore.isVisible()
    rest(qtbot, window)
    take_picture(window, "proposal")
    QTest.mouseClick(card.ignore, LEFT)
    assert scene.selection.n_faces == 0
    qtbot.waitUntil(lambda: not document.tasks.busy, timeout=PATIENCE)
    rest(qtbot, window)
    assert document.model.rules == proposed.rules
    assert card.isHidden()
    assert document.motion.exact is not None
    assert document.motion.exact.excluded.touching > 0
    told = window.collision.exact.details.text()
    assert f"{document.motion.exact.excluded.touching} at places that nearly always touch" in told
    # Nothing is offered if the user has chosen rules, or if there is no proposal.
    document.set_model(document.model)
    qtbot.waitUntil(lambda: not document.tasks.busy, timeout=PATIENCE)
    assert card.isHidden()
    with qtbot.waitSignal(document.tasks.rules_proposed, timeout=PATIENCE):
        document.set_model(RigBody.of(rigged_body(n_frames=30)))
    assert card.isHidden()


@pytest.mark.slow
def test_a_crossing_in_all_frames_of_a_clip_is_offered_until_it_is_answered(
    qtbot: QtBot, window: MainWindow
) -> None:
    """With default rules and a short clip."""
    document, card = window.document, window.collision.proposal
    body = RigBody.of(sunk_arm())
    assert not body.rules_are_chosen
    with qtbot.waitSignal(document.tasks.rules_proposed, timeout=PATIENCE):
        document.set_model(body)
    rest(qtbot, window)
    scene = window.viewport.scene
    assert scene is not None
    assert card.isVisible()
    assert card.ignore.isVisible()
    assert scene.selection.n_faces > 0
    take_picture(window, "proposal_of_a_clip")
    QTest.mouseClick(card.dismiss, LEFT)
    assert (card.isVisible(), scene.selection.n_faces) == (False, 0)
    qtbot.waitUntil(lambda: not document.tasks.busy, timeout=PATIENCE)
    # When reopened, it is not offered again; the dialog still has the places.
    with qtbot.waitSignal(document.tasks.rules_proposed, timeout=PATIENCE):
        document.set_model(RigBody.of(sunk_arm()))
    assert card.isHidden()
    assert document.tasks.proposed_rules is not None


def test_parts_and_rules_are_changed_one_after_the_other_and_neither_is_lost(
    qtbot: QtBot, window: MainWindow, body: RigBody
) -> None:
    document, parts = window.document, window.actions_by_key["parts"]
    dialog = dialog_of(qtbot, window)
    dialog.tolerated.setValue(1.5)
    parts.trigger()
    (named,) = (d for d in window.findChildren(BodyPartsDialog) if d.isVisible())
    assert dialog.apply.isEnabled()
    document.tasks.edit_parts(PartEdits({0: "knee"}, {}))
    assert not any(held.isEnabled() for held in (dialog.apply, named.save, parts))
    qtbot.waitUntil(lambda: not document.tasks.busy, timeout=PATIENCE)
    assert parts.isEnabled()
    dialog.tolerated.setValue(1.5)
    QTest.mouseClick(dialog.apply, LEFT)
    assert not any(held.isEnabled() for held in (dialog.apply, parts))
    qtbot.waitUntil(lambda: not document.tasks.busy, timeout=PATIENCE)
    assert document.model.domain_names[0] == "knee" != body.domain_names[0]
    assert document.model.rules.tolerated_depth == 0.015
    dialog.close()
