"""Corrections of a motion by hand: a change of one frame, eased in and out over its neighbours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import ShapeError
from lcollision_core.motion.motion import Motion


def corrected(motion: Motion, frame: int, codes: npt.ArrayLike, easing: int) -> Motion:
    """Set one frame of a motion, and lead the frames round it there and back.

    A motion whose first and last frame are equal, as a cycle's, is eased across its seam and stays
    one.

    Parameters
    ----------
    motion : T frames
    frame : that is set
    codes : (D,) what it is set to
    easing : >= 0, frames on either side over which the change fades, on a raised cosine

    Returns
    -------
    corrected : all frames beyond those stay equal to the bit

    Raises
    ------
    ShapeError : another shape.
    """
    aim = np.asarray(codes, dtype=np.float64)
    if aim.shape != motion.codes.shape[1:]:
        raise ShapeError.must_be(
            "the corrected frame", f"shape {motion.codes.shape[1:]}", aim.shape
        )
    changed = np.array(motion.codes)
    reached = eased_frames(motion, frame, easing)
    change = aim - motion.codes[frame]
    for at, away in reached.items():
        changed[at] += (0.5 + 0.5 * np.cos(np.pi * away / (easing + 1))) * change
    # What was set is there to the bit.
    changed[[at for at, away in reached.items() if away == 0]] = aim
    return replace(motion, codes=changed)


def eased_frames(motion: Motion, frame: int, easing: int) -> dict[int, int]:
    """Return the frames that a correction of one reaches, and how far each is from it."""
    n = len(motion)
    near = {at: abs(at - frame) for at in range(max(0, frame - easing), min(n, frame + easing + 1))}
    if motion.is_cycle:
        # The last frame is the first of the next cycle.
        for at in range(n):
            away = min(abs(at - frame + cycle * (n - 1)) for cycle in (-1, 1))
            if away <= easing:
                near[at] = min(near.get(at, away), away)
    return near
