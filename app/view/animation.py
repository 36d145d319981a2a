"""What moves by itself for a moment: the mesh after Resolve, and the camera."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QEasingCurve, QObject, QVariantAnimation, Signal, Slot

from app.view.camera import View, between

TRANSITION_MILLISECONDS = 320
"""From the pose before Resolve to the one after."""

TURN_MILLISECONDS = 260
"""From one camera to another."""

Float32Array = npt.NDArray[np.float32]


class _Motion(QVariantAnimation):
    """Runs once from 0 to 1, slowly at both ends."""

    moved = Signal(object)

    def __init__(self, milliseconds: int, parent: QObject) -> None:
        super().__init__(parent)
        self.setStartValue(0.0)
        self.setEndValue(1.0)
        self.setDuration(milliseconds)
        self.setEasingCurve(QEasingCurve.Type.InOutCubic)
        self.valueChanged.connect(self._on_value_changed)

    @property
    def is_running(self) -> bool:
        """Whether the end has not been reached."""
        return self.state() is not QVariantAnimation.State.Stopped

    def at(self, share: float) -> object:
        """Return what `moved` tells at a share from 0 to 1 of the way."""
        return share

    @Slot(object)
    def _on_value_changed(self, share: float) -> None:
        # Setting the end values above counts as a change, too.
        if self.is_running:
            self.moved.emit(self.at(share))


class PoseTransition(_Motion):
    """Moves a mesh between two poses, each vertex along a line.

    Signals
    -------
    moved : (V, 3) float32 array; at the end the very array that was given
    """

    def __init__(self, parent: QObject) -> None:
        super().__init__(TRANSITION_MILLISECONDS, parent)
        self._from = self._to = np.zeros((0, 3), dtype=np.float32)

    def begin(self, from_vertices: npt.NDArray[Any], to_vertices: npt.NDArray[Any]) -> None:
        """Start anew.

        Parameters
        ----------
        from_vertices, to_vertices : (V, 3) arrays
        """
        self.stop()
        self._from = np.asarray(from_vertices, dtype=np.float32)
        self._to = np.asarray(to_vertices, dtype=np.float32)
        self.start()

    def at(self, share: float) -> Float32Array:
        """Return the mesh at a share of the way."""
        if share >= 1.0:
            return self._to
        between_poses: Float32Array = self._from + np.float32(share) * (self._to - self._from)
        return between_poses


class CameraTurn(_Motion):
    """Moves a camera round what it looks at.

    Signals
    -------
    moved : View
    """

    def __init__(self, parent: QObject) -> None:
        super().__init__(TURN_MILLISECONDS, parent)
        self._ends: tuple[View, View] | None = None

    def begin(self, from_view: View, to_view: View) -> None:
        """Start anew."""
        self.stop()
        self._ends = (from_view, to_view)
        self.start()

    def at(self, share: float) -> View | None:
        """Return the camera at a share of the way."""
        return between(*self._ends, share) if self._ends is not None else None
