"""How a motion was changed by its resolution, in the numbers that people judge it by."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion.motion import Motion
from lcollision_core.motion.standing import placed_frames
from lcollision_core.posing import ExactCheck

_STILL = 1e-9
"""Normalised: a frame none of whose vertices has moved farther is unchanged."""


@dataclass(frozen=True)
class MotionReport:
    """What a resolution did to a motion. Lengths are normalised.

    Attributes
    ----------
    mean_change : over the vertices of the frames that changed
    largest_change : of any vertex
    acceleration_ratio : mean squared second difference of the vertices after, over that before, in
        the frames that changed and those beside them; 1 where none did
    largest_jump : of the change of the correction from one frame to the next, the mean over the
        vertices
    foot_slide : the farthest that the mean of a standing part's change moves from one frame to the
        next
    """

    mean_change: float = 0.0
    largest_change: float = 0.0
    acceleration_ratio: float = 1.0
    largest_jump: float = 0.0
    foot_slide: float = 0.0

    @classmethod
    def of(
        cls,
        before: Motion,
        after: Motion,
        check: ExactCheck,
        standing: npt.NDArray[np.bool_] | None = None,
    ) -> MotionReport:
        """Measure a motion against itself as it was, frame by frame in bounded memory.

        Parameters
        ----------
        before, after : T frames each, at the same times
        check : of the body's poses
        standing : (T, K) bool, the parts that stood in each frame
        """
        domain, n_domains = check.space.vertex_domain, check.space.n_domains
        sizes = np.maximum(np.bincount(domain, minlength=n_domains), 1)
        changes, largest, jumps, slides = [], [], [0.0], [0.0]
        bends: list[tuple[float, float]] = []
        window: list[tuple[FloatArray, FloatArray]] = []
        last: FloatArray | None = None
        frames = zip(placed_frames(before, check), placed_frames(after, check), strict=True)
        for frame, (old, new) in enumerate(frames):
            moved = new - old
            lengths = np.linalg.norm(moved, axis=1)
            changes.append(float(lengths.mean()))
            largest.append(float(lengths.max()))
            if last is not None:
                step = moved - last
                jumps.append(float(np.linalg.norm(step, axis=1).mean()))
                if standing is not None and (feet := standing[frame] & standing[frame - 1]).any():
                    means = [np.bincount(domain, along, n_domains) / sizes for along in step.T]
                    slides.append(float(np.linalg.norm(means, axis=0)[feet].max()))
            last = moved
            window = [*window[-2:], (old, new)]
            if len(window) == 3:
                bends.append(tuple(_bend([pair[side] for pair in window]) for side in (0, 1)))  # type: ignore[arg-type]
        touched = np.array(largest) > _STILL
        near = touched.copy()
        near[1:] |= touched[:-1]
        near[:-1] |= touched[1:]
        old_bend, new_bend = (
            np.array([pair[side] for pair in bends])[near[1:-1]].sum() if bends else 0.0
            for side in (0, 1)
        )
        return cls(
            mean_change=float(np.mean(np.array(changes)[touched])) if touched.any() else 0.0,
            largest_change=max(largest),
            acceleration_ratio=float(new_bend / old_bend) if old_bend > 0.0 else 1.0,
            largest_jump=max(jumps),
            foot_slide=max(slides),
        )


def _bend(three: list[FloatArray]) -> float:
    """Return the mean squared second difference of three frames' vertices."""
    first, second = (after - before for before, after in pairwise(three))
    return float(((second - first) ** 2).sum(axis=1).mean())
