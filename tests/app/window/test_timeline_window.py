"""The timeline in a real window: opening, keyboard, mouse, export and video."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PySide6.QtCore import Qt, QTimer
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QDialog, QMessageBox
from pytestqt.qtbot import QtBot

from app.benchmarks.measures import is_free_by_brute_force
from app.view.camera import View, sees_all
from app.view.offscreen import MotionVideo, VideoStyle
from app.view.shading import Shading
from app.window.dialogs.forms import MotionDialog
from app.window.layout import bring_up
from app.window.main_window import MainWindow
from app.work.motion_checks import MotionChecks
from app.work.threads import as_task
from lcollision_core.bodies import ExportRequest, open_body, read_poses
from lcollision_core.bodies.motions import read_motions
from lcollision_core.contact import DEPTH_TOLERANCE, penetration_depth
from lcollision_core.files.gltf.schema import GltfDocument
from lcollision_core.meshes import contact_rules
from lcollision_core.motion import MotionOptions, ResolvedMotion
from lcollision_core.motion.frames import KeptSpan, Reason
from lcollision_core.tasks import exporting
from tests.app.windows import (
    PATIENCE,
    accept_and_choose,
    answer,
    drop,
    is_checked,
    name_field,
    rest,
    settle_layout,
    shown,
)
from tests.core.bodies.test_retargeting import of_rig
from tests.core.motion.swings import CLIP, N_FRAMES, OTHER, swinging_body
from tests.independent_check import crossing_pairs
from tests.rigged_shapes import write_gltf

pytestmark = pytest.mark.one_window


@pytest.fixture
def swinging(qtbot: QtBot, window: MainWindow, swing: Path) -> MainWindow:
    """Return a window with a character whose arm swings through its trunk, all frames checked."""
    with qtbot.waitSignal(window.document.tasks.opened, timeout=PATIENCE):
        drop(window, swing)
    qtbot.waitUntil(lambda: is_checked(window, N_FRAMES))
    rest(qtbot, window)
    return window


def test_the_timeline_comes_with_a_motion_and_goes_without(
    qtbot: QtBot, window: MainWindow, swing: Path
) -> None:
    assert not window.timeline.isVisible()
    with qtbot.waitSignal(window.document.tasks.opened, timeout=PATIENCE):
        drop(window, swing)
    qtbot.waitUntil(window.timeline.isVisible)
    assert [window.timeline.clips.itemText(k) for k in range(2)] == [CLIP, OTHER]
    # Frames are not poses of the library.
    names = [window.library.list.item(k).text() for k in range(window.library.list.count())]
    assert not any(name.startswith(CLIP) for name in names)


def test_keys_in_the_view_move_the_playhead(swinging: MainWindow) -> None:
    timeline, view = swinging.document.timeline, swinging.viewport
    view.setFocus()

    def press(key: Qt.Key, modifier: Qt.KeyboardModifier = Qt.KeyboardModifier.NoModifier) -> None:
        QTest.keyClick(swinging.viewport, key, modifier)

    press(Qt.Key.Key_Home)
    assert timeline.frame == 0
    press(Qt.Key.Key_Right)
    press(Qt.Key.Key_Right)
    press(Qt.Key.Key_Left)
    assert timeline.frame == 1
    press(Qt.Key.Key_End)
    assert timeline.frame == N_FRAMES - 1
    press(Qt.Key.Key_N)
    first = int(np.flatnonzero(timeline.checks.deepest > 0.0)[0])
    assert timeline.frame == first
    press(Qt.Key.Key_I)
    press(Qt.Key.Key_N)
    press(Qt.Key.Key_O)
    assert (timeline.first, timeline.last) == (first, first + 1)
    press(Qt.Key.Key_Space)
    assert timeline.playing
    assert swinging.actions_by_key["play"].property("drawing") == "pause text"
    press(Qt.Key.Key_Space)
    assert not timeline.playing
    assert swinging.actions_by_key["play"].property("drawing") == "play text"


def test_keys_stay_those_of_fields(swinging: MainWindow) -> None:
    timeline = swinging.document.timeline
    timeline.go_to(3)
    swinging.sliders.filter.setFocus()
    QTest.keyClicks(swinging.sliders.filter, "no i")
    QTest.keyClick(swinging.sliders.filter, Qt.Key.Key_Left)
    assert swinging.sliders.filter.text() == "no i"
    assert timeline.frame == 3
    assert not timeline.playing


def test_a_click_on_the_strip_goes_there_and_what_it_says_is_what_was_found(
    swinging: MainWindow,
) -> None:
    timeline, strip = swinging.document.timeline, swinging.timeline.strip
    timeline.go_to(0)
    worst = int(np.argmax(timeline.checks.deepest))
    x = next(x for x in range(strip.width()) if strip.frame_at(x) == worst)
    where = strip.rect().center()
    where.setX(x)
    QTest.mouseClick(strip, Qt.MouseButton.LeftButton, pos=where)
    assert timeline.frame == worst
    n = int((timeline.checks.deepest > 0.0).sum())
    assert swinging.timeline.facts.text().startswith(f"{n} of {N_FRAMES} frames collide")
    assert swinging.timeline.place.text().startswith(f"{worst} · ")
    assert "between" not in swinging.timeline.facts.text()
    timeline.checks.between[0] = True
    timeline.checked.emit()
    assert swinging.timeline.facts.text().endswith(" % deep; ◆ 1 collision between frames")
    timeline.checks = MotionChecks.of(N_FRAMES, len(swinging.document.model.domain_names))
    timeline.checked.emit()
    # No frame is checked yet.
    assert swinging.timeline.facts.text() == f"0 of {N_FRAMES} frames checked"


@pytest.mark.parametrize(
    ("most_searched", "frames"), [(60, f"{N_FRAMES} frames"), (24, "24 of 24 searched")]
)
def test_what_is_not_counted_has_a_line_of_its_own_and_is_said_in_full_on_hovering(
    qtbot: QtBot,
    swinging: MainWindow,
    monkeypatch: pytest.MonkeyPatch,
    most_searched: int,
    frames: str,
) -> None:
    monkeypatch.setattr(contact_rules, "_MOST_SEARCHED", most_searched)
    timeline, panel = swinging.document.timeline, swinging.timeline
    swinging.resize(1280, 720)
    settle_layout(qtbot, swinging)
    height = panel.facts.parentWidget().height()
    checks = timeline.checks
    timeline.checks = replace(
        checks,
        excluded=np.repeat([[7, 0, 0, 0, 0, 0]], N_FRAMES, axis=0),
        excluded_deepest=np.full(N_FRAMES, 0.0039),
    )
    timeline.checked.emit()
    settle_layout(qtbot, swinging)
    found, line = panel.facts.fitting().split("\n")
    assert line == f"Not counted in {frames}, up to 0.39 %"
    assert "frames collide" in found
    assert panel.facts.height() >= 2 * panel.facts.fontMetrics().height()
    assert panel.facts.parentWidget().height() == height
    assert panel.facts.toolTip().endswith("0.39 % of the body size deep in frame 0")


def painted(window: MainWindow, frame: int) -> tuple[bool, int]:
    """Return whether a frame's exact check is painted as a collision, and the bar's height.

    The bar starts at the bottom; above it, the strip has its own colour.
    """
    strip = window.timeline.strip
    track = strip._track()
    row, image = strip._rows(track)[1], strip.grab().toImage()
    x = round(track.x_of(frame + 0.5))
    column = [image.pixelColor(x, y) for y in range(int(row.bottom()) - 1, int(row.top()), -1)]
    bar = column[0]
    is_warm = bar.hue() < 40 or bar.hue() > 340
    assert bar.saturation() > 60
    assert is_warm or 130 < bar.hue() < 190
    same = [colour == bar for colour in column]
    return is_warm, same.index(False) if False in same else len(same)


def deepest_overlap(window: MainWindow, frame: int) -> float:
    """Return a frame's deepest penetration by all pairs of faces, independently of the strip.

    Independent code decides whether two faces intersect.
    """
    document = window.document
    model, motion = document.model, document.timeline.motion
    assert motion is not None
    vertices = motion.vertices(frame, model.exact_check()).astype(np.float64)
    found = sorted(crossing_pairs(vertices, model.faces.astype(np.int64)))
    pairs = np.array(found, dtype=np.int64).reshape(-1, 2)
    corners = vertices[model.faces]
    depths = penetration_depth(corners[pairs[:, 0]], corners[pairs[:, 1]]) / model.body_size
    depths = depths[model.detector.rules_of(pairs, depths) == 0]
    return float(depths[depths > DEPTH_TOLERANCE].max(initial=0.0))


@pytest.mark.slow
def test_the_strip_shows_of_ten_frames_what_brute_force_finds(
    qtbot: QtBot, swinging: MainWindow
) -> None:
    document, strip = swinging.document, swinging.timeline.strip
    timeline = document.timeline
    frames = np.linspace(0, N_FRAMES - 1, 10).round().astype(int).tolist()

    def compare(before: MotionChecks | None = None) -> list[bool]:
        """Check the painted frames, off the playhead, and return which collide.

        With `before`, wait for checks other than those.
        """
        qtbot.waitUntil(lambda: timeline.checks is not before and is_checked(swinging, N_FRAMES))
        timeline.go_to(frames[4] + 2)
        deepest = [deepest_overlap(swinging, frame) for frame in frames]
        seen = [painted(swinging, frame) for frame in frames]
        for frame, deep, (is_warm, _) in zip(frames, deepest, seen, strict=True):
            assert timeline.checks.deepest[frame] == pytest.approx(deep, rel=1e-3, abs=1e-7)
            assert is_warm == (deep > 0.0), frame
            motion = timeline.motion
            assert motion is not None
            vertices = motion.vertices(frame, document.model.exact_check())
            assert is_free_by_brute_force(document.model, vertices) != is_warm
            said = strip._facts(frame)[1]
            assert said == "free" if deep == 0.0 else said.startswith("overlaps by")
        # Deeper is higher, and free frames are lower than any collision.
        heights = np.array([height for _, height in seen])[np.argsort(deepest, kind="stable")]
        assert (np.diff(heights) >= 0).all()
        return [is_warm for is_warm, _ in seen]

    collide = compare()
    assert 0 < sum(collide) < len(collide)
    before = timeline.checks
    timeline.resolve()
    qtbot.waitUntil(lambda: not document.tasks.solving_motion)
    assert not any(compare(before))
    # Move back into the trunk by hand, within a resolved span.
    document.motion.set_solid(False)
    assert timeline.original is not None
    timeline.go_to(frames[5])
    before = timeline.checks
    document.motion.edit("Move back", timeline.original.codes[frames[5]])
    again = compare(before)
    assert again[5]
    assert not again[0]


def test_the_motion_is_resolved_exported_and_read_again(
    qtbot: QtBot, swinging: MainWindow, swing: Path, tmp_path: Path
) -> None:
    document = swinging.document
    timeline = document.timeline
    swinging.actions_by_key["resolve_motion"].trigger()
    assert not swinging.actions_by_key["resolve_motion"].isEnabled()
    qtbot.waitUntil(lambda: not document.tasks.solving_motion)
    motion = timeline.motion
    assert motion is not None
    assert document.history.modified
    told: list[str] = []
    job = as_task(
        exporting.export_clips, document.model, swing, timeline.changes, tmp_path / "free.glb"
    )
    document.tasks.write("Exporting", job, told.append)
    qtbot.waitUntil(lambda: bool(told))
    assert told == ["Exported free.glb: no collisions (checked)"]
    body = open_body(tmp_path / "free.glb")
    again = {held.name: held for held in read_motions(body, tmp_path / "free.glb")}
    assert set(again) == {CLIP, OTHER}
    check = body.exact_check()
    for frame in range(N_FRAMES):
        np.testing.assert_allclose(
            again[CLIP].vertices(frame, check), motion.vertices(frame, check), atol=1e-5
        )


@pytest.mark.slow
def test_a_skeletons_motion_is_resolved_and_comes_back_as_such(
    qtbot: QtBot, swinging: MainWindow, swing: Path, tmp_path: Path
) -> None:
    document, timeline = swinging.document, swinging.document.timeline
    body = open_body(swing)
    source, path = tmp_path / "walk.bvh", tmp_path / "walk, resolved.bvh"
    source.write_text(of_rig(body, read_motions(body, swing, CLIP)[0].codes))
    timeline.open(source)
    qtbot.waitUntil(lambda: timeline.file == source and is_checked(swinging, N_FRAMES))
    swinging.actions_by_key["resolve_motion"].trigger()
    qtbot.waitUntil(lambda: not document.tasks.solving_motion)
    timers: list[QTimer] = []
    timers.append(answer(accept_and_choose(path, timers)))
    swinging.actions_by_key["export_timeline"].trigger()
    qtbot.waitUntil(timeline.are_saved)
    (back,) = read_motions(body, path)
    assert body.exact_check().are_free(back.codes).all()
    head = source.read_text().index("Frame Time")
    assert path.read_text()[:head] == source.read_text()[:head]


def export_by(
    qtbot: QtBot, window: MainWindow, choose: Callable[[QDialog], None], timers: list[QTimer]
) -> list[str]:
    """Export the motion with the form's settings, and return the status bar's message."""
    timers.append(answer(choose))
    told: list[str] = []
    window.document.message.connect(told.append)
    window.actions_by_key["export_timeline"].trigger()
    qtbot.waitUntil(lambda: any(words.startswith("Exported") for words in told))
    return told


@pytest.mark.variants
@pytest.mark.parametrize("kind", ["bvh", "vrma"])
def test_the_motion_is_exported_as_that_of_a_skeleton(
    qtbot: QtBot, swinging: MainWindow, tmp_path: Path, kind: str
) -> None:
    document, timeline = swinging.document, swinging.document.timeline
    motion, path = timeline.motion, tmp_path / f"swing.{kind}"
    assert motion is not None
    timeline.set_range(4, 33)
    timers: list[QTimer] = []
    choose_file = accept_and_choose(path, timers)

    def choose(dialog: QDialog) -> None:
        assert isinstance(dialog, MotionDialog)
        dialog.form.setCurrentIndex(dialog.form.findData(kind))
        assert (dialog.axes.isEnabled(), dialog.rate.isEnabled()) == (False, True)
        dialog.range.setCurrentIndex(1)
        choose_file(dialog)

    told = export_by(qtbot, swinging, choose, timers)
    (back,) = read_motions(document.model, path)
    expected = document.model.decode(motion.codes[4:34])
    off = np.abs(document.model.decode(back.codes) - expected).max()
    assert off < 1e-4 * document.model.body_size
    n_colliding = int((timeline.checks.deepest[4:34] > 0.0).sum())
    assert told[-1].startswith(f"Exported swing.{kind}: {n_colliding} of 30 frames collide")


def test_a_motion_that_is_opened_is_in_front_and_on_the_body(
    qtbot: QtBot, swinging: MainWindow, swing: Path, tmp_path: Path
) -> None:
    document, timeline = swinging.document, swinging.document.timeline
    assert timeline.frame is None
    assert (
        swinging.timeline.strip.accessibleDescription() == f"{N_FRAMES} frames, none of them shown"
    )
    body, source = open_body(swing), tmp_path / "walk.bvh"
    source.write_text(of_rig(body, read_motions(body, swing, CLIP)[0].codes))
    bring_up(swinging.library)
    qtbot.waitUntil(lambda: swinging.timeline.visibleRegion().isEmpty())
    drop(swinging, source)
    qtbot.waitUntil(lambda: timeline.file == source and timeline.frame == 0)
    rest(qtbot, swinging)
    qtbot.waitUntil(lambda: not swinging.timeline.visibleRegion().isEmpty())
    assert timeline.motion is not None
    first = document.model.decode(timeline.motion.codes[0])
    np.testing.assert_allclose(shown(swinging), first, atol=1e-6)


def test_a_dropped_clip_without_a_mesh_goes_to_the_timeline_and_into_the_file(
    qtbot: QtBot, swinging: MainWindow, swing: Path, tmp_path: Path
) -> None:
    document, timeline = swinging.document, swinging.document.timeline
    source, path = tmp_path / "walk.glb", tmp_path / "with walk.glb"
    held = GltfDocument(swing.read_bytes(), swing).editable()
    for node in held.description["nodes"]:
        node.pop("mesh", None)
        node.pop("skin", None)
    for kind in ("meshes", "skins"):
        del held.description[kind]
    source.write_bytes(held.encoded())
    drop(swinging, source)
    qtbot.waitUntil(lambda: timeline.file == source and timeline.frame == 0)
    assert timeline.motion is not None
    (own,) = read_motions(open_body(swing), swing, CLIP)
    np.testing.assert_allclose(timeline.motion.codes, own.codes, atol=1e-6)
    timers: list[QTimer] = []
    choose_file = accept_and_choose(path, timers)

    def choose(dialog: QDialog) -> None:
        assert isinstance(dialog, MotionDialog)
        dialog.form.setCurrentIndex(dialog.form.findData("clip"))
        choose_file(dialog)

    export_by(qtbot, swinging, choose, timers)
    assert len(read_motions(document.model, path)[0]) == N_FRAMES


@pytest.mark.slow
def test_the_box_of_motions_is_as_wide_as_their_names(qtbot: QtBot, swinging: MainWindow) -> None:
    timeline, box = swinging.document.timeline, swinging.timeline.clips
    name = "a walk with a long name"
    motion = timeline.motion
    assert motion is not None
    before = box.width()
    timeline.motions[name] = replace(motion, name=name)
    timeline.choose(name)
    qtbot.waitUntil(lambda: box.width() > before)
    assert box.width() > box.fontMetrics().horizontalAdvance(name)


def test_what_is_shown_as_it_was_has_its_own_verdict_and_pairs(
    qtbot: QtBot, swinging: MainWindow
) -> None:
    document, timeline = swinging.document, swinging.document.timeline
    motion, card, scene = document.motion, swinging.collision.exact, swinging.viewport.scene
    swinging.viewport.set_shading(Shading.EXACT)
    worst = int(np.argmax(timeline.checks.deepest))
    timeline.go_to(worst)
    motion.edit("Free", np.zeros(document.model.latent_size))
    qtbot.waitUntil(lambda: timeline.checks.deepest[worst - 1] == 0.0)

    def says(verdict: str) -> bool:
        return card.verdict.text() == verdict and swinging.viewport.canvas.is_settled

    qtbot.waitUntil(lambda: says("No collisions (checked)"))
    assert not scene.crossing.n_faces
    assert timeline.original is not None
    swinging.actions_by_key["compare"].trigger()
    qtbot.waitUntil(lambda: says("Colliding (checked)"))
    was = document.model.decode(timeline.original.codes[worst])
    np.testing.assert_allclose(shown(swinging), was, atol=1e-6)
    expected = document.model.detector.detect(was.astype(np.float32))
    assert motion.exact is not None
    assert np.array_equal(motion.exact.pairs, expected.pairs)
    assert scene.crossing.n_faces == len(np.unique(expected.pairs))
    assert card.source.text() == "as it was read"
    n_before = int((timeline.original_checks.deepest > 0.0).sum())
    told = f"As it was read: {n_before} of {N_FRAMES} frames collide, "
    assert swinging.timeline.facts.text().startswith(told)
    assert painted(swinging, worst - 1)[0]
    swinging.actions_by_key["compare"].trigger()
    qtbot.waitUntil(lambda: says("No collisions (checked)"))
    assert not scene.crossing.n_faces
    assert card.source.text() == "on the mesh"
    assert not painted(swinging, worst - 1)[0]


@pytest.mark.slow
def test_what_resolve_found_is_not_shown_beside_a_frame_as_it_was(
    qtbot: QtBot, swinging: MainWindow
) -> None:
    document, timeline = swinging.document, swinging.document.timeline
    timeline.go_to(int(np.argmax(timeline.checks.deepest)))
    swinging.actions_by_key["resolve"].trigger()
    qtbot.waitUntil(lambda: document.history.state.outcome is not None, timeout=PATIENCE)
    qtbot.waitUntil(lambda: not document.tasks.solving, timeout=PATIENCE)
    shown = list[bool]()
    for _ in range(3):
        shown.append(not swinging.collision.outcome.isHidden())
        swinging.actions_by_key["compare"].trigger()
    assert shown == [True, False, True]


def test_the_camera_follows_a_body_that_walks_until_it_is_told_not_to(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    document, timeline, viewport = window.document, window.document.timeline, window.viewport
    walking = write_gltf(swinging_body(travel=9.0), tmp_path / "walk.glb")
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        drop(window, walking)
    qtbot.waitUntil(lambda: timeline.motion is not None)

    def view_at(frame: int) -> View:
        timeline.go_to(frame)
        rest(qtbot, window)
        return viewport.scene.view

    def in_picture(view: View) -> bool:
        return sees_all(view, shown(window), viewport._aspect)

    near, far = view_at(0), view_at(N_FRAMES - 1)
    way = document.model.decode(timeline.motion.codes[[0, -1]]).mean(axis=1)
    assert in_picture(far)
    expected = np.delete(way[1] - way[0], document.model.up_axis)
    np.testing.assert_allclose(
        np.delete(far.position - near.position, document.model.up_axis), expected, atol=1e-5
    )
    np.testing.assert_allclose(far.position - far.focus, near.position - near.focus, atol=1e-9)
    # Editing the frame does not move the camera.
    document.motion.set_code(0, float(document.history.latent[0]) + 0.5)
    rest(qtbot, window)
    assert np.array_equal(viewport.scene.view.position, far.position)
    document.history.undo()
    rest(qtbot, window)
    back = view_at(0)
    np.testing.assert_allclose(back.position, near.position, atol=1e-5)
    window.actions_by_key["follow"].trigger()
    assert not window.settings["camera_follows"]
    assert np.array_equal(view_at(N_FRAMES - 1).position, back.position)
    assert not in_picture(back)


@pytest.mark.slow
def test_a_resolve_shows_how_far_it_is_and_is_cancelled_where_it_was_begun(
    qtbot: QtBot, swinging: MainWindow
) -> None:
    timeline, panel = swinging.document.timeline, swinging.timeline
    before, said = timeline.motion, set[str]()
    assert (panel.resolve.isVisible(), panel.working.isVisible()) == (True, False)
    swinging.resizeDocks([swinging.docks["timeline"]], [400], Qt.Orientation.Vertical)
    settle_layout(qtbot, swinging)
    height = panel.strip.height()
    timeline.resolving.changed.connect(lambda: said.add(panel.facts.text()))
    swinging.actions_by_key["resolve_motion"].trigger()
    assert (panel.resolve.isVisible(), panel.working.isVisible()) == (False, True)
    assert panel.facts.text().startswith("Checking frames, ")
    panel.layout().activate()
    assert abs(panel.strip.height() - height) < 10
    with qtbot.waitSignal(swinging.document.message) as told:
        panel.cancel.click()
    assert told.args == ["Resolve was cancelled: the motion is as it was"]
    assert (panel.resolve.isVisible(), panel.working.isVisible()) == (True, False)
    assert timeline.motion is before
    swinging.actions_by_key["resolve_motion"].trigger()
    qtbot.waitUntil(lambda: not swinging.document.tasks.solving_motion)
    assert not panel.working.isVisible()
    assert any(words.startswith("0 of ") and words.endswith(" so far") for words in said)
    assert any(words.endswith(" frames, less than a minute left") for words in said)


def test_why_frames_are_left_colliding_is_read_until_the_motion_changes(
    qtbot: QtBot, swinging: MainWindow
) -> None:
    timeline, card = swinging.document.timeline, swinging.collision.exact
    motion, free = timeline.motion, timeline.checks.deepest == 0.0
    assert motion is not None
    left = np.flatnonzero(~free)
    timeline.go_to(int(left[0]))
    rest(qtbot, swinging)
    kept = KeptSpan((int(left[0]), int(left[-1])), Reason.TOO_FAR, ((1, 3),), 0.01)
    standing = np.zeros((len(motion), 1), dtype=np.bool_)
    timeline._on_resolved(motion, ResolvedMotion(motion, free, free, (), standing, kept=(kept,)))
    (why,) = timeline.kept_sentences()
    names = swinging.document.model.domain_names
    assert f": {names[1]} and {names[3]}, 1" in why
    assert why.endswith(f"% deep; {Reason.TOO_FAR}")
    assert why in swinging.timeline.facts.toolTip()
    for frame, is_said in ((int(left[0]), True), (0, False), (int(left[-1]), True)):
        timeline.go_to(frame)
        rest(qtbot, swinging)
        assert (why in card.details.text().replace("\N{NO-BREAK SPACE}", " ")) is is_said
    swinging.document.motion.set_code(0, 0.1)
    rest(qtbot, swinging)
    swinging.document.motion.end_gesture()
    qtbot.waitUntil(lambda: timeline.kept_sentences() == [])
    swinging.document.history.undo()
    assert timeline.kept_sentences() == [why]


@pytest.mark.slow
def test_a_resolve_that_is_stopped_keeps_what_is_done(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    timeline, panel = window.document.timeline, window.timeline
    path = write_gltf(swinging_body(n_frames=96, n_swings=3), tmp_path / "swings.glb")
    with qtbot.waitSignal(window.document.tasks.opened, timeout=PATIENCE):
        drop(window, path)
    qtbot.waitUntil(lambda: timeline.motion is not None and not window.document.tasks.preparing)
    timeline.set_easing(1)
    before = timeline.motion
    assert before is not None

    def stop() -> None:
        if panel.keep.isEnabled():
            panel.keep.click()

    timeline.resolving.changed.connect(stop)
    told: list[str] = []
    window.document.message.connect(told.append)
    timeline.resolve(options=MotionOptions(easing=2))
    qtbot.waitUntil(lambda: not window.document.tasks.solving_motion)
    clearance = window.document.motion.clearance
    check = window.document.model.exact_check(clearance=clearance)
    now, free = timeline.motion, check.are_free
    assert now is not None
    changed = (now.codes != before.codes).any(axis=1)
    assert changed.any()
    # Around the freed frames, a correction eases over others that get less overlap by it.
    eased = np.flatnonzero(changed & ~free(now.codes))
    assert len(eased) < np.count_nonzero(changed)
    for frame in eased:
        old, new = (check.find(check.decode(motion.codes[frame])[0]) for motion in (before, now))
        assert not new.exceeds(old)
    n_left = int((~free(now.codes)).sum())
    n_before = int((~free(before.codes)).sum())
    left = f"{n_left} still do{'es' * (n_left == 1)}" if n_left else "all are free now"
    assert told[-1].startswith(f"Stopped: {n_before} frames collided; {left}")
    assert n_left < n_before
    window.document.history.undo()
    assert timeline.motion is before


def test_a_range_is_exported_as_frames_at_another_rate(
    qtbot: QtBot, swinging: MainWindow, tmp_path: Path
) -> None:
    document, timeline = swinging.document, swinging.document.timeline
    motion = timeline.motion
    assert motion is not None
    told: list[str] = []
    part, request = motion.part(range(9)).at_rate(15.0), ExportRequest(fps=15.0)
    job = partial(exporting.export_frames, document.model, part, tmp_path / "part.mdd", request)
    document.tasks.write("Exporting", job, told.append)
    qtbot.waitUntil(lambda: bool(told))
    from lcollision_core.files.motion.caches import read_point_cache

    frames = read_point_cache(tmp_path / "part.mdd")
    assert len(frames) == 5
    check = document.model.exact_check()
    np.testing.assert_allclose(frames[1], motion.vertices(2, check), atol=1e-5)


def test_a_video_of_the_motion_has_its_frames(
    qtbot: QtBot, swinging: MainWindow, tmp_path: Path
) -> None:
    document = swinging.document
    motion = document.timeline.motion
    assert motion is not None
    part = motion.part(range(0, 40, 1)).at_rate(6.0)
    style = VideoStyle(len(part) / 6.0, 96, 96, 6, "plain", "#ffffff")
    swinging.viewport.pictures.film(tmp_path / "swing.gif", style, part)
    qtbot.waitUntil((tmp_path / "swing.gif").exists)
    with Image.open(tmp_path / "swing.gif") as film:
        assert film.n_frames == len(part)
        first = np.asarray(film.convert("RGB"))
        film.seek(len(part) // 2)
        middle = np.asarray(film.convert("RGB"))
    assert (first != middle).any()


@pytest.mark.slow
def test_a_video_shows_what_codes_do_not_hold_of_its_frames(
    swinging: MainWindow, tmp_path: Path
) -> None:
    model, motion = swinging.document.model, swinging.document.timeline.motion
    assert motion is not None
    space = model.space
    fatter = [
        space.shaped_as(row, space.decode(row[None])[0] + 0.25 * frame / model.body_size)
        for frame, row in enumerate(motion.codes[:3])
    ]
    moved = replace(motion, space_at=lambda time: fatter[int(time)])
    style = VideoStyle(0.5, 96, 96, 6, "plain", "#ffffff")
    renderer = swinging.viewport.pictures._copy(96, 96, transparent=False)
    video = MotionVideo(renderer, tmp_path / "moved.gif", style, model, moved.part(range(3)))
    try:
        for frame in range(3):
            video.draw_next()
            drawn = model.decode(motion.codes[frame]) + 0.25 * frame
            np.testing.assert_allclose(renderer.scene.surface.vertices, drawn, atol=1e-6)
    finally:
        video.close()


@pytest.mark.slow
def test_the_path_of_a_point_goes_with_its_motion_and_stays_with_new_names(
    qtbot: QtBot, swinging: MainWindow
) -> None:
    document, timeline = swinging.document, swinging.document.timeline

    def is_drawn() -> bool:
        return swinging.viewport.scene.motion._path is not None

    timeline.go_to(5)
    timeline.set_trail(40)
    qtbot.waitUntil(is_drawn)
    scene = swinging.viewport.scene
    with qtbot.waitSignal(document.model_changed, timeout=PATIENCE):
        document.tasks.set_rules(document.model.rules)
    assert swinging.viewport.scene is not scene
    assert is_drawn()
    timeline.choose(OTHER)
    qtbot.waitUntil(lambda: timeline.motion is not None and timeline.motion.name == OTHER)
    assert not is_drawn()


def test_the_frame_at_the_playhead_goes_to_the_library(swinging: MainWindow) -> None:
    document = swinging.document
    document.timeline.go_to(12)
    document.library.add_pose(document.library.free_name(document.history.pose.name))
    kept = document.library.poses[-1]
    motion = document.timeline.motion
    assert motion is not None
    assert kept.name.startswith(f"{CLIP} 12")
    assert kept.latent.tobytes() == motion.codes[12].tobytes()


def test_save_exports_an_edited_motion_and_save_as_saves_the_frame_as_a_pose(
    qtbot: QtBot, swinging: MainWindow, tmp_path: Path
) -> None:
    document = swinging.document
    timeline, path = document.timeline, tmp_path / "mine.glb"
    document.motion.set_solid(False)
    timeline.go_to(20)
    document.motion.set_code(10, float(document.history.latent[10]) + 0.3)
    motion, asked = timeline.motion, []
    assert motion is not None

    def give_up(dialog: QDialog) -> None:
        asked.append(dialog.windowTitle())
        dialog.reject()

    for key in ("save", "save_as"):
        timer = answer(give_up)
        swinging.actions_by_key[key].trigger()
        assert not timer.isActive()
        assert not timeline.are_saved()
        told = "Save exports the edited motion; Save as saves the frame as a pose"
        assert swinging.statusBar().currentMessage() == told
    timers: list[QTimer] = []
    timers.append(answer(accept_and_choose(path, timers)))
    swinging.activateWindow()
    QTest.keyClick(swinging, Qt.Key.Key_S, Qt.KeyboardModifier.ControlModifier)
    qtbot.waitUntil(timeline.are_saved)
    assert not swinging.isWindowModified()
    body = open_body(path)
    (again,) = read_motions(body, path, CLIP)
    check = body.exact_check()
    for frame in (0, 18, 20, 22):
        np.testing.assert_allclose(
            again.vertices(frame, check), motion.vertices(frame, check), atol=1e-5
        )
    # The motion is in a file: only the frame as a pose is left to save.
    timers.append(answer(give_up))
    swinging.actions_by_key["save"].trigger()
    assert asked == ["Export motion", "Save poses", "Save poses"]
    assert "motion is exported" in swinging.actions_by_key["save"].toolTip()


def test_a_dropped_motion_does_not_replace_an_edited_one_unasked(
    qtbot: QtBot, swinging: MainWindow, swing: Path, tmp_path: Path
) -> None:
    document, timeline = swinging.document, swinging.document.timeline
    body = open_body(swing)
    source = tmp_path / "walk.bvh"
    source.write_text(of_rig(body, read_motions(body, swing, CLIP)[0].codes))
    document.motion.set_solid(False)
    timeline.go_to(20)
    document.motion.set_code(10, float(document.history.latent[10]) + 0.3)
    edited, told = timeline.motion, []

    def decide(words: str, dialog: QDialog) -> None:
        assert isinstance(dialog, QMessageBox)
        told.append(dialog.text())
        next(one for one in dialog.buttons() if words in one.text().replace("&", "")).click()

    for words in ("Cancel", "Discard"):
        timer = answer(partial(decide, words))
        drop(swinging, source)
        qtbot.waitUntil(lambda timer=timer: not timer.isActive())
        if words == "Cancel":
            assert timeline.motion is edited
            assert not document.tasks.incoming
    qtbot.waitUntil(lambda: timeline.file == source)
    assert told == [f"Export the changes of “{CLIP}”?"] * 2
    assert timeline.are_saved()


@pytest.mark.slow
def test_a_pose_is_asked_about_before_the_timeline_takes_its_place(
    swinging: MainWindow, tmp_path: Path
) -> None:
    document, timeline = swinging.document, swinging.document.timeline
    document.tasks.save(tmp_path / "mine.json")
    document.tasks.wait_for_saves()
    document.motion.set_solid(False)
    document.motion.set_code(8, 0.4)
    mine, told = document.history.latent.copy(), []

    def decide(words: str, dialog: QDialog) -> None:
        assert isinstance(dialog, QMessageBox)
        told.append(dialog.text())
        next(one for one in dialog.buttons() if one.text().replace("&", "") == words).click()

    timer = answer(partial(decide, "Cancel"))
    timeline.go_to(5)
    assert timeline.frame is None
    timer = answer(partial(decide, "Save"))
    timeline.go_to(5)
    assert not timer.isActive()
    assert timeline.frame == 5
    assert len(told) == 2
    assert all("mine.json" in words for words in told)
    (held,) = read_poses(tmp_path / "mine.json", document.model)
    assert held.latent.tobytes() == mine.tobytes()
    # Nor does Save replace it by the frame.
    asked: list[str] = []

    def give_up(dialog: QDialog) -> None:
        asked.append(dialog.windowTitle())
        dialog.reject()

    timer = answer(give_up)
    swinging.actions_by_key["save"].trigger()
    assert not timer.isActive()
    assert asked == ["Save poses"]
    (again,) = read_poses(tmp_path / "mine.json", document.model)
    assert again.latent.tobytes() == mine.tobytes()


def test_closing_goes_on_once_the_motion_is_exported(swinging: MainWindow, tmp_path: Path) -> None:
    document = swinging.document
    document.motion.set_solid(False)
    document.timeline.go_to(20)
    document.motion.set_code(10, float(document.history.latent[10]) + 0.3)
    path, timers = tmp_path / "swung.glb", list[QTimer]()

    def save(dialog: QDialog) -> None:
        name_field(dialog).setText(str(path))
        dialog.accept()

    def accept(dialog: QDialog) -> None:
        assert isinstance(dialog, MotionDialog)
        timers.append(answer(save))
        dialog.accept()

    def export(dialog: QDialog) -> None:
        assert isinstance(dialog, QMessageBox)
        timers.append(answer(accept))
        next(one for one in dialog.buttons() if "Export" in one.text().replace("&", "")).click()

    timers.append(answer(export))
    assert swinging.close()
    assert not any(timer.isActive() for timer in timers)
    assert document.timeline.are_saved()
    (written,) = read_motions(open_body(path), path, CLIP)
    exported = document.timeline.motion
    assert exported is not None
    np.testing.assert_allclose(written.codes, exported.codes, atol=1e-5)


@pytest.mark.parametrize(("words", "closes"), [("Cancel", False), ("Discard", True)])
def test_closing_asks_about_a_motion_that_was_not_exported(
    swinging: MainWindow, words: str, closes: bool
) -> None:
    document = swinging.document
    document.motion.set_solid(False)
    document.timeline.go_to(20)
    document.motion.set_code(10, float(document.history.latent[10]) + 0.3)
    told: list[str] = []

    def decide(dialog: QDialog) -> None:
        assert isinstance(dialog, QMessageBox)
        told.append(dialog.text())
        buttons = {one.text().replace("&", ""): one for one in dialog.buttons()}
        assert set(buttons) == {"Export…", "Discard", "Cancel"}
        buttons[words].click()

    timer = answer(decide)
    assert swinging.close() is closes
    assert told == [f"Export the changes of “{CLIP}”?"]
    timer.stop()
    document.timeline.mark_saved()
