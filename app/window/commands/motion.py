"""The Motion menu: playback, the playhead, Resolve of frames, onion skin and motion path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from PySide6.QtCore import Qt

from app.view.shading import Shading
from app.window.command import EditorWindow, Menu, called, greyed, in_view, ticked, unless
from app.window.dialogs.joints import JointsDialog

if TYPE_CHECKING:
    from app.editing.timeline import Timeline

MOTION = Menu("&Motion")

_NO_MOTION = "Open a character with a clip, or a motion, first"


def _timeline(window: EditorWindow) -> Timeline:
    return window.document.timeline


_with_motion = unless(lambda window: _timeline(window).motion is not None, _NO_MOTION)
_on_frame = unless(
    lambda window: _timeline(window).frame is not None, "Go to a frame of the timeline first"
)


def _why_not_resolved(window: EditorWindow) -> str:
    document = window.document
    if document.timeline.motion is None:
        return _NO_MOTION
    if not document.model.can_resolve:
        return "This model has no predictor to resolve with"
    return "Wait for Resolve to finish" if document.tasks.solving_motion else ""


def _why_not_filmed(window: EditorWindow) -> str:
    if window.document.timeline.motion is None:
        return _NO_MOTION
    by_frame = (Shading.EXACT, Shading.PREDICTED, Shading.MOVEMENT)
    if window.viewport.shading not in by_frame:
        return ""
    return "Choose a shading that is the same in all frames: plain, body parts or textured"


@MOTION.command(
    "open_motion", "&Open motion…", "Ctrl+Alt+O", "Open a motion of this body on the timeline"
)
def _open(window: EditorWindow) -> None:
    path = window.files.ask_open("Open motion", "motion")
    if path is not None:
        window.files.open_motion(path)


@MOTION.command(
    "export_timeline", "&Export motion…", "Ctrl+Alt+T", "Save the motion on the timeline", "export"
)
@_with_motion
def _export(window: EditorWindow) -> None:
    window.files.export_motion()


@MOTION.command(
    "video", "Save &video…", "Ctrl+Alt+V", "Save the motion as a GIF, a WebP or numbered images"
)
@greyed(_why_not_filmed)
def _film(window: EditorWindow) -> None:
    window.files.video()


def choose_joints(window: EditorWindow) -> None:
    """Show the dialog that matches the joints of the motion and the body."""
    timeline = _timeline(window)
    match, file = timeline.joints, timeline.joints_of
    if match is None or file is None:
        return
    dialog = JointsDialog(match, file.name, window.document.model.name, window)
    dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
    dialog.chosen.connect(lambda followed: window.attempt(lambda: timeline.choose_joints(followed)))
    window.document.model_changed.connect(dialog.reject)
    dialog.open()


@MOTION.command(
    "motion_joints",
    "&Joints of the motion…",
    "Ctrl+Alt+J",
    "Choose which joint of the motion's skeleton each joint of the body follows",
)
@unless(
    lambda window: _timeline(window).joints is not None,
    "Open a motion of another skeleton first",
)
def _joints(window: EditorWindow) -> None:
    choose_joints(window)


MOTION.line()


@MOTION.command("play", "&Play", "Space", "Play the motion from the playhead", "play")
@_with_motion
@in_view
@called(lambda window: "&Pause" if _timeline(window).playing else "&Play")
def _play(window: EditorWindow) -> None:
    _timeline(window).toggle_playing()


@MOTION.command("loop", "&Loop", "L", "Begin again at the in point when playing", "loop")
@in_view
@ticked(lambda window: _timeline(window).playback.loops)
def _loop(window: EditorWindow) -> None:
    playback = _timeline(window).playback
    playback.set_loops(not playback.loops)


def _go(
    go: Callable[[Timeline], None], key: str, text: str, keys: str, tip: str, icon: str = ""
) -> None:
    """Add a command that moves the playhead."""
    run = _with_motion(in_view(lambda window: go(_timeline(window))))
    MOTION.command(key, text, keys, tip, icon)(run)


_go(
    lambda t: t.step(-1),
    "step_back",
    "Previous fra&me",
    "Left",
    "Go to the previous frame",
    "step-back",
)
_go(lambda t: t.step(1), "step_on", "&Next frame", "Right", "Go to the next frame", "step-on")
_go(lambda t: t.go_to(t.first), "go_first", "&First frame", "Home", "Go to the in point")
_go(lambda t: t.go_to(t.last), "go_last", "L&ast frame", "End", "Go to the out point")
_go(
    lambda t: t.go_to_colliding(-1),
    *("colliding_before", "Previous collidin&g frame", "Shift+N"),
    *("Go to the previous colliding frame", "colliding-before"),
)
_go(
    lambda t: t.go_to_colliding(1),
    *("colliding_next", "Next &colliding frame", "N"),
    *("Go to the next frame that collides", "colliding-next"),
)
_go(
    lambda t: t.go_to_worst(),
    *("go_worst", "&Deepest overlap", "Shift+D", "Go to the frame with the deepest overlap"),
)

MOTION.line()


@MOTION.command("in_point", "Set &in point", "I", "Begin at the playhead", "in-point")
@_on_frame
@in_view
def _set_in(window: EditorWindow) -> None:
    timeline = _timeline(window)
    timeline.set_range(timeline.frame or 0, max(timeline.last, timeline.frame or 0))


@MOTION.command("out_point", "Set o&ut point", "O", "End at the playhead", "out-point")
@_on_frame
@in_view
def _set_out(window: EditorWindow) -> None:
    timeline = _timeline(window)
    timeline.set_range(min(timeline.first, timeline.frame or 0), timeline.frame or 0)


@MOTION.command("whole_range", "&Whole motion", "Ctrl+Alt+A", "Set in and out points to the ends")
@_with_motion
def _set_whole(window: EditorWindow) -> None:
    timeline = _timeline(window)
    if timeline.motion is not None:
        timeline.set_range(0, len(timeline.motion) - 1)


MOTION.line()


@MOTION.command(
    "resolve_motion",
    "&Resolve motion",
    "Ctrl+Alt+R",
    "Resolve all colliding frames and keep the motion smooth",
    "resolve",
)
@greyed(_why_not_resolved)
def _resolve(window: EditorWindow) -> None:
    _timeline(window).resolve()


@MOTION.command(
    "resolve_range",
    "Resolve from in to ou&t point",
    "Ctrl+Alt+Shift+R",
    "Resolve the frames from the in point to the out point",
)
@greyed(_why_not_resolved)
def _resolve_range(window: EditorWindow) -> None:
    timeline = _timeline(window)
    timeline.resolve(range(timeline.first, timeline.last + 1))


MOTION.line()


@MOTION.command(
    "compare", "Show as it &was", "B", "Show the frame as the motion was read", "compare"
)
@_on_frame
@in_view
@ticked(lambda window: _timeline(window).comparing)
def _compare(window: EditorWindow) -> None:
    timeline = _timeline(window)
    timeline.compare(not timeline.comparing)


@MOTION.command(
    "follow", "Follow the bod&y", "F", "Keep the body in the view while the playhead moves"
)
@in_view
@ticked(lambda window: window.viewport.follows)
def _follow(window: EditorWindow) -> None:
    follows = window.viewport.follows = not window.viewport.follows
    window.settings["camera_follows"] = follows


_ONIONS = MOTION.choices("Onion s&kin")


def _onion(count: int, text: str, tip: str) -> None:
    @_ONIONS.command(f"onion_{count}", text, f"Alt+Shift+{count}", tip)
    @ticked(lambda window: _timeline(window).onion.count == count)
    def choose(window: EditorWindow) -> None:
        timeline = _timeline(window)
        timeline.set_onion(replace(timeline.onion, count=count))


_onion(0, "&None", "Show the frame alone")
_onion(1, "&1 frame each way", "Show one frame before and after the playhead")
_onion(2, "&2 frames each way", "Show two frames before and after the playhead")
_onion(4, "&4 frames each way", "Show four frames before and after the playhead")

_STEPS = MOTION.choices("Onion skin &step")


def _step(step: int) -> None:
    tip = "Spacing of the onion skin frames"
    text = f"Every &{step} frames" if step > 1 else "&Every frame"

    @_STEPS.command(f"skin_step_{step}", text, f"Ctrl+Shift+{step}", tip)
    @ticked(lambda window: _timeline(window).onion.step == step)
    def choose(window: EditorWindow) -> None:
        timeline = _timeline(window)
        timeline.set_onion(replace(timeline.onion, step=step))


for _frames in (1, 2, 4, 8):
    _step(_frames)


@MOTION.command("trail", "Motion &path", "T", "Show the motion path of the patch under the pointer")
@_with_motion
@ticked(lambda window: _timeline(window).trail is not None)
def _trail(window: EditorWindow) -> None:
    timeline, vertex = _timeline(window), window.viewport.pointed_vertex
    if timeline.trail is not None:
        timeline.set_trail(None)
    elif vertex is not None:
        timeline.set_trail(vertex)
    else:
        window.document.message.emit("Point at the body first")
