"""Measure how parts of a motion sink into a level ground, float above it or slide on it."""

from __future__ import annotations

from dataclasses import dataclass
from operator import itemgetter

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
        soles: dict[int, tuple[npt.NDArray[np.intp], FloatArray]] = {}
        n_standing = 0
        for frame, vertices in enumerate(placed_frames(motion, check)):
            heights = vertices @ axis - ground
            measures = [("sink", -float(heights[stands].min()))]
            parts = np.flatnonzero(standing[frame]).tolist()
            vertices_of_part = {part: np.flatnonzero(domain == part) for part in parts}
            vertices_of_part = {part: rows for part, rows in vertices_of_part.items() if len(rows)}
            n_standing += bool(vertices_of_part)
            soles = {part: place for part, place in soles.items() if part in vertices_of_part}
            for part, rows in vertices_of_part.items():
                lowest = float(heights[rows].min())
                measures.append(("gap", lowest))
                if part not in soles:
                    sole = rows[heights[rows] <= max(lowest, 0.0) + _SOLE]
                    soles[part] = sole, level @ vertices[sole].mean(axis=0)
                sole, place = soles[part]
                moved = level @ vertices[sole].mean(axis=0) - place
                measures.append(("slide", float(np.linalg.norm(moved))))
            for name, value in measures:
                worst[name] = max(worst[name], (value, frame), key=itemgetter(0))
        depths = {name: value for name, (value, _) in worst.items()}
        frames = {f"{name}_frame": frame for name, (_, frame) in worst.items()}
        return cls(n_standing, **depths, **frames)  # type: ignore[arg-type]
