"""Pins: patches of the body that stay where they are while others are dragged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, Signal

from app.editing.history import PoseHistory
from app.editing.motion import PoseMotion
from app.editing.naming import part_name
from app.wording import counted

if TYPE_CHECKING:
    from lcollision_core.posing import Grip, Pin


class Pins(QObject):
    """Sets and removes the pins of the working pose, each time as one step.

    Parameters
    ----------
    history : gets the steps
    motion : knows where the body is

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
        label : of the step; it names the body part of the first patch where ""
        oriented : their body parts keep their orientation too
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
        kept = [pin for pin in self._pins if pin.vertex not in added]
        pins = (*kept, *added.values())
        if len(pins) > MAX_PINS:
            self.message.emit(f"A pose has at most {counted(MAX_PINS, 'pin')}")
            return
        self._set(label or f"Pin {part_name(model, grips[0].vertex)}", pins)

    def has(self, vertex: int | None) -> bool:
        """Whether a pin is on a vertex."""
        return any(pin.vertex == vertex for pin in self._pins)

    def toggle(self, vertex: int, oriented: bool = False) -> None:
        """Pin the patch round a vertex, of the present radius, or remove the pin on it.

        Parameters
        ----------
        oriented : its body part keeps its orientation too, also where it is pinned already
        """
        pins = self._pins
        index = next((i for i, pin in enumerate(pins) if pin.vertex == vertex), None)
        if index is None or (oriented and not pins[index].frame):
            self.pin([self._motion.grip_at(vertex)], oriented=oriented)
        else:
            label = f"Unpin {part_name(self._history.model, vertex)}"
            self._set(label, pins[:index] + pins[index + 1 :])

    def remove_all(self) -> None:
        """Remove all pins."""
        self._set("Unpin all", ())

    @property
    def _pins(self) -> tuple[Pin, ...]:
        return self._history.pose.pins

    def _set(self, label: str, pins: tuple[Pin, ...]) -> None:
        self._history.close_gesture()
        state = self._history.state
        self._history.push(label, replace(state, pose=replace(state.pose, pins=pins)))
