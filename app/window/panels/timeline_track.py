"""Where the frames of a timeline lie, and what many of them show in one column of pixels."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from app.view.shading import FloatArray

IndexArray = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Track:
    """Where the frames lie: side by side, each in a cell of the same width.

    Attributes
    ----------
    left, width : of what is seen, in device-independent pixels
    first, span : what is seen, in frames
    n_frames : of the motion
    """

    left: float
    width: float
    first: float
    span: float
    n_frames: int

    @property
    def cell(self) -> float:
        """Width of a frame."""
        return self.width / self.span

    def x_of(self, place: float) -> float:
        """Return where a frame's cell begins; where its middle is, of half a frame more."""
        return self.left + (place - self.first) * self.cell

    def place_of(self, x: float) -> float:
        """Return the inverse of `x_of`."""
        return self.first + (x - self.left) / self.cell

    def frames_at(self, x: float) -> range:
        """Return the frames that share the pixel at `x`, or the nearest that is seen."""
        last = math.ceil(self.first + self.span - 1e-6) - 1
        inside = min(max(x, self.left), self.left + self.width)
        if self.cell < 1.0:
            inside = math.floor(inside)
        start = min(max(int(self.place_of(inside)), 0), last)
        stop = int(self.place_of(inside + 1.0)) if self.cell < 1.0 else start + 1
        return range(start, min(max(stop, start + 1), last + 1))

    def frame_before(self, x: float, frames: IndexArray, within: float) -> int | None:
        """Return which of some frames ends nearest to `x`, within a distance; None if none does."""
        away = np.abs(self.x_of(0.0) + (frames + 1) * self.cell - x)
        return int(frames[away.argmin()]) if away.min(initial=np.inf) <= within else None

    def is_seen(self, place: float) -> bool:
        """Return whether a place is in what is seen, or at its ends."""
        return -1e-6 <= place - self.first <= self.span + 1e-6

    def columns(self, n_columns: int) -> IndexArray:
        """Return where the frames of each of some columns begin, and where the last ends.

        A column that is narrower than a frame has one; otherwise each frame is in one column.

        Returns
        -------
        starts : (n_columns + 1,) array, ascending
        """
        places = self.first + np.arange(n_columns + 1) * (self.span / n_columns)
        starts = np.minimum(places.astype(np.intp), self.n_frames - 1)
        starts[-1] = min(max(math.ceil(places[-1]), starts[-2] + 1), self.n_frames)
        return starts


def by_column(reduce: np.ufunc, values: npt.NDArray[Any], starts: IndexArray) -> npt.NDArray[Any]:
    """Reduce the frames of each column to one value.

    Parameters
    ----------
    reduce : such as `np.fmax`
    values : (T,) array
    starts : (W + 1,) array of `Track.columns`

    Returns
    -------
    reduced : (W,) array
    """
    # Where two starts are the same frame, reduceat returns this one's value.
    reduced: npt.NDArray[Any] = reduce.reduceat(values[: starts[-1]], starts[:-1])
    return reduced


def round_up(value: float) -> float:
    """Return the smallest of 1, 2, 5, 10, 20, 50 ... and 0.5, 0.2, 0.1 ... that is no smaller."""
    power = 10.0 ** math.floor(math.log10(value) + 1e-9)
    # Not 0.30000000000000004 of 0.3, which would be beyond it.
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value * 0.999999)


def known_runs(values: FloatArray) -> Iterator[slice]:
    """Return the runs of values between those that are NaN."""
    known = np.concatenate([[False], np.isfinite(values), [False]])
    turns = np.flatnonzero(known[1:] != known[:-1])
    for start, stop in turns.reshape(-1, 2):
        yield slice(start, stop)
