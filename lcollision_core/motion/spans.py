"""Which frames of a motion a resolution may change: the colliding ones and those around them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def runs(mask: npt.NDArray[np.bool_]) -> list[range]:
    """Return the runs of True in a (T,) mask, in order."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [range(start, stop) for start, stop in edges.reshape(-1, 2).tolist()]


def colliding_spans(
    colliding: npt.NDArray[np.bool_], easing: int, within: range | None = None
) -> list[range]:
    """Return the spans of frames that may change: colliding ones, and `easing` on either side.

    Spans that would overlap or meet are one, and none goes beyond the frames `within`.
    """
    eased = colliding.copy()
    for run in runs(colliding):
        eased[max(0, run.start - easing) : run.stop + easing] = True
    if within is not None:
        eased[: within.start] = eased[within.stop :] = False
    return runs(eased)


def windows(span: range, length: int, overlap: int) -> list[range]:
    """Cut a long span into windows that are resolved one after the other.

    Each begins `overlap` frames before the end of the one before, which it corrects again.
    """
    starts = range(span.start, max(span.start + 1, span.stop - overlap), length - overlap)
    return [range(start, min(start + length, span.stop)) for start in starts]
