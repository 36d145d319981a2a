"""Measure how parts of a motion sink into a level ground, float above it or slide on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion.motion import Motion, placed_frames, standing_parts
from lcollision_core.posing import ExactCheck

_SOLE = 0.005
"""Normalised height above a part's lowest vertex up to which vertices belong to its sole."""


@dataclass(frozen=True)
class GroundReport:
    """How a motion stands on the ground. Lengths are normalised; the names are those of the JSON.

    Attributes
    ----------
    standing_frames : number of frames in which a body part stands: near the ground, hardly moving
    sink, sink_frame : largest depth of a point below the ground, 0 for none, and its frame
    gap, gap_frame : largest height of the lowest point of a standing part above the ground
    slide, slide_frame : largest distance of a part along the ground from where it came to stand
    """

    standing_frames: int = 0
    sink: float = 0.0
    sink_frame: int = 0
    gap: float = 0.0
    gap_frame: int = 0
    slide: float = 0.0
    slide_frame: int = 0

    @classmethod
    def of(
        cls,
        motion: Motion,
        check: ExactCheck,
        up: npt.ArrayLike,
        ground: float,
        stands: npt.NDArray[np.bool_],
    ) -> GroundReport:
        """Measure a motion, frame by frame in bounded memory.

        Parameters
        ----------
        up : (3,) unit vector
        ground : its height along `up`, normalised
        stands : (V,) whether a vertex does not belong to the ground itself
        """
        domain = np.where(stands, check.space.vertex_domain, -1)
        standing, axis = standing_parts(motion, check, up, ground), np.asarray(up, np.float64)
        level = np.eye(3) - np.outer(axis, axis)
        worst = dict.fromkeys(("sink", "gap", "slide"), (0.0, 0))
        # For each standing part, the vertices of its sole and where their mean was at first.
        standing_vertices: dict[int, tuple[npt.NDArray[np.intp], FloatArray]] = {}
        n_standing = 0
        for frame, vertices in enumerate(placed_frames(motion, check)):
            heights = vertices @ axis - ground
            worst_values = [("sink", -float(heights[stands].min()))]
            parts = np.flatnonzero(standing[frame]).tolist()
            vertices_of_part = {part: np.flatnonzero(domain == part) for part in parts}
            vertices_of_part = {part: rows for part, rows in vertices_of_part.items() if len(rows)}
            n_standing += bool(vertices_of_part)
            standing_vertices = {
                part: place for part, place in standing_vertices.items() if part in vertices_of_part
            }
            for part, rows in vertices_of_part.items():
                lowest = float(heights[rows].min())
                worst_values.append(("gap", lowest))
                if part not in standing_vertices:
                    sole = rows[heights[rows] <= max(lowest, 0.0) + _SOLE]
                    standing_vertices[part] = sole, level @ vertices[sole].mean(axis=0)
                sole, place = standing_vertices[part]
                moved = level @ vertices[sole].mean(axis=0) - place
                worst_values.append(("slide", float(np.linalg.norm(moved))))
            for name, value in worst_values:
                worst[name] = max(worst[name], (value, frame), key=lambda one: one[0])
        depths = {name: value for name, (value, _) in worst.items()}
        frames = {f"{name}_frame": frame for name, (_, frame) in worst.items()}
        return cls(n_standing, **depths, **frames)  # type: ignore[arg-type]
