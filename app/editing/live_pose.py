"""The live pose: its motion by hand, its pins, and its newest frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Signal, Slot

from app.editing.history import PoseHistory, read_only
from app.work.frames import (
    MotionStart,
    PoseFrame,
    PoseMailbox,
    PoseRequest,
    empty_points,
)
from app.work.threads import Failure, Response, single_shot
from lcollision_core.tasks.words import counted

if TYPE_CHECKING:
    from app.editing.history import DocumentState
    from lcollision_core.bodies import Body, NamedPose
    from lcollision_core.contact import NearestPair, SelfCollisions
    from lcollision_core.posing import Grip, Pin, Twist


_MOST_IDLE = 12
"""Requests without progress after which a motion counts as settled: a straight arm that is to bend
needs several before it begins."""

_NEARER = 0.999
"""A miss below this fraction of the least one so far counts as progress."""


RADIUS_STEP = 1.25
"""Factor from one grip radius to the next larger one."""


@dataclass(eq=False)
class ActiveMotion:
    """The motion in progress.

    Attributes
    ----------
    start : the worker's starting point
    target : the newest one; None before the first
    pin : index and patch of the pin that is dragged; None if none is
    has_ended : the hand has let go; the undo step is pushed once the pose has settled
    least_miss, n_idle : the least distance to the target so far, and the requests since
    """

    start: MotionStart
    target: FloatArray | None = None
    pin: tuple[int, Grip] | None = None
    has_ended: bool = False
    least_miss: float = field(default=np.inf)
    n_idle: int = 0

    def count_frame(self, frame: PoseFrame) -> bool:
        """Count a frame; return whether the same target is worth another request."""
        self.n_idle += 1
        if frame.miss < _NEARER * self.least_miss:
            self.least_miss, self.n_idle = frame.miss, 0
        return not frame.settled and self.n_idle < _MOST_IDLE


def code_name(model: Body, index: int) -> str:
    """Return the display name of one latent entry."""
    group = next(g for g in model.latent_space.groups if index < g.codes.stop)
    name = model.code_names[index]
    return name if group.colour is None else f"{group.name}, {name}"


def domain_of(model: Body, vertex: int) -> int:
    """Return the body part with the largest share in a vertex, from 0."""
    return int(model.space.vertex_domain[vertex])


def part_name(model: Body, vertex: int) -> str:
    """Return the name of the body part with the largest share in a vertex."""
    return model.domain_names[domain_of(model, vertex)]


def training_pose(model: Body, number: int) -> NamedPose:
    """Return a training pose of the model by its number, from 0."""
    from lcollision_core.bodies import NamedPose

    return NamedPose(model.card.pose_names[number], model.known_poses[number])


def starter_poses(model: Body) -> list[NamedPose]:
    """Return the starter poses; none for a body whose joints are not known."""
    from lcollision_core.bodies import NamedPose

    return [NamedPose(pose.name, pose.codes, moves=pose.moves) for pose in model.starter_poses]


FloatArray = npt.NDArray[np.float64]

REST_MILLISECONDS = 60
"""How long a pose must rest before its exact check, if its frame came without one."""

_QUICK_SECONDS = 0.012
"""Time of a frame below which it pays to draw the window only once the next one has arrived."""


class PoseMotion(QObject):
    """Moves the working pose and keeps its newest frame; another thread computes both.

    A pose that is set is evaluated unchanged. A pose that is moved, by hand or (with Solid on) by
    its codes, approaches the newest target until it comes no nearer. The worker's results become
    the pose as they arrive, so nothing is computed twice. Such a motion is one gesture; its undo
    step is pushed when the pose has settled or another action begins.

    Between `begin_gesture` and `end_gesture` changes show at once but form one undo step. Outside
    a gesture, as from the keyboard, consecutive changes of one slider within a second merge.

    Parameters
    ----------
    history : owns the pose

    Attributes
    ----------
    frame : the newest computed frame; it lags slightly behind the pose while a slider moves
    shows_another : `frame` is not the pose's: see `show_instead`
    exact : the exact check of the drawn pose (see `shows_another`); None until it is known
    nearest : the nearest pair of the drawn pose; None until measured, or if none is in range
    is_measured : whether `nearest` was measured
    resting : the frame to check completely once it rests, and then, once `set_ready` was called, to
        measure; None if all is known of it
    solid : drags and edits of the codes keep the pose free of self-collision
    standing : body parts that stand on the ground stay there in drags
    whole_body : the whole body follows drags, not only the held limb
    clearance : kept between parts by Resolve and Solid, normalised
    drag_strength : how strongly drags stay near the training poses; 0 not at all
    locked_domains : not changed by drags, Resolve, Randomise, Reset all and blending
    predicts : frames come with a prediction

    Signals
    -------
    frame_changed, exact_changed : `frame`, `exact` are new, or None while unknown
    nearest_changed : `nearest` is new
    solid_changed, grip_radius_changed, locks_changed, clearance_changed : a new value
    message : str, one sentence for the status bar
    failed : Failure; one that repeats from pose to pose is reported once
    """

    frame_changed = Signal()
    exact_changed = Signal()
    nearest_changed = Signal()
    solid_changed = Signal()
    grip_radius_changed = Signal()
    locks_changed = Signal()
    clearance_changed = Signal()
    message = Signal(str)
    failed = Signal(object)

    def __init__(self, history: PoseHistory) -> None:
        super().__init__(history)
        self._history = history
        self.frame: PoseFrame | None = None
        self.exact: SelfCollisions | None = None
        self.nearest: NearestPair | None = None
        self.is_measured = self.shows_another = False
        self.resting: PoseFrame | None = None
        self.solid, self.standing, self.whole_body = True, True, False
        self.drag_strength, self.clearance = 1.0, 0.0
        self.locked_domains: frozenset[int] = frozenset()
        self._is_ready = self.predicts = self._is_quick = self._has_skipped = False
        self._adopted: FloatArray | None = None
        self._moving: ActiveMotion | None = None
        self._grip_radius: float | None = None
        self._last_grip: Grip | None = None
        self._grips: dict[tuple[int, float], Grip] = {}
        self._reported: dict[str, str] = {}
        self._mailbox = PoseMailbox(self)
        self._mailbox.answered.connect(self._on_answered)
        self._rested = single_shot(self, REST_MILLISECONDS, self._check)
        history.latent_changed.connect(self._on_latent_changed)
        history.gesture_closed.connect(self._on_gesture_closed)

    # The model.

    def set_model(self) -> None:
        """Follow the pose of another model, without signals: see `emit_all`."""
        self.locked_domains = frozenset()
        self.frame = self._last_grip = None
        self._grips = {}
        self._set_exact(None)
        self._is_ready = self.predicts = False
        self.follow()

    def set_ready(self, predicts: bool) -> None:
        """Start measuring frames, and predicting if `predicts`: all is loaded and compiled."""
        self._is_ready, self.predicts = True, predicts
        if predicts and self._moving is None and not self.shows_another:
            self.follow()
        else:
            self._look_on()

    def emit_all(self) -> None:
        """Emit the change signals, as after loading another model."""
        for changed in (self.frame_changed, self.exact_changed, self.locks_changed):
            changed.emit()

    def close(self, deadline: float) -> bool:
        """End the thread; see `LongWork.close`."""
        self._rested.stop()
        self._moving = self.resting = None
        return self._mailbox.close(deadline)

    # Locks.

    @property
    def all_locked(self) -> bool:
        """Whether every domain is locked, so that only sliders can move the pose."""
        return self._history.has_model and len(self.locked_domains) == len(
            self._history.model.domain_names
        )

    def set_locked(self, domain: int, locked: bool) -> None:
        """Lock a domain against Resolve, Randomise, Reset all and blending, or unlock it."""
        changed = self.locked_domains | {domain} if locked else self.locked_domains - {domain}
        if changed != self.locked_domains:
            self.locked_domains = changed
            self.locks_changed.emit()

    def set_clearance(self, clearance: float) -> None:
        """Set the normalised clearance that Resolve and later drags keep."""
        if clearance != self.clearance:
            self.clearance = clearance
            self.clearance_changed.emit()

    # Gestures.

    @property
    def dragging(self) -> bool:
        """Whether a drag of the body is in progress."""
        moving = self._moving
        return moving is not None and moving.start.grip is not None and not moving.has_ended

    @property
    def moving(self) -> bool:
        """Whether the worker has not settled on the newest target yet."""
        moving = self._moving
        return moving is not None and any(
            request.start is moving.start for request in self._mailbox.pending
        )

    @property
    def expects_frame(self) -> bool:
        """Whether a frame is pending that will probably arrive at once."""
        pending = self._mailbox.pending
        return self._is_quick and any(request.resting is None for request in pending)

    @property
    def expects_verdict(self) -> bool:
        """Whether `exact` is unknown and a pending frame will probably bring it."""
        return self.exact is None and self.expects_frame

    def stop_expecting(self) -> None:
        """Stop waiting for the pending frame: it is taking longer."""
        self._is_quick = False
        self.exact_changed.emit()

    def begin_gesture(self, label: str) -> None:
        """Start a drag: the changes until `end_gesture` form one undo step."""
        self._history.open_gesture(label)

    def end_gesture(self) -> None:
        """End a drag; if the worker still moves the pose, the step is pushed when it settles."""
        if self._moving is not None and self.moving:
            self._moving.has_ended = True
        else:
            self._history.close_gesture()

    def cancel_gesture(self) -> None:
        """Cancel a drag, as Escape does, and restore its start exactly."""
        self._stop()
        self._history.cancel_gesture()

    # Drags.

    def set_solid(self, solid: bool) -> None:
        """Set whether later drags and edits of the codes keep the pose free of self-collision."""
        if solid != self.solid:
            self.solid = solid
            self.solid_changed.emit()

    @property
    def grip_radius(self) -> float:
        """The radius of dragged patches, in normalised length along the surface."""
        from lcollision_core.posing import GRIP_RADIUS

        return GRIP_RADIUS if self._grip_radius is None else self._grip_radius

    def set_grip_radius(self, radius: float) -> None:
        """Set the radius of dragged patches, clipped to `LEAST_RADIUS` and `LARGEST_RADIUS`."""
        from lcollision_core.posing import LARGEST_RADIUS, LEAST_RADIUS

        radius = min(max(radius, LEAST_RADIUS), LARGEST_RADIUS)
        if radius != self.grip_radius:
            self._grip_radius = radius
            self.grip_radius_changed.emit()

    def grip_at(self, vertex: int) -> Grip:
        """Return the patch around a vertex, with the present radius.

        Raises
        ------
        LCollisionError : there is no such vertex.
        """
        from lcollision_core.posing import make_grip

        grip = self._last_grip
        if grip is None or (grip.vertex, grip.radius) != (vertex, self.grip_radius):
            grip = self._last_grip = make_grip(self._history.model.space, vertex, self.grip_radius)
        return grip

    def begin_drag(self, grip: Grip | Twist, label: str, whole_body: bool = False) -> None:
        """Start dragging a patch, or twisting a body part; pins and locked body parts stay.

        Parameters
        ----------
        label : of the undo step
        whole_body : let the whole body follow this drag, whatever `self.whole_body` is
        """
        self.begin_gesture(label)
        self._begin(grip, self._history.pose.pins, whole_body)

    def begin_pin_drag(self, index: int, whole_body: bool = False) -> None:
        """Start dragging a pinned patch with its pin; the other pins stay."""
        pins = self._history.pose.pins
        pin = pins[index]
        grip = self._grip_of(pin)
        self.begin_gesture(f"Move pin on {part_name(self._history.model, pin.vertex)}")
        moving = self._begin(grip, pins[:index] + pins[index + 1 :], whole_body)
        moving.pin = index, grip

    def pins_on(self, vertices: npt.NDArray[np.floating]) -> tuple[Pin, ...]:
        """Return the pose's pins moved to their patches on (V, 3) vertices, in the data's unit."""
        return tuple(pin.moved(self._grip_of(pin), vertices) for pin in self._history.pose.pins)

    @property
    def pinned_domains(self) -> frozenset[int]:
        """The body parts with a pin: Resolve keeps them in place as far as it can."""
        model, pins = self._history.model, self._history.pose.pins
        return frozenset(domain_of(model, pin.vertex) for pin in pins)

    def _grip_of(self, pin: Pin) -> Grip:
        from lcollision_core.posing import make_grip

        key = (pin.vertex, pin.radius)
        if key not in self._grips:
            self._grips[key] = make_grip(self._history.model.space, *key)
        return self._grips[key]

    def drag_to(self, target: npt.ArrayLike) -> None:
        """Set the target of the drag; the newest one counts. Does nothing without a drag.

        Parameters
        ----------
        target : (3,) point in the data's unit, in the model's coordinates; for a twist (1,), the
            angle in radians since the start
        """
        if self.dragging:
            self._move(np.array(target, dtype=np.float64).reshape(-1))

    def end_drag(self) -> None:
        """Let go: the pose settles on the newest target, unless another action begins."""
        if self.dragging:
            self.end_gesture()

    def cancel_drag(self) -> None:
        """Cancel the drag and restore its start exactly."""
        if self.dragging:
            self.cancel_gesture()

    # Edits of the codes.

    def load_pose(self, pose: NamedPose) -> None:
        """Load a pose of the library, of the file or of the training set, under its name.

        A pose of some codes only, such as a hand pose, leaves the others.
        """
        if pose.moves is None:
            self._history.load_pose(pose)
            return
        self._tell_if_locked()
        self.edit(pose.name, self._with_locked(pose.applied_to(self._history.latent)))

    def set_code(self, index: int, value: float) -> None:
        """Set one latent entry; a non-finite value is ignored.

        Parameters
        ----------
        index : from 0, in the latent's order
        value : may exceed the slider's range, as in imported meshes
        """
        if np.isfinite(value) and value != self._wanted[index]:
            self._set_codes(
                f"Move {code_name(self._history.model, index)}", index, value, run=index
            )

    def reset_code(self, index: int) -> None:
        """Set one latent entry to 0."""
        self._set_codes(f"Reset {code_name(self._history.model, index)}", index, 0.0)

    def reset_domain(self, domain: int) -> None:
        """Set all codes of a domain to 0: its own, and its entry of the whole body."""
        codes = self._history.model.space.codes_of([domain])
        self._set_codes(f"Reset {self._history.model.domain_names[domain]}", codes, 0.0)

    def reset_shapes(self) -> None:
        """Set the sliders of all morph targets to 0."""
        self._set_codes("Reset all shapes", self._history.model.shape_codes, 0.0)

    def reset_all(self) -> None:
        """Set all codes to 0 and remove all pins in one step; report how many locked parts stay.

        The pose changes at once and ignores contact, like any loaded pose.
        """
        history = self._history
        history.close_gesture()
        latent = self._with_locked(np.zeros_like(history.latent))
        state = history.with_latent(read_only(latent))
        history.push("Reset all", replace(state, pose=replace(state.pose, pins=())))
        if self.locked_domains and not self.all_locked:
            n_locked = counted(len(self.locked_domains), "locked body part", "locked body parts")
            self.message.emit(f"Everything was reset except {n_locked}: see Edit > Unlock all")
        self._tell_if_locked()

    def paste(self, label: str, latent: FloatArray, codes: npt.NDArray[np.bool_]) -> None:
        """Copy the entries of `latent` where `codes` is True, except those of locked domains.

        Both are (D,). The pose changes at once and ignores contact, like any loaded pose.
        """
        history = self._history
        history.close_gesture()
        pasted = self._with_locked(np.where(codes, latent, history.latent))
        history.push(label, history.with_latent(read_only(pasted)))
        self._tell_if_locked()

    def randomise(self, amount: float, seed: int) -> None:
        """Move the pose towards a random one, except its locked domains and its shapes.

        Parameters
        ----------
        amount : 0 leaves the pose, 1 replaces it by a random one: see `Body.sample`
        seed : equal seeds draw equal poses
        """
        self._tell_if_locked()
        model, pose = self._history.model, self._history.latent
        drawn = model.sample(1, np.random.default_rng(seed))[0]
        drawn[model.shape_codes] = pose[model.shape_codes]
        latent = (1.0 - amount) * pose + amount * drawn
        self.edit("Randomise", self._with_locked(latent))

    def blend_towards(self, latent: npt.ArrayLike, fraction: float) -> None:
        """Blend from the pose at the start of the gesture (0) to another (D,) latent (1).

        Locked domains stay as they are.
        """
        gesture, moving = self._history.gesture, self._moving
        has_ended = moving is not None and moving.has_ended
        start = self._wanted if gesture is None or has_ended else gesture.before.pose.latent
        target = np.asarray(latent, dtype=np.float64)
        blended = target.copy() if fraction == 1.0 else start + fraction * (target - start)
        self.edit("Blend", self._with_locked(blended))

    @property
    def _wanted(self) -> FloatArray:
        """(D,) codes that an edit of some of them starts from."""
        moving = self._moving
        if moving is None or moving.target is None or moving.start.grip is not None:
            return self._history.latent
        return moving.target if self.moving else self._history.latent

    def _set_codes(self, label: str, codes: Any, value: float, run: int | None = None) -> None:
        latent = self._wanted.copy()
        latent[codes] = value
        self.edit(label, latent, run)

    def edit(self, label: str, latent: FloatArray, run: int | None = None) -> None:
        """Move the pose to other codes; with Solid on, as far as contact allows.

        Parameters
        ----------
        label : of the undo step
        latent : (D,), made read-only
        run : see `ChangeState`
        """
        history, moving = self._history, self._moving
        gesture = history.gesture
        is_same_run = self.solid and run is not None and gesture is not None and gesture.run == run
        if moving is not None and (
            moving.start.grip is not None or (moving.has_ended and not is_same_run)
        ):
            history.close_gesture()
        if not self.solid:
            history.push(label, history.with_latent(read_only(latent)), run)
            return
        if self._moving is None:
            is_own = history.gesture is None
            if is_own and latent.tobytes() == history.latent.tobytes():
                return
            if is_own:
                history.open_gesture(label, run)
            self._begin(None).has_ended = is_own
        self._move(latent)

    def _tell_if_locked(self) -> None:
        if self.all_locked:
            self.message.emit("All body parts are locked; unlock one to move the pose")

    def _with_locked(self, latent: FloatArray) -> FloatArray:
        """Return `latent` with the present codes of locked domains."""
        locked = self._history.model.space.codes_of(self.locked_domains)
        return np.where(locked, self._history.latent, latent)

    # To the worker.

    def _begin(
        self, grip: Grip | Twist | None, pins: tuple[Pin, ...] = (), whole_body: bool = False
    ) -> ActiveMotion:
        from lcollision_core.posing import DragOptions

        options = DragOptions(
            solid=self.solid,
            strength=self.drag_strength,
            # Codes that a code target does not change stay anyway, so it needs no locks.
            locked_domains=frozenset() if grip is None else self.locked_domains,
            standing=self.standing,
            whole_body=self.whole_body or whole_body,
            clearance=self.clearance if self.solid else 0.0,
        )
        pose, space = self._history.pose, self._history.state.space
        start = MotionStart(pose.latent, grip, pins, options, pose.placement, space)
        self._moving = ActiveMotion(start)
        return self._moving

    def _move(self, target: FloatArray) -> None:
        """Continue towards another target, which is made read-only."""
        moving, gesture = self._moving, self._history.gesture
        assert moving is not None
        assert gesture is not None
        gesture.has_asked = True
        moving.target, moving.least_miss, moving.n_idle = read_only(target), np.inf, 0
        self._mailbox.put(PoseRequest(self._history.model, target, moving.start, self.predicts))

    def follow(self) -> None:
        """Request the frame, and later the exact check, of the present pose."""
        self._moving = self.resting = None
        self.shows_another = False
        history, predicts = self._history, self.predicts
        space = history.state.space
        self._mailbox.put(PoseRequest(history.model, history.latent, None, predicts, space))

    @Slot()
    def _check(self) -> None:
        resting = self.resting
        if self._mailbox.pending or resting is None:
            return
        if self._is_ready or not resting.is_checked:
            self._mailbox.put(PoseRequest(self._history.model, resting=resting))

    def _look_on(self) -> None:
        """Start the timer for the outstanding check or measurement, if there is one."""
        if self.resting is not None and not self._mailbox.pending:
            self._rested.start()

    def _stop(self) -> None:
        """End the motion at its newest frame; drop its later results."""
        moving, self._moving = self._moving, None
        if moving is None:
            return
        waiting, frame = self._mailbox.waiting, self.frame
        if waiting is not None and waiting.start is moving.start:
            self._mailbox.waiting = None
        # The motion's first request may have replaced the one for this pose, and the predictor
        # may have become ready during the drag.
        is_of_pose = frame is not None and frame.latent is self._history.latent
        lacks = frame is None or (self.predicts and frame.prediction is None)
        if not self.shows_another and (lacks or not is_of_pose):
            self.follow()
        elif self.resting is not None:
            self._rested.start()

    @Slot()
    def _on_latent_changed(self) -> None:
        if self._history.latent is self._adopted:
            return
        self.follow()
        if self.exact is not None:
            self._set_exact(None)
            self.exact_changed.emit()

    @Slot()
    def _on_gesture_closed(self) -> None:
        moving, was_moving = self._moving, self.moving
        self._stop()
        if moving is None or self.frame is None:
            return
        if moving.start.grip is not None:
            # The drag no longer presses against contacts.
            self.frame = replace(self.frame, contacts=empty_points(), standing=empty_points())
        elif not was_moving:
            return
        # Views of the target's codes show those of the pose again.
        self.frame_changed.emit()

    # From the worker.

    @Slot(object, object)
    def _on_answered(self, request: PoseRequest, answer: Response) -> None:
        frame: PoseFrame | None = answer.value if request.resting is None else None
        moving = self._moving
        if moving is None or request.start is not moving.start:
            moving = None
        is_late, leads_on = moving is not None and self._mailbox.waiting is not None, False
        if moving is not None and frame is not None and request.target is moving.target:
            leads_on = moving.count_frame(frame)
        if leads_on:
            self._mailbox.put(request)
        # The next request is sent before the response is drawn: the worker need not wait.
        self._mailbox.send()
        if frame is not None:
            self._is_quick = frame.seconds < _QUICK_SECONDS
        # Skip a late frame: drawing it takes longer than computing the newest one.
        self._has_skipped = is_late and self._is_quick and not self._has_skipped
        if request.model is not self._history.model or self._has_skipped:
            return
        if answer.failure is not None:
            self._report(request, answer.failure)
        else:
            self._reported.pop(request.kind, None)
            if request.resting is not None:
                self._note(request.resting, answer.value)
            elif moving is not None and frame is not None:
                self._adopt(moving, frame)
            elif request.start is None and frame is not None:
                self._show(frame)
        self._look_on()
        if moving is not None and moving.has_ended and not self.moving:
            self._history.close_gesture()

    def _report(self, request: PoseRequest, failure: Failure) -> None:
        if failure.headline != self._reported.get(request.kind):
            self._reported[request.kind] = failure.headline
            self.failed.emit(failure)
        if request.resting is self.resting:
            self.resting = None
        self.exact_changed.emit()

    def _note(self, resting: PoseFrame, answer: Any) -> None:
        """Note the check of a frame, which is measured next, or its measurement."""
        if resting is not self.resting:
            return
        if resting.is_checked:
            self.resting, self.nearest, self.is_measured = None, answer, True
            self.nearest_changed.emit()
        else:
            self.resting, self.exact = answer, answer.collisions
            self.exact_changed.emit()

    def _show(self, frame: PoseFrame) -> None:
        """Show a requested frame; while a slider moves, it is of an earlier pose."""
        if self.shows_another:
            return
        self.frame = frame
        is_of_pose = frame.latent is self._history.latent
        if is_of_pose:
            self.resting = frame
        is_checked = is_of_pose and frame.collisions is not None
        if is_checked:
            self._set_exact(frame.collisions)
        self.frame_changed.emit()
        if is_checked:
            self.exact_changed.emit()

    def _set_exact(self, collisions: SelfCollisions | None) -> None:
        """Set the exact check of another pose, which is not measured yet."""
        self.exact, self.nearest, self.is_measured = collisions, None, False

    def show(self, frame: PoseFrame, state: DocumentState) -> None:
        """Apply a state whose frame is already computed, such as one of a motion."""
        self._moving = None
        self._mailbox.waiting = None
        self._take(frame, state)
        self._rested.start()

    def show_own(self) -> None:
        """Draw the pose's own frame again if another is drawn."""
        if self.shows_another:
            self.follow()
            self._set_exact(None)
            self.exact_changed.emit()

    def show_instead(self, frame: PoseFrame) -> None:
        """Draw and check a frame that is not the pose's, until the pose changes or `show_own`."""
        self.frame = self.resting = frame
        self.shows_another = True
        self._set_exact(frame.collisions)
        self.frame_changed.emit()
        self.exact_changed.emit()
        self._rested.start()

    def _adopt(self, moving: ActiveMotion, frame: PoseFrame) -> None:
        """Make a motion's newest frame the pose."""
        history = self._history
        if frame.latent.tobytes() == history.latent.tobytes():
            state = replace(history.state, pose=replace(history.pose, latent=frame.latent))
        else:
            state = history.with_latent(frame.latent)
            if moving.pin is not None:
                index, grip = moving.pin
                pins = list(history.pose.pins)
                pins[index] = pins[index].moved(grip, frame.vertices)
                state = replace(state, pose=replace(state.pose, pins=tuple(pins)))
        self._take(frame, state)

    def _take(self, frame: PoseFrame, state: DocumentState) -> None:
        self.frame = self.resting = frame
        self.shows_another = False
        self._set_exact(frame.collisions)
        self._adopted = frame.latent
        self._history.apply(state)
        self._adopted = None
        self.frame_changed.emit()
        self.exact_changed.emit()


class Pins(QObject):
    """Sets and removes pins of the working pose, each time as one undo step.

    Parameters
    ----------
    history : receives the steps
    motion : provides the posed mesh

    Signals
    -------
    message : str, one sentence for the status bar
    """

    message = Signal(str)

    def __init__(self, history: PoseHistory, motion: PoseMotion) -> None:
        super().__init__(history)
        self._history, self._motion = history, motion

    def pin(self, grips: Sequence[Grip], label: str = "", oriented: bool = False) -> None:
        """Pin patches where they are; a pin on the same vertex is replaced.

        Parameters
        ----------
        label : of the step; by default it names the body part of the first patch
        oriented : also keep the orientation of their body parts
        """
        from lcollision_core.bodies import MAX_PINS
        from lcollision_core.posing import Pin, frame_round

        frame, model = self._motion.frame, self._history.model
        if frame is None:
            return
        state = self._history.state
        is_late = frame.latent is not state.pose.latent
        vertices = state.drawn(model) if is_late else frame.vertices
        space = model.space
        added = {
            grip.vertex: Pin.of(grip, vertices, frame_round(space, grip.vertex) if oriented else ())
            for grip in grips
        }
        other_pins = [pin for pin in self._pins if pin.vertex not in added]
        pins = (*other_pins, *added.values())
        if len(pins) > MAX_PINS:
            self.message.emit(f"A pose has at most {counted(MAX_PINS, 'pin', 'pins')}")
            return
        self._set_pins(label or f"Pin {part_name(model, grips[0].vertex)}", pins)

    def has(self, vertex: int | None) -> bool:
        """Whether a pin is on a vertex."""
        return any(pin.vertex == vertex for pin in self._pins)

    def toggle(self, vertex: int, oriented: bool = False) -> None:
        """Pin the patch around a vertex, with the present radius, or remove the pin on it.

        Parameters
        ----------
        oriented : also keep the body part's orientation, even if the vertex is already pinned
        """
        pins = self._pins
        index = next((i for i, pin in enumerate(pins) if pin.vertex == vertex), None)
        if index is None or (oriented and not pins[index].frame):
            self.pin([self._motion.grip_at(vertex)], oriented=oriented)
        else:
            label = f"Unpin {part_name(self._history.model, vertex)}"
            self._set_pins(label, pins[:index] + pins[index + 1 :])

    def remove_all(self) -> None:
        """Remove all pins."""
        self._set_pins("Unpin all", ())

    @property
    def _pins(self) -> tuple[Pin, ...]:
        return self._history.pose.pins

    def _set_pins(self, label: str, pins: tuple[Pin, ...]) -> None:
        self._history.close_gesture()
        state = self._history.state
        self._history.push(label, replace(state, pose=replace(state.pose, pins=pins)))
