"""What is drawn of a motion beside its frame: the frames round it, and the path of a point."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pyvista as pv

from app.view.surface import Surface, actor_of

if TYPE_CHECKING:
    from app.view.palettes import Theme
    from app.work.frames import PoseFrame
    from lcollision_core.bodies import PosableBody

_OPACITY = 0.32
"""Of the nearest frame that shows through; the others fade."""


class MotionMarks:
    """Onion skins and a path, in one renderer.

    Skins before the playhead have the colour of what is free, those after it that of what invites:
    both differ in hue and in lightness.

    Parameters
    ----------
    renderer : drawn into
    model : of the frames
    theme : whose colours are used
    """

    def __init__(self, renderer: pv.Renderer, model: PosableBody, theme: Theme) -> None:
        self._renderer, self._model, self._theme = renderer, model, theme
        self._skins: list[tuple[Surface, pv.Actor]] = []
        self._path: pv.Actor | None = None

    def set_theme(self, theme: Theme) -> None:
        """Apply the colours of a theme, from the next time on."""
        self._theme = theme
        if self._path is not None:
            self._path.prop.color = theme.accent

    def show_skins(self, frames: Sequence[tuple[int, PoseFrame]]) -> None:
        """Let frames show through.

        Parameters
        ----------
        frames : how far each is from the playhead, and the frame; the nearest first
        """
        while len(self._skins) < len(frames):
            self._skins.append(self._new_skin())
        farthest = max((abs(by) for by, _ in frames), default=1)
        for number, (surface, actor) in enumerate(self._skins):
            is_shown = number < len(frames)
            actor.SetVisibility(is_shown)
            if not is_shown:
                continue
            by, frame = frames[number]
            surface.vertices[:], surface.normals[:] = frame.vertices, frame.normals
            surface.polydata.Modified()
            actor.prop.color = self._theme.free if by < 0 else self._theme.accent
            actor.prop.opacity = _OPACITY * (1.2 - abs(by) / farthest)

    def show_path(self, points: npt.NDArray[np.floating] | None) -> None:
        """Draw the path through (N, 3) points, in the data's unit; None for none."""
        if self._path is not None:
            self._renderer.RemoveActor(self._path)
            self._path = None
        if points is not None and len(points) > 1:
            line = pv.lines_from_points(points.astype(np.float32))
            self._path = actor_of(line, lighting=False, line_width=2.5, color=self._theme.accent)
            self._renderer.AddActor(self._path)

    def _new_skin(self) -> tuple[Surface, pv.Actor]:
        surface = Surface(self._model.faces, self._model.n_vertices)
        actor = actor_of(surface.polydata, ambient=0.5, diffuse=0.6, culling="back")
        actor.ForceTranslucentOn()
        self._renderer.AddActor(actor)
        return surface, actor
