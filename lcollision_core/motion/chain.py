"""Free frames to start from: each next to the correction of its neighbour."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion.frames import Frames

_FLICKER = 10.0
"""Price of the change of the correction from frame to frame against that of the correction."""


def chain_corrections(
    frames: Frames, run: range, before: FloatArray | None = None
) -> dict[int, FloatArray]:
    """Resolve a run of colliding frames one after the other, forwards and backwards.

    Each frame is polished from its target plus the correction of its neighbour, not from its
    target, so that contacts keep to one side. The cheaper of the two directions counts.

    Parameters
    ----------
    frames : of the motion
    run : colliding frames
    before : (D,) correction of the frame before the run; None where that is free

    Returns
    -------
    corrections : (D,) by frame, of those that could be freed
    """
    forwards, backwards = frames.pool.map(
        lambda order: _chained(frames, *order), ((run, before), (reversed(run), None))
    )
    return min(forwards, backwards, key=lambda found: _cost(frames, run, found, before))


def _chained(
    frames: Frames, order: Iterable[int], near: FloatArray | None
) -> dict[int, FloatArray]:
    found: dict[int, FloatArray] = {}
    for frame in order:
        free = frames.resolved(frame, near)
        if free is not None:
            found[frame] = near = free - frames.motion.codes[frame]
    return found


def _cost(
    frames: Frames, run: range, found: dict[int, FloatArray], before: FloatArray | None
) -> tuple[int, float]:
    still = np.zeros(frames.motion.codes.shape[1])
    first = still if before is None else before
    rows = np.array([first, *(found.get(frame, still) for frame in run), still])
    cost = sum(
        weight * np.einsum("td,de,te->", moved, frames.metric, moved)
        for weight, moved in ((1.0, rows), (_FLICKER, np.diff(rows, axis=0)))
    )
    return len(run) - len(found), float(cost)
