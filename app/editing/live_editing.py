"""Edits that go through the worker: drags by hand, pins, and codes that stop at contact."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Signal, Slot

from app.editing.codes import CodeEditing
from app.editing.history import Gesture, read_only
from app.wording import counted
from app.work.frames import NO_POINTS, ExactVerdict, LiveFrame
from app.work.live_pose import DragSession, LivePose

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lcollision_core.posing import Grip, Pin, Twist

FloatArray = npt.NDArray[np.float64]

REST_MILLISECONDS = 60
"""How long a pose must be unchanged before it is checked exactly, where its frame came without."""


@dataclass(eq=False)
class Drag:
    """What the worker moves.

    Attributes
    ----------
    session : of the worker
    pin : index and patch of the pin that comes along, None if none does
    codes : (D,) that are wanted, of a session without a grip
    has_ended : the hand has let go; the step is made when the pose has settled
    """

    session: DragSession
    pin: tuple[int, Grip] | None = None
    codes: FloatArray | None = None
    has_ended: bool = False


class LiveEditing(CodeEditing):
    """Moves the working pose in the worker; see `PoseDocument` for the signals.

    A drag is a gesture: its frames are adopted as the pose as they come, and nothing is computed
    twice. With Solid on, edits of the codes are such gestures too: the codes wanted are the
    target, and the pose becomes what the worker reached. What an edit has reached is its step of
    undo, when it has settled or another action begins.

    Attributes
    ----------
    frame : the newest computed one; while a slider moves, an instant behind `latent`
    exact : the exact check of `latent`; None until then
    solid : drags and edits of the codes keep the pose out of itself
    standing : what stands on the ground stays there in drags
    whole_body : all of the body helps in drags, not only the limb that is held
    drag_strength : how strongly drags keep to poses like those of the training, 0 not at all
    """

    frame_changed = Signal()
    exact_changed = Signal()
    solid_changed = Signal()
    grip_radius_changed = Signal()
    failed = Signal(object)

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self.frame: LiveFrame | None = None
        self.exact: ExactVerdict | None = None
        self.solid = True
        self.standing, self.whole_body = True, False
        self.drag_strength = 1.0
        self._predicts = False
        self._drag: Drag | None = None
        self._adopted: FloatArray | None = None
        self._grip_radius: float | None = None
        self._last_grip: Grip | None = None
        self._live = LivePose(REST_MILLISECONDS, self)
        self._live.frame_computed.connect(self._on_frame_computed)
        self._live.dragged.connect(self._on_dragged)
        self._live.settled.connect(self._on_settled)
        self._live.verdict_computed.connect(self._on_verdict_computed)
        self._live.failed.connect(self.failed)

    # Drags.

    def set_solid(self, solid: bool) -> None:
        """Choose whether later drags and edits of the codes keep the pose out of itself."""
        if solid != self.solid:
            self.solid = solid
            self.solid_changed.emit()

    @property
    def grip_radius(self) -> float:
        """Of the patch that is taken, in normalised length along the surface."""
        from lcollision_core.posing import GRIP_RADIUS

        return GRIP_RADIUS if self._grip_radius is None else self._grip_radius

    def set_grip_radius(self, radius: float) -> None:
        """Take larger or smaller patches; put between the least and the largest radius."""
        from lcollision_core.posing import LARGEST_RADIUS, LEAST_RADIUS

        radius = min(max(radius, LEAST_RADIUS), LARGEST_RADIUS)
        if radius != self.grip_radius:
            self._grip_radius = radius
            self.grip_radius_changed.emit()

    def grip_at(self, vertex: int) -> Grip:
        """Return the patch round a vertex, of the present radius.

        Raises
        ------
        LCollisionError : there is no such vertex.
        """
        from lcollision_core.posing import make_grip

        held = self._last_grip
        if held is None or (held.vertex, held.radius) != (vertex, self.grip_radius):
            held = self._last_grip = make_grip(self.model.space, vertex, self.grip_radius)
        return held

    @property
    def dragging(self) -> bool:
        """Whether the hand holds the body."""
        drag = self._drag
        return drag is not None and drag.session.grip is not None and not drag.has_ended

    @property
    def moving(self) -> bool:
        """Whether a pose is wanted that the worker has not settled on yet."""
        return self._drag is not None and self._live.is_dragging

    def begin_drag(self, grip: Grip | Twist, label: str, whole_body: bool = False) -> None:
        """Take hold of a patch, or of a body part to twist; pins and locked body parts stay.

        Parameters
        ----------
        label : of the step of undo
        whole_body : let all of the body help this time, whatever `self.whole_body` is
        """
        self.begin_gesture(label)
        self._drag = self._begun(grip, self.pose.pins, whole_body)

    def begin_pin_drag(self, index: int, whole_body: bool = False) -> None:
        """Take hold of a pinned patch; the pin comes along, and the other pins stay."""
        from lcollision_core.posing import make_grip

        pins = self.pose.pins
        pin = pins[index]
        grip = make_grip(self.model.space, pin.vertex, pin.radius)
        self.begin_gesture(f"Move pin on {self.part_name(pin.vertex)}")
        self._drag = self._begun(grip, pins[:index] + pins[index + 1 :], whole_body)
        self._drag.pin = index, grip

    def drag_to(self, target: npt.ArrayLike) -> None:
        """Go on towards a target; the newest one counts. Does nothing without a drag.

        Parameters
        ----------
        target : (3,) point in the data's unit, in the model's frame; of a twist (1,) the angle in
            radians since the start
        """
        if self._drag is not None and self.dragging:
            aim = read_only(np.array(target, dtype=np.float64).reshape(-1))
            self._live.drag(self._drag.session, aim, self._predicts)

    def end_drag(self) -> None:
        """Let go: the pose settles on the newest target, unless another action begins."""
        if self.dragging:
            self.end_gesture()

    def cancel_drag(self) -> None:
        """Let go and put everything back, to the bit."""
        if self.dragging:
            self.cancel_gesture()

    def end_gesture(self) -> None:
        """End a drag; where the worker still moves the pose, the step is made when it settles."""
        if self._drag is not None and self._live.is_dragging:
            self._drag.has_ended = True
        else:
            self._close_gesture()

    def cancel_gesture(self) -> None:
        """Cancel a drag and restore its start, as for Escape."""
        self._end_drag()
        super().cancel_gesture()

    def undo(self) -> None:
        """Undo the last step; a drag or an edit that has not ended is that step."""
        gesture, was_moving = self._gesture, self.moving
        if was_moving and gesture is not None and gesture.before.same_as(self._state):
            # It has moved nothing yet: undoing it leaves the pose, and the step before stays.
            self._close_gesture()
        else:
            super().undo()

    def _close_gesture(self) -> None:
        drag, was_moving = self._drag, self.moving
        self._end_drag()
        super()._close_gesture()
        if drag is None or self.frame is None:
            return
        if drag.session.grip is not None:
            # No hand presses against the contacts any more.
            self.frame = replace(self.frame, contacts=NO_POINTS, standing=NO_POINTS)
        elif not was_moving:
            return
        # What shows the wanted codes shows those of the pose again.
        self.frame_changed.emit()

    def _end_drag(self) -> None:
        if self._drag is not None:
            self._drag = None
            self._live.end_drag()
            if self._predicts and self.frame is not None and self.frame.prediction is None:
                # The predictor has come in the middle of the drag.
                self._live.follow(self.model, self.latent, self._predicts)

    def _begun(
        self, grip: Grip | Twist | None, pins: tuple[Pin, ...] = (), whole_body: bool = False
    ) -> Drag:
        from lcollision_core.posing import DragOptions

        # What a code's target leaves as it was stays, so that locks need no more than that.
        locked = frozenset() if grip is None else self.locked_domains
        options = DragOptions(
            solid=self.solid,
            strength=self.drag_strength,
            locked_domains=locked,
            standing=self.standing,
            whole_body=self.whole_body or whole_body,
        )
        return Drag(
            DragSession(self.model, self.latent, grip, pins, options, self.placement),
        )

    # Edits of the codes.

    @property
    def _wanted(self) -> FloatArray:
        codes = self._drag.codes if self._drag is not None and self._live.is_dragging else None
        return self.latent if codes is None else codes

    @property
    def _gesture_start(self) -> FloatArray:
        has_ended = self._drag is not None and self._drag.has_ended
        return self._wanted if has_ended else super()._gesture_start

    def _edit(self, label: str, latent: FloatArray, run: int | None = None) -> None:
        held, drag = self._gesture, self._drag
        is_same_run = self.solid and run is not None and held is not None and held.run == run
        if drag is not None and (
            drag.session.grip is not None or (drag.has_ended and not is_same_run)
        ):
            self._close_gesture()
        if not self.solid:
            super()._edit(label, latent, run)
            return
        if self._drag is None:
            is_own = self._gesture is None
            if is_own and latent.tobytes() == self.latent.tobytes():
                return
            if is_own:
                self._gesture = Gesture(label, self._state, run)
            self._drag = self._begun(None)
            self._drag.has_ended = is_own
        self._drag.codes = read_only(latent)
        self._live.drag(self._drag.session, latent, self._predicts)

    # Pins.

    @property
    def pins(self) -> tuple[Pin, ...]:
        """Patches that stay where they are while others are dragged."""
        return self.pose.pins

    def pin(self, grip: Grip, oriented: bool = False) -> None:
        """Pin a patch where it is; see `pin_grips`."""
        self.pin_grips([grip], f"Pin {self.part_name(grip.vertex)}", oriented)

    def pin_grips(self, grips: Sequence[Grip], label: str, oriented: bool = False) -> None:
        """Pin patches where they are, as one step; a pin on the same vertex is replaced.

        Parameters
        ----------
        oriented : their body parts keep their orientation too
        """
        from lcollision_core.model import MAX_PINS
        from lcollision_core.posing import Pin, frame_round

        frame = self.frame
        if frame is None:
            return
        is_late = frame.latent is not self.latent
        vertices = self.model.decode(self.latent, n_threads=1) if is_late else frame.vertices
        space = self.model.space
        added = {
            grip.vertex: Pin.of(grip, vertices, frame_round(space, grip.vertex) if oriented else ())
            for grip in grips
        }
        kept = [pin for pin in self.pins if pin.vertex not in added]
        pins = (*kept, *added.values())
        if len(pins) > MAX_PINS:
            self.message.emit(f"A pose has at most {counted(MAX_PINS, 'pin')}")
            return
        self._set_pins(label, pins)

    def is_pinned(self, vertex: int | None) -> bool:
        """Whether a pin is on a vertex."""
        return any(pin.vertex == vertex for pin in self.pins)

    def toggle_pin(self, vertex: int, oriented: bool = False) -> None:
        """Pin the patch round a vertex, of the present radius, or remove the pin on it.

        Parameters
        ----------
        oriented : its body part keeps its orientation too, also where it is pinned already
        """
        index = next((i for i, pin in enumerate(self.pins) if pin.vertex == vertex), None)
        if index is None or (oriented and not self.pins[index].frame):
            self.pin(self.grip_at(vertex), oriented)
        else:
            self.unpin(index)

    def unpin(self, index: int) -> None:
        """Remove one pin."""
        label = f"Unpin {self.part_name(self.pins[index].vertex)}"
        self._set_pins(label, self.pins[:index] + self.pins[index + 1 :])

    def unpin_all(self) -> None:
        """Remove all pins."""
        self._set_pins("Unpin all", ())

    def _set_pins(self, label: str, pins: tuple[Pin, ...]) -> None:
        self._close_gesture()
        self._push(label, replace(self._state, pose=replace(self.pose, pins=pins)))

    def domain_of(self, vertex: int) -> int:
        """Return the body part that leads a vertex, from 0."""
        return int(self.model.space.vertex_domain[vertex])

    def part_name(self, vertex: int) -> str:
        """Return the name of the body part that leads a vertex."""
        return self.model.domain_names[self.domain_of(vertex)]

    # The results of the worker.

    @Slot(object)
    def _on_frame_computed(self, frame: LiveFrame) -> None:
        self.frame = frame
        self.frame_changed.emit()
        if frame.verdict is not None and frame.latent is self.latent:
            self._on_verdict_computed(frame.verdict)

    @Slot(object)
    def _on_verdict_computed(self, verdict: ExactVerdict) -> None:
        self.exact = verdict
        self.exact_changed.emit()

    @Slot(object)
    def _on_dragged(self, frame: LiveFrame) -> None:
        """Adopt what a drag has reached as the pose."""
        drag = self._drag
        if drag is None:
            return
        state = self._state
        if frame.latent.tobytes() == self.latent.tobytes():
            state = replace(state, pose=replace(self.pose, latent=frame.latent))
        else:
            state = self._with_latent(frame.latent)
            if drag.pin is not None:
                index, grip = drag.pin
                pins = list(self.pins)
                pins[index] = pins[index].moved(grip, frame.vertices)
                state = replace(state, pose=replace(state.pose, pins=tuple(pins)))
        self.frame, self.exact = frame, frame.verdict
        self._adopted = frame.latent
        self._apply(state)
        self.frame_changed.emit()
        self.exact_changed.emit()

    @Slot()
    def _on_settled(self) -> None:
        if self._drag is not None and self._drag.has_ended:
            self._close_gesture()

    def _follow_latent(self) -> None:
        adopted, self._adopted = self._adopted, None
        if self.latent is adopted:
            return
        self._drag = None
        self._live.follow(self.model, self.latent, self._predicts)
        if self.exact is not None:
            self.exact = None
            self.exact_changed.emit()
