"""The motion on the timeline: playhead, edits, checks of frames, Resolve."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from threading import Event

import numpy as np
import numpy.typing as npt
import pytest
from pytestqt.qtbot import QtBot
from scipy.spatial.transform import Rotation

from app.editing.document import PoseDocument
from app.editing.tasks import Work
from app.editing.timeline import Timeline
from app.work.frames import Onion
from app.work.motion_checks import MotionChecks, check_motion
from app.work.preparing import open_to_show
from lcollision_core.bodies import ExportRequest, NamedPose, open_body, write_poses
from lcollision_core.files import read_mesh
from lcollision_core.jobs import Job
from lcollision_core.motion import Motion, MotionOptions, colliding_spans
from lcollision_core.posing import make_grip
from lcollision_core.tasks import exporting
from lcollision_core.tasks.opening import OpenedModel
from tests.app.windows import PATIENCE
from tests.core.motion.swings import CLIP, N_FRAMES, OTHER, through_the_trunk


@pytest.fixture(scope="module")
def opened_swing(swing: Path) -> OpenedModel:
    """Return a character whose arm swings through its trunk, as the window opens it."""
    return open_to_show(swing, Job())


@pytest.fixture
def timeline(qtbot: QtBot, document: PoseDocument, opened_swing: OpenedModel) -> Timeline:
    """Return the timeline of a document with this character."""
    document.tasks.model_opened.emit(opened_swing)
    held = document.timeline
    qtbot.waitUntil(lambda: held.motion is not None)
    return held


@pytest.fixture
def walk(document: PoseDocument, timeline: Timeline, tmp_path: Path) -> Path:
    """Return a file of six poses of the clip."""
    poses = [NamedPose(f"{k}", now(timeline).codes[k]) for k in range(3, 9)]
    write_poses(tmp_path / "walk.json", document.model, poses)
    return tmp_path / "walk.json"


def checked(qtbot: QtBot, timeline: Timeline) -> None:
    """Wait until all frames are checked, and the poses between them."""
    qtbot.waitUntil(lambda: timeline.checks.n_checked == len(timeline.checks.deepest))
    qtbot.waitUntil(lambda: bool(timeline.checks.checked_between[:-1].all()))


def now(timeline: Timeline) -> Motion:
    motion = timeline.motion
    assert motion is not None
    return motion


def test_a_character_s_clips_are_its_motions_and_the_pose_stays_at_rest(
    document: PoseDocument, timeline: Timeline
) -> None:
    assert list(timeline.motions) == [CLIP, OTHER]
    assert (now(timeline).name, len(now(timeline))) == (CLIP, N_FRAMES)
    assert (timeline.frame, timeline.first, timeline.last) == (None, 0, N_FRAMES - 1)
    assert not document.history.latent.any()
    assert not document.history.modified


def test_drags_are_ready_before_all_frames_are_checked(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    may_end = Event()

    def prepare(_: Job) -> None:
        assert may_end.wait(PATIENCE / 1000)

    checked(qtbot, timeline)
    document.tasks.start(Work.PREPARE, "Preparing drags", prepare, lambda _: None)
    try:
        timeline.check_again()
        # Escape does not stop preparing drags.
        document.tasks.cancel_all()
        qtbot.wait(300)
        assert timeline.checks.n_checked == 0
    finally:
        may_end.set()
    checked(qtbot, timeline)


def test_all_frames_are_checked_as_the_exact_check_has_them(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    checked(qtbot, timeline)
    check, motion = document.model.exact_check(), now(timeline)
    free = check.are_free(motion.codes)
    assert 0 < free.sum() < N_FRAMES
    assert ((timeline.checks.deepest == 0.0) == free).all()
    worst = int(np.argmax(timeline.checks.deepest))
    found = check.find(motion.vertices(worst, check))
    assert timeline.checks.deepest[worst] == found.penetration_depth.max()
    # The colliding parts are the arm and those that it touches.
    deep = timeline.checks.parts[worst]
    assert deep.max() == np.float32(timeline.checks.deepest[worst])
    assert 2 <= np.count_nonzero(deep) < len(deep)


def test_what_collides_between_two_free_frames_is_found() -> None:
    body, motion = through_the_trunk()
    checks = MotionChecks.of(len(motion), len(body.domain_names))
    check_motion(body, motion, checks, Job())
    assert not checks.deepest.any()
    assert np.flatnonzero(checks.between).tolist() == [13]
    assert checks.checked_between[:-1].all()


def test_the_playhead_makes_a_frame_the_pose_without_a_step_of_undo(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    timeline.go_to(7)
    assert timeline.frame == 7
    assert document.history.pose.name == f"{CLIP} 7"
    assert document.history.latent.tobytes() == now(timeline).codes[7].tobytes()
    timeline.step(2)
    assert timeline.frame == 9
    timeline.go_to(10_000)
    assert timeline.frame == N_FRAMES - 1
    timeline.go_to(-3)
    assert timeline.frame == 0
    assert document.history.undo_stack.count() == 0
    assert not document.history.modified
    qtbot.waitUntil(
        lambda: (
            document.motion.frame is not None
            and document.motion.frame.latent.tobytes() == now(timeline).codes[0].tobytes()
        )
    )


def test_a_pose_that_is_not_saved_stays_a_step_of_undo(
    document: PoseDocument, timeline: Timeline
) -> None:
    document.motion.set_solid(False)
    document.motion.set_code(8, 0.4)
    mine = document.history.latent
    timeline.go_to(3)
    document.history.undo()
    assert document.history.latent.tobytes() == mine.tobytes()
    assert timeline.frame is None
    document.history.redo()
    assert timeline.frame == 3


@pytest.mark.parametrize("way", ["go_to", "play", "resolve"])
def test_a_pose_that_the_user_would_rather_save_stays(
    document: PoseDocument, timeline: Timeline, way: str
) -> None:
    document.motion.set_solid(False)
    document.motion.set_code(8, 0.4)
    mine, asked = document.history.pose, []
    document.tasks.may_leave_pose = lambda: bool(asked.append(way))
    getattr(timeline, way)(*[3] * (way == "go_to"))
    assert asked == [way]
    assert document.history.pose is mine
    assert document.history.modified
    assert timeline.frame is None
    assert not timeline.playing
    assert not document.tasks.solving_motion
    # Without an edit, nothing is asked.
    document.history.undo()
    timeline.go_to(3)
    assert (asked, timeline.frame) == ([way], 3)


def test_next_and_previous_go_to_frames_that_collide(qtbot: QtBot, timeline: Timeline) -> None:
    checked(qtbot, timeline)
    colliding = np.flatnonzero(timeline.checks.deepest > 0.0).tolist()
    timeline.go_to(0)
    timeline.go_to_colliding(1)
    assert timeline.frame == colliding[0]
    timeline.go_to_colliding(-1)
    assert timeline.frame == colliding[-1]
    timeline.go_to_worst()
    assert timeline.frame == int(np.argmax(timeline.checks.deepest))


def test_an_edit_by_hand_eases_in_and_out_and_is_one_step(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    document.motion.set_solid(False)
    checked(qtbot, timeline)
    known = timeline.checks.deepest.copy()
    timeline.set_easing(4)
    timeline.go_to(20)
    before = now(timeline)
    code = 10
    document.motion.set_code(code, float(before.codes[20, code]) + 0.3)
    edited = now(timeline)
    changed = np.flatnonzero((edited.codes != before.codes).any(axis=1))
    assert changed.tolist() == list(range(16, 25))
    assert edited.codes[20, code] == document.history.latent[code]
    assert document.history.pose.name == f"{CLIP} 20"
    assert document.history.modified
    # The checks of the other frames stay valid.
    same = np.delete(np.arange(N_FRAMES), changed)
    assert timeline.checks.deepest[same].tobytes() == known[same].tobytes()
    timeline.go_to(40)
    document.history.undo()
    assert now(timeline) is before
    assert timeline.frame == 20
    assert not document.history.modified
    document.history.redo()
    assert now(timeline) is edited


def test_a_pose_of_the_library_takes_the_place_of_the_frame(
    document: PoseDocument, timeline: Timeline
) -> None:
    timeline.go_to(5)
    before = now(timeline)
    other = before.codes[5] + 0.05
    document.motion.load_pose(NamedPose("mine", other))
    assert timeline.frame == 5
    assert now(timeline).codes[5].tobytes() == other.tobytes()
    assert (now(timeline).codes[6] != before.codes[6]).any()


def test_with_solid_on_no_frame_round_an_edit_begins_to_collide(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    document.motion.set_solid(True)
    checked(qtbot, timeline)
    free = timeline.checks.deepest == 0.0
    first = int(np.flatnonzero(~free)[0])
    frame = first - 4
    timeline.set_easing(3)
    timeline.go_to(frame)
    before = now(timeline)
    # Towards the trunk, as far as contact allows.
    aim = before.codes[frame] + 4.0 * (before.codes[first] - before.codes[frame])
    document.motion.edit("Move the arm", aim)
    qtbot.waitUntil(lambda: not document.motion.moving)
    document.history.close_gesture()
    assert now(timeline) is not before
    qtbot.waitUntil(lambda: not document.tasks.busy)
    check, edited = document.model.exact_check(), now(timeline)
    still_free = check.are_free(edited.codes)
    assert still_free[free].all()
    assert still_free[frame]
    assert document.history.undo_stack.count() == 1
    document.history.undo()
    assert now(timeline) is before


def test_resolve_frees_the_motion_in_one_step_and_keeps_the_rest_to_the_bit(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    checked(qtbot, timeline)
    before = now(timeline)
    colliding = timeline.checks.deepest > 0.0
    timeline.go_to(24)
    timeline.resolve()
    qtbot.waitUntil(lambda: not document.tasks.solving_motion)
    after = now(timeline)
    assert document.model.exact_check().are_free(after.codes).all()
    assert document.history.undo_stack.count() == 1
    spans = np.zeros(N_FRAMES, dtype=np.bool_)
    easing = before.in_frames(MotionOptions().easing)
    for span in colliding_spans(colliding, easing, is_cycle=before.is_cycle):
        spans[np.arange(span.start, span.stop) % N_FRAMES] = True
    assert (after.codes != before.codes).any(axis=1)[colliding].all()
    assert after.codes[~spans].tobytes() == before.codes[~spans].tobytes()
    assert document.history.latent.tobytes() == after.codes[24].tobytes()
    checked(qtbot, timeline)
    assert not timeline.checks.deepest.any()
    document.history.undo()
    assert now(timeline) is before


@pytest.mark.slow
def test_a_resolve_right_after_an_edit_is_not_spoilt_by_its_easing(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    document.motion.set_solid(True)
    checked(qtbot, timeline)
    first = int(np.flatnonzero(timeline.checks.deepest > 0.0)[0])
    timeline.set_easing(3)
    timeline.go_to(first - 4)
    codes = now(timeline).codes
    aim = codes[first - 4] + 4.0 * (codes[first] - codes[first - 4])
    document.motion.edit("Move the arm", aim)
    qtbot.waitUntil(lambda: not document.motion.moving)
    document.history.close_gesture()
    assert document.tasks.busy == "Easing the edit"
    timeline.resolve()
    qtbot.waitUntil(lambda: not document.tasks.busy)
    assert document.model.exact_check().are_free(now(timeline).codes).all()
    assert document.history.undo_stack.undoText() == "Resolve motion"


def test_an_edit_stops_a_resolve_of_the_motion_before_it(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    document.motion.set_solid(False)
    timeline.go_to(20)
    timeline.resolve()
    with qtbot.waitSignal(document.message) as told:
        document.motion.set_code(10, float(document.history.latent[10]) + 0.3)
    assert told.args == ["Resolve was stopped: the motion has changed"]
    assert not document.tasks.solving_motion
    qtbot.waitUntil(lambda: not document.tasks.busy)
    assert document.history.undo_stack.count() == 1


@pytest.mark.slow
def test_a_body_part_with_a_pin_stays_where_the_motion_has_it(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    before, space = now(timeline), document.model.space
    inside = space.vertex_domain == document.model.domain_names.index("Head")
    timeline.go_to(24)
    qtbot.waitUntil(lambda: document.motion.frame is not None)
    document.pins.pin([make_grip(space, int(np.flatnonzero(inside)[0]))])
    assert document.history.pose.pins
    timeline.resolve()
    qtbot.waitUntil(lambda: not document.tasks.solving_motion)
    old, new = (
        document.model.decode(motion.codes)[:, inside] / document.model.body_size
        for motion in (before, now(timeline))
    )
    assert 0.0 < np.abs(new - old).max() < 2e-3


def test_only_the_chosen_range_is_resolved(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    before = now(timeline)
    colliding = np.flatnonzero(~document.model.exact_check().are_free(before.codes))
    chosen = range(int(colliding[0]), int(colliding[3]) + 1)
    timeline.set_range(chosen.stop - 1, chosen.start)
    assert (timeline.first, timeline.last) == (chosen.start, chosen.stop - 1)
    timeline.resolve(chosen)
    qtbot.waitUntil(lambda: not document.tasks.solving_motion)
    changed = np.flatnonzero((now(timeline).codes != before.codes).any(axis=1))
    assert len(changed)
    assert set(changed.tolist()) <= set(chosen)
    free = document.model.exact_check().are_free(now(timeline).codes)
    assert free[chosen.start : chosen.stop].all()
    assert not free[colliding[5]]


def test_playing_shows_frames_in_order_and_counts_what_it_leaves_out(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    shown: list[int] = []
    document.history.moment_changed.connect(lambda: shown.append(timeline.frame or 0))
    timeline.playback.set_loops(False)
    timeline.play()
    assert timeline.playing
    qtbot.waitUntil(lambda: not timeline.playing)
    assert timeline.frame == N_FRAMES - 1
    assert shown == sorted(shown)
    steps = np.diff(shown)
    left_out = int((steps[steps > 0] - 1).sum())
    # The last frame comes at the end, however many frames were skipped before.
    assert timeline.playback.n_dropped <= left_out
    assert timeline.playback.n_dropped >= left_out - int(steps[-1])
    assert document.history.undo_stack.count() == 0


def test_playing_goes_round_between_in_and_out_point(qtbot: QtBot, timeline: Timeline) -> None:
    timeline.set_range(10, 14)
    shown: list[int] = []
    timeline.moved.connect(lambda: shown.append(timeline.frame or 0))
    timeline.play()
    qtbot.waitUntil(lambda: shown.count(10) >= 3)
    timeline.toggle_playing()
    assert not timeline.playing
    assert set(shown) <= set(range(10, 15))


def test_the_motion_as_it_was_is_shown_beside_and_instead(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    document.motion.set_solid(False)
    timeline.go_to(20)
    document.motion.set_code(10, float(document.history.latent[10]) + 0.3)
    original = timeline.original
    assert original is not None
    timeline.go_to(21)
    was = document.model.decode(original.codes[21]).astype(np.float32)
    # The previous frame's ghost may come first.
    qtbot.waitUntil(lambda: np.array_equal(document.history.ghost, was))
    timeline.compare(True)
    assert document.motion.frame is not None
    np.testing.assert_array_equal(document.motion.frame.vertices, was)
    # A frame that is not computed yet is shown as soon as it is ready.
    timeline.compare(False)
    document.history.show_ghost(False)
    timeline.go_to(22)
    timeline.compare(True)
    then = document.model.decode(original.codes[22]).astype(np.float32)
    qtbot.waitUntil(
        lambda: (
            document.motion.frame is not None
            and np.array_equal(document.motion.frame.vertices, then)
        )
    )
    timeline.go_to(21)
    timeline.compare(True)
    assert document.history.latent.tobytes() == now(timeline).codes[21].tobytes()
    timeline.compare(False)
    qtbot.waitUntil(
        lambda: (
            document.motion.frame is not None
            and document.motion.frame.latent is document.history.latent
        )
    )


def test_a_frame_of_the_pose_that_comes_late_does_not_take_the_place_of_what_is_shown(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    motion = document.motion

    def shows_pose() -> bool:
        return motion.frame is not None and motion.frame.latent is document.history.latent

    motion.set_solid(False)
    timeline.go_to(20)
    qtbot.waitUntil(shows_pose)
    another = motion.frame
    assert another is not None
    motion.set_code(10, float(document.history.latent[10]) + 0.3)
    motion.show_instead(another)
    # Measuring the pose does not replace the verdict either.
    qtbot.waitUntil(lambda: motion.is_measured)
    assert motion.frame is another
    assert motion.exact is not None
    expected = document.model.detector.detect(another.vertices)
    assert np.array_equal(motion.exact.pairs, expected.pairs)
    motion.show_own()
    assert (motion.exact, motion.is_measured) == (None, False)
    qtbot.waitUntil(shows_pose)
    qtbot.waitUntil(lambda: motion.exact is not None)


def test_frames_round_the_playhead_show_through(qtbot: QtBot, timeline: Timeline) -> None:
    timeline.set_onion(Onion(count=2, step=3))
    timeline.go_to(4)
    qtbot.waitUntil(lambda: len(timeline.onion_frames()) == 3)
    # The second frame before the playhead would be before the motion.
    assert sorted(by for by, _ in timeline.onion_frames()) == [-3, 3, 6]
    timeline.go_to(20)
    qtbot.waitUntil(lambda: len(timeline.onion_frames()) == 4)
    for by, frame in timeline.onion_frames():
        assert frame.latent.tobytes() == now(timeline).codes[20 + by].tobytes()


def test_the_path_of_a_point_goes_through_its_places(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    timeline.set_range(5, 30)
    timeline.set_trail(3)
    qtbot.waitUntil(lambda: timeline.trail_points is not None)
    assert timeline.trail_points is not None
    expected = document.model.decode(now(timeline).codes[5:31])[:, 3]
    np.testing.assert_allclose(timeline.trail_points, expected, atol=1e-12)
    timeline.set_trail(None)
    assert timeline.trail_points is None


def test_a_path_that_is_drawn_does_not_stop_the_reading_of_a_clip(
    qtbot: QtBot, timeline: Timeline
) -> None:
    timeline.choose(OTHER)
    timeline.set_trail(3)
    qtbot.waitUntil(lambda: now(timeline).name == OTHER)


def test_a_resolve_that_is_cancelled_leaves_no_span_behind(
    document: PoseDocument, timeline: Timeline
) -> None:
    before = now(timeline)
    timeline.go_to(2)
    timeline.resolve()
    # As the worker marks frames that it has freed.
    timeline.resolving._solved[3:6] = True
    assert range(3, 6) in timeline.resolving.spans
    document.tasks.cancel_all()
    assert not document.tasks.solving_motion
    assert timeline.resolving.spans == ()
    assert now(timeline) is before


def test_another_clip_and_another_file_take_its_place(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline, walk: Path
) -> None:
    timeline.go_to(5)
    timeline.choose(OTHER)
    qtbot.waitUntil(lambda: now(timeline).name == OTHER)
    assert timeline.frame == 0
    assert document.history.pose.name == f"{OTHER} 0"
    timeline.open(walk)
    qtbot.waitUntil(lambda: now(timeline).name == "walk")
    assert len(now(timeline)) == 6
    assert list(timeline.motions) == ["walk"]


def test_an_edit_of_one_clip_lasts_while_another_is_looked_at(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    document.motion.set_solid(False)
    timeline.go_to(20)
    read = now(timeline)
    document.motion.set_code(10, float(document.history.latent[10]) + 0.3)
    edited = now(timeline)
    timeline.choose(OTHER)
    qtbot.waitUntil(lambda: now(timeline).name == OTHER)
    assert timeline.changes == [(read, edited)]
    assert document.history.modified
    timeline.choose(CLIP)
    assert now(timeline) is edited
    assert timeline.original is read
    timeline.mark_saved([edited])
    assert not document.history.modified


def test_the_clip_that_was_chosen_last_comes_and_an_edit_that_goes_on_stays_with_its_own(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    document.motion.set_solid(False)
    timeline.go_to(20)
    read, came = now(timeline), []
    timeline.choose(OTHER)
    timeline.choose(CLIP)
    timeline.opened.connect(lambda: came.append(now(timeline).name))
    done: list[object] = []
    # Jobs run in order: by now the other clip would have arrived.
    timeline._reading.start("Waiting", lambda *_: 1, done.append)
    qtbot.waitUntil(lambda: bool(done))
    assert came == []
    timeline.go_to(20)
    document.history.open_gesture("Drag")
    document.motion.set_code(10, float(document.history.latent[10]) + 0.3)
    timeline.choose(OTHER)
    qtbot.waitUntil(lambda: now(timeline).name == OTHER)
    ((was, edited),) = timeline.changes
    assert was is read
    assert (edited.codes[20] != read.codes[20]).any()


def test_a_clip_that_comes_ends_no_edit_of_a_pose_that_is_none_of_its_frames(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    document.motion.set_solid(False)
    gesture = document.history.open_gesture("Drag")
    document.motion.set_code(8, 0.4)
    timeline.choose(OTHER)
    qtbot.waitUntil(lambda: now(timeline).name == OTHER)
    assert document.history.gesture is gesture
    document.motion.set_code(8, 0.5)
    document.history.close_gesture()
    assert document.history.undo_stack.count() == 1
    assert document.history.latent[8] == 0.5


def test_a_clip_that_comes_late_is_not_put_among_another_files_motions(
    qtbot: QtBot, timeline: Timeline, walk: Path
) -> None:
    held = Event()
    timeline._reading.start("Waiting", lambda *_: held.wait(PATIENCE / 1000), lambda _: None)
    timeline.choose(OTHER)
    timeline.open(walk)
    qtbot.waitUntil(lambda: now(timeline).name == "walk")
    held.set()
    done: list[object] = []
    timeline._reading.start("Waiting", lambda *_: 1, done.append)
    qtbot.waitUntil(lambda: bool(done))
    assert list(timeline.motions) == ["walk"]
    assert now(timeline).name == "walk"


def test_edits_that_were_made_while_a_motion_was_read_are_asked_about(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline, walk: Path
) -> None:
    document.motion.set_solid(False)
    timeline.go_to(20)
    asked: list[str] = []
    document.tasks.may_replace = lambda: bool(asked.append(document.tasks.busy))
    timeline.open(walk)
    document.motion.set_code(10, float(document.history.latent[10]) + 0.3)
    edited = now(timeline)
    qtbot.waitUntil(lambda: bool(asked))
    qtbot.waitUntil(lambda: not document.tasks.busy)
    assert now(timeline) is edited
    assert list(timeline.motions) == [CLIP, OTHER]


def test_a_file_that_is_no_motion_is_refused_and_nothing_changes(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline, tmp_path: Path
) -> None:
    before = now(timeline)
    (tmp_path / "broken.pc2").write_bytes(b"POINTCACHE2")
    with qtbot.waitSignal(document.failed, timeout=PATIENCE) as told:
        timeline.open(tmp_path / "broken.pc2")
    assert "broken" in told.args[0].headline
    assert now(timeline) is before


def test_a_body_without_a_motion_has_an_empty_timeline(document: PoseDocument) -> None:
    timeline = document.timeline
    assert timeline.motion is None
    assert timeline.motions == {}
    timeline.go_to(3)
    timeline.play()
    assert not timeline.playing
    assert timeline.frame is None


def test_the_body_of_the_file_is_the_one_that_moves(swing: Path, timeline: Timeline) -> None:
    assert open_body(swing).fingerprint == timeline._history.model.fingerprint


def test_pins_stay_on_their_patches_as_the_playhead_moves(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    space, motion = document.model.space, now(timeline)
    hand = np.flatnonzero(space.vertex_domain == document.model.domain_names.index("Left hand"))
    grip = make_grip(space, int(hand[0]))

    def place(number: int) -> tuple[float, ...]:
        decoded = document.model.decode(motion.codes[number]).astype(np.float32)
        return tuple(grip.position(decoded).tolist())

    timeline.go_to(4)
    qtbot.waitUntil(lambda: document.motion.frame is not None)
    document.pins.pin([grip], oriented=True)
    (there,) = document.history.pose.pins
    assert there.position == place(4)
    # Go to frames that are not computed yet, then to computed ones.
    for number in (24, 40, 24, 4):
        timeline.go_to(number)
        (pin,) = document.history.pose.pins
        assert (pin.vertex, pin.radius) == (there.vertex, there.radius)
        assert pin.position == place(number)
        assert [vertex for vertex, _ in pin.frame] == [vertex for vertex, _ in there.frame]
        qtbot.waitUntil(lambda: bool(document.motion.exact is not None))
    assert place(24) != place(4)
    assert document.history.pose.pins == (there,)
    timeline.play()
    qtbot.waitUntil(lambda: (timeline.frame or 0) > 8)
    timeline.pause()
    assert document.history.pose.pins[0].position == place(timeline.frame or 0)
    # A pin is one undo step wherever the playhead has gone, and does not edit the motion.
    assert document.history.undo_stack.count() == 1
    assert not document.history.modified
    timeline.choose(OTHER)
    qtbot.waitUntil(lambda: now(timeline).name == OTHER)
    assert [pin.vertex for pin in document.history.pose.pins] == [there.vertex]


def test_a_resolve_of_the_frame_leaves_a_pinned_part_where_it_is(
    qtbot: QtBot, document: PoseDocument, timeline: Timeline
) -> None:
    timeline.go_to(16)
    qtbot.waitUntil(lambda: document.motion.frame is not None)
    space, before = document.model.space, document.model.decode(document.history.latent)

    def moved() -> npt.NDArray[np.float64]:
        """Resolve the frame and undo it; return how far each body part was moved."""
        with qtbot.waitSignal(document.tasks.solve_finished, timeout=PATIENCE):
            document.tasks.resolve()
        assert document.model.exact_check().is_free(document.history.latent)
        away = np.linalg.norm(document.model.decode(document.history.latent) - before, axis=1)
        document.history.undo()
        return np.array([away[space.vertex_domain == k].max() for k in range(space.n_domains)])

    trunk = document.model.domain_names.index("Torso")
    assert moved()[trunk] > 0.01
    inside = np.flatnonzero(space.vertex_domain == trunk)
    document.pins.pin([make_grip(space, int(inside[0]))])
    assert moved()[trunk] < 0.001


@pytest.fixture
def bumpy(document: PoseDocument, tmp_path: Path) -> tuple[Path, npt.NDArray[np.float32]]:
    """Return a file of displaced frames with detail that codes do not represent, and the frames."""
    from lcollision_core.files import PoseSet, write_pose_set

    model = document.model
    frames = model.decode(model.known_poses[:5])
    frames += 0.004 * model.body_size * np.random.default_rng(3).normal(size=frames.shape)
    turn = Rotation.from_rotvec([0.2, 1.1, -0.4]).as_matrix()
    frames = (frames @ turn.T + [3.0, -1.0, 2.0]).astype(np.float32)
    names = tuple(f"frame {number}" for number in range(len(frames)))
    write_pose_set(tmp_path / "bumpy.npz", PoseSet(frames, model.topology, names))
    return tmp_path / "bumpy.npz", frames


def test_what_codes_do_not_hold_of_a_frame_is_drawn_checked_and_dragged(
    qtbot: QtBot,
    document: PoseDocument,
    bumpy: tuple[Path, npt.NDArray[np.float32]],
    tmp_path: Path,
) -> None:
    path, frames = bumpy
    timeline, model = document.timeline, document.model
    size = model.body_size
    timeline.open(path)
    qtbot.waitUntil(lambda: timeline.motion is not None)
    motion = now(timeline)

    def home(number: int) -> npt.NDArray[np.float64]:
        placement = motion.placement(number)
        assert placement is not None
        return placement.inverse().apply(frames[number])

    def drawn() -> npt.NDArray[np.float32]:
        qtbot.waitUntil(
            lambda: (
                document.motion.frame is not None
                and document.motion.frame.latent.tobytes() == document.history.latent.tobytes()
                and document.motion.exact is not None
            )
        )
        assert document.motion.frame is not None
        return document.motion.frame.vertices

    far = np.abs(model.decode(motion.codes[2]) - home(2)).max()
    assert far > 0.004 * size
    timeline.set_onion(Onion(count=1, step=1))
    for number in (0, 2, 3, 2):
        timeline.go_to(number)
        np.testing.assert_allclose(drawn(), home(number), atol=2e-6 * size)
        exact, found = document.motion.exact, model.detector.detect(home(number))
        assert exact is not None
        assert len(exact.pairs) == len(found.pairs)
    state = document.history.state
    assert state.moment is not None
    write = partial(exporting.export, own=state.moment.space)
    obj, asked = tmp_path / "frame.obj", ExportRequest()
    write(model, state.pose, None, obj, asked)
    np.testing.assert_allclose(read_mesh(obj).vertices, frames[2], atol=2e-6 * size)
    qtbot.waitUntil(lambda: len(timeline.onion_frames()) == 2)
    for by, skin in timeline.onion_frames():
        np.testing.assert_allclose(skin.vertices, home(2 + by), atol=2e-6 * size)
    timeline.set_trail(40)
    qtbot.waitUntil(lambda: timeline.trail_points is not None)
    assert timeline.trail_points is not None
    places = [home(number)[40] for number in range(len(frames))]
    np.testing.assert_allclose(timeline.trail_points, places, atol=2e-6 * size)
    timeline.set_trail(None)
    # A drag moves the drawn mesh: the patch moves from its drawn position to the pointer.
    document.motion.set_solid(False)
    grip = document.motion.grip_at(40)
    seen = grip.position(drawn())
    aim = seen + 0.03 * size * np.array([1.0, 0.0, 0.0])
    document.motion.begin_drag(grip, "Drag")
    document.motion.drag_to(aim)
    document.motion.end_drag()
    qtbot.waitUntil(lambda: not document.motion.moving and document.history.gesture is None)
    vertices, latent = drawn(), document.history.latent
    assert np.linalg.norm(grip.position(vertices) - aim) < 0.01 * size
    kept = vertices - model.decode(latent)
    np.testing.assert_allclose(kept, home(2) - model.decode(motion.codes[2]), atol=3e-6 * size)
    assert document.history.pose.placement == motion.placement(2)
    # As exported to the motion's file.
    edited, check = now(timeline), model.exact_check()
    np.testing.assert_allclose(edited.drawn(2, check), vertices, atol=2e-6 * size)
    place = edited.placement(2)
    assert place is not None
    np.testing.assert_allclose(
        place.inverse().apply(edited.vertices(2, check)), vertices, atol=2e-6 * size
    )
    document.pins.pin([grip])
    np.testing.assert_allclose(document.history.pose.pins[0].position, grip.position(vertices))


def test_a_pose_that_takes_the_place_of_a_frame_lies_where_the_motion_does(
    qtbot: QtBot, document: PoseDocument, bumpy: tuple[Path, npt.NDArray[np.float32]]
) -> None:
    timeline = document.timeline
    timeline.open(bumpy[0])
    qtbot.waitUntil(lambda: timeline.motion is not None)
    motion = now(timeline)
    document.motion.set_solid(False)
    timeline.go_to(2)
    document.history.load_pose(NamedPose("mine", document.model.known_poses[1] * 0.5))
    assert now(timeline) is not motion
    assert motion.placement(2) is not None
    assert document.history.pose.placement == motion.placement(2)
