"""Which frames of a motion a resolution may change: the colliding ones and those around them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def runs(mask: npt.NDArray[np.bool_]) -> list[range]:
    """Return the runs of True in a (T,) mask, in order."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [range(start, stop) for start, stop in edges.reshape(-1, 2).tolist()]


def colliding_spans(
    colliding: npt.NDArray[np.bool_],
    easing: int,
    within: range | None = None,
    is_cycle: bool = False,
    barred: npt.NDArray[np.bool_] | None = None,
) -> list[range]:
    """Return the spans of frames that may change: colliding ones, and `easing` on either side.

    Spans that would overlap or meet are one, and none goes beyond the frames `within`.

    Parameters
    ----------
    colliding : (T,) mask
    easing : frames
    within : the frames that may change; all if None
    is_cycle : the first frame comes after the last, and its number is T there: a span across the
        seam goes on beyond it, and one of all frames begins where it is free, if there is such
    barred : (T,) mask, frames that may not change and are left aside though they collide
    """
    n = len(colliding)
    if barred is not None:
        colliding = colliding & ~barred
    turns = np.tile(colliding, 3 if is_cycle else 1)
    eased = turns.copy()
    for run in runs(turns):
        eased[max(0, run.start - easing) : run.stop + easing] = True
    if is_cycle:
        eased = eased[n : 2 * n]
    if within is not None:
        eased &= np.isin(np.arange(n), np.asarray(within) % n)
    if barred is not None:
        eased &= ~barred
    first = int(np.argmin(colliding if eased.all() else eased)) if is_cycle else 0
    spans = [range(first + run.start, first + run.stop) for run in runs(np.roll(eased, -first))]
    if barred is None:
        return spans
    # Nothing fades over frames behind those that are barred.
    return [span for span in spans if colliding[np.asarray(span) % n].any()]


def windows(span: range, length: int, overlap: int) -> list[range]:
    """Cut a long span into windows that are resolved one after the other.

    Each begins `overlap` frames before the end of the one before, which it corrects again.
    """
    starts = range(span.start, max(span.start + 1, span.stop - overlap), length - overlap)
    return [range(start, min(start + length, span.stop)) for start in starts]
