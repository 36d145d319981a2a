"""The timeline: the open motion, its playback and its resolving."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Qt, QTimer, Signal, Slot

from app.editing.history import DocumentState, Moment
from app.editing.motion_resolve import MotionResolve
from app.editing.tasks import Work
from app.work.frames import FrameCache, Onion
from app.work.motion_checks import MotionChecks, check_motion, path_of_vertex
from app.work.preparing import open_motions_to_show
from app.work.threads import LongWork
from lcollision_core.errors import LCollisionError
from lcollision_core.tasks.editing import free_neighbours
from lcollision_core.tasks.opening import OpenedModel, own_motions, read_motions
from lcollision_core.tasks.words import counted, joined, say, with_capital

if TYPE_CHECKING:
    from app.editing.history import PoseHistory
    from app.editing.live_pose import PoseMotion
    from app.editing.tasks import Tasks
    from app.work.frames import PoseFrame
    from lcollision_core.bodies.partners import JointMap, JointMatch
    from lcollision_core.files import FileStamp
    from lcollision_core.motion import Motion, ResolvedMotion
    from lcollision_core.motion.frames import KeptSpan
    from lcollision_core.options import MotionOptions
    from lcollision_core.tasks.opening import OpenedMotions


_RATE_SECONDS = 1.0
"""Interval over which the achieved frame rate is measured."""


class Playback(QObject):
    """Signals which frame of a motion is due, by the wall clock.

    Attributes
    ----------
    loops : whether it starts again after the last frame
    speed : 1 for the motion's own rate
    n_dropped : frames skipped since the start because they were not ready in time
    rate : frames shown per second

    Signals
    -------
    due : int, the frame that is due
    changed : playback has started or stopped, or its options have changed
    """

    due = Signal(int)
    changed = Signal()

    def __init__(self, parent: QObject) -> None:
        super().__init__(parent)
        self.loops, self.speed = True, 1.0
        self.n_dropped, self.rate = 0, 0.0
        self._motion: Motion | None = None
        self._first = self._last = self._from = self._shown = 0
        self._began = 0.0
        self._times: list[float] = []
        self._tick = QTimer(self, timerType=Qt.TimerType.PreciseTimer)
        self._tick.timeout.connect(self._on_tick)

    @property
    def playing(self) -> bool:
        """Whether playback is running."""
        return self._tick.isActive()

    def play(self, motion: Motion, start: int, first: int, last: int) -> None:
        """Play from frame `start`, within the range from `first` to `last`."""
        self._motion, self._first, self._last = motion, first, last
        self.n_dropped, self.rate, self._times = 0, 0.0, []
        self._begin(start)
        # Two ticks a frame, so that no frame is late by more than half of one.
        self._tick.start(max(1, int(500.0 / (motion.rate * self.speed))))
        self.changed.emit()

    def pause(self) -> None:
        """Stop the clock."""
        if self.playing:
            self._tick.stop()
            self.changed.emit()

    def set_speed(self, speed: float) -> None:
        """Play at `speed` times the motion's own rate, from the current frame."""
        self.speed = speed
        if self.playing and self._motion is not None:
            self.play(self._motion, self._shown, self._first, self._last)
        self.changed.emit()

    def set_loops(self, loops: bool) -> None:
        """Set whether playback starts again after the last frame."""
        self.loops = loops
        self.changed.emit()

    def note_shown(self, frame: int) -> None:
        """Count a shown frame, and the frames skipped before it."""
        self.n_dropped += max(0, frame - self._shown - 1)
        self._shown = frame
        now = time.perf_counter()
        self._times = [at for at in self._times if now - at < _RATE_SECONDS] + [now]
        if len(self._times) > 1:
            self.rate = (len(self._times) - 1) / (self._times[-1] - self._times[0])

    def _begin(self, start: int) -> None:
        self._began, self._from, self._shown = time.perf_counter(), start, start

    @Slot()
    def _on_tick(self) -> None:
        assert self._motion is not None
        times = self._motion.times
        now = times[self._from] + (time.perf_counter() - self._began) * self.speed
        frame = int(np.searchsorted(times, now, "right")) - 1
        if now > times[self._last]:
            if not self.loops:
                self.pause()
                self.due.emit(self._last)
                return
            # The last frame of a cycle equals its first.
            self._begin(self._first)
            frame = self._first
        elif frame == self._shown:
            return
        self.due.emit(frame)


@dataclass(frozen=True, eq=False)
class EditedMotions:
    """Motions of one file with changed frames.

    Attributes
    ----------
    file : that they were read from
    stamp : of the file at that time, None if it did not exist
    open : the name of the motion on the timeline
    frame : the playhead
    read, edited : as read, and as edited; by the same names
    saved : names of the motions exported since their last edit
    """

    file: Path
    stamp: FileStamp | None
    open: str
    frame: int
    read: Mapping[str, Motion]
    edited: Mapping[str, Motion]
    saved: frozenset[str]


AHEAD = 24
"""Frames computed ahead of the playhead during playback."""

EASING = 12
"""Default number of frames, at 30 per second, over which an edit by hand eases in and out."""

_CLIP, _TRAIL = "clip", "trail"
"""Kinds of reading jobs."""

_STOPPED = "Resolve was stopped: the motion has changed"


class Timeline(QObject):
    """The motions of a body: the open one, its playhead and its edits.

    Once the user has gone to a frame, the working pose is the frame at the playhead. An edit of
    the pose eases in and out over the surrounding frames, in one undo step; a Resolve of the
    motion is one undo step too. One thread computes frames ahead, another checks all of them
    exactly.

    Parameters
    ----------
    history, pose_motion, tasks : of the same document

    Attributes
    ----------
    motions : by name, as read: the clips of a character's file, or those of an opened file; a
        clip that was not read yet is None
    original : the open motion as read; None without one
    file, file_stamp : the file that the motions were read from, and its stamp at that time
    joints, joints_of : how the joints of another skeleton's motions match, and their file; None
        for motions of the body itself
    checks, original_checks : results for the frames of the motion, and of the motion as read
    first, last : the in and out points
    playback : the playback clock
    easing : frames, at 30 per second, over which an edit by hand eases in and out
    onion : the onion skin frames
    trail : the vertex whose path is drawn; None for none
    comparing : whether the motion is shown as read
    resolving : the Resolve of the motion

    Signals
    -------
    opened : another motion, or none, is on the timeline
    arrived : a requested file's motions are open, and the first frame is shown
    joints_unsure : the user should match the joints
    moved : the playhead, or the motion at it, has changed
    checked : `checks` has new results
    range_changed, options_changed, onion_changed, trail_changed : new values
    message : str, one sentence for the status bar
    failed : Failure
    """

    opened = Signal()
    arrived = Signal()
    joints_unsure = Signal()
    moved = Signal()
    checked = Signal()
    range_changed = Signal()
    options_changed = Signal()
    onion_changed = Signal()
    trail_changed = Signal()
    message = Signal(str)
    failed = Signal(object)

    def __init__(self, history: PoseHistory, pose_motion: PoseMotion, tasks: Tasks) -> None:
        super().__init__(history)
        self._history, self._pose, self._tasks = history, pose_motion, tasks
        self.motions: dict[str, Motion | None] = {}
        self._edited: dict[str, Motion] = {}
        self._saved: dict[str, Motion] = {}
        self.original: Motion | None = None
        self.file: Path | None = None
        self.file_stamp: FileStamp | None = None
        self.joints: JointMatch | None = None
        self.joints_of: Path | None = None
        self.checks = self.original_checks = MotionChecks.of(0, 0)
        self.first = self.last = 0
        self.easing = EASING
        self.onion = Onion()
        self.trail: int | None = None
        self.trail_points: npt.NDArray[np.float64] | None = None
        self.comparing = self._waits = False
        self._motion: Motion | None = None
        self.resolving = MotionResolve(self, tasks)
        self._kept: tuple[Motion | None, dict[KeptSpan, str]] = (None, {})
        self._edit: tuple[Motion, Motion] | None = None
        self._cache = FrameCache(self)
        self._cache.ready.connect(self._on_ready)
        self._cache.failed.connect(self.failed)
        self._checking = LongWork(self, "checking frames")
        self._checking.progressed.connect(self.checked)
        self._checking.failed.connect(self.failed)
        self._reading = LongWork(self, "reading motions")
        self._reading.failed.connect(self.failed)
        # The timeline keeps its motion; views return to it.
        self._reading.failed.connect(self.opened)
        self.playback = Playback(self)
        self.playback.due.connect(self._on_due)
        self.playback.changed.connect(self._on_playback)
        history.moment_changed.connect(self._on_moment)
        history.motions = self
        tasks.progressed.connect(self.checked)
        tasks.busy_changed.connect(self._on_busy)

    # The open motion.

    @property
    def motion(self) -> Motion | None:
        """The open motion in its current version."""
        now = self._history.state.motion if self._history.has_model else None
        return now or self._motion

    @property
    def frame(self) -> int | None:
        """The playhead; None while the working pose is not a frame of the motion."""
        moment = self._history.state.moment if self._history.has_model else None
        return None if moment is None else moment.frame

    @property
    def playing(self) -> bool:
        """Whether the motion plays."""
        return self.playback.playing

    @property
    def is_reading(self) -> bool:
        """Whether the motion that was chosen is being read."""
        return bool(self._reading.labels(_CLIP))

    @property
    def is_of_character(self) -> bool:
        """Whether the motions are clips of the character's own file."""
        return self.file is not None and self.file == self._history.model.own_file

    def set_model(self) -> None:
        """Start with another body: list its own clips and read the first."""
        model = self._history.model
        self._cache.forget(model)
        file, clips = own_motions(model)
        self._open_motions(file if clips else None, dict.fromkeys(clips))
        self._forget()
        if clips:
            self.choose(clips[0], enters=False)

    def _forget(self) -> None:
        self.pause()
        self._checking.cancel_all()
        self._reading.cancel_all()
        self._motion = self.original = None
        self._forget_checks()
        self.trail = self.trail_points = None
        self.first = self.last = 0
        self.opened.emit()

    def open(self, path: str | Path) -> None:
        """Read a file's motions in the long worker, and go to the first frame of the first one.

        Parameters
        ----------
        path : see `read_motions`
        """
        job = partial(open_motions_to_show, self._history.model, Path(path))
        self._tasks.start_loading(f"Opening {Path(path).name}", job, partial(self._on_read, path))

    def choose(self, name: str, enters: bool = True) -> None:
        """Put another motion on the timeline once it is read; with `enters`, go to frame 0."""
        self._reading.cancel(_CLIP)
        motion = self.motions.get(name)
        if motion is not None:
            self._on_clip(enters, [motion])
            return
        assert self.file is not None
        # Use the reading thread: preparing drags would block the other one.
        job = partial(read_motions, self._history.model, self.file, name)
        done = partial(self._on_clip, enters)
        self._reading.start(f"Reading {name}", job, done, kind=_CLIP)

    def choose_joints(self, followed: JointMap) -> None:
        """Remember which joint of the body follows which, and read the motions again."""
        assert self.joints is not None
        assert self.joints_of is not None
        from lcollision_core.bodies.partners import remember_followed

        remember_followed(self.joints, followed)
        self.open(self.joints_of)

    def _on_read(self, path: str | Path, read: OpenedMotions) -> None:
        body, motions, history = read.body, read.motions, self._history
        if not motions:
            self.joints, self.joints_of = read.joints, Path(path)
            self.joints_unsure.emit()
            return
        notes = () if body is history.model else body.notes
        if body is not history.model:
            if not self._tasks.may_replace():
                return
            self._tasks.model_opened.emit(OpenedModel(body, history.model_file))
        self._open_motions(Path(path), {motion.name: motion for motion in motions})
        text = say(
            "Opened {file}: {motions}",
            file=Path(path).name,
            motions=counted(len(motions), "motion", "motions"),
        )
        self.message.emit(joined((text, *notes)))
        self.joints, self.joints_of = read.joints, Path(path)
        self._put_on_timeline(motions[0])
        if self._history.state.moment is None:
            # The user was asked about the edited pose before the file was read.
            self._enter(motions[0], 0)
        self.arrived.emit()
        if read.joints is not None and read.joints.unsure:
            self.joints_unsure.emit()

    def _open_motions(self, file: Path | None, motions: Mapping[str, Motion | None]) -> None:
        from lcollision_core.files import file_stamp

        self._reading.cancel(_CLIP)
        self.file, self.file_stamp = file, None if file is None else file_stamp(file)
        self.motions, self._edited, self._saved = dict(motions), {}, {}
        self.joints = self.joints_of = None

    def _on_clip(self, enters: bool, read: list[Motion]) -> None:
        self.motions |= {motion.name: motion for motion in read}
        self._put_on_timeline(read[0])
        # Do not end a drag in progress.
        if enters and self._history.gesture is None:
            self._go(0)

    def _put_on_timeline(self, motion: Motion, state: DocumentState | None = None) -> None:
        """Put a motion on the timeline, at its first frame or in a state at one of its frames."""
        self.pause()
        self.resolving.end(_STOPPED)
        history = self._history
        if history.state.moment is not None:
            # An unfinished edit belongs to the previous motion.
            history.close_gesture()
        self.original = motion
        self._motion = motion = self._edited.get(motion.name, motion)
        self._forget_checks()
        self.first, self.last = 0, len(motion) - 1
        self.trail = self.trail_points = None
        if state is not None:
            history.begin(state, history.file, history.file_poses)
        elif history.state.moment is not None:
            history.begin(self._state_at(motion, 0))
        self.opened.emit()
        self._check()

    # The playhead.

    def go_to(self, frame: int) -> None:
        """Move the playhead; the newest frame counts."""
        self.pause()
        self._go(frame)

    def step(self, by: int) -> None:
        """Move the playhead by some frames, from the in point if there is none."""
        at = self.frame
        self.go_to(self.first if at is None else at + by)

    def go_to_colliding(self, direction: int) -> None:
        """Go to the next (1) or previous (-1) colliding frame, wrapping at the ends."""
        deep = np.flatnonzero(np.nan_to_num(self.checks.deepest) > 0.0)
        if len(deep) == 0:
            all_checked = self.checks.n_checked == len(self.checks.deepest)
            self.message.emit(
                "No frame collides" if all_checked else "No colliding frame is known yet"
            )
            return
        at = -1 if self.frame is None else self.frame
        beyond = deep[deep > at] if direction > 0 else deep[deep < at][::-1]
        again = deep[0] if direction > 0 else deep[-1]
        self.go_to(int(beyond[0] if len(beyond) else again))

    def go_to_worst(self) -> None:
        """Go to the frame with the deepest known penetration."""
        if not np.isnan(self.checks.deepest).all():
            self.go_to(int(np.nanargmax(self.checks.deepest)))

    def set_range(self, first: int, last: int) -> None:
        """Set the in and out points, clipped to the motion and sorted."""
        motion = self.motion
        if motion is not None:
            ends = sorted(min(max(at, 0), len(motion) - 1) for at in (first, last))
            self.first, self.last = ends
            self.range_changed.emit()

    def _state_at(
        self, motion: Motion, frame: int, cached: PoseFrame | None = None
    ) -> DocumentState:
        """Return the state at a frame, with the pins moved to its patches."""
        from lcollision_core.bodies import MAX_POSE_NAME_LENGTH, NamedPose

        codes = motion.codes[frame] if cached is None else cached.latent
        ending = f" {frame}"
        name = motion.name[: MAX_POSE_NAME_LENGTH - len(ending)] + ending
        pose = NamedPose(name, codes, motion.placement(frame))
        moment = Moment(motion, frame)
        state = DocumentState(pose, moment=moment, ghost=self._ghost(motion, frame))
        if not self._history.pose.pins:
            return state
        vertices = state.drawn(self._history.model) if cached is None else cached.vertices
        return replace(state, pose=replace(pose, pins=self._pose.pins_on(vertices)))

    def _go(self, frame: int) -> None:
        motion, history = self.motion, self._history
        if motion is None:
            return
        frame = min(max(frame, 0), len(motion) - 1)
        if history.state.moment is None:
            history.close_gesture()
            if history.modified and not self._tasks.may_leave_pose():
                return
            self._enter(motion, frame)
        elif frame != self.frame:
            history.close_gesture()
            # Closing the gesture may have edited the motion.
            motion = self.motion
            assert motion is not None
            cached = self._cache.get(motion, frame)
            if cached is None:
                history.apply(self._state_at(motion, frame))
            else:
                self._pose.show(cached, self._state_at(motion, frame, cached))
        self._want(motion, frame)

    def _enter(self, motion: Motion, frame: int) -> None:
        """Make a frame the working pose, as an undo step if the present pose is unsaved."""
        history, state = self._history, self._state_at(motion, frame)
        if history.modified:
            history.push("Go to the motion", state)
        else:
            history.apply(state)
        history.update_modified()

    def _want(self, motion: Motion, frame: int, ahead: int = 1) -> None:
        """Request frames, the most urgent first."""
        self._cache.predicts = self._pose.predicts
        numbers = [frame, *self.onion.frames(frame, len(motion))]
        numbers += [self._wrapped(frame + by) for by in range(1, ahead + 1)]
        requests = [(motion, number) for number in dict.fromkeys(numbers)]
        before = self._differing(motion, frame)
        if before is not None:
            requests.insert(1, (before, frame))
        self._cache.want(requests)

    def _wrapped(self, frame: int) -> int:
        if frame <= self.last:
            return frame
        span = self.last - self.first + 1
        return self.first + (frame - self.first) % span if self.playback.loops else self.last

    @Slot(object, int)
    def _on_ready(self, motion: Motion, number: int) -> None:
        at, now = self.frame, self.motion
        if now is None or at is None or motion not in (now, self.original):
            return
        state = self._history.state
        if self.comparing and motion is self.original and number == at:
            self._show_original(motion, number)
        if number == at and self._history.gesture is None and state.ghost is None:
            ghost = self._ghost(now, at)
            if ghost is not None:
                self._history.apply(replace(state, ghost=ghost))
        if number in self.onion.frames(at, len(now)):
            self.onion_changed.emit()

    # The motion as read.

    def _differing(self, motion: Motion, frame: int) -> Motion | None:
        """Return the motion as it was read if its frame differs and is shown as a ghost."""
        before = self.original
        if before is None or motion is before or not self._history.ghost_shown:
            return None
        return None if np.array_equal(before.codes[frame], motion.codes[frame]) else before

    def _ghost(self, motion: Motion, frame: int) -> npt.NDArray[np.float32] | None:
        before = self._differing(motion, frame)
        cached = None if before is None else self._cache.get(before, frame)
        return None if cached is None else cached.vertices

    def compare(self, comparing: bool) -> None:
        """Show the motion as read, or as edited; the pose does not change."""
        if comparing == self.comparing or self.original is None or self.frame is None:
            return
        self.comparing = comparing
        if comparing:
            self._show_original(self.original, self.frame)
        else:
            self._pose.show_own()
        self.options_changed.emit()

    def _show_original(self, original: Motion, frame: int) -> None:
        """Show a frame as read, or request it; `_on_ready` shows it then."""
        cached = self._cache.get(original, frame)
        if cached is None:
            self._cache.want([(original, frame)])
        else:
            self._pose.show_instead(cached)

    # Onion skin and trail.

    def set_onion(self, onion: Onion) -> None:
        """Choose the onion skin frames around the playhead."""
        self.onion = onion
        if self.motion is not None and self.frame is not None:
            self._want(self.motion, self.frame)
        self.onion_changed.emit()

    def onion_frames(self) -> list[tuple[int, PoseFrame]]:
        """Return the onion skin frames that are ready, each with its offset from the playhead."""
        motion, at = self.motion, self.frame
        if motion is None or at is None or self.playing:
            return []
        numbers = self.onion.frames(at, len(motion))
        ready = [(number - at, self._cache.get(motion, number)) for number in numbers]
        return [(by, frame) for by, frame in ready if frame is not None]

    def set_trail(self, vertex: int | None) -> None:
        """Draw the path of a vertex over the motion, or none."""
        self.trail, self.trail_points = vertex, None
        self._follow_trail()
        self.trail_changed.emit()

    def _follow_trail(self) -> None:
        motion = self.motion
        # Cancel only this job: the thread also reads motions.
        self._reading.cancel(_TRAIL)
        if self.trail is not None and motion is not None:
            frames = range(self.first, self.last + 1)
            job = partial(path_of_vertex, self._history.model, motion, frames, self.trail)
            self._reading.start("Following a point", job, self._on_trail, kind=_TRAIL)

    def _on_trail(self, points: npt.NDArray[np.float64]) -> None:
        self.trail_points = points
        self.trail_changed.emit()

    # Playing.

    def toggle_playing(self) -> None:
        """Play from the playhead, or pause."""
        (self.pause if self.playing else self.play)()

    def play(self) -> None:
        """Play from the playhead, or from the in point if the playhead is outside the range."""
        motion = self.motion
        if motion is None or self.last == self.first:
            return
        at = self.frame
        start = self.first if at is None or not self.first <= at < self.last else at
        self._go(start)
        if self.frame is None:
            return
        # Leave the cores to the frames.
        self._checking.cancel_all()
        self.playback.play(motion, start, self.first, self.last)

    def pause(self) -> None:
        """Stop playing where the playhead is."""
        self.playback.pause()

    def set_easing(self, frames: int) -> None:
        """Set over how many frames, at 30 per second, later edits ease in and out."""
        self.easing = frames
        self.options_changed.emit()

    @Slot(int)
    def _on_due(self, frame: int) -> None:
        motion = self.motion
        if motion is None:
            self.pause()
            return
        cached = self._cache.get(motion, frame)
        if cached is not None:
            self._pose.show(cached, self._state_at(motion, frame, cached))
            self.playback.note_shown(frame)
        elif not self.playing:
            self._go(frame)
        self._want(motion, frame, AHEAD)

    @Slot()
    def _on_playback(self) -> None:
        if not self.playing:
            self.onion_changed.emit()
            self._check()

    # Edits.

    @property
    def changes(self) -> list[tuple[Motion, Motion]]:
        """Each edited motion, as a pair: as read, as edited."""
        pairs = [(self.motions.get(name), now) for name, now in self._edited.items()]
        return [(was, now) for was, now in pairs if was is not None and was is not now]

    def are_saved(self) -> bool:
        """Whether no motion has changed since it was read or exported: see `MotionEdits`."""
        return all(map(self._is_saved, self._edited))

    def _is_saved(self, name: str) -> bool:
        return self._edited.get(name) is self._saved.get(name, self.motions.get(name))

    def edits(self) -> EditedMotions | None:
        """Return the edits that a crash must not lose; None if no motion was edited."""
        motion, frame, pairs = self.motion, self.frame, self.changes
        if motion is None or frame is None or self.file is None or not pairs:
            return None
        read, edited = ({pair[k].name: pair[k] for pair in pairs} for k in (0, 1))
        # Include the open motion even if it is unchanged.
        read.setdefault(motion.name, self.original or motion)
        edited.setdefault(motion.name, motion)
        saved = frozenset(name for name in edited if self._is_saved(name))
        return EditedMotions(self.file, self.file_stamp, motion.name, frame, read, edited, saved)

    def restore(self, lost: EditedMotions) -> None:
        """Restore the motions that a crash left; the pose is a frame of the open one."""
        motions: dict[str, Motion | None] = dict(lost.read)
        own_file, own_clips = own_motions(self._history.model)
        if lost.file == own_file:
            motions = dict.fromkeys(own_clips) | motions
        self._reading.cancel_all()
        self._open_motions(lost.file, motions)
        self.file_stamp = lost.stamp
        self._edited = dict(lost.edited)
        self._saved = {name: lost.edited[name] for name in lost.saved}
        motion, pose = lost.edited[lost.open], self._history.pose
        state = self.with_motion_edit(DocumentState(pose, moment=Moment(motion, lost.frame)))
        self._put_on_timeline(lost.read[lost.open], state)
        self._want(state.motion or motion, lost.frame)

    def mark_saved(self, exported: Iterable[Motion] | None = None) -> None:
        """Mark motions as saved, all if None."""
        saved = self._edited.values() if exported is None else exported
        self._saved |= {motion.name: motion for motion in saved}
        self._history.update_modified()

    def with_motion_edit(self, state: DocumentState) -> DocumentState:
        """Turn an edit of a frame into a correction of its motion: see `MotionEdits`."""
        from lcollision_core.motion.motion import corrected

        moment = state.moment
        if moment is None:
            return state
        motion, frame = moment.motion, moment.frame
        if np.array_equal(state.pose.latent, motion.codes[frame]):
            return state
        changed = corrected(motion, frame, state.pose.latent, motion.in_frames(self.easing))
        name, placement = f"{motion.name} {frame}", motion.placement(frame)
        pose = replace(state.pose, name=name, tags=(), placement=placement)
        self._edit = (motion, changed)
        return replace(state, pose=pose, origin=None, moment=replace(moment, motion=changed))

    @Slot()
    def _on_moment(self) -> None:
        """Follow a change of the frame or of the motion, as after an edit or an undo."""
        now, before = self.motion, self._motion
        if now is not None:
            self._edited[now.name] = now
        if now is not None and now is not before:
            self.resolving.end(_STOPPED)
            if before is None or (now.name, now.codes.shape) != (before.name, before.codes.shape):
                # An undo step has returned to a motion that was open before.
                self.original = self.motions.get(now.name) or now
                self._motion = now
                self._forget_checks()
                self.first, self.last = 0, len(now) - 1
                self.opened.emit()
            else:
                same = (now.codes == before.codes).all(axis=1)
                self._checking.cancel_all()
                self.checks = self.checks.of_changed(same)
                self._motion = now
            self._follow_trail()
            self._hold_solid(now)
            if not self.playing:
                self._check()
            self.checked.emit()
        if self.comparing:
            self.comparing = False
            self._pose.show_own()
            self.options_changed.emit()
        self.moved.emit()
        if self.onion.count:
            self.onion_changed.emit()

    def _hold_solid(self, now: Motion) -> None:
        """Free the frames that an eased edit made collide, in the same undo step."""
        edit, self._edit = self._edit, None
        if edit is None or edit[1] is not now or not self._pose.solid:
            return
        if self._history.model.can_resolve:
            job = partial(free_neighbours, self._history.model, *edit, self._pose.clearance)
            self._tasks.start(Work.EASE, "Easing the edit", job, partial(self._on_eased, now))

    def _on_eased(self, asked: Motion, eased: Motion | None) -> None:
        state = self._history.state
        if eased is not None and state.moment is not None and state.motion is asked:
            moment = replace(state.moment, motion=eased)
            self._history.amend(replace(state, moment=moment))

    def _check(self) -> None:
        """Start or continue the exact check of all frames."""
        motion = self.motion
        self._checking.cancel_all()
        # Preparing drags comes first.
        self._waits = motion is not None and self._tasks.preparing
        if motion is not None and not self._waits:
            job = partial(check_motion, self._history.model, motion, self.checks)
            self._checking.start("Checking frames", job, lambda _: self.checked.emit())

    @Slot()
    def _on_busy(self) -> None:
        if self._waits and not (self.playing or self._tasks.preparing):
            self._check()
        self.checked.emit()

    def check_again(self) -> None:
        """Discard all checks, after a change of the contact rules, and check again."""
        motion = self.motion
        if motion is not None:
            self._forget_checks()
            self._cache.forget(self._history.model)
            self._check()
            self.checked.emit()

    def _forget_checks(self) -> None:
        motion, n_parts = self._motion, len(self._history.model.domain_names)
        shape = 0 if motion is None else len(motion), n_parts
        self.checks = MotionChecks.of(*shape)
        self.original_checks = self.checks if motion is self.original else MotionChecks.of(*shape)

    @property
    def shown_checks(self) -> MotionChecks:
        """The checks of the shown motion: `original_checks` while comparing, else `checks`."""
        return self.original_checks if self.comparing else self.checks

    # Resolve.

    def resolve(self, within: range | None = None, options: MotionOptions | None = None) -> None:
        """Free the motion in the long worker, in one step of undo.

        Parameters
        ----------
        within : the frames that may change; all if None
        options : the defaults if None; locked domains are taken from the document, and body
            parts with a pin stay where the motion has them

        Raises
        ------
        LCollisionError : there is no motion, or the body cannot resolve.
        """
        from lcollision_core.options import MotionOptions

        history, model = self._history, self._history.model
        if self.motion is None:
            raise LCollisionError("there is no motion to resolve", "open one first")
        motion_options = options or MotionOptions()
        # A motion keeps its feet by itself, part by part and for as long as they stand.
        of_frames = replace(self._tasks.resolve_options(motion_options.frame), standing=None)
        motion_options = replace(motion_options, frame=of_frames)
        self.pause()
        if history.state.moment is None:
            self._go(self.first)
        if history.state.moment is None:
            return
        history.close_gesture()
        # This Resolve also frees the frames of the last edit.
        self._tasks.cancel(Work.EASE)
        motion = self.motion
        self.resolving.start(
            model, motion, motion_options, within, partial(self._on_resolved, motion)
        )

    def kept_sentences(self, frame: int | None = None) -> list[str]:
        """Say of each span that Resolve left colliding why, until the motion changes.

        Parameters
        ----------
        frame : only of the span with this frame; of all if None
        """
        motion, kept = self._kept
        if motion is None or self.motion is not motion or self.comparing:
            return []
        return [why for span, why in kept.items() if frame is None or frame in span]

    def _on_resolved(self, asked: Motion, resolved: ResolvedMotion) -> None:
        history = self._history
        state = history.state
        if state.moment is None or state.motion is not asked:
            self.message.emit(_STOPPED)
            return
        # Worded now: another model may be open while its motion is still read.
        names = history.model.domain_names
        whys = {span: with_capital(span.sentence(names)) for span in resolved.kept}
        self._kept = resolved.motion if resolved.spans else asked, whys
        if resolved.spans:
            frame = state.moment.frame
            moment = Moment(resolved.motion, frame)
            pose = replace(state.pose, latent=resolved.motion.codes[frame])
            after = replace(state, pose=pose, moment=moment, outcome=None, ghost=None)
            history.push("Resolve motion", after)
            # Resolve has checked these frames exactly.
            self.checks.deepest[resolved.after & np.isnan(self.checks.deepest)] = 0.0
            self.checked.emit()
        self.resolving.changed.emit()
        self.message.emit(self.resolving.summary(resolved, history.model.domain_names))

    def close(self, deadline: float) -> bool:
        """Stop all work and end the threads; see `LongWork.close`."""
        self.pause()
        self._waits = False
        parts = (self._cache, self._checking, self._reading)
        ended = [part.close(deadline) for part in parts]
        return all(ended)
